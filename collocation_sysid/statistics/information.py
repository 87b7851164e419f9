"""The information of the fit, factored, in coordinates where the statistics are simple.

With S the slopes of all residuals and P the priors' slopes, the information is A = SᵀS + PᵀP.
The root L with A⁻¹ = L Lᵀ turns S into D = S L, for which DᵀD + LᵀPᵀP L = I: a covariance B of
the score Sᵀe becomes L (LᵀB L) Lᵀ for the parameters, without any further inverse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from .linearised import LinearisedFit

Mask = NDArray[np.bool_]

# Eigenvalue of the information, in units of its diagonal, that is zero up to rounding; and the
# share in such a direction that does not matter.
SINGULAR = 1e-12
NEGLIGIBLE = 1e-3


@dataclass(frozen=True, eq=False)
class Information:
    """A⁻¹ = L Lᵀ of all parameters, in the r directions that are determined.

    Those that ended at a bound are free here like the others: had the noise been another, they
    would not have, and what they can take from the others belongs to these others' error.

    Attributes
    ----------
    root : (p, r) L
    slopes : of each experiment (T, 3M, r), D = S L; zero where missing
    prior : (r, r) Lᵀ PᵀP L
    undetermined : (p,) bool
        Parameters in whose direction the loss is flat.
    """

    root: Array
    slopes: tuple[Array, ...]
    prior: Array
    undetermined: Mask

    @property
    def fitted(self) -> float:
        """Number of parameters the data determine; one that a prior determines counts in part."""
        return float(sum(np.sum(slope**2) for slope in self.slopes))

    def covariance(self, of_score: Array) -> Array:
        """(p, p) of the parameters from LᵀB L (r, r); infinite variance if undetermined."""
        found = self.root @ of_score @ self.root.T
        lost = self.undetermined
        found[lost] = found[:, lost] = np.nan
        found[lost, lost] = np.inf
        return found


def information(fit: LinearisedFit) -> Information:
    """Factor the information of a fit."""
    count = len(fit.names)
    slopes = [block.channels[1] for block in fit.blocks]
    matrix = np.diag(fit.prior_slope**2)
    for slope in slopes:
        rows = slope.reshape(slope.shape[0] * slope.shape[1], count)
        matrix = matrix + rows.T @ rows
    units = np.sqrt(np.diag(matrix))
    units[units == 0] = 1.0
    values, vectors = np.linalg.eigh(matrix / np.outer(units, units))
    known = values > SINGULAR
    root = vectors[:, known] / np.sqrt(values[known]) / units[:, None]
    undetermined = np.zeros(count, dtype=bool)
    undetermined |= (np.abs(vectors[:, ~known]) > NEGLIGIBLE).any(axis=1)
    prior = root * fit.prior_slope[:, None]
    return Information(root, tuple(slope @ root for slope in slopes), prior.T @ prior, undetermined)
