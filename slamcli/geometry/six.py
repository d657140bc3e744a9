"""Six doubles at once in kernels: a row of what belongs to a twist, worked on by one instruction where the processor has such.

LLVM could find such rows itself, but numba switches that off (its NUMBA_SLP_VECTORIZE), since it has been known to go wrong. Each lane is
rounded as a number by itself would be: results are those of loops over the six, digit by digit.
"""

import operator

from llvmlite import ir
from numba import float64, int64, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from slamcli.jit.kernel import kernel

LANES = 6
_VECTOR, _INDEX = ir.VectorType(ir.DoubleType(), LANES), ir.IntType(32)


class Six(types.Type):
    """Numba's type of six doubles, with + and - lane by lane, and one double times all six."""

    def __init__(self) -> None:
        super().__init__("six doubles")


SIX = Six()


@register_model(Six)
class _SixModel(models.PrimitiveModel):
    """LLVM's vector of six doubles."""

    def __init__(self, manager, of) -> None:
        super().__init__(manager, of, _VECTOR)


class _LaneByLane(AbstractTemplate):
    def generic(self, given, _names):
        return signature(SIX, SIX, SIX) if given == (SIX, SIX) else None


@infer_global(operator.add)
class _Sum(_LaneByLane):
    """Six + six."""


@infer_global(operator.sub)
class _Difference(_LaneByLane):
    """Six - six."""


@infer_global(operator.mul)
class _Multiple(AbstractTemplate):
    """Double * six."""

    def generic(self, given, _names):
        return signature(SIX, float64, SIX) if isinstance(given[0], types.Float) and given[1] == SIX else None


@lower_builtin(operator.add, Six, Six)
def _add(_context, builder, _signature, pair):
    return builder.fadd(*pair)


@lower_builtin(operator.sub, Six, Six)
def _subtract(_context, builder, _signature, pair):
    return builder.fsub(*pair)


@lower_builtin(operator.mul, types.Float, Six)
def _multiply(_context, builder, _signature, pair):
    number, lanes = pair
    first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), number, ir.Constant(_INDEX, 0))
    everywhere = ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES)
    return builder.fmul(builder.shuffle_vector(first, first, everywhere), lanes)


@intrinsic
def six(_typing, a, b, c, d, e, f):
    """Join six doubles."""

    def generate(_context, builder, _signature, numbers):
        joined = ir.Constant(_VECTOR, ir.Undefined)
        for k, number in enumerate(numbers):
            joined = builder.insert_element(joined, number, ir.Constant(_INDEX, k))
        return joined

    return SIX(*[float64] * LANES), generate


@intrinsic
def load(_typing, rows, k):
    """Return row k of rows (n, 6), a C-contiguous array of doubles; neither k nor the width is tested."""

    def generate(context, builder, of, given):
        return builder.load(_address(context, builder, of, given), align=8)

    return (SIX(rows, int64), generate) if _are_rows(rows) else None


@intrinsic
def store(_typing, rows, k, lanes):
    """Write row k of rows (n, 6), a C-contiguous array of doubles; neither k nor the width is tested."""

    def generate(context, builder, of, given):
        builder.store(given[2], _address(context, builder, of, given), align=8)
        return context.get_dummy_value()

    return (types.void(rows, int64, SIX), generate) if _are_rows(rows) and rows.mutable else None


def _are_rows(of):
    return isinstance(of, types.Array) and (of.dtype, of.ndim, of.layout) == (float64, 2, "C")


def _address(context, builder, of, given):
    rows, k = given[:2]
    data = context.make_array(of.args[0])(context, builder, rows).data
    start = builder.gep(data, [builder.mul(k, ir.Constant(k.type, LANES))])
    return builder.bitcast(start, _VECTOR.as_pointer())


@kernel
def screw(x, y, z, g0, g1, g2):
    """Return (g, p x g) of a gradient g at the point p = (x, y, z): the row of a Jacobian by the left twist (rho, phi)."""
    return six(g0, g1, g2, y * g2 - z * g1, z * g0 - x * g2, x * g1 - y * g0)
