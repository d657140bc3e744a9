"""The reduced camera system of bundle adjustment: symmetric, 6 x 6 blocks, one block row per free key frame.

Blocks exist where two key frames share a landmark or an edge. Key frames are put in an order in which those that share landmarks stand close, and
the system is factorized as a band, or as a dense matrix where the band is wide. SuperLU took four to five times as long as a band, even
for 1500 key frames in a band of 600. What would not fit into memory is solved by conjugate gradients, which need the blocks alone.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import f8, i8
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from slamcli.geometry import banded_cholesky
from slamcli.geometry.algebra import inverse, product
from slamcli.jit.kernel import kernel

ORDER_FROM = 40  # free key frames from which the search for a narrow band pays
RELATIVE_RESIDUAL, MOST_ITERATIONS = 1e-9, 2000  # of conjugate gradients
DIRECT_UP_TO = 80_000_000  # numbers in a factor: 640 MB, 1490 key frames that all share landmarks


class Factor(Protocol):
    """A factorized system."""

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Solve for right-hand sides (6 n,) or (6 n, M)."""


@dataclass(frozen=True)
class _CholeskyFactor:
    upper: np.ndarray  # flat, as `banded_cholesky` has it
    n: int
    stride: int
    reach: int

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        columns = np.array(rhs.reshape(self.n, -1).T, order="C")
        banded_cholesky.solve(self.upper, self.n, self.stride, self.reach, columns)
        return columns.T.reshape(rhs.shape)


class _EmptyFactor:
    def solve(self, rhs: np.ndarray) -> np.ndarray:
        return rhs


@dataclass(frozen=True)
class _ConjugateGradients:
    matrix: bsr_array
    inverse_diagonal: np.ndarray  # (n, 6, 6)

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        return np.array([self._solve(column) for column in rhs.reshape(len(rhs), -1).T]).T.reshape(rhs.shape)

    def _solve(self, rhs: np.ndarray) -> np.ndarray:
        """Iterate until the residual is RELATIVE_RESIDUAL of the right-hand side: M. Hestenes, E. Stiefel 1952, doi:10.6028/jres.049.044."""
        x, residual = np.zeros_like(rhs), rhs.copy()
        direction, before = np.zeros_like(rhs), 1.0
        for _ in range(MOST_ITERATIONS):
            if np.sqrt(_dot(residual, residual)) <= RELATIVE_RESIDUAL * np.sqrt(_dot(rhs, rhs)):
                break
            conditioned = product(self.inverse_diagonal, residual.reshape(-1, 6, 1)).ravel()
            now = _dot(residual, conditioned)
            direction, before = conditioned + now / before * direction, now
            along = self.matrix @ direction  # of SciPy's own loops, not of BLAS
            step = now / _dot(direction, along)
            x += step * direction
            residual -= step * along
        return x


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return float((a * b).sum())


class ReducedSystem:
    """The blocks of the system, and how it is solved.

    row, column : (B,) block coordinates, row <= column; the first n are the diagonal's
    block_of : (n, n) int32 number of a block, -1 where there is none
    blocks : (B, 6, 6), for the caller to fill; on the diagonal only the upper triangle is read
    """

    def __init__(self, row: np.ndarray, column: np.ndarray, n: int) -> None:
        self.n, self.row, self.column = n, row, column
        self.blocks = np.zeros((len(row), 6, 6))
        self.block_of = np.full((n, n), -1, dtype=np.int32)
        self.block_of[row, column] = np.arange(len(row))
        self.bandwidth = 6 * int((column - row).max(initial=0)) + 5
        self.form = self._form()

    def _form(self) -> str:
        if self.n == 0:
            return "empty"
        form = "band" if 2 * self.bandwidth < 6 * self.n else "dense"
        size = 6 * self.n * (self.bandwidth + 1 if form == "band" else 6 * self.n)
        return form if size <= DIRECT_UP_TO else "iterative"

    def factorize(self) -> Factor | None:
        """Factorize what `blocks` holds; None where it is not positive definite."""
        if self.form == "empty":
            return _EmptyFactor()
        if self.form == "iterative":
            return self._iterative()
        size, reach = 6 * self.n, self.bandwidth if self.form == "band" else 6 * self.n - 1
        stride = reach if self.form == "band" else size
        upper = self._upper(stride)
        is_definite = banded_cholesky.factorize(upper, size, stride, reach, np.empty((6, size)))
        return _CholeskyFactor(upper, size, stride, reach) if is_definite else None

    def _upper(self, stride: int) -> np.ndarray:
        """Return the upper triangle, entry (row, column) of the system at row * stride + column."""
        flat = np.zeros(6 * self.n * stride + 6 * self.n)
        _spread(self.blocks, self.row, self.column, self.n, stride, flat)
        return flat

    def _iterative(self) -> Factor | None:
        diagonal = np.triu(self.blocks[: self.n])
        diagonal += np.triu(diagonal, 1).transpose(0, 2, 1)
        inverted = inverse(diagonal)
        if not np.isfinite(inverted).all():
            return None
        row = np.concatenate([self.row, self.column[self.n :]])
        column = np.concatenate([self.column, self.row[self.n :]])
        blocks = np.concatenate([diagonal, self.blocks[self.n :], self.blocks[self.n :].transpose(0, 2, 1)])
        order = np.lexsort((column, row))
        start = np.searchsorted(row[order], np.arange(self.n + 1))
        return _ConjugateGradients(bsr_array((blocks[order], column[order], start), shape=(6 * self.n, 6 * self.n)), inverted)


@kernel
def _spread(blocks: f8[:, :, ::1], row: i8[::1], column: i8[::1], n: i8, stride: i8, flat: f8[::1]):
    """Write entry (row, column) of the system to row * stride + column of `flat`; the first n blocks are the diagonal's."""
    for b in range(len(blocks)):
        for i in range(6):
            start = (6 * row[b] + i) * stride + 6 * column[b]
            for j in range(i if b < n else 0, 6):  # in a band, the place below the diagonal belongs to the row before
                flat[start + j] = blocks[b, i, j]


def order_and_blocks(
    free: np.ndarray, obs_kf: np.ndarray, obs_lm: np.ndarray, n_key_frames: int, edge_kf: np.ndarray
) -> tuple[np.ndarray, ReducedSystem]:
    """Order the free key frames and find which of them share landmarks or an edge.

    free : (n,) key frames; obs_kf, obs_lm : (O,) the observations; edge_kf : (E, 2) key frames that edges join
    Returns `place` (K,), the block row of each key frame, -1 = not free.
    """
    n = len(free)
    place = np.full(n_key_frames, -1, dtype=np.int64)
    place[free] = np.arange(n)
    if n < ORDER_FROM:  # nearly every pair shares a landmark: to search would cost more than to solve
        row, column = np.triu_indices(n, 1)
    else:
        # An edge is like a landmark that both its key frames see.
        n_landmarks = int(obs_lm.max(initial=-1)) + 1
        obs_kf = np.concatenate([obs_kf, edge_kf.ravel()])
        obs_lm = np.concatenate([obs_lm, n_landmarks + np.repeat(np.arange(len(edge_kf)), 2)])
        is_free = place[obs_kf] >= 0
        entries = (np.ones(is_free.sum(), dtype=np.float32), (place[obs_kf[is_free]], obs_lm[is_free]))
        seen = csr_array(entries, shape=(n, n_landmarks + len(edge_kf)))
        shared = (seen @ seen.T).tocsr()
        order = reverse_cuthill_mckee(shared, symmetric_mode=True)
        new_place = np.empty(n, dtype=np.int64)
        new_place[order] = np.arange(n)
        place[free] = new_place
        i, j = shared.nonzero()
        row, column = new_place[i], new_place[j]
        above = row < column
        row, column = row[above], column[above]
        by_row = np.lexsort((column, row))
        row, column = row[by_row], column[by_row]
    diagonal = np.arange(n)
    return place, ReducedSystem(np.concatenate([diagonal, row]), np.concatenate([diagonal, column]), n)
