"""Stages by which a lens comes about, their course, and the folder that is written whole and read back."""
