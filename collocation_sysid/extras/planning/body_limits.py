"""Limits of the body during a plan: stretch of its elements, and clearance to obstacles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...model.contact.force import Contact, contact_terms
from ...recording import Experiment
from .hand_limits import WITHIN

# Limits enter a step if their value is above this, or becomes positive to first order.
NEAR = -0.05


@dataclass(frozen=True, eq=False)
class BodyLimits:
    """Limits of the body at the samples of a plan, as values that must not be positive.

    The first values belong to the elements, with the largest principal stretch of the mean
    deformation gradient, the others to the points of the surface that an obstacle may touch.
    """

    experiment: Experiment  # experiment of the plan
    theta: Array  # (k,): constants of the body
    sample_rows: Index  # (T,) of int: grid times of the samples
    largest_stretch: float | None  # largest principal stretch
    clearance_m: float | None  # smallest distance to obstacles [m]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of the limit of each value of one sample."""
        elements = len(self._gradients) if self.largest_stretch is not None else 0
        points = sum(len(each.law_of_contact.widths_m) for each in self._contacts)
        return ("largest_stretch",) * elements + ("clearance_m",) * points

    @cached_property
    def _gradients(self) -> Array:
        """Mean shape gradients (E, nodes, 3) of the elements [1/m]."""
        body = self.experiment.body
        geometry = body.stress_free_geometry(self.theta)
        cells, points = geometry.shape[:2]
        return geometry[..., :-1].reshape(cells, points, body.element.nodes, 3).mean(axis=1)

    @cached_property
    def _contacts(self) -> tuple[Contact, ...]:
        return () if self.clearance_m is None else contact_terms(self.experiment)

    def extremes(self, x: Array) -> dict[str, float]:
        """Return the largest stretch and the smallest clearance [m] in positions (T, 3n) [m], by
        the name of the limit; of those that are limited.
        """
        found = {}
        if self.largest_stretch is not None:
            found["largest_stretch"] = float(self._stretches(x)[0].max())
        if self._contacts:
            found["clearance_m"] = min(float(gaps.min()) for gaps, _ in self._gaps(x))
        return found

    def values(self, x: Array) -> Array:
        """Return the values (T, m) at positions (T, 3n) [m] at the samples."""
        parts = []
        if self.largest_stretch is not None:
            parts.append(self._stretches(x)[0] / (WITHIN * self.largest_stretch) - 1)
        if self.clearance_m is not None:
            parts += [1 - WITHIN * gaps / self.clearance_m for gaps, _ in self._gaps(x)]
        return np.concatenate(parts, axis=1) if parts else np.zeros((len(x), 0))

    def linearise(self, x: Array, slopes: Array, enters: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return the values (k,) that enter a step, and their derivatives (k, c).

        Parameters
        ----------
        x : (N, 3n) array
            Motion [m].
        slopes : (N, 3n, c) array
            Its derivatives by the unknowns.
        enters : (T, m) array
            Which of the values these are.
        """
        sampled, moved = x[self.sample_rows], slopes[self.sample_rows]
        values = self.values(sampled)
        chosen = np.argwhere(enters)
        by_c = np.zeros((len(chosen), slopes.shape[2]))
        elements = self.names.count("largest_stretch")
        of_elements = chosen[:, 1] < elements
        if of_elements.any():
            times, cells = chosen[of_elements].T
            _, directions, stretched = self._stretches(sampled[np.unique(times)])
            rows = np.searchsorted(np.unique(times), times)
            nodes = self.experiment.body.cells[cells]
            at_nodes = moved.reshape(len(moved), -1, 3, slopes.shape[2])[times[:, None], nodes]
            shares = np.einsum("kaj,kj->ka", self._gradients[cells], directions[rows, cells])
            by_c[of_elements] = np.einsum(
                "ka,ki,kaic->kc", shares, stretched[rows, cells], at_nodes, optimize=True
            )
            assert self.largest_stretch is not None
            by_c[of_elements] /= WITHIN * self.largest_stretch
        first = elements
        for contact, (gaps, by_vector) in zip(self._contacts, self._gaps(sampled), strict=True):
            own = (chosen[:, 1] >= first) & (chosen[:, 1] < first + gaps.shape[1])
            for time in np.unique(chosen[own, 0]):
                at = np.flatnonzero(own & (chosen[:, 0] == time))
                points = chosen[at, 1] - first
                vectors = contact.points.vectors(moved[time].T)[:, :, points]
                by_c[at] = np.einsum("vi,vci->ic", by_vector[:, time, points], vectors)
            assert self.clearance_m is not None
            by_c[own] *= -WITHIN / self.clearance_m
            first += gaps.shape[1]
        return values[tuple(chosen.T)], by_c

    def _stretches(self, x: Array) -> tuple[Array, Array, Array]:
        """Return the largest principal stretch (T, E), its direction v (T, E, 3) in the undeformed
        body, and the unit vector along F v (T, E, 3), for positions (T, 3n) [m].
        """
        nodes = x.reshape(len(x), -1, 3)[:, self.experiment.body.cells]
        gradient = np.einsum("teai,eaj->teij", nodes, self._gradients, optimize=True)
        squares, vectors = np.linalg.eigh(np.swapaxes(gradient, -1, -2) @ gradient)
        stretch = np.sqrt(squares[..., -1])
        direction = vectors[..., -1]
        stretched = np.einsum("teij,tej->tei", gradient, direction) / stretch[..., None]
        return stretch, direction, stretched

    def _gaps(self, x: Array) -> list[tuple[Array, Array]]:
        """Return the gaps (T, i) [m] of each obstacle's points and their slopes (12, T, i)."""
        return [
            each.law_of_contact.gaps_with_slopes(each.points.vectors(x)) for each in self._contacts
        ]
