"""The lens that a STEP file holds, read by OCC; in a process of its own, since OCC may end it over a damaged file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Surface
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.Geom import Geom_BSplineSurface
from OCP.GeomAbs import GeomAbs_SurfaceType as Kind
from OCP.gp import gp_Pnt, gp_Vec
from OCP.IFSelect import IFSelect_RetDone
from OCP.Message import Message
from OCP.ShapeAnalysis import ShapeAnalysis_ShapeTolerance
from OCP.STEPControl import STEPControl_Reader
from OCP.TopAbs import TopAbs_FACE, TopAbs_Orientation, TopAbs_SOLID, TopAbs_VERTEX
from OCP.TopoDS import TopoDS, TopoDS_Face, TopoDS_Solid

from bstcad.cad import nurbs, patches, solid_edges, uv_maps
from bstcad.cad.solid_edges import AXIAL, parts_of
from bstcad.optics.bspline import SMALLEST_NET, BSplineSurface, knots, parameter
from bstcad.optics.lens import Lens
from bstcad.optics.outlines import Outline
from bstcad.optics.surfaces import Conic, Plane, Sphere, Surface

if TYPE_CHECKING:
    import cadquery

UNIFORM = 1e-9  # mm; a net further from uniform in x and y is not one of ours


@dataclass(frozen=True)
class StepLens:
    """A lens as one STEP file holds it; lengths in mm."""

    name: str  # of the file
    shape: TopoDS_Solid
    control_points: np.ndarray  # (m, m, 3), x along the first axis, as read from the OCC face
    knots_x: np.ndarray  # (m + 3,), full
    knots_y: np.ndarray
    front: Surface
    outline: Outline  # of the walls of a lens and no more; of others how far the edge of the back reaches
    edge: np.ndarray | None  # (n, 2) mm, once around the back, if its walls are not those of its outline
    surface: Geom_BSplineSurface  # the back face itself, for `sample`
    faces: tuple[TopoDS_Face, TopoDS_Face]  # front and back

    @property
    def clear(self) -> tuple[Outline, Outline]:
        """The clear apertures of front and back, by the edges of these faces; see solid_edges.clear."""
        return solid_edges.clear(*map(solid_edges.edge, self.faces))

    @property
    def solid(self) -> cadquery.Solid:
        """The solid for Workplane chains and assemblies."""
        import cadquery

        return cadquery.Solid(self.shape)


@dataclass(frozen=True)
class Samples:
    """Points of the re-read back face and its unit normals there, pointing out of the lens (+z)."""

    points: np.ndarray  # (n, 3) mm
    normals: np.ndarray  # (n, 3)


@contextmanager
def silence() -> Iterator[None]:
    """OCC prints no statistics, and no complaints about a file, inside the block."""
    messenger = Message.DefaultMessenger_s()
    printers = list(messenger.Printers())
    for printer in printers:
        messenger.RemovePrinter(printer)
    try:
        yield
    finally:
        for printer in printers:
            messenger.AddPrinter(printer)


def read(path: str | Path) -> StepLens:
    """The lens in a STEP file; ValueError in one sentence if OCC does not find exactly one there."""
    path = Path(path)
    found = solid(path)
    try:
        return _lens_in(found, path.name)
    except ValueError as error:
        raise ValueError(f"{path.name}: read by OCC: {error}") from error


def solid(path: Path) -> TopoDS_Solid:
    """The one solid in a STEP file, as OCC reads it; ValueError if there is not exactly one."""
    reader = STEPControl_Reader()
    with silence():
        if reader.ReadFile(str(path)) != IFSelect_RetDone:
            raise ValueError(f"{path.name}: OCC cannot read it, the file is damaged; write it again")
        reader.TransferRoots()
    shape = reader.OneShape()
    if shape.IsNull():
        raise ValueError(f"{path.name}: OCC finds no shape in it, the file is damaged; write it again")
    solids = parts_of(shape, TopAbs_SOLID)
    if len(solids) != 1:
        raise ValueError(f"{path.name}: OCC finds {len(solids)} solids in it, the file is damaged; write it again")
    return TopoDS.Solid_s(solids[0])


def _lens_in(solid: TopoDS_Solid, name: str) -> StepLens:
    surfaces = [(face, BRepAdaptor_Surface(face)) for face in map(TopoDS.Face_s, parts_of(solid, TopAbs_FACE))]
    nets = [(face, surface) for face, surface in surfaces if is_freeform(surface)]
    rest = [pair for pair in surfaces if not is_freeform(pair[1])]
    (face, back), given = _told_apart([(face, _plain(surface)) for face, surface in nets])
    net, (knots_x, knots_y) = nurbs.net_of(back), nurbs.knots_of(back)
    middle = (net[0, 0, :2] + net[-1, -1, :2]) / 2
    if not np.abs(middle).max() <= AXIAL:
        raise ValueError(f"the net of the back is centred at {middle} mm; centre the lens on the axis")
    if given is None:
        front, front_face, walls = _front_and_walls(rest)
    else:
        front, front_face, walls = _net_front(given[1]), given[0], [surface for _, surface in rest]
    outline = solid_edges.of_walls(walls)
    edge = solid_edges.edge(face) if outline is None else None
    outline = outline or solid_edges.around(edge)
    return StepLens(name, solid, net, knots_x, knots_y, front, outline, edge, back, (front_face, face))


def _corners(face: TopoDS_Face) -> list[tuple[float, float, float]]:
    """The vertices of a face (mm)."""
    points = (BRep_Tool.Pnt_s(TopoDS.Vertex_s(vertex)) for vertex in parts_of(face, TopAbs_VERTEX))
    return [(p.X(), p.Y(), p.Z()) for p in points]


def is_freeform(surface: BRepAdaptor_Surface) -> bool:
    """Has it a net larger than 3 x 3, which a conic or a nearly flat sphere is, and is no ruled wall?"""
    return _is_patch(surface) and surface.NbUPoles() * surface.NbVPoles() > 9


def _plain(surface: BRepAdaptor_Surface) -> Geom_BSplineSurface:
    net = surface.BSpline()
    m, n = net.NbUPoles(), net.NbVPoles()
    if (net.UDegree(), net.VDegree(), m) != (2, 2, n) or m < SMALLEST_NET or net.IsURational() or net.IsVRational():
        raise ValueError(
            f"the freeform face is of degree {net.UDegree()} x {net.VDegree()} on a net of {m} x {n}; "
            "bstcad reads plain squares of degree 2 x 2"
        )
    return net


def _told_apart(nets: list[tuple[TopoDS_Face, Geom_BSplineSurface]]) -> tuple[Any, Any]:
    """(the back and its net, the front and its or None) of the freeform faces: the back faces +z, the front -z."""
    if len(nets) == 1:
        return nets[0], None
    facing = [(_faces_up(*pair), pair) for pair in nets]
    if sorted(up for up, _ in facing) != [False, True]:
        raise ValueError(f"{len(nets)} B-spline faces; a lens has one, or two that face away from each other")
    return next(pair for up, pair in facing if up), next(pair for up, pair in facing if not up)


def _faces_up(face: TopoDS_Face, net: Geom_BSplineSurface) -> bool:
    point, du, dv = gp_Pnt(), gp_Vec(), gp_Vec()
    net.D1(*((full[0] + full[-1]) / 2 for full in nurbs.knots_of(net)), point, du, dv)
    return (du.Crossed(dv).Z() > 0) != (face.Orientation() == TopAbs_Orientation.TopAbs_REVERSED)


def _net_front(net: Geom_BSplineSurface) -> BSplineSurface:
    """A freeform front, its heights measured from where it crosses the axis."""
    return _spline("the front", nurbs.net_of(net), nurbs.knots_of(net)).from_vertex()


def freeform_surface(face: TopoDS_Face) -> BSplineSurface:
    """The height over (x, y) that a face with a large net is; ValueError if it is none of bstcad's."""
    return _net_front(BRepAdaptor_Surface(face).BSpline())


def _front_and_walls(rest: list) -> tuple[Surface, TopoDS_Face, list[BRepAdaptor_Surface]]:
    """The face across the axis, a plane z = const, a sphere on the axis or a patch of 3 x 3, and the other faces."""
    curved = [pair for pair in rest if pair[1].GetType() == Kind.GeomAbs_Sphere or _is_patch(pair[1])]
    level = [pair for pair in rest if _across(pair[1])]
    if len(level) > 1:  # those of a flange reach further, or look the other way
        level = sorted((pair for pair in level if not _looks_up(*pair)), key=_reach)
    chosen = next(iter([*curved, *level]), None)
    if chosen is None:
        raise ValueError("no plane, sphere or flat patch faces the light; give a file written by bstcad")
    face, surface = chosen
    kind = surface.GetType()
    if kind == Kind.GeomAbs_Sphere:
        front = _sphere(surface.Sphere(), _corners(face)[0][2])
    else:
        front = Plane(surface.Plane().Location().Z()) if kind == Kind.GeomAbs_Plane else _conic(surface.BSpline())
    return front, face, [pair[1] for pair in rest if pair is not chosen]


def _is_patch(surface: BRepAdaptor_Surface) -> bool:
    """Of 3 x 3, and no ruled wall."""
    return surface.GetType() == Kind.GeomAbs_BSplineSurface and min(surface.UDegree(), surface.VDegree()) > 1


def _across(surface: BRepAdaptor_Surface) -> bool:
    return surface.GetType() == Kind.GeomAbs_Plane and abs(surface.Plane().Axis().Direction().Z()) > 1 - AXIAL


def _looks_up(face: TopoDS_Face, surface: BRepAdaptor_Surface) -> bool:
    plane = surface.Plane()
    normal = plane.XAxis().Direction().Crossed(plane.YAxis().Direction())  # ∂u x ∂v, whatever the axis is
    return (normal.Z() > 0) != (face.Orientation() == TopAbs_Orientation.TopAbs_REVERSED)


def _reach(pair: tuple[TopoDS_Face, BRepAdaptor_Surface]) -> float:
    """How far from the axis a face reaches (mm)."""
    return float(np.hypot(*solid_edges.edge(pair[0]).T).max())


def _sphere(sphere: object, z_rim: float) -> Sphere:
    centre, radius = sphere.Location(), sphere.Radius()
    if max(abs(centre.X()), abs(centre.Y())) > AXIAL:
        raise ValueError(f"the sphere's centre is at ({centre.X():g}, {centre.Y():g}), off the axis; centre the lens")
    side = 1.0 if centre.Z() > z_rim else -1.0
    return Sphere(centre.Z() - side * radius, side / radius)


def _conic(patch: Geom_BSplineSurface) -> Sphere | Conic:
    """z0, c and k from the poles and weights of a patch of 3 x 3 (see faces.conic_net).

    Q = a² + b² of its half widths; with weights of mean 1 at the corner and in the middle, w = 1 ± K Q / 4 there,
    K = (1 + k) c², and z0 + c/2 Q / w and z0 - c/2 Q / w are their heights.  The parabola that a flat sphere is written
    as reads as that sphere.
    """
    net, weights = nurbs.net_of(patch), nurbs.weights_of(patch)
    if net.shape != (3, 3, 3) or (patch.UDegree(), patch.VDegree()) != (2, 2):
        raise ValueError("the front is a freeform patch; give a file written by bstcad")
    weights = weights / ((weights[0, 0] + weights[1, 1]) / 2)
    a, b, _ = ((net[-1, -1] - net[0, 0]) / 2 * weights[0, 0]).tolist()
    size, (corner, middle) = a * a + b * b, (float(weights[0, 0]), float(weights[1, 1]))
    c = float(net[0, 0, 2] - net[1, 1, 2]) * corner * middle / size
    z = float(net[0, 0, 2]) - c / 2 * size / corner
    bend = 2 * (corner - middle) / size
    found = Conic(z, c, bend / c**2 - 1) if c else Conic(z)
    poles, expected = patches.conic_net(found, a, b)
    if not (np.abs(poles - net).max() <= UNIFORM and np.abs(expected - weights).max() <= UNIFORM):
        raise ValueError("the front is a patch of 3 x 3 and no conic; give a file written by bstcad")
    flat = bend == 0 and abs(c) ** 3 * size**2 / 8 < 10 * uv_maps.PARABOLA  # a round one's patch is wider
    return Sphere(z, c) if flat else found


def sample(step_lens: StepLens, x: np.ndarray, y: np.ndarray) -> Samples:
    """The re-read back face at (x, y) (mm), evaluated by OCC.

    (u, v) comes from (x, y) by the closed form for uniform control points; the points' own x and y tell whether the
    file's net is that uniform.
    """
    net, m = step_lens.control_points, len(step_lens.control_points)
    (x0, y0, _), (x1, y1, _) = net[0, 0], net[-1, -1]
    u = parameter(torch.from_numpy((np.asarray(x, float) - x0) * ((m - 1) / (x1 - x0))).clamp(0, m - 1), m)
    v = parameter(torch.from_numpy((np.asarray(y, float) - y0) * ((m - 1) / (y1 - y0))).clamp(0, m - 1), m)
    out = points_and_tangents(step_lens.surface, u.ravel().tolist(), v.ravel().tolist())
    normals = np.cross(out[:, 1], out[:, 2])
    return Samples(out[:, 0], normals / np.linalg.norm(normals, axis=1, keepdims=True))


def points_and_tangents(surface: Any, u: list[float], v: list[float]) -> np.ndarray:
    """(n, 3, 3) of a surface of OCC's at each (u, v): the point (mm) and the derivatives in u and in v."""
    return np.fromiter(_evaluated(surface, u, v), np.dtype((float, 3)), 3 * len(u)).reshape(-1, 3, 3)


def _evaluated(surface: Any, u: list[float], v: list[float]) -> Iterator[tuple[float, ...]]:
    p, du, dv = gp_Pnt(), gp_Vec(), gp_Vec()
    evaluate, point, along_u, along_v = surface.D1, p.Coord, du.Coord, dv.Coord
    for s, t in zip(u, v, strict=True):
        evaluate(s, t, p, du, dv)
        yield point()
        yield along_u()
        yield along_v()


def is_valid(solid: TopoDS_Solid) -> bool:
    """Does OCC find the re-read solid valid?"""
    return BRepCheck_Analyzer(solid).IsValid()


def gaps(solid: TopoDS_Solid) -> float:
    """The largest tolerance (mm) of an edge or vertex of the re-read solid.

    OCC's reader calls a solid valid whose curves miss the faces, and writes down here how far.
    """
    return ShapeAnalysis_ShapeTolerance().Tolerance(solid, 1)


def back_surface(step_lens: StepLens) -> BSplineSurface:
    """The re-read back face as our noun (float64), for tracing; ValueError if its net or knots are not uniform."""
    return _spline(f"{step_lens.name}: read by OCC", step_lens.control_points, (step_lens.knots_x, step_lens.knots_y))


def _spline(name: str, net: np.ndarray, full_knots: tuple[np.ndarray, np.ndarray]) -> BSplineSurface:
    m = len(net)
    for axis, full in zip("xy", full_knots, strict=True):
        off = np.abs(full - knots(m))
        if off.max() > 1e-12 * m:
            worst = f"{knots(m)[off.argmax()]:g} is {full[off.argmax()]:.15g}"
            raise ValueError(f"{name}: knots in {axis} are not 0 … {m - 2} ({worst}); give a file written by bstcad")
    x, y = (float(net[0, 0, 0]), float(net[-1, -1, 0])), (float(net[0, 0, 1]), float(net[-1, -1, 1]))
    uniform = np.stack(np.meshgrid(np.linspace(*x, m), np.linspace(*y, m), indexing="ij"), axis=-1)
    off = np.abs(net[..., :2] - uniform).max(axis=-1)
    if not off.max() <= UNIFORM:
        i, j = divmod(int(off.argmax()), m)
        raise ValueError(
            f"{name}: control points {off.max():.1e} mm off a uniform grid, the worst at ({i}, {j}); "
            "give a file written by bstcad"
        )
    return BSplineSurface.from_control_points(net)


def lens(step_lens: StepLens, index: float) -> Lens:
    """The lens of the file, of this refractive index, for tracing."""
    return Lens(step_lens.front, back_surface(step_lens), step_lens.outline, index)
