"""Hyperbolic tangent that a compiler can vectorise."""

import math

import numpy as np
from numba import types
from numba.extending import overload

# Beyond this, tanh is 1 to float32's precision.
_LIMIT = np.float32(8.3)
# Rational minimax fit on [0, 8.3] (least squares, re-weighted by the error): 3e-8 off, before rounding.
_P1, _P3, _P5, _P7, _P9, _P11 = (
    np.float32(value)
    for value in (9.99999973e-01, 1.29618009e-01, 2.96682815e-03, 9.69610243e-06, -1.41079706e-08, 2.17991528e-11)
)
_Q0, _Q2, _Q4, _Q6 = (np.float32(value) for value in (1.0, 4.62951100e-01, 2.39508891e-02, 2.34518795e-04))


def tanh(x: float) -> float:
    """Hyperbolic tangent of a number: 3e-7 relative error in float32, exact to rounding in float64."""
    raise NotImplementedError("only for compiled code")


@overload(tanh, inline="always")
def _tanh_of_type(x):
    if x == types.float32:

        def rational(x):
            x = min(max(x, -_LIMIT), _LIMIT)
            y = x * x
            numerator = ((((_P11 * y + _P9) * y + _P7) * y + _P5) * y + _P3) * y + _P1
            denominator = ((_Q6 * y + _Q4) * y + _Q2) * y + _Q0
            return x * numerator / denominator

        return rational
    if x == types.float64:
        return lambda x: math.tanh(x)
    return None
