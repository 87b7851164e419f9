"""How well a fit explains the data for its number of parameters, errors being correlated.

Akaike's criterion is −2 ln L + 2k. Of n independent normal errors of unknown variance −2 ln L is
n ln(RSS/n), up to what all models of the same data share. Residuals of a model that misses
something are not independent: ten samples that err alike are worth one. n is then the number of
independent ones that are worth as much: samples over 1 + 2 Σ_k (1 − k/T) ρ_k along time, and
channels by (tr Σ)²/tr Σ² across, with the ρ and Σ of `autocorrelation`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .autocorrelation import ErrorProcess, error_processes
from .linearised import FitBlock, LinearisedFit, information
from .noise import ROUNDING


@dataclass(frozen=True)
class Evidence:
    """What the criterion needs to know of a fit.

    Attributes
    ----------
    misfit : float
        Σ residual² of the markers, in units of σ²; rounding at least.
    prior : float
        Σ residual² of the priors.
    fitted : float
        Number of parameters that the data determine, nuisance parameters included.
    measurements : int
    independent : float
        The number of independent measurements that these are worth.
    """

    misfit: float
    prior: float
    fitted: float
    measurements: int
    independent: float

    def criterion(self, independent: float) -> float:
        """Akaike's, if the measurements are worth so many; models are compared at the same."""
        return independent * float(np.log(self.misfit)) + self.prior + 2 * self.fitted


def evidence_of(fit: LinearisedFit) -> Evidence:
    """The evidence for a model from its fit near the answer."""
    factored, rounding = information(fit), ROUNDING**2 * fit.measurements
    independent = float(fit.measurements)
    if fit.chi_squared > rounding:
        processes = error_processes(fit, factored)
        pairs = zip(fit.blocks, processes, strict=True)
        independent = sum(_independent(b, p) for b, p in pairs if b.measurements)
    return Evidence(
        max(fit.chi_squared, rounding),
        float(np.sum(fit.prior_residual**2)),
        factored.fitted,
        fit.measurements,
        independent,
    )


def _independent(block: FitBlock, process: ErrorProcess) -> float:
    lags = np.arange(1, len(process.along_time))
    in_time = 1 + 2 * float((1 - lags / len(block.t_s)) @ process.along_time[1:])
    seen = block.channels[2].any(axis=0)
    among = process.among_channels[np.ix_(seen, seen)]
    total = float(np.trace(among)) ** 2
    # Few samples make channels look alike that are not: that much is taken off tr Σ².
    alike = float(np.sum(among**2)) - total / max(process.samples, 1.0)
    channels = float(np.clip(total / max(alike, 1e-300), 1.0, len(among)))
    return block.measurements * channels / len(among) / max(1.0, in_time)
