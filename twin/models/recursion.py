"""Linear recursions x[k] = factor[k-1] x[k-1] + forcing[k], all samples in one call of LAPACK.

A recursion of order one is a lower bidiagonal system of equations. Solved by substitution (dtbtrs) it costs what the
recursion costs, without a Python step per sample. Filters, sensitivities and Newton steps of a free run are all of
this kind.
"""

import numpy as np
from scipy.linalg import get_lapack_funcs

from twin.runs import Array

(dtbtrs,) = get_lapack_funcs(("tbtrs",), dtype=np.float64)


def linear_recursion(factor: Array, forcing: Array) -> Array:
    """x (n, batch) or (n, batch, P), with x[0] = forcing[0].

    factor: (n - 1, batch), from each sample to the next. forcing: (n, batch) or (n, batch, P). A recursion that grows
    beyond all numbers gives infinities or NaN, not an exception, and NaN in the columns after it, too.
    """
    samples, batch = forcing.shape[:2]
    # All columns together form one system: the factor between the last row of one and the first of the next is zero.
    bands = np.zeros((2, batch, samples))
    bands[0] = 1.0
    bands[1, :, :-1] = -factor.T
    right = forcing.reshape(samples, batch, -1).transpose(1, 0, 2).reshape(batch * samples, -1)
    solved, _ = dtbtrs(bands.reshape(2, -1), np.array(right, order="F"), uplo="L", overwrite_b=1)
    return np.ascontiguousarray(solved.reshape(batch, samples, -1).transpose(1, 0, 2)).reshape(forcing.shape)
