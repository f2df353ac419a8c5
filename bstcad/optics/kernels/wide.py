"""Sums of four numbers at a time into a net: the three control points of a span along v, and the next with weight 0.

LLVM makes no vectors of such sums by itself, since it cannot know that they share no places.  Here the vectors are
stated; a processor without registers of four numbers takes two of two.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

NUMBER, LANES = ir.DoubleType(), 4
VECTOR = ir.VectorType(NUMBER, LANES)
instructions: Any = intrinsic  # decorator of functions that are called without the first of their arguments
CONTRACT = ("contract",)  # a product and a sum may be one instruction, as in the other kernels
# Weights of the control points along v at the place t of a span in its middle: B = 1/2 - t + t²/2, 1/2 + t - t², t²/2.
CONSTANT, LINEAR, SQUARE = (0.5, 0.5, 0.0, 0.0), (-1.0, 1.0, 0.0, 0.0), (0.5, -1.0, 0.5, 0.0)


def _same(builder: Any, number: Any) -> Any:
    """Return a vector of equal numbers."""
    none, index = ir.Constant(VECTOR, ir.Undefined), ir.IntType(32)
    first = builder.insert_element(none, number, ir.Constant(index, 0))
    return builder.shuffle_vector(first, none, ir.Constant(ir.VectorType(index, LANES), LANES * [0]))


@instructions
def add_to_span(_: Any, own: Any, at: Any, n: Any, s: Any, t: Any, g: Any, g_u: Any, g_v: Any) -> Any:
    """Add g, g_u and g_v at the place (s, t) of an inner span to its nine control points, the transpose of `sag`.

    own: net (m, n), contiguous.  at: index of the span's first control point, which is not the last of its row but two.
    """
    signature = types.void(own, types.uint64, types.uint64, *[types.float64] * 5)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def times(x: Any, y: Any) -> Any:
            return builder.fmul(x, y, CONTRACT)

        def plus(x: Any, y: Any) -> Any:
            return builder.fadd(x, y, CONTRACT)

        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        at, n, s, t, g, g_u, g_v = arguments[1:]
        constant, linear, square = (ir.Constant(VECTOR, list(each)) for each in (CONSTANT, LINEAR, SQUARE))
        t = _same(builder, t)
        b = plus(times(plus(times(square, t), linear), t), constant)
        b_v = plus(times(plus(square, square), t), linear)
        flat = plus(times(b_v, _same(builder, g_v)), times(b, _same(builder, g)))
        tilted = times(b, _same(builder, g_u))
        one, half = (ir.Constant(NUMBER, number) for number in (1.0, 0.5))
        q = builder.fsub(one, s, CONTRACT)
        a_0, a_2 = times(half, times(q, q)), times(half, times(s, s))
        a_1 = builder.fsub(builder.fsub(one, a_0, CONTRACT), a_2, CONTRACT)
        for a, a_u in ((a_0, builder.fneg(q)), (a_1, builder.fsub(q, s, CONTRACT)), (a_2, s)):
            place = builder.bitcast(builder.gep(data, [at]), VECTOR.as_pointer())
            before = builder.load(place, align=8)
            sums = plus(times(_same(builder, a), flat), plus(times(_same(builder, a_u), tilted), before))
            builder.store(sums, place, align=8)
            at = builder.add(at, n)
        return context.get_dummy_value()

    return signature, generate
