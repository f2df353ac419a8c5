"""The words for what is reported on: a lens or a mirror, Contents.optic."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

SIMULATED = {
    "lens": ["refraction at both faces (vector Snell)", "total internal reflection", "vignetting by the outline"],
    "mirror": ["reflection at the face, without loss", "vignetting by the outline"],
}
LEFT_OUT = {
    "lens": [
        "Fresnel reflection", "absorption in the glass", "dispersion", "size of the source", "stray light",
        "diffraction",
    ],
    "mirror": [
        "reflectance below 1", "shadows of the source and of the mirror on itself", "size of the source",
        "stray light", "diffraction",
    ],
}  # fmt: skip
WAYS = {  # of the light
    "lens": "Light travels along +z",
    "mirror": "Light comes down to the mirror along -z and leaves it along +z",
}
OF_GLASS = ("lost through the sides", "total internal reflection")  # lines of the ledger that a mirror cannot have


def turned(tilt: Sequence[float], number: Callable[[float], str]) -> str:
    """Of what a scene tilts by so many degrees about x, and then about y."""
    turns = (f"{number(angle)} degrees about {axis}" for angle, axis in zip(tilt, "xy", strict=True) if angle)
    return ", then ".join(turns) or "none"


def ledger(flux: Mapping[str, float], of: str) -> dict[str, float]:
    """The lines of a ledger as people read them."""
    lines = {line: part for line, part in flux.items() if of == "lens" or line not in OF_GLASS}
    return {line.replace("the lens", f"the {of}"): part for line, part in lines.items()}
