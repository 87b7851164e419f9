"""The information of the fit, factored, in coordinates where the statistics are simple.

With S the slopes of all residuals and P the priors' slopes, the information is A = SᵀS + PᵀP.
The root L with A⁻¹ = L Lᵀ turns S into D = S L, for which DᵀD + LᵀPᵀP L = I: a covariance B of
the score Sᵀe becomes L (LᵀB L) Lᵀ for the parameters, without any further inverse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..program.least_squares import LeastSquares
from .linearised import LinearisedFit


@dataclass(frozen=True, eq=False)
class Information:
    """What residuals and priors say of all parameters, by the r directions that are determined.

    Those that ended at a bound are free here like the others: had the noise been another, they
    would not have, and what they can take from the others belongs to these others' error.

    Attributes
    ----------
    fit : LeastSquares
        Its root is L.
    slopes : of each experiment (T, 3M, r), D = S L; zero where missing
    prior : (r, r) Lᵀ PᵀP L
    """

    fit: LeastSquares
    slopes: tuple[Array, ...]
    prior: Array

    @property
    def fitted(self) -> float:
        """Number of parameters the data determine; one that a prior determines counts in part."""
        return float(sum(np.sum(slope**2) for slope in self.slopes))


def information(fit: LinearisedFit) -> Information:
    """Factor the information of a fit."""
    all_rows = least_squares(fit)
    slopes = tuple(block.channels[1] @ all_rows.root for block in fit.blocks)
    prior = all_rows.root * fit.prior_slope[:, None]
    return Information(all_rows, slopes, prior.T @ prior)


def least_squares(fit: LinearisedFit) -> LeastSquares:
    """Residuals and priors by a step of all parameters."""
    found = LeastSquares.none(len(fit.names)).add(fit.prior_residual, np.diag(fit.prior_slope))
    for block in fit.blocks:
        residual, slope, _ = block.channels
        found = found.add(residual.ravel(), slope.reshape(residual.size, slope.shape[2]))
    return found


def best_step(fit: LinearisedFit) -> Array:
    """(p,) step of all parameters to the least squares of what is linearised."""
    free = np.full(len(fit.names), np.inf)
    return least_squares(fit).best(-free, free)
