"""Surfaces, their nets and outlines, rays, and points over a face."""
