"""Huber's loss as squared residuals, so that least-squares steps can lower it."""

from __future__ import annotations

import numpy as np

from ..arrays import Array


def huberised(residual: Array, slope: Array, threshold: float) -> tuple[Array, Array]:
    """Residuals and slopes whose squares sum to Huber's loss, with its gradient.

    With d the length of a sample's residual and δ the threshold, ρ = d² up to δ and 2δd − δ²
    beyond; residuals are scaled by √ρ / d and slopes by δ / √ρ there, so that r'ᵀr' = Σρ and
    S'ᵀr' is half its gradient (Huber 1964; reweighting after Triggs et al. 2000, sec. 4.3).

    Parameters
    ----------
    residual : (3 k,) ndarray
        Three coordinates of each sample, in standard deviations.
    slope : (3 k, nq) ndarray
    threshold : float
    """
    samples = residual.reshape(-1, 3)
    length = np.linalg.norm(samples, axis=1)
    beyond = np.maximum(length, threshold)
    root = np.sqrt(2 * threshold * beyond - threshold**2)
    shrunk = samples * np.where(length > threshold, root / beyond, 1.0)[:, None]
    weights = np.where(length > threshold, threshold / root, 1.0)
    return shrunk.ravel(), slope * np.repeat(weights, 3)[:, None]
