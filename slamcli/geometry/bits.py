"""Hamming distance of binary descriptors, for use inside kernels."""

from numba import types
from numba.extending import intrinsic

from slamcli.jit.kernel import kernel


@intrinsic
def popcount(_typing, x):
    """Count the set bits of a uint64, as one instruction; spelled in shifts and masks it would cost every kernel compile time."""
    return types.uint64(types.uint64), lambda _context, sparse_map, _signature, arguments: sparse_map.ctpop(arguments[0])


@kernel(inline="always")
def hamming(a, i, b, j):
    """Count the differing bits of rows a[i] and b[j] of uint64 (N, 4) tables."""
    return popcount(a[i, 0] ^ b[j, 0]) + popcount(a[i, 1] ^ b[j, 1]) + popcount(a[i, 2] ^ b[j, 2]) + popcount(a[i, 3] ^ b[j, 3])
