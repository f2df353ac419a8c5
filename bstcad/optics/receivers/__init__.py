"""Receivers of light: planes and directions, their pixels, and the goals on them."""
