"""Large control nets in STEP files, written as text around the rest of the file, which OCC writes.

OCC makes an object of each control point, then its text: 16 s and 2.5 GB for 2049 x 2049 of them.  So it is given the
solid with a *stand-in* for each large net, a patch without inner knots on the same parameters, and the stand-in's
statement in OCC's text gives way to that of the net.  The points follow behind the last entity of the file: all other
statements, edges and their images in the parameter planes included, are OCC's own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from OCP.BRepAdaptor import BRepAdaptor_Surface
from OCP.GeomAbs import GeomAbs_BSplKnotDistribution as Distribution
from OCP.GeomAbs import GeomAbs_SurfaceType as Kind
from OCP.StepData import StepData_StepModel
from OCP.StepGeom import StepGeom_BSplineSurfaceWithKnots
from OCP.TopAbs import TopAbs_FACE
from OCP.TopoDS import TopoDS, TopoDS_Shape

from bstcad.cad import patches
from bstcad.cad.step_reading import parts_of

FIXED, SCIENTIFIC = "%.14f", "%.16E"  # of numbers from LEAST to MOST, and of all others
LEAST, MOST = 0.1, 1e3
FAR = 1e60  # mm; the first control point of stand-in k is at x = (k + 1) FAR, where no lens is
WIDE = 16  # references a line
OTHER = "UNSPECIFIED"
FORMS = {
    Distribution.GeomAbs_Uniform: "UNIFORM_KNOTS",
    Distribution.GeomAbs_QuasiUniform: "QUASI_UNIFORM_KNOTS",
    Distribution.GeomAbs_PiecewiseBezier: "PIECEWISE_BEZIER_KNOTS",
}


@dataclass(frozen=True)
class LargeNet:
    """A net that a stand-in takes the place of."""

    control_points: np.ndarray  # (m, n, 3) mm
    knots: tuple[np.ndarray, np.ndarray]  # full, in u and in v
    form: str  # of both knot vectors, as Part 21 calls it

    @property
    def degrees(self) -> tuple[int, int]:
        """In u and in v."""
        u, v = (len(knots) - size - 1 for knots, size in zip(self.knots, self.control_points.shape, strict=False))
        return u, v


def with_stand_ins(shape: TopoDS_Shape) -> tuple[TopoDS_Shape, list[LargeNet]]:
    """A copy of the shape with a stand-in for each large net, and these nets; the shape itself if it has none."""
    nets: list[LargeNet] = []
    data = b""
    for face in parts_of(shape, TopAbs_FACE):
        surface = BRepAdaptor_Surface(TopoDS.Face_s(face), False)
        if surface.GetType() != Kind.GeomAbs_BSplineSurface or surface.NbUPoles() * surface.NbVPoles() <= patches.FEW:
            continue
        patch = surface.BSpline()
        if patch.IsURational() or patch.IsVRational() or patch.IsUPeriodic() or patch.IsVPeriodic():
            continue
        forms = {FORMS.get(form, OTHER) for form in (patch.UKnotDistribution(), patch.VKnotDistribution())}
        form = forms.pop() if len(forms) == 1 else OTHER
        net = LargeNet(patches.net_of(patch), patches.knots_of(patch), form)
        data = data or patches.dumped(shape)
        data = data.replace(patches.record(net.control_points, *net.knots), _stand_in(net, len(nets)))
        nets.append(net)
    return (patches.read_back(data), nets) if nets else (shape, nets)


def _stand_in(net: LargeNet, k: int) -> bytes:
    """The patch without inner knots, on the same parameters and of the same degrees, that stands for net k."""
    points = np.zeros((*(degree + 1 for degree in net.degrees), 3))
    points[..., 0] = (k + 1) * FAR + np.arange(points[..., 0].size).reshape(points.shape[:2]) * (FAR / 1000)
    ends = [np.repeat([knots[0], knots[-1]], degree + 1) for knots, degree in zip(net.knots, net.degrees, strict=True)]
    return patches.record(points, *ends)


def _count(net: LargeNet) -> int:
    """Of the points of its stand-in."""
    return math.prod(degree + 1 for degree in net.degrees)


def stand_ins_of(model: StepData_StepModel, count: int) -> list[int]:
    """The numbers of the stand-ins of so many nets among the entities of a model."""
    numbers = [0] * count
    for number in range(1, model.NbEntities() + 1) if count else ():
        entity = model.Value(number)
        if isinstance(entity, StepGeom_BSplineSurfaceWithKnots):
            place = entity.ControlPointsListValue(1, 1).CoordinatesValue(1) / FAR
            if place > 0.5:
                numbers[round(place) - 1] = number
    return numbers


def filled_in(text: bytes, stand_ins: Sequence[int], nets: Sequence[LargeNet]) -> Iterator[bytes]:
    """The text of a STEP file, in parts, with the nets in the place of their stand-ins.

    OCC numbers entities from 1 on without gaps, so that the points can be numbered on from the last one.
    """
    end = text.rindex(b"ENDSEC;")
    number = int(text[text.rindex(b"\n#", 0, end) + 2 : end].split(b"=", 1)[0]) + 1
    done, points = 0, []
    for stand_in, net in sorted(zip(stand_ins, nets, strict=True), key=lambda pair: pair[0]):
        begin = text.index(b"\n#%d = B_SPLINE_SURFACE_WITH_KNOTS(" % stand_in, done) + 1
        yield text[done:begin]
        yield from _surface(stand_in, net, number)
        done = text.index(b"\n#%d = " % (stand_in + 1 + _count(net)), begin) + 1  # its own points stand right behind it
        points.append((net, number))
        number += net.control_points[..., 0].size
    yield text[done:end]
    for net, number in points:
        yield from _points(net.control_points, number)
    yield text[end:]


def _surface(name: int, net: LargeNet, first: int) -> Iterator[bytes]:
    """The statement of a net whose points are numbered from `first` on, v changing fastest."""
    m, n, _ = net.control_points.shape
    yield b"#%d = B_SPLINE_SURFACE_WITH_KNOTS('',%d,%d,(\n" % (name, *net.degrees)
    for i in range(m):
        row = first + n * i
        lines = (
            ",".join(f"#{k}" for k in range(start, min(start + WIDE, row + n))) for start in range(row, row + n, WIDE)
        )
        yield ("(" + ",\n".join(lines) + (")),\n" if i == m - 1 else "),\n")).encode()
    distinct = [np.unique(knots, return_counts=True) for knots in net.knots]
    listed = [_listed(counts.astype(str).tolist()) for _, counts in distinct]
    listed += [_listed(_reals(values)) for values, _ in distinct]
    yield (".UNSPECIFIED.,.F.,.F.,.F.,\n" + ",\n".join(listed) + f",\n.{net.form}.);\n").encode()


def _listed(words: Sequence[str]) -> str:
    lines = (",".join(words[start : start + WIDE]) for start in range(0, len(words), WIDE))
    return "(" + ",\n".join(lines) + ")"


def _points(net: np.ndarray, first: int) -> Iterator[bytes]:
    """The statements of the points of a net, one a line, numbered from `first` on; a row of the net at a time."""
    n, before, y = net.shape[1], None, []
    for i, row in enumerate(net):
        x, z = _reals(row[:1, 0]) * n if (row[:, 0] == row[0, 0]).all() else _reals(row[:, 0]), _reals(row[:, 2])
        if before is None or not np.array_equal(row[:, 1], before):  # they are the same in each row of a lens's net
            before, y = row[:, 1], _reals(row[:, 1])
        numbers = range(first + n * i, first + n * (i + 1))
        lines = [f"#{k} = CARTESIAN_POINT('',({a},{b},{c}));\n" for k, a, b, c in zip(numbers, x, y, z, strict=True)]
        yield "".join(lines).encode()


def _reals(values: np.ndarray) -> list[str]:
    """Numbers as OCC is told to write them: 15 to 17 digits."""
    size = np.abs(values)
    fixed = (size >= LEAST) & (size < MOST)
    forms = np.where(fixed, FIXED, SCIENTIFIC).tolist()
    return ("\n".join(forms) % tuple(values.tolist())).split("\n")
