"""Reading of the lens in a STEP file by OCC, in a second process, because a damaged file may crash OCC.

A lens that another program has moved is read in its own frame, in which its axis is z and its back faces +z, together
with the placement of this frame in the file.  The outline follows from the walls or from the edge of the back, the
clear apertures from the edges of both faces.  Edges are compared with the faces that they bound, because OCC's own
checks examine only a few points of an edge, and accept a solid whose rim runs the wrong way around its circle.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve, BRepAdaptor_Curve2d, BRepAdaptor_Surface
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.BRepTools import BRepTools, BRepTools_WireExplorer
from OCP.Geom import Geom_BSplineSurface
from OCP.GeomAbs import GeomAbs_SurfaceType as Kind
from OCP.gp import gp_Pnt, gp_Trsf, gp_Vec
from OCP.IFSelect import IFSelect_RetDone
from OCP.Message import Message
from OCP.ShapeAnalysis import ShapeAnalysis_ShapeTolerance
from OCP.STEPControl import STEPControl_Reader
from OCP.StepShape import StepShape_FaceSurface
from OCP.TopAbs import TopAbs_EDGE, TopAbs_FACE, TopAbs_Orientation, TopAbs_ShapeEnum, TopAbs_SOLID, TopAbs_VERTEX
from OCP.TopExp import TopExp
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS, TopoDS_Face, TopoDS_Shape, TopoDS_Solid
from OCP.TopTools import TopTools_IndexedMapOfShape

from bstcad.cad import patches
from bstcad.cad.radial_nets import radial_surface
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import BACK, FRONT
from bstcad.optics.surfaces.bspline import BSplineSurface, knots, position, require_net
from bstcad.optics.surfaces.outlines import Circle, Outline, Rectangle, Rounded
from bstcad.optics.surfaces.sides import MIN_SIDE
from bstcad.optics.surfaces.surfaces import Conic, Plane, Recess, Sphere, Surface, sag
from bstcad.step_text.placement import Placement, identity, own_frame

GRID_TOLERANCE = 1e-9  # largest deviation (mm) of a net from a uniform grid in x and y, or from the net of a conic
AXIAL_TOLERANCE = 1e-9  # largest offset (mm) of a surface from the axis, and largest 1 - cosine of its tilt
CIRCLE_TOLERANCE = 1e-6  # largest deviation (mm) of an edge from its circle or rectangle
LEVEL_TOLERANCE = 1e-7  # largest distance (mm) of the plane around a front from the front's edge
APERTURE_DECIMALS = 9  # decimals of a clear aperture (mm); further ones are rounding errors of the coordinates
POINTS_PER_EDGE = 129  # number of points sampled along each edge of a face
POINTS_PER_SPAN = 4  # number of points sampled on an edge per knot span of a net, so that a wrong pole is detected

OccFace = tuple[TopoDS_Face, BRepAdaptor_Surface]


class StatedFace(NamedTuple):
    """Statements of a file on one face, which OCC reads without using them or corrects silently."""

    name: str  # name of the face; "": none
    consistent: bool  # True if its sense, .T. or .F., agrees with the directions of its edges


class StatedSolid(NamedTuple):
    """A solid as read from a STEP file, and what the file states on its faces."""

    shape: TopoDS_Solid
    faces: tuple[StatedFace, ...]  # statements on the faces, in the order of parts_of(shape, TopAbs_FACE)


class ReadFace(NamedTuple):
    """A face of a lens as read from a STEP file."""

    shape: TopoDS_Face
    surface: Surface


@dataclass(frozen=True)
class StepLens:
    """A lens as read from a STEP file, in its own frame; lengths in mm."""

    shape: TopoDS_Solid  # solid in the frame of the lens
    control_points: np.ndarray  # control points of the back as read by OCC, (m, n, 3), x along the first axis
    faces: dict[str, ReadFace]  # faces of the lens by name, in the order of Lens.faces
    outline: Outline  # outline of a bare lens; with other walls, the circle or rectangle around the back's edge
    edge: np.ndarray | None  # points along the edge of the back, (n, 2), mm; None: a bare lens
    placement: Placement = field(default_factory=identity)  # placement of the lens's frame in the file
    stated: tuple[StatedFace, ...] = ()  # statements on the faces of `shape`, as in StatedSolid

    @property
    def front(self) -> Surface:
        """Lowest surface."""
        return self.faces[FRONT].surface

    @property
    def back(self) -> BSplineSurface:
        """Highest surface, which is a net."""
        return require_net(self.faces[BACK].surface)

    @property
    def misnamed(self) -> str:
        """First name of one of `faces` that the file gives to another face, in words; "" if there is none."""
        for face, (name, _) in zip(parts_of(self.shape, TopAbs_FACE), self.stated, strict=True):
            if name in self.faces and not face.IsSame(self.faces[name].shape):
                roles = (role for role, other in self.faces.items() if face.IsSame(other.shape))
                own = next((f"the {role}" for role in roles), "another face")
                return f"the file gives the name '{name}' to {own}"
        return ""

    @property
    def clear(self) -> tuple[Outline, Outline]:
        """Clear apertures of front and back, from the edges of the two faces; see `clear_apertures`."""
        if self.front.chart != self.back.chart:
            return self.front.outline or Circle(_farthest(self.faces[FRONT].shape)), self.outline
        front, back = clear_apertures(*(outer_edge(face.shape) for face in self.faces.values()))
        return self.front.outline or front, back


@contextlib.contextmanager
def quiet_occ() -> Iterator[None]:
    """Suppress the messages that OpenCASCADE prints inside the `with` block."""
    messenger = Message.DefaultMessenger_s()
    printers = list(messenger.Printers())
    for printer in printers:
        messenger.RemovePrinter(printer)
    try:
        yield
    finally:
        for printer in printers:
            messenger.AddPrinter(printer)


def parts_of(shape: TopoDS_Shape, kind: TopAbs_ShapeEnum) -> list[TopoDS_Shape]:
    """Return the solids, faces, edges or vertices of a shape, each once, without cadquery (its import takes 1.4 s)."""
    parts = TopTools_IndexedMapOfShape()
    TopExp.MapShapes_s(shape, kind, parts)
    return [parts(i) for i in range(1, parts.Extent() + 1)]


def solid(path: Path) -> StatedSolid:
    """Read the solid in a STEP file; ValueError if there is not exactly one."""
    reader = STEPControl_Reader()
    with quiet_occ():
        if reader.ReadFile(str(path)) != IFSelect_RetDone:
            raise ValueError(f"{path.name}: OpenCASCADE cannot read this damaged file; write it again")
        reader.TransferRoots()
    shape = reader.OneShape()
    solids = [] if shape.IsNull() else parts_of(shape, TopAbs_SOLID)
    if len(solids) != 1:
        raise ValueError(f"{path.name}: OpenCASCADE finds {len(solids)} solids instead of one; write it again")
    return StatedSolid(TopoDS.Solid_s(solids[0]), tuple(_stated_faces(reader, solids[0])))


def _stated_faces(reader: STEPControl_Reader, shape: TopoDS_Shape) -> Iterator[StatedFace]:
    """Yield the statements on each face; where sense and edges contradict each other, OCC reverses the face."""
    transfer = reader.WS().TransferReader()
    for face in parts_of(shape, TopAbs_FACE):
        stated = transfer.EntityFromShapeResult(face, 1)
        if not isinstance(stated, StepShape_FaceSurface):  # a face that OCC has divided
            yield StatedFace("", True)
            continue
        name, forward = "", face.Orientation() != TopAbs_Orientation.TopAbs_REVERSED
        with contextlib.suppress(UnicodeDecodeError, AttributeError):  # AttributeError: the face has no name
            name = stated.Name().ToCString()
        yield StatedFace(name, forward == stated.SameSense())


def read(path: str | Path, stated: StatedSolid | None = None) -> StepLens:
    """Read the lens in a STEP file; ValueError unless the file has one lens.  stated: its solid, if already read."""
    path = Path(path)
    try:
        shape, faces = stated or solid(path)
        found, placement = in_own_frame(shape)
        return replace(_lens_in(found), placement=placement, stated=faces)
    except ValueError as error:
        raise ValueError(f"{path.name}: read by OpenCASCADE: {error}") from error


def lens(step_lens: StepLens, index: float) -> Lens:
    """Return the lens of a file, with a refractive index, for ray tracing."""
    return Lens.between(step_lens.front, step_lens.back, step_lens.outline, index)


def is_valid(solid: TopoDS_Solid) -> bool:
    """True if OCC finds a re-read solid valid."""
    return BRepCheck_Analyzer(solid).IsValid()


def gaps(solid: TopoDS_Solid) -> float:
    """Return the largest tolerance (mm) in a solid; OCC's reader raises tolerances until curves meet faces."""
    return ShapeAnalysis_ShapeTolerance().Tolerance(solid, 1)


# ---- own frame ----------------------------------------------------------------------------------------------------


def in_own_frame(solid: TopoDS_Solid) -> tuple[TopoDS_Solid, Placement]:
    """Return the solid of a lens in the frame of the lens, and the placement of that frame in the file.

    The frame of the lens is the frame in which the file defines the solid, if the back is a height z(x, y) there.
    Otherwise, it is the frame of the back's net.  A solid without a freeform back keeps the frame of its definition.
    """
    stated = _placement(solid.Location())
    defined = TopoDS.Solid_s(solid.Located(TopLoc_Location()))
    back = _back_face(_freeform_faces(_faces(defined)))
    if back is None:
        return defined, stated
    face, surface = back
    frame = own_frame(patches.net_of(surface.BSpline()))
    if not frame.moves:
        return defined, stated
    if not _looks_along_net(face):
        why = "its freeform face points against the normal u x v of the net, as in a mirror image"
        raise ValueError(f"{why}; export the lens as bstcad wrote it")
    return TopoDS.Solid_s(defined.Moved(_location(frame.inverse))), stated.after(frame)


def _placement(location: TopLoc_Location) -> Placement:
    if location.IsIdentity():
        return identity()
    motion = location.Transformation()
    rows = np.array([[motion.Value(i, j) for j in range(1, 5)] for i in range(1, 4)])
    return Placement(rows[:, :3], rows[:, 3])


def _location(placement: Placement) -> TopLoc_Location:
    motion = gp_Trsf()
    motion.SetValues(*np.column_stack([placement.rotation, placement.shift]).ravel().tolist())
    return TopLoc_Location(motion)


# ---- back and front ------------------------------------------------------------------------------------------------


def _lens_in(solid: TopoDS_Solid) -> StepLens:
    faces = _faces(solid)
    nets = _freeform_faces(faces)
    if (found := _back_face(nets)) is None:
        raise ValueError(f"it has {len(nets)} freeform faces; give a lens with one, or two facing opposite ways")
    (back_face, back), fronts = found, [face for face in nets if face is not found]
    net = patches.net_of(back.BSpline())
    back_surface = _uniform_net(back, net)
    x, y = (sum(ends) / 2 for ends in (back_surface.x, back_surface.y))
    if not max(abs(x), abs(y)) <= AXIAL_TOLERANCE:
        raise ValueError(f"the net of the back is centred at ({x:g}, {y:g}) mm; centre the lens on the axis")
    rest = [face for face in faces if face not in nets]
    chosen = fronts[0] if fronts else _front_face(rest)
    others = [face for face in rest if face[0] is not chosen[0]]
    front = freeform_surface(chosen[0]) if fronts else _front_surface(*chosen, others)
    if front.outline is not None:
        others = [face for face in others if not _is_level(face[1], front.around.z)]
    walls = [surface for _, surface in others]
    outline, edge = _outline_of_walls(walls), None
    if not back_surface.chart.flat:
        outline = _outline_in_chart(back_face, back_surface)
        edge = (
            None if all(wall.GetType() == Kind.GeomAbs_SurfaceOfExtrusion for wall in walls) else outer_edge(back_face)
        )
    elif outline is None:
        edge = outer_edge(back_face)
        outline = _bounding_outline(edge)
    found_faces = {FRONT: ReadFace(chosen[0], front), BACK: ReadFace(back_face, back_surface)}
    return StepLens(solid, net, found_faces, outline=outline, edge=edge)


def _faces(solid: TopoDS_Solid) -> list[OccFace]:
    return [(face, BRepAdaptor_Surface(face)) for face in map(TopoDS.Face_s, parts_of(solid, TopAbs_FACE))]


def _freeform_faces(faces: Sequence[OccFace]) -> list[OccFace]:
    return [face for face in faces if is_freeform(face[1])]


def _back_face(nets: Sequence[OccFace]) -> OccFace | None:
    """Return the only freeform face, or of two the only one that points along its net's normal; None: there is none."""
    backs = [face for face in nets if len(nets) == 1 or _looks_along_net(face[0])]
    return backs[0] if len(backs) == 1 and len(nets) <= 2 else None


def _looks_along_net(face: TopoDS_Face) -> bool:
    """True if the outward normal of a face is ∂u x ∂v of its surface, as on the back of a lens."""
    return face.Orientation() != TopAbs_Orientation.TopAbs_REVERSED


def is_freeform(surface: BRepAdaptor_Surface) -> bool:
    """True for a B-spline that is not a ruled wall, with more control points than the 3 x 3 of conics and parabolas."""
    return _is_patch(surface) and surface.NbUPoles() * surface.NbVPoles() > 9


def _is_patch(surface: BRepAdaptor_Surface) -> bool:
    return surface.GetType() == Kind.GeomAbs_BSplineSurface and min(surface.UDegree(), surface.VDegree()) > 1


def freeform_surface(face: TopoDS_Face) -> BSplineSurface:
    """Return the surface of a face, heights from its vertex; ValueError unless its net is as bstcad writes nets."""
    surface = BRepAdaptor_Surface(face)
    found = _uniform_net(surface, patches.net_of(surface.BSpline()))
    return found.from_vertex() if found.chart.flat else found


def _uniform_net(surface: BRepAdaptor_Surface, net: np.ndarray) -> BSplineSurface:
    """Return the surface of a net of degree 2 x 2 with uniform knots, of heights or of distances from a centre.

    Raises ValueError unless x and y of the control points are uniform, or their directions are those of a radial net.
    """
    patch = surface.BSpline()
    (m, n), degrees = (patch.NbUPoles(), patch.NbVPoles()), (patch.UDegree(), patch.VDegree())
    if degrees != (2, 2) or min(m, n) < MIN_SIDE or patch.IsURational() or patch.IsVRational():
        raise ValueError(
            f"the freeform face has degree {degrees[0]} x {degrees[1]} and a net of {m} x {n}; "
            "give a file written by bstcad, with a net of degree 2 x 2 without weights"
        )
    for axis, full, count in zip("xy", patches.knots_of(patch), (m, n), strict=True):
        off = np.abs(full - knots(count))
        if off.max() > 1e-12 * count:
            worst = f"knot {knots(count)[off.argmax()]:g} is {full[off.argmax()]:.15g}"
            raise ValueError(f"knots in {axis} are not 0 … {count - 2} ({worst}); give a file written by bstcad")
    found = BSplineSurface.from_control_points(net)
    off = np.abs(net - found.control_points())[..., :2].max(axis=-1)
    if not off.max() <= GRID_TOLERANCE:
        with contextlib.suppress(ValueError):
            return radial_surface(net)
        i, j = divmod(int(off.argmax()), n)
        raise ValueError(
            f"control points deviate by up to {off.max():.1e} mm from a uniform grid, most at point ({i}, {j}), "
            "counted from 0, and are no radial net about the axis; give a file written by bstcad"
        )
    return found


def _looks_up(face: TopoDS_Face, surface: BRepAdaptor_Surface) -> bool:
    """True if the outward normal of a face points towards +z at the centre of its parameter range."""
    u = (surface.FirstUParameter() + surface.LastUParameter()) / 2
    v = (surface.FirstVParameter() + surface.LastVParameter()) / 2
    [[_, along_u, along_v]] = points_and_tangents(surface, [u], [v])
    return (np.cross(along_u, along_v)[2] > 0) != (face.Orientation() == TopAbs_Orientation.TopAbs_REVERSED)


def _front_face(rest: Sequence[OccFace]) -> OccFace:
    """Return the face of a front without a net: a sphere or patch of 3 x 3, else the smallest plane that faces -z."""
    planes = [face for face in rest if face[1].GetType() == Kind.GeomAbs_Plane]
    level = [face for face in planes if abs(face[1].Plane().Axis().Direction().Z()) > 1 - AXIAL_TOLERANCE]
    if len(level) > 1:
        facing_down = (face for face in level if not _looks_up(*face))
        level = sorted(facing_down, key=lambda face: float(np.hypot(*outer_edge(face[0]).T).max()))
    curved = [face for face in rest if face[1].GetType() == Kind.GeomAbs_Sphere or _is_patch(face[1])]
    if not (curved or level):
        raise ValueError("it has no plane, sphere or conic as a front; give a file written by bstcad")
    return (curved or level)[0]


def _front_outline(front: Sphere | Conic, face: TopoDS_Face, others: Sequence[OccFace]) -> Circle | None:
    """Return the outline of a curved front with a plane z = const, one of `others`, around it; None: there is none."""
    edge = _bounding_outline(outer_edge(face))
    if front.level or not isinstance(edge, Circle):
        return None
    rim = Circle(round(edge.radius, APERTURE_DECIMALS))
    z = Recess(front, rim).around.z
    return rim if any(_is_level(surface, z) and not _looks_up(other, surface) for other, surface in others) else None


def _is_level(surface: BRepAdaptor_Surface, z: float) -> bool:
    if surface.GetType() != Kind.GeomAbs_Plane:
        return False
    plane = surface.Plane()
    return abs(plane.Axis().Direction().Z()) > 1 - AXIAL_TOLERANCE and abs(plane.Location().Z() - z) <= LEVEL_TOLERANCE


def _front_surface(face: TopoDS_Face, surface: BRepAdaptor_Surface, others: Sequence[OccFace]) -> Surface:
    """Return the surface of a front without a net, with an outline if a plane surrounds it.  others: other faces."""
    if surface.GetType() == Kind.GeomAbs_Plane:
        return Plane(surface.Plane().Location().Z())
    curved = _sphere(face, surface) if surface.GetType() == Kind.GeomAbs_Sphere else _conic(surface.BSpline())
    own = _front_outline(curved, face, others)
    return curved if own is None else Recess(curved, own)


def _sphere(face: TopoDS_Face, surface: BRepAdaptor_Surface) -> Sphere:
    centre, radius = surface.Sphere().Location(), surface.Sphere().Radius()
    if max(abs(centre.X()), abs(centre.Y())) > AXIAL_TOLERANCE:
        raise ValueError(f"the sphere's centre, ({centre.X():g}, {centre.Y():g}) mm, is off the axis; centre the lens")
    rim = BRep_Tool.Pnt_s(TopoDS.Vertex_s(parts_of(face, TopAbs_VERTEX)[0]))
    side = 1.0 if centre.Z() > rim.Z() else -1.0
    return Sphere(centre.Z() - side * radius, side / radius)


def _conic(patch: Geom_BSplineSurface) -> Sphere | Conic:
    """Return the conic with the poles and weights of a patch of 3 x 3 (see patches.conic_net).

    Let Q = a² + b² for half widths a and b, and scale the weights at corner and centre to the mean 1.  They are then
    w = 1 ± K Q / 4 (+ at the corner) with K = (1 + k) c², and the poles there have z = z0 ± c/2 Q / w.  The parabola
    that represents a nearly flat sphere is read as the sphere.
    """
    net, weights = patches.net_of(patch), patches.weights_of(patch)
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
    if not (np.abs(poles - net).max() <= GRID_TOLERANCE and np.abs(expected - weights).max() <= GRID_TOLERANCE):
        raise ValueError("the front is a patch of 3 x 3 but not a conic; give a file written by bstcad")
    deviation = abs(c) ** 3 * size**2 / 8  # deviation of the sphere from its parabola at the patch's corner
    return Sphere(z, c) if bend == 0 and deviation < 10 * patches.PARABOLA_TOLERANCE else found


def sample(step_lens: StepLens, x: np.ndarray, y: np.ndarray, *, of: str = BACK) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) of a re-read net at (x, y) (mm), evaluated by OCC, and its unit normals towards +z.

    of: name of the face, which is a net.  (u, v) are computed from (x, y) with the closed form for uniform
    control points; x and y of the returned points show whether the net of the file is uniform.
    """
    face = step_lens.faces[of]
    u, v = patches.net_parameters(require_net(face.surface))(np.ravel(x), np.ravel(y)).T.tolist()
    found = points_and_tangents(BRepAdaptor_Surface(face.shape).BSpline(), u, v)
    normals = np.cross(found[:, 1], found[:, 2])
    return found[:, 0], normals / np.linalg.norm(normals, axis=1, keepdims=True)


def points_and_tangents(surface: Any, u: Sequence[float], v: Sequence[float]) -> np.ndarray:
    """Return the point (mm) and the derivatives in u and v of an OCC surface at each (u, v), (n, 3, 3)."""

    def evaluated() -> Iterator[float]:
        p, du, dv = gp_Pnt(), gp_Vec(), gp_Vec()
        evaluate, point, along_u, along_v = surface.D1, p.Coord, du.Coord, dv.Coord
        for s, t in zip(u, v, strict=True):
            evaluate(s, t, p, du, dv)
            yield from point()
            yield from along_u()
            yield from along_v()

    return np.fromiter(evaluated(), float, 9 * len(u)).reshape(-1, 3, 3)


# ---- outlines ------------------------------------------------------------------------------------------------------


def _outline_of_walls(walls: Sequence[BRepAdaptor_Surface]) -> Outline | None:
    """Return the outline whose walls are exactly these faces; None if there is none, as with a flange or draft."""
    if all(wall.GetType() == Kind.GeomAbs_Cylinder for wall in walls):
        radii = [_radius(wall) for wall in walls]
        return Circle(max(radii)) if radii and max(radii) - min(radii) <= AXIAL_TOLERANCE else None
    if len(walls) == 4 and all(wall.GetType() == Kind.GeomAbs_Plane for wall in walls):
        planes = [wall.Plane() for wall in walls]
        normals = np.abs([plane.Axis().Direction().Coord() for plane in planes])
        points = np.array([plane.Location().Coord() for plane in planes])
        along = [points[normals[:, axis] > 1 - AXIAL_TOLERANCE, axis] for axis in (0, 1)]
        if all(len(pair) == 2 and abs(pair.sum()) <= AXIAL_TOLERANCE for pair in along):
            width, height = (float(np.ptp(pair)) for pair in along)
            return Rectangle(width, height)
    return None


def _radius(wall: BRepAdaptor_Surface) -> float:
    """Return the radius (mm) of a cylinder about the axis of the lens; infinite for any other cylinder."""
    axis = wall.Cylinder().Axis()
    off = max(abs(axis.Location().X()), abs(axis.Location().Y()), 1 - abs(axis.Direction().Z()))
    return wall.Cylinder().Radius() if off <= AXIAL_TOLERANCE else math.inf


def _outline_in_chart(face: TopoDS_Face, net: BSplineSurface) -> Circle:
    """Return the circle about the axis of a net's chart on which the outer edge of its face lies."""
    edges = map(TopoDS.Edge_s, parts_of(face, TopAbs_EDGE))
    curves, fractions = (BRepAdaptor_Curve2d(edge, face) for edge in edges), np.linspace(0.0, 1.0, POINTS_PER_EDGE)
    x, y = chart_coordinates(net, np.concatenate([_curve_points(curve, fractions) for curve in curves]))
    radius = np.hypot(x, y)
    if not np.ptp(radius) <= CIRCLE_TOLERANCE:
        raise ValueError(f"the back's edge is {np.ptp(radius):.2g} mm off a circle in the chart; correct the edge")
    return Circle(round(float(radius.mean()), APERTURE_DECIMALS))


def chart_coordinates(net: BSplineSurface, uv: np.ndarray) -> np.ndarray:
    """Return x and y (2, n) (mm) of the chart at parameters (u, v), (n, 2), of the net."""
    axes = zip(uv.T, net.shape, net.pitch, (net.x, net.y), strict=True)
    return np.stack([low + pitch * position(torch.from_numpy(t.copy()), m).numpy() for t, m, pitch, (low, _) in axes])


def _farthest(face: TopoDS_Face) -> float:
    """Return the largest distance (mm) of a face's outer edge from the axis, rounded as a clear aperture."""
    return round(float(np.hypot(*outer_edge(face).T).max()), APERTURE_DECIMALS)


def outer_edge(face: TopoDS_Face) -> np.ndarray:
    """Return points (n, 2) in mm along the outer edge of a face, once around."""
    parts, explorer = [], BRepTools_WireExplorer(BRepTools.OuterWire_s(face), face)
    while explorer.More():
        points = _curve_points(BRepAdaptor_Curve(explorer.Current()), np.linspace(0.0, 1.0, POINTS_PER_EDGE))
        backwards = explorer.Orientation() == TopAbs_Orientation.TopAbs_REVERSED
        parts.append(points[:0:-1, :2] if backwards else points[:-1, :2])
        explorer.Next()
    return np.concatenate(parts)


def clear_apertures(front: np.ndarray, back: np.ndarray) -> tuple[Outline, Outline]:
    """Return the clear apertures of front and back from points (n, 2) in mm along the edges of these faces.

    The aperture of the back is the circle or rectangle about the axis, with sharp or round corners, on which its edge
    lies.  The front's aperture is the back's, reduced by the largest inset of the front's edge.  A front's edge outside
    the back's, for example in the plane of a flange, does not limit the light of the lens.
    Raises ValueError if the edge of the back has another shape.
    """
    rim = _bounding_outline(back)
    if isinstance(rim, Circle):
        rim = Circle(round(rim.radius, APERTURE_DECIMALS))
    else:
        corner = float((rim.width + rim.height) / 2 - np.abs(back).sum(axis=1).max()) / (2 - math.sqrt(2))
        width, height = round(rim.width, APERTURE_DECIMALS), round(rim.height, APERTURE_DECIMALS)
        corner = round(corner, APERTURE_DECIMALS) if corner > CIRCLE_TOLERANCE else 0.0
        rim = Rounded(width, height, corner_radius=corner) if corner else Rectangle(width, height)
    if not (off := np.abs(rim.depth(*back.T)).max()) <= CIRCLE_TOLERANCE:
        raise ValueError(f"the back's edge is {off:.2g} mm off a circle or rectangle about the axis; correct the edge")
    inset = float(rim.depth(*front.T).max())
    return rim.inset(round(inset, APERTURE_DECIMALS)) if inset > CIRCLE_TOLERANCE else rim, rim


def _bounding_outline(points: np.ndarray) -> Outline:
    """Return the circle about the axis on which all points lie, or else their bounding rectangle about the axis."""
    distance = np.hypot(*points.T)
    if np.ptp(distance) <= CIRCLE_TOLERANCE:
        return Circle(float(distance.max()))
    return Rectangle(*(2 * np.abs(points).max(axis=0)).tolist())


# ---- edges ---------------------------------------------------------------------------------------------------------


def points_on_edges(solid: TopoDS_Shape) -> np.ndarray:
    """Return the ends and midpoints of all edges, (n, 3), mm, in any order."""
    edges = map(TopoDS.Edge_s, parts_of(solid, TopAbs_EDGE))
    curves = (BRepAdaptor_Curve(edge) for edge in edges if not BRep_Tool.Degenerated_s(edge))  # except a cone's apex
    return np.concatenate([_curve_points(curve, np.array([0.0, 0.5, 1.0])) for curve in curves])


def edge_deviations(shape: TopoDS_Shape, lens: Lens) -> tuple[tuple[float, str], tuple[float, str]]:
    """Return (largest distance (mm), place) of edges from the faces that they bound, and the same from the wall.

    The wall of a lens on a base is no wall of its outline; the second distance is then infinite.
    """
    spans = max(max(lens.back_net.shape) - 2, math.ceil(2 * max(lens.outline.half_extent) / lens.front.detail))
    fractions = np.linspace(0.0, 1.0, POINTS_PER_SPAN * spans + 1)
    from_faces, from_wall = [], []
    for face in map(TopoDS.Face_s, parts_of(shape, TopAbs_FACE)):
        for each in map(TopoDS.Edge_s, parts_of(face, TopAbs_EDGE)):
            points = _curve_points(BRepAdaptor_Curve(each), fractions)
            distance = np.linalg.norm(points - _curve_points(BRepAdaptor_Curve(each, face), fractions), axis=1)
            from_faces.append(_largest(distance, points))
            if lens.shares_outline:
                from_wall.append(_largest(_distance_from_wall(points, lens), points))
    nothing = (float("inf"), "no edge")
    return max(from_faces, default=nothing), max(from_wall, default=nothing)


def _curve_points(curve: BRepAdaptor_Curve | BRepAdaptor_Curve2d, fractions: np.ndarray) -> np.ndarray:
    """Return points (n, 3) of a curve, in space or on a face, or (n, 2) in (u, v), at fractions of its interval."""
    first, last = curve.FirstParameter(), curve.LastParameter()
    parameters = (first + fractions * (last - first)).tolist()
    coordinates = (coordinate for t in parameters for coordinate in curve.Value(t).Coord())
    return np.fromiter(coordinates, float).reshape(len(fractions), -1)


def _largest(distance: np.ndarray, points: np.ndarray) -> tuple[float, str]:
    distance = np.where(np.isfinite(distance), distance, np.inf)
    k = int(distance.argmax())
    return float(distance[k]), "at ({:.4g}, {:.4g}, {:.4g}) mm".format(*points[k])


def _distance_from_wall(points: np.ndarray, lens: Lens) -> np.ndarray:
    """Return the distance (mm) of each point from the lens's wall or, if nearer, from the rim of a recessed front."""
    x, y, z = points.T
    outside = np.maximum(z - sag(lens.back, x, y), sag(lens.front.around, x, y) - z)
    off = np.maximum(np.abs(lens.outline.depth(x, y)), outside)
    if (edge := lens.front.outline) is None:
        return off
    return np.minimum(off, np.hypot(edge.depth(x, y), z - lens.front.around.z))  # distance from the edge of the front
