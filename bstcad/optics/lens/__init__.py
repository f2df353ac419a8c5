"""Interfaces and their laws, media, losses, and the faces of a body in the order of the light."""
