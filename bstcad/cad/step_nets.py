"""Large control nets in STEP files, written as text; OCC writes the rest of the file.

OCC makes an object of each control point, then its text: 16 s and 2.5 GB for 2049 x 2049 points.  Therefore OCC writes
the solid with a *placeholder* for each large net: a patch without inner knots, with the same parameter ranges.  In
OCC's text, the net's statement replaces the placeholder's, and the points are appended after the last entity.  All
other statements are OCC's own, including edges and their images in the parameter planes.
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

FIXED_FORMAT, SCIENTIFIC_FORMAT = "%.14f", "%.16E"  # formats of numbers in [FIXED_MIN, FIXED_MAX), and of all others
FIXED_MIN, FIXED_MAX = 0.1, 1e3  # limits of the absolute values that are written in FIXED_FORMAT
PLACEHOLDER_X = 1e60  # x (mm), beyond any lens; the first control point of placeholder k is at (k + 1) PLACEHOLDER_X
REFERENCES_PER_LINE = 16  # number of entries per line of a list
OTHER_FORM = "UNSPECIFIED"  # name in Part 21 of any other form, or of two different forms in u and v
KNOT_FORMS = {  # names in Part 21 of the forms of knot vectors
    Distribution.GeomAbs_Uniform: "UNIFORM_KNOTS",
    Distribution.GeomAbs_QuasiUniform: "QUASI_UNIFORM_KNOTS",
    Distribution.GeomAbs_PiecewiseBezier: "PIECEWISE_BEZIER_KNOTS",
}


@dataclass(frozen=True)
class LargeNet:
    """A large control net, which a placeholder represents in OCC."""

    control_points: np.ndarray  # control net, (m, n, 3), mm
    knots: tuple[np.ndarray, np.ndarray]  # full knot vectors in u and v
    form: str  # name in Part 21 of the form of the knot vectors

    @property
    def degrees(self) -> tuple[int, int]:
        """Degrees in u and v."""
        u, v = (len(knots) - size - 1 for knots, size in zip(self.knots, self.control_points.shape, strict=False))
        return u, v


def with_placeholders(shape: TopoDS_Shape) -> tuple[TopoDS_Shape, list[LargeNet]]:
    """Return the shape, as a copy with a placeholder for each large net if it has any, and these nets."""
    nets: list[LargeNet] = []
    data = b""
    for face in parts_of(shape, TopAbs_FACE):
        surface = BRepAdaptor_Surface(TopoDS.Face_s(face), False)
        if surface.GetType() != Kind.GeomAbs_BSplineSurface:
            continue
        if surface.NbUPoles() * surface.NbVPoles() <= patches.SMALL_NET:
            continue
        patch = surface.BSpline()
        if patch.IsURational() or patch.IsVRational() or patch.IsUPeriodic() or patch.IsVPeriodic():
            continue
        forms = {KNOT_FORMS.get(form, OTHER_FORM) for form in (patch.UKnotDistribution(), patch.VKnotDistribution())}
        form = forms.pop() if len(forms) == 1 else OTHER_FORM
        net = LargeNet(patches.net_of(patch), patches.knots_of(patch), form)
        data = data or patches.to_bytes(shape)
        data = data.replace(patches.surface_bytes(net.control_points, *net.knots), _placeholder(net, len(nets)))
        nets.append(net)
    return (patches.from_bytes(data), nets) if nets else (shape, nets)


def _placeholder(net: LargeNet, k: int) -> bytes:
    """Encode the placeholder of net k: a patch of the same degrees and parameter ranges, without inner knots."""
    points = np.zeros((*(degree + 1 for degree in net.degrees), 3))
    numbers = np.arange(points[..., 0].size).reshape(points.shape[:2])
    points[..., 0] = (k + 1) * PLACEHOLDER_X + numbers * (PLACEHOLDER_X / 1000)
    ends = [np.repeat([knots[0], knots[-1]], degree + 1) for knots, degree in zip(net.knots, net.degrees, strict=True)]
    return patches.surface_bytes(points, *ends)


def _placeholder_size(net: LargeNet) -> int:
    return math.prod(degree + 1 for degree in net.degrees)


def placeholder_numbers(model: StepData_StepModel, count: int) -> list[int]:
    """Return the entity numbers of `count` placeholders in a model."""
    numbers = [0] * count
    for number in range(1, model.NbEntities() + 1) if count else ():
        entity = model.Value(number)
        if isinstance(entity, StepGeom_BSplineSurfaceWithKnots):
            multiple = entity.ControlPointsListValue(1, 1).CoordinatesValue(1) / PLACEHOLDER_X
            if multiple > 0.5:
                numbers[round(multiple) - 1] = number
    return numbers


def fill_in_nets(text: bytes, placeholders: Sequence[int], nets: Sequence[LargeNet]) -> Iterator[bytes]:
    """Yield pieces of a STEP file's text, with nets in place of placeholders; placeholders: their entity numbers."""
    end = text.rindex(b"ENDSEC;")
    # OCC numbers entities from 1 without gaps, so that the numbers of the points continue those of the file
    number = int(text[text.rindex(b"\n#", 0, end) + 2 : end].split(b"=", 1)[0]) + 1
    done, points = 0, []
    for placeholder, net in sorted(zip(placeholders, nets, strict=True), key=lambda pair: pair[0]):
        begin = text.index(b"\n#%d = B_SPLINE_SURFACE_WITH_KNOTS(" % placeholder, done) + 1
        yield text[done:begin]
        yield from _surface_statement(placeholder, net, number)
        after = placeholder + 1 + _placeholder_size(net)  # the points of the placeholder follow it
        done = text.index(b"\n#%d = " % after, begin) + 1
        points.append((net, number))
        number += net.control_points[..., 0].size
    yield text[done:end]
    for net, number in points:
        yield from _point_statements(net.control_points, number)
    yield text[end:]


def _surface_statement(name: int, net: LargeNet, first: int) -> Iterator[bytes]:
    """Yield the text of statement number `name`: a net with points numbered from `first` on, v changing fastest."""
    m, n, _ = net.control_points.shape
    yield b"#%d = B_SPLINE_SURFACE_WITH_KNOTS('',%d,%d,(\n" % (name, *net.degrees)
    for i in range(m):
        row = first + n * i
        lines = (
            ",".join(f"#{k}" for k in range(start, min(start + REFERENCES_PER_LINE, row + n)))
            for start in range(row, row + n, REFERENCES_PER_LINE)
        )
        yield ("(" + ",\n".join(lines) + (")),\n" if i == m - 1 else "),\n")).encode()
    distinct = [np.unique(knots, return_counts=True) for knots in net.knots]
    listed = [_format_list(counts.astype(str).tolist()) for _, counts in distinct]
    listed += [_format_list(_format_reals(values)) for values, _ in distinct]
    yield (".UNSPECIFIED.,.F.,.F.,.F.,\n" + ",\n".join(listed) + f",\n.{net.form}.);\n").encode()


def _format_list(words: Sequence[str]) -> str:
    starts = range(0, len(words), REFERENCES_PER_LINE)
    return "(" + ",\n".join(",".join(words[start : start + REFERENCES_PER_LINE]) for start in starts) + ")"


def _point_statements(net: np.ndarray, first: int) -> Iterator[bytes]:
    """Yield the statements of a net's points, numbered from `first` on, one per line, a row of the net at a time."""
    n, before, y = net.shape[1], None, []
    for i, row in enumerate(net):
        x = _format_reals(row[:1, 0]) * n if (row[:, 0] == row[0, 0]).all() else _format_reals(row[:, 0])
        z = _format_reals(row[:, 2])
        if before is None or not np.array_equal(row[:, 1], before):  # equal in each row of a lens's net
            before, y = row[:, 1], _format_reals(row[:, 1])
        numbers = range(first + n * i, first + n * (i + 1))
        lines = [f"#{k} = CARTESIAN_POINT('',({a},{b},{c}));\n" for k, a, b, c in zip(numbers, x, y, z, strict=True)]
        yield "".join(lines).encode()


def _format_reals(values: np.ndarray) -> list[str]:
    """Format numbers with FIXED_FORMAT or SCIENTIFIC_FORMAT, as OCC does: 14 to 17 significant digits."""
    size = np.abs(values)
    fixed = (size >= FIXED_MIN) & (size < FIXED_MAX)
    forms = np.where(fixed, FIXED_FORMAT, SCIENTIFIC_FORMAT).tolist()
    return ("\n".join(forms) % tuple(values.tolist())).split("\n")
