"""Residual of nonlinear equations and its derivative at a state, for Newton's method."""

from __future__ import annotations

from typing import NamedTuple

from ...common.array_types import Array


class NewtonLinearisation(NamedTuple):
    """Residual r and its derivative at a state x.

    Attributes
    ----------
    residual : (3n,) array
        Residual [N].
    symmetric : (m,) array
        Lower triangle of the symmetric part of −∂r/∂x [N/m].
    skew : (m,) or (0,) array
        Lower triangle of the skew part of −∂r/∂x; empty for a symmetric derivative.
    """

    residual: Array
    symmetric: Array
    skew: Array
