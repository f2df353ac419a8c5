"""Intersection and refraction at height fields by their slopes, as textbooks write them, instead of by normals."""

from bstcad.optics.lens import interfaces


def intersect(surface, rays, outline, missed):
    """Return (rays at the surface, ∂z/∂x, ∂z/∂y)."""
    at, (n_x, n_y, n_z) = interfaces.intersect(surface, rays, outline, missed)
    return at, -n_x / n_z, -n_y / n_z


def deflect(rays, z_x, z_y, law):
    """Refract or reflect rays at a surface of slopes z_x and z_y."""
    return interfaces.deflect(rays, interfaces.normal_of(z_x, z_y), law)
