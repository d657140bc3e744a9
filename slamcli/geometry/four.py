"""Four doubles or whole numbers at once in kernels, for loops whose next round waits for the last: four such loops in step.

A comparison gives four flags, by which `where` chooses, so that no lane has a branch to mispredict. As with `geometry.six`, each lane is
rounded as a number by itself would be.
"""

import operator

from llvmlite import ir
from numba import float64, int64, types, uint64
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 4
_INDEX = ir.IntType(32)


class Four(types.Type):
    """Numba's type of four doubles, whole numbers or flags."""

    def __init__(self, lane: ir.Type) -> None:
        super().__init__(f"four {lane}")
        self.vector = ir.VectorType(lane, LANES)


DOUBLES, WHOLES, FLAGS = Four(ir.DoubleType()), Four(ir.IntType(64)), Four(ir.IntType(1))
_OF_LANE = {float64: DOUBLES, uint64: WHOLES}


@register_model(Four)
class _FourModel(models.PrimitiveModel):
    """LLVM's vector."""

    def __init__(self, manager, of) -> None:
        super().__init__(manager, of, of.vector)


@infer_global(operator.add)
class _Sum(AbstractTemplate):
    """Lane by lane; whole numbers wrap around."""

    def generic(self, given, _names):
        return signature(given[0], *given) if given in ((DOUBLES, DOUBLES), (WHOLES, WHOLES)) else None


@lower_builtin(operator.add, Four, Four)
def _add(_context, builder, of, pair):
    return (builder.fadd if of.return_type == DOUBLES else builder.add)(*pair)


class _OfDoubles(AbstractTemplate):
    def generic(self, given, _names):
        return signature(FLAGS, *given) if given == (DOUBLES, DOUBLES) else None


@infer_global(operator.lt)
class _Less(_OfDoubles):
    """Flags of two fours of doubles."""


@infer_global(operator.le)
class _NotMore(_OfDoubles):
    """Flags of two fours of doubles."""


@lower_builtin(operator.lt, Four, Four)
def _is_less(_context, builder, _of, pair):
    return builder.fcmp_ordered("<", *pair)


@lower_builtin(operator.le, Four, Four)
def _is_not_more(_context, builder, _of, pair):
    return builder.fcmp_ordered("<=", *pair)


@infer_global(operator.eq)
class _Equality(AbstractTemplate):
    """Flags of two fours of whole numbers."""

    def generic(self, given, _names):
        return signature(FLAGS, *given) if given == (WHOLES, WHOLES) else None


@lower_builtin(operator.eq, Four, Four)
def _equal(_context, builder, _of, pair):
    return builder.icmp_unsigned("==", *pair)


@intrinsic
def where(_typing, flags, yes, no):
    """Choose lane by lane."""

    def generate(_context, builder, _of, given):
        return builder.select(*given)

    return (yes(flags, yes, no), generate) if flags == FLAGS and yes == no else None


@intrinsic
def everywhere(_typing, number):
    """Put one number into all four lanes."""
    if number not in _OF_LANE:
        return None
    of = _OF_LANE[number]

    def generate(_context, builder, _of, given):
        first = builder.insert_element(ir.Constant(of.vector, ir.Undefined), given[0], ir.Constant(_INDEX, 0))
        return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES))

    return of(number), generate


@intrinsic
def lanes(_typing, four):
    """Return the four as a tuple."""
    number = {of: number for number, of in _OF_LANE.items()}.get(four)

    def generate(context, builder, of, given):
        parts = [builder.extract_element(given[0], ir.Constant(_INDEX, k)) for k in range(LANES)]
        return context.make_tuple(builder, of.return_type, parts)

    return (types.UniTuple(number, LANES)(four), generate) if number else None


@intrinsic
def load(_typing, rows, k):
    """Return row k of rows (n, 4), a C-contiguous array of doubles or unsigned whole numbers; neither k nor the width is tested."""
    if not isinstance(rows, types.Array) or (rows.ndim, rows.layout) != (2, "C") or rows.dtype not in _OF_LANE:
        return None
    of = _OF_LANE[rows.dtype]

    def generate(context, builder, _of, given):
        data = context.make_array(rows)(context, builder, given[0]).data
        start = builder.gep(data, [builder.mul(given[1], ir.Constant(given[1].type, LANES))])
        return builder.load(builder.bitcast(start, of.vector.as_pointer()), align=8)

    return of(rows, int64), generate
