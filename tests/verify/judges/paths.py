"""Distance between two traces of the same rays, batoid's and ours, in position and optical path."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bstcad.optics.surfaces import sampling
from bstcad.optics.trace.trace import clear_window
from bstcad.optics.trace.wavefront_error import optical_path, path_from_reference


class PathsApart(NamedTuple):
    path: float  # mm, largest difference of the optical paths from source to plane
    place: float  # mm, largest distance of the places on the plane
    rays: int  # number of rays that both traces bring there


def paths_apart(lens, source, z, n=128):
    """Both traces on a plane z (mm), by n x n rays of a point or of parallel light.

    The clear apertures of the lens have to keep one and a half pitches inside the rims of its nets.  batoid counts the
    path of a ray from its start: from there to where `followed` begins ours leaves a part out.
    """
    import batoid

    from bstcad.verify.judges import batoid as judge

    lens, source = lens.plain(), source.central
    area = clear_window(source, lens)
    rays = source.rays_through(*sampling.grid(area, n), lens.entrance.z, area.area / n**2)
    ours, path, _ = optical_path(source, lens, rays, z)
    in_a_row = replace(rays, position=rays.position.reshape(3, -1), direction=rays.direction.reshape(3, -1))
    theirs = judge.through(lens, judge.surfaces(lens), in_a_row)
    batoid.intersect(batoid.Plane(), theirs, batoid.CoordSys(origin=[0.0, 0.0, z]))
    both = (ours.alive & (rays.flux > 0)).numpy().ravel() & ~theirs.failed & ~theirs.vignetted
    left_out = -path_from_reference(source, lens.entrance.z, rays, rays.sense)
    x, y, _ = (p.numpy().ravel() for p in ours.position)
    off = theirs.t - (left_out + path).numpy().ravel(), np.hypot(theirs.x - x, theirs.y - y)
    return PathsApart(*(float(np.abs(each[both]).max()) for each in off), rays=int(both.sum()))
