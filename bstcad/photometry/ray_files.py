"""Reading of ray files by their content: TM-25, Zemax, Speos and LightTools."""

from __future__ import annotations

from pathlib import PurePath

from bstcad.photometry import lighttools_rays, speos_rays, tm25, zemax_rays
from bstcad.photometry.intensity import PhotometricError
from bstcad.photometry.ray_set import RaySet
from bstcad.photometry.ray_table import Source, bytes_of

SUFFIXES = ".tm25ray", ".dat", ".sdf", ".ray"
HEAD = 512  # bytes by which a format is recognised


def read(name: str, source: Source) -> RaySet:
    """Return the rays of a file; PhotometricError if it cannot be used.

    The suffix of the name tells a ray file from others, the content its format: different programs write `.ray`.
    """
    if PurePath(name).suffix.lower() not in SUFFIXES:
        raise PhotometricError(f"is no ray file; give one of {', '.join(SUFFIXES)}")
    head = bytes_of(source)[:HEAD].tobytes()
    if head[: len(tm25.MAGIC)] == tm25.MAGIC:
        return tm25.read(source)
    if lighttools_rays.is_binary(head) or lighttools_rays.is_text(head):
        return lighttools_rays.read(source)
    if speos_rays.is_speos(head):
        return speos_rays.read(source)
    return zemax_rays.read(source)
