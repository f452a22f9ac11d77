"""Linear recursions x[k] = factor[k-1] x[k-1] + forcing[k] of many signals side by side.

Filters, sensitivities and Newton steps of a free run are all of this kind. Many signals go from sample to sample
together. Few would cost a Python step for each sample: they are solved as what a recursion of order one is, a lower
bidiagonal system of equations, in one call of LAPACK (dtbtrs). Both do the same multiplications and additions.
"""

import numpy as np
from scipy.linalg import get_lapack_funcs

from fantwin.twin.runs import Array

(dtbtrs,) = get_lapack_funcs(("tbtrs",), dtype=np.float64)

MANY_SIGNALS = 128
"""from which a Python step for each sample costs less than the substitution"""


def linear_recursion(factor: Array, forcing: Array) -> Array:
    """Solve x[k] = factor[k-1] x[k-1] + forcing[k] for many signals: x (n, batch) or (n, batch, P), x[0] = forcing[0].

    Filters, sensitivities and Newton steps of a free run are all of this kind. Many signals go from sample to sample
    together. Few would cost a Python step for each sample: they are solved as what a recursion of order one is, a lower
    bidiagonal system of equations, in one call of LAPACK (dtbtrs). Both do the same multiplications and additions.

    factor: (n - 1, batch), from each sample to the next. forcing: (n, batch) or (n, batch, P). A recursion that grows
    beyond all numbers gives infinities or NaN, not an exception; of few signals also in the columns after it.
    """
    many = forcing[0].size >= MANY_SIGNALS
    return _sample_by_sample(factor, forcing) if many else _as_one_system(factor, forcing)


def _sample_by_sample(factor: Array, forcing: Array) -> Array:
    solution = np.empty_like(forcing, order="C")
    solution[0] = forcing[0]
    factors = factor.reshape(*factor.shape, *(1,) * (forcing.ndim - factor.ndim))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, len(forcing)):
            np.multiply(factors[k - 1], solution[k - 1], out=solution[k])
            solution[k] += forcing[k]
    return solution


def _as_one_system(factor: Array, forcing: Array) -> Array:
    samples, batch = forcing.shape[:2]
    # All columns together form one system: the factor between the last row of one and the first of the next is zero.
    bands = np.zeros((2, batch, samples))
    bands[0] = 1.0
    bands[1, :, :-1] = -factor.T
    right = forcing.reshape(samples, batch, -1).transpose(1, 0, 2).reshape(batch * samples, -1)
    solved, _ = dtbtrs(bands.reshape(2, -1), np.array(right, order="F"), uplo="L", overwrite_b=1)
    return np.ascontiguousarray(solved.reshape(batch, samples, -1).transpose(1, 0, 2)).reshape(forcing.shape)
