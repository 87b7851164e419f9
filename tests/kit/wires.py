"""A chain of rigid links with elastic hinges and Dahl's friction, in a plane, as another program has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import fsolve

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Chain:
    """Links of equal length, of which a clamp turns the first one; half a link is beyond each end."""

    length_m: float
    links: int
    bending_n_m2: float
    friction_n_m: float
    stick_n_m2: float
    weight_n_m: float
    tip_n: float = 0.0

    def equilibria(self, clamps_rad: Array) -> Array:
        """Return the angles (K, links + 1) of the links with the horizontal at angles of the clamp,
        one after another, by integration of Dahl's rate in small turns of the clamp.
        """
        step_m = self.length_m / self.links
        lengths = np.full(self.links + 1, step_m)
        lengths[[0, -1]] /= 2
        below_n = self.tip_n + self.weight_n_m * (np.cumsum(lengths[::-1])[::-1] - lengths / 2)
        angles = np.zeros(self.links + 1)
        friction = np.zeros(self.links)
        shapes = []
        at = clamps_rad[0]
        # At the first angle of the clamp there is no friction.
        angles = self._balanced(angles, at, friction, below_n, lengths, step_m, None)[0]
        for goal in clamps_rad:
            for clamp in np.linspace(at, goal, 1 + int(np.ceil(abs(goal - at) / 0.01)))[1:]:
                bends = np.diff(angles) / step_m
                angles, friction = self._balanced(
                    angles, clamp, friction, below_n, lengths, step_m, bends
                )
            at = goal
            shapes.append(angles)
        return np.array(shapes)

    def _balanced(self, angles, clamp, friction, below_n, lengths, step_m, bends):
        def slipped(now: Array) -> Array:
            if bends is None:
                return friction
            change = np.diff(now) / step_m - bends
            limit = np.sign(change) * self.friction_n_m
            share = np.exp(-self.stick_n_m2 * np.abs(change) / self.friction_n_m)
            return limit + (friction - limit) * share

        def unbalanced(free: Array) -> Array:
            now = np.append(clamp, free)
            moments = self.bending_n_m2 * np.diff(now) / step_m + slipped(now)
            beyond = np.append(moments[1:], 0.0)
            return moments - beyond + below_n[1:] * lengths[1:] * np.cos(now[1:])

        for disturbance in (0.0, 1e-3, -1e-3):  # at a reversal the derivative jumps
            start = angles[1:] + disturbance * np.linspace(0, 1, self.links)
            found, info, *_ = fsolve(unbalanced, start, xtol=1e-10, full_output=True)
            if np.abs(info["fvec"]).max() < 1e-6 * self.friction_n_m:
                break
        else:
            raise ArithmeticError("no equilibrium was found")
        now = np.append(clamp, found)
        return now, slipped(now)

    def points_m(self, shapes: Array, s_m: Array) -> Array:
        """Return places (K, M, 2) at arc lengths of shapes (K, links + 1)."""
        lengths = np.full(self.links + 1, self.length_m / self.links)
        lengths[[0, -1]] /= 2
        ends = np.append(0.0, np.cumsum(lengths))
        steps = lengths[None, :, None] * np.stack([np.cos(shapes), np.sin(shapes)], axis=2)
        places = np.concatenate([np.zeros((len(shapes), 1, 2)), np.cumsum(steps, axis=1)], axis=1)
        return np.stack(
            [[np.interp(s_m, ends, places[k, :, c]) for c in (0, 1)] for k in range(len(shapes))]
        ).swapaxes(1, 2)
