"""Six linear equations in a kernel: what one rigid motion needs."""

import numpy as np

from slamcli.jit.kernel import kernel

SINGULAR = 1e-12  # of a diagonal entry, that must be left of it: the rest is the rounding of what was subtracted


@kernel(error_model="numpy")
def solve_damped(H, b, damping, L, out):
    """Solve (H + damping diag H) out = b for 6 unknowns by Cholesky from H's upper triangle; False if it is not positive definite."""
    for j in range(6):
        for i in range(j, 6):
            s = H[j, i]
            if i == j:
                s += damping * H[j, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > SINGULAR * H[j, j] or s == 0.0:
                    return False
                L[j, j] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(6):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * out[k]
        out[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = out[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * out[k]
        out[i] = s / L[i, i]
    return True
