"""Potts prior of the phases of a two-phase field, whose two constants are estimated.

With the phases h ∈ {0, 1}ᴱ of the elements, a field B per element of phase 1 and a strength J,

    −ln π(h) = J Σ_f w_f |Δh|_f − B Σ_e h_e + ln Z(J, B).

The first sum is over the faces between two elements, w_f is the face's area over the mean area. A
given J without B makes inclusions too small and, in exchange, their contrast too large, because the
area decreases with the volume. B balances it. J and B are therefore unknown, with normal priors,
and sampled with the phases. Their likelihood is the pseudo-likelihood Π_e π(h_e | neighbours) of
Besag (1975), which does not contain Z: a logistic regression on the phases of the neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..common.array_types import Array


class PottsConstants(NamedTuple):
    """Constants of the Potts prior of one or several chains."""

    face_nats: Array  # (C,): strength J for each of C chains [nats per face of mean area]
    element_nats: Array  # (C,): field B [nats per element]


@dataclass(frozen=True)
class PottsHyperprior:
    """Normal prior of the constants J and B, and limits of their estimation."""

    # Mean of J. Tetrahedra have four neighbours like the sites of the diamond lattice, whose phases
    # are disordered below 0.74; from 3 on, single elements never differ.
    face_nats: float = 1.5
    # Standard deviation of J: the mean is between both limits, which are about one deviation away.
    face_deviation: float = 1.0
    # Standard deviation of B, whose mean is zero: about half of what four faces weigh.
    element_deviation: float = 2.0
    # Newton steps of the mode; each changes J by at most 0.5 and B by at most 1.
    newton_steps: int = 8
    largest_logit: float = 30.0  # limit of the logits, against overflow

    def draw(
        self,
        phases: Array,
        face_balance: Array,
        constants: PottsConstants,
        rng: np.random.Generator,
    ) -> PottsConstants:
        """Draw J ≥ 0 and B given the phases of each chain, from Laplace's approximation of their
        pseudo-posterior.

        Parameters
        ----------
        phases : (C, E) array
            Phases of each chain, 0 or 1.
        face_balance : (C, E) array
            For each element, the weights of the faces to neighbours of phase 1 less those of the
            faces to neighbours of phase 0.
        constants : PottsConstants
            Start of the search for the mode.
        rng : numpy.random.Generator
            Source of random numbers; advanced.
        """
        pairs = [
            self._draw_chain(phase, balance, start=np.array(start), rng=rng)
            for phase, balance, start in zip(
                phases, face_balance, zip(*constants, strict=True), strict=True
            )
        ]
        drawn = np.array(pairs)
        return PottsConstants(np.maximum(drawn[:, 0], 0.0), element_nats=drawn[:, 1])

    def _draw_chain(
        self, phase: Array, balance: Array, start: Array, rng: np.random.Generator
    ) -> Array:
        """Draw (J, B) of a chain; the search for the mode begins at `start`."""
        regressors = np.column_stack([balance, np.ones_like(balance)])
        mean = np.array([self.face_nats, 0.0])
        precision = np.array([self.face_deviation, self.element_deviation])
        precision = precision**-2.0
        largest_step = np.array([0.5, 1.0])
        value = start
        information = np.diag(precision)
        for _ in range(self.newton_steps):
            logit = np.clip(regressors @ value, -self.largest_logit, self.largest_logit)
            probability = 1 / (1 + np.exp(-logit))
            score = regressors.T @ (phase - probability)
            score -= precision * (value - mean)
            spread = probability * (1 - probability)
            information = regressors.T @ (spread[:, None] * regressors)
            information += np.diag(precision)
            step = np.linalg.solve(information, score)
            value = value + np.clip(step, -largest_step, largest_step)
        covariance = np.linalg.inv(information)
        return value + np.linalg.cholesky(covariance) @ rng.normal(size=2)
