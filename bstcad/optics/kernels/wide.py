"""Vectors of four numbers in kernels: LLVM makes none of these sums by itself, so that the vectors are stated here.

`add_to_span` adds to the three control points of a span along v at a time, and to the next with weight 0.  A net of
points in space has (x, y, z, 0) for each control point, and one of these vectors at a time is read by `space_piece` and
`curved_space_piece`, or added to by `add_to_space_span`.  A processor without registers of four numbers takes two of
two.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

NUMBER, LANES = ir.DoubleType(), 4
VECTOR = ir.VectorType(NUMBER, LANES)
INDEX = ir.IntType(32)
instructions: Any = intrinsic  # decorator of functions that are called without the first of their arguments
CONTRACT = ("contract",)  # a product and a sum may be one instruction, as in the other kernels
# Weights of the control points along v at the place t of a span in its middle: B = 1/2 - t + t²/2, 1/2 + t - t², t²/2.
CONSTANT, LINEAR, SQUARE = (0.5, 0.5, 0.0, 0.0), (-1.0, 1.0, 0.0, 0.0), (0.5, -1.0, 0.5, 0.0)


class _Vectors(NamedTuple):
    """Instructions with numbers, or with vectors of four."""

    builder: Any

    def times(self, x: Any, y: Any) -> Any:
        return self.builder.fmul(x, y, CONTRACT)

    def plus(self, x: Any, y: Any) -> Any:
        return self.builder.fadd(x, y, CONTRACT)

    def minus(self, x: Any, y: Any) -> Any:
        return self.builder.fsub(x, y, CONTRACT)

    def of(self, numbers: Sequence[Any]) -> Any:
        """Return the vector of at most four numbers; the others are 0."""
        vector = ir.Constant(VECTOR, LANES * [0.0])
        for lane, number in enumerate(numbers):
            vector = self.builder.insert_element(vector, number, ir.Constant(INDEX, lane))
        return vector

    def same(self, number: Any) -> Any:
        """Return the vector of equal numbers."""
        none = ir.Constant(VECTOR, ir.Undefined)
        first = self.builder.insert_element(none, number, ir.Constant(INDEX, 0))
        return self.builder.shuffle_vector(first, none, ir.Constant(ir.VectorType(INDEX, LANES), LANES * [0]))

    def place(self, data: Any, at: Any) -> Any:
        """Return the pointer to the four numbers from index `at` on."""
        return self.builder.bitcast(self.builder.gep(data, [at]), VECTOR.as_pointer())

    def load(self, place: Any) -> Any:
        return self.builder.load(place, align=8)

    def add(self, place: Any, a: Any, x: Any, b: Any, y: Any) -> None:
        """Add a x + b y to the four numbers at a pointer."""
        sums = self.plus(self.times(a, x), self.plus(self.times(b, y), self.load(place)))
        self.builder.store(sums, place, align=8)

    def step(self, at: Any, by: Any) -> Any:
        """Return the index at + by."""
        return self.builder.add(at, by if isinstance(by, ir.Value) else ir.Constant(ir.IntType(64), by))


def _data(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Return the pointer to the first number of an array."""
    return context.make_array(kind)(context, builder, array).data


@instructions
def add_to_span(_: Any, own: Any, at: Any, n: Any, s: Any, t: Any, g: Any, g_u: Any, g_v: Any) -> Any:
    """Add g, g_u and g_v at the place (s, t) of an inner span to its nine control points, the transpose of `sag`.

    own: net (m, n), contiguous.  at: index of the span's first control point, which is not the last of its row but two.
    """
    signature = types.void(own, types.uint64, types.uint64, *[types.float64] * 5)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vectors = _Vectors(builder)
        times, plus, minus = vectors.times, vectors.plus, vectors.minus
        data = _data(context, builder, signature.args[0], arguments[0])
        at, n, s, t, g, g_u, g_v = arguments[1:]
        constant, linear, square = (ir.Constant(VECTOR, list(each)) for each in (CONSTANT, LINEAR, SQUARE))
        t = vectors.same(t)
        b = plus(times(plus(times(square, t), linear), t), constant)
        b_v = plus(times(plus(square, square), t), linear)
        flat = plus(times(b_v, vectors.same(g_v)), times(b, vectors.same(g)))
        tilted = times(b, vectors.same(g_u))
        one, half = (ir.Constant(NUMBER, number) for number in (1.0, 0.5))
        q = minus(one, s)
        a_0, a_2 = times(half, times(q, q)), times(half, times(s, s))
        a_1 = minus(minus(one, a_0), a_2)
        for a, a_u in ((a_0, builder.fneg(q)), (a_1, minus(q, s)), (a_2, s)):
            vectors.add(vectors.place(data, at), vectors.same(a), flat, vectors.same(a_u), tilted)
            at = vectors.step(at, n)
        return context.get_dummy_value()

    return signature, generate


def _differences(vectors: _Vectors, three: Sequence[Any], weights: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Return value, slope and second difference of three points along an axis; weights: (a0, a2, p0, p2) of `basis`."""
    times, plus, minus = vectors.times, vectors.plus, vectors.minus
    (a0, a2, p0, p2), (first, middle, last) = weights, three
    low, high = minus(middle, first), minus(last, middle)
    value = plus(times(a2, high), minus(middle, times(a0, low)))
    return value, plus(times(p2, high), times(p0, low)), minus(high, low)


def _space_jet(
    vectors: _Vectors, data: Any, at: Any, row: Any, along: Sequence[Any], bends: Sequence[Any]
) -> list[Any]:
    """Return the vectors S, S_u, S_v and, if there are bends, S_uu, S_uv, S_vv; as in `spline.curved_piece`."""
    along_u, along_v = ([vectors.same(weight) for weight in each] for each in (along[:4], along[4:]))
    rows = []
    for _ in range(3):
        points = [vectors.load(vectors.place(data, vectors.step(at, LANES * k))) for k in range(3)]
        rows.append(_differences(vectors, points, along_v))
        at = vectors.step(at, row)
    values, slopes, second = zip(*rows, strict=True)
    s, s_u, s_uu = _differences(vectors, values, along_u)
    s_v, s_uv, _ = _differences(vectors, slopes, along_u)
    if not bends:
        return [s, s_u, s_v]
    c_u, c_v = (vectors.same(bend) for bend in bends)
    s_vv = _differences(vectors, second, along_u)[0]
    return [s, s_u, s_v, vectors.times(c_u, s_uu), s_uv, vectors.times(c_v, s_vv)]


def _typed_jet(net: Any, count: int, bends: int) -> Any:
    """Return signature and code of `space_piece` (count 3, bends 0) or `curved_space_piece` (6, 2)."""
    triple = types.UniTuple(types.float64, 3)
    weights = [types.float64] * (8 + bends)
    signature = types.UniTuple(triple, count)(net, types.uint64, types.uint64, *weights)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vectors, data = _Vectors(builder), _data(context, builder, signature.args[0], arguments[0])
        at, row, *weights = arguments[1:]
        parts = [
            context.make_tuple(
                builder, triple, [builder.extract_element(vector, ir.Constant(INDEX, lane)) for lane in range(3)]
            )
            for vector in _space_jet(vectors, data, at, row, along=weights[:8], bends=weights[8:])
        ]
        return context.make_tuple(builder, signature.return_type, parts)

    return signature, generate


@instructions
def space_piece(
    _: Any, net: Any, at: Any, row: Any, a0: Any, a2: Any, p0: Any, p2: Any, b0: Any, b2: Any, q0: Any, q2: Any
) -> Any:
    """Return (S, ∂S/∂u, ∂S/∂v) of a span of a net in space, as `spline.piece` does of a net of heights.

    net: flattened, (x, y, z, 0) of each control point.  at: index of the span's first number.  row: numbers per row.
    """
    return _typed_jet(net, 3, 0)


@instructions
def curved_space_piece(
    _: Any, net: Any, at: Any, row: Any, a0: Any, a2: Any, p0: Any, p2: Any, b0: Any, b2: Any, q0: Any, q2: Any,
    c_u: Any, c_v: Any,
) -> Any:  # fmt: skip
    """Return (S, ∂S/∂u, ∂S/∂v, ∂²S/∂u², ∂²S/∂u∂v, ∂²S/∂v²) of a span, by `basis` and `bend`; see `space_piece`."""
    return _typed_jet(net, 6, 2)


@instructions
def add_to_space_span(
    _: Any, own: Any, at: Any, row: Any, a0: Any, a2: Any, p0: Any, p2: Any, b0: Any, b2: Any, q0: Any, q2: Any,
    g: Any, g_u: Any, g_v: Any,
) -> Any:  # fmt: skip
    """Add vectors g, g_u and g_v at a place of a span to its nine control points, the transpose of `space_piece`.

    own: net (m, 4 n), contiguous, (x, y, z, 0) of each control point.  at: index of the span's first number.
    """
    triple = types.UniTuple(types.float64, 3)
    signature = types.void(own, types.uint64, types.uint64, *[types.float64] * 8, *[triple] * 3)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vectors, data = _Vectors(builder), _data(context, builder, signature.args[0], arguments[0])
        times, plus, minus, same = vectors.times, vectors.plus, vectors.minus, vectors.same
        at, row, a0, a2, p0, p2, b0, b2, q0, q2 = arguments[1:11]
        g, g_u, g_v = (vectors.of([builder.extract_value(each, c) for c in range(3)]) for each in arguments[11:])
        one = ir.Constant(NUMBER, 1.0)
        columns = [
            (same(b0), same(builder.fneg(q0))),
            (same(minus(minus(one, b0), b2)), same(minus(q0, q2))),
            (same(b2), same(q2)),
        ]
        for a, p in ((a0, builder.fneg(p0)), (minus(minus(one, a0), a2), minus(p0, p2)), (a2, p2)):
            flat = plus(times(same(a), g), times(same(p), g_u))
            tilted = times(same(a), g_v)
            for k, (b, q) in enumerate(columns):
                vectors.add(vectors.place(data, vectors.step(at, LANES * k)), b, flat, q, tilted)
            at = vectors.step(at, row)
        return context.get_dummy_value()

    return signature, generate
