"""The prescription: every surface of a lens as it was designed, with source and target.

    the lens:    front at its vertex, glass, back at its vertex (where each crosses the axis)
    the signs:   light travels along +z; a radius is positive if its centre lies further along +z than its vertex

Numbers are the design's own, to the last bit: not those of the scene, whose radius may have been free and whose back
may have had to move, and not rounded.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch

from bstcad.optics.bspline import DEGREE
from bstcad.optics.lens import Lens
from bstcad.optics.media import density
from bstcad.report.units import exact, number, quantity, turned
from bstcad.report.vocabulary import WAYS
from bstcad.scene.scene import Scene

MOVED = 1e-3  # of the thickness that was drawn; by less the vertex moves in stage 2 anyhow
WIDTH = 30  # columns of the names in the text


@dataclass(frozen=True)
class Face:
    """One face of the lens."""

    kind: str  # "plane", "sphere", "conic" or "bspline"
    vertex: tuple[float, float, float]  # where it crosses the axis (mm)
    curvature: float | None  # 1/mm; 0 for a plane, None for a freeform face
    radius: float | None  # mm, 1 / curvature; None for a plane and a freeform face
    conic_constant: float | None = None  # None for what is no conic


@dataclass(frozen=True)
class Net:
    """The control net of the freeform face, as lens.step and design.npz list it."""

    control_points: tuple[int, int]  # along x and y, uniform in both
    degree: int
    knots: str  # in either direction, multiple ones repeated
    x: tuple[float, float]  # between which the net lies (mm); beyond the rim of a round lens
    y: tuple[float, float]


@dataclass(frozen=True)
class Prescription:
    """A lens with its source and its target; lengths in mm, angles in degrees, wavelengths in nm."""

    name: str
    title: str
    wavelength: float  # of several lines the main one
    material: str | None  # None: only the index is known, or it is a mirror
    index: float
    outline: dict[str, Any]
    clear: tuple[dict[str, Any], dict[str, Any]] | None  # clear apertures of front and back in the part; None: no mount
    front: Face
    back: Face
    reflects: bool  # is it a mirror, whose back is the face that light meets?
    net: Net
    back_asked: float  # z at which the scene has the back's vertex (mm)
    centre_thickness: float  # mm
    edge_thickness: tuple[float, float]  # least and greatest (mm)
    volume: float  # mm³
    mass: float | None  # g; None where the density of the material is not known
    source: dict[str, Any]
    target: dict[str, Any]


def prescription(scene: Scene, lens: Lens, shape: Mapping[str, Any]) -> Prescription:
    """Of `lens` as it was designed for `scene`; shape: of bstcad.analysis.shape, and the volume."""
    front = lens.front
    curvature = None if front.curvature is None else float(front.curvature)
    constant = front.parameters().get("conic_constant")
    material = scene.lens.material
    heavy, m = density(material) if material else None, lens.back.m
    return Prescription(
        name=scene.name,
        title=scene.title,
        wavelength=scene.source.main_wavelength,
        material=material,
        index=lens.index,
        outline=asdict(lens.outline),
        clear=lens.clear and tuple(map(asdict, lens.clear)),
        front=Face(
            kind=front.kind,
            vertex=(0.0, 0.0, float(front.z)),
            curvature=curvature,
            radius=1 / curvature if curvature else None,
            conic_constant=None if constant is None else float(constant),
        ),
        back=Face("bspline", vertex=(0.0, 0.0, vertex(lens)), curvature=None, radius=None),
        reflects=lens.reflects,
        net=Net((m, m), DEGREE, f"0, 0, 0, 1, 2, …, {m - 3}, {m - 2}, {m - 2}, {m - 2}", x=lens.back.x, y=lens.back.y),
        back_asked=scene.lens.back.z,
        centre_thickness=shape["centre_thickness"],
        edge_thickness=(shape["edge_thickness_min"], shape["edge_thickness_max"]),
        volume=shape["volume"],
        mass=None if heavy is None else shape["volume"] * heavy / 1000,
        source=_stated(asdict(scene.source)),
        target=_stated(scene.target.model_dump(mode="json")),
    )


def vertex(lens: Lens) -> float:
    """z (mm) where the back crosses the axis."""
    axis = torch.zeros(1, dtype=torch.float64)
    return float(lens.back.sag_and_slope(axis, axis)[0])


def moved(scene: Scene, lens: Lens) -> float:
    """By how much the back's vertex stands off lens.back.z (mm); 0 for the little that stage 2 does to every vertex."""
    by = vertex(lens) - scene.lens.back.z
    return by if abs(by) > MOVED * (scene.lens.back.z - scene.lens.front.z) else 0.0


def scene_text(scene: Scene, lens: Lens) -> str:
    """scene.toml beside `lens`, from which the same lens is designed again, with a note on the z of its back."""
    if not moved(scene, lens):
        return scene.toml()
    stands = f"as designed, the vertex of the back stands at z = {vertex(lens)!r} mm; it started at lens.back.z below"
    return f"# {stands}\n{scene.toml()}"


def _stated(table: Mapping[str, Any]) -> dict[str, Any]:
    """The entries that are not None."""
    return {key: value for key, value in table.items() if value is not None}


# --- for people -------------------------------------------------------------------------------------------------------


def sections(record: Prescription) -> list[tuple[str, list[tuple[str, str]]]]:
    """The prescription in words: (heading, [(name, value), …]), numbers in full."""
    moved = record.back.vertex[2] != record.back_asked
    asked = [("asked (lens.back.z)", f"{exact(record.back_asked)} mm")] if moved else []
    back = [*_face(record.back), *_clear(record, 1), *asked, *_net(record)]
    front = [*_face(record.front), *_clear(record, 0)]
    if record.reflects:
        mirror, rear = ("Mirror: the face that light meets", back), ("Rear of the plate", list(_face(record.front)))
        bodies = [mirror, rear, ("Plate", list(_body(record)))]
    else:
        glass = ("Glass", list(_glass(record)))
        bodies = [("Front: light enters", front), glass, ("Back: light leaves", back), ("Lens", list(_body(record)))]
    return [*bodies, ("Source", list(_rows(record.source))), ("Target", list(_rows(record.target)))]


def text(record: Prescription) -> str:
    """prescription.txt."""
    title = f": {record.title}" if record.title else ""
    lines = [
        f"Prescription of {record.name}{title}",
        "",
        "Lengths in mm, angles in degrees, wavelengths in nm.  The axis is x = y = 0.",
        f"{WAYS['mirror' if record.reflects else 'lens']}.",
        "A radius is positive if its centre lies further along +z than the vertex.",
        "The freeform back is exact in lens.step, and its control points are in design.npz.",
    ]
    for heading, rows in sections(record):
        lines += ["", heading, *(f"    {name:<{WIDTH}}{value}" for name, value in rows)]
    return "\n".join(lines) + "\n"


def _face(face: Face) -> Iterator[tuple[str, str]]:
    yield "kind", {"bspline": "freeform, B-spline"}.get(face.kind, face.kind)
    yield "vertex", "({})".format(", ".join(map(exact, face.vertex))) + " mm"
    if face.curvature is not None:
        yield "radius", "infinite" if face.radius is None else f"{exact(face.radius)} mm"
        yield "curvature", f"{exact(face.curvature)} 1/mm"
    if face.conic_constant is not None:
        yield "conic constant", exact(face.conic_constant)


def _clear(record: Prescription, face: int) -> Iterator[tuple[str, str]]:
    """The clear aperture of a face, 0 the front and 1 the back, that part.step leaves of it."""
    if record.clear is not None:
        yield from _rows({"clear aperture": record.clear[face]})


def _net(record: Prescription) -> Iterator[tuple[str, str]]:
    net = record.net
    yield "control points", " x ".join(map(str, net.control_points))
    yield "degree", f"{net.degree} x {net.degree}, not rational"
    yield "knots, in x and y", net.knots
    for axis, ends in (("x", net.x), ("y", net.y)):
        yield f"net in {axis}", " to ".join(map(exact, ends)) + " mm"


def _glass(record: Prescription) -> Iterator[tuple[str, str]]:
    yield "material", record.material or "not named"
    yield "refractive index", f"{exact(record.index)} at {number(record.wavelength)} nm"


def _body(record: Prescription) -> Iterator[tuple[str, str]]:
    yield from _rows({"outline": record.outline})
    yield "centre thickness", f"{exact(record.centre_thickness)} mm"
    yield "edge thickness", " to ".join(f"{edge:.6g}" for edge in record.edge_thickness) + " mm"
    yield "volume", quantity(record.volume, "mm³")
    yield "mass", "not known: the density is not" if record.mass is None else f"{number(record.mass)} g"


def _rows(table: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """A table of the scene by its own keys, `kind` first."""
    for key, value in sorted(table.items(), key=lambda row: row[0] != "kind"):
        if isinstance(value, Mapping):
            sizes = (f"{name} {_plain(part)}" for name, part in value.items() if name != "shape")
            yield key, ", ".join([value["shape"], *sizes] if "shape" in value else sizes)
        elif key == "wavelength" and isinstance(value, list | tuple):
            yield "lines", ", ".join(f"{_plain(nm)} nm (weight {_plain(weight)})" for nm, weight in value)
        else:
            yield key, turned(value, exact) if key == "tilt" else _plain(value)


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return exact(value)
    if isinstance(value, list | tuple):
        return ", ".join(map(_plain, value))
    return str(value)
