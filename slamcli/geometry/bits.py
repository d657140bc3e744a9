"""Hamming distance of binary descriptors, for use inside kernels."""

from numba import uint64

from slamcli.kernels import kernel


@kernel(inline="always")
def popcount(x):
    """Count the set bits of a uint64 (Hacker's Delight, figure 5-2; LLVM turns it into one instruction)."""
    x = x - ((x >> uint64(1)) & uint64(0x5555555555555555))
    x = (x & uint64(0x3333333333333333)) + ((x >> uint64(2)) & uint64(0x3333333333333333))
    x = (x + (x >> uint64(4))) & uint64(0x0F0F0F0F0F0F0F0F)
    return (x * uint64(0x0101010101010101)) >> uint64(56)


@kernel(inline="always")
def hamming(a, i, b, j):
    """Count the differing bits of rows a[i] and b[j] of uint64 (N, 4) tables."""
    return popcount(a[i, 0] ^ b[j, 0]) + popcount(a[i, 1] ^ b[j, 1]) + popcount(a[i, 2] ^ b[j, 2]) + popcount(a[i, 3] ^ b[j, 3])
