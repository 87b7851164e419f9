"""Contact within one time step, restricted to the points that may touch.

Other points of the surface contribute nothing, and obstacles do not move while the step is solved.
Candidate points are therefore searched once a step, with a margin, and only the forces on the nodes
of their faces are evaluated, with exact derivatives for Newton's method.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ...common.array_types import Array, Index
from ...fem.contact_surface import VECTORS_PER_POINT
from ...fem.pattern import SymmetricPattern
from ..local_force import ActivePoints, CandidatePoints, LocalForce
from .law import POINT_BATCH, ContactLaw

# Share of this distance by which a coordinate may change before candidates are searched again.
CHANGE = 1 / 3


@dataclass(frozen=True, eq=False)
class ContactCandidates:
    """Contact points that an obstacle may touch in a time step."""

    law: ContactLaw  # contact law of the obstacle
    points: CandidatePoints

    @cached_property
    def _last_data(self) -> dict[tuple[float, bytes, bytes], Array]:
        """Data at the last evaluation, by length of the step, constants and frame."""
        return {}

    @staticmethod
    @lru_cache(maxsize=64)
    def from_indices(
        law: ContactLaw, pattern: SymmetricPattern, chosen: bytes
    ) -> ContactCandidates:
        """Build the candidates of an obstacle; the last 64 are cached by their arguments, because
        successive steps are similar.

        Parameters
        ----------
        chosen : bytes
            Indices of the points among all contact points, an array of int64 as bytes.
        """
        some = np.frombuffer(chosen, dtype=np.int64)
        points = law.surface.points
        return ContactCandidates(
            law,
            CandidatePoints.from_nodes(
                some,
                points.nodes[some, :-VECTORS_PER_POINT],
                weights=points.node_weights[some, 0, :-VECTORS_PER_POINT],
                pattern=pattern,
            ),
        )

    def inputs(self, xi: Array, nu: Array, constants: Array, step_s: float) -> tuple[Array, Array]:
        """Return the inputs of the law's `point_force_function` at i candidates: positions [m] and,
        if the law depends on them, velocities [m/s] (3 or 6, i) relative to the obstacle's frame,
        and the data (d, i) of the points.

        Parameters
        ----------
        xi, nu : (3n,) arrays
            State [m] and velocity [m/s].
        constants : (c,) array
            Constants of the law.
        step_s : float
            Length of the time step over which the pressure is averaged [s]; 0 if it is not.
        """
        moving = (xi, nu) if self.law.depends_on_velocity else (xi,)
        nodes = np.concatenate(
            [each.reshape(-1, 3).take(self._nodes, axis=0) for each in moving], axis=1
        )
        frame = nodes[-VECTORS_PER_POINT:]
        u = self.points.interpolate(nodes[:-VECTORS_PER_POINT] - frame[0])
        return u, self._data_with(frame, constants, step_s=step_s)

    @cached_property
    def _nodes(self) -> Index:
        """Nodes (m + 4,) of the faces of all candidates, then those of the obstacle's frame."""
        return np.concatenate([self.points.all_nodes, self.law.obstacle.nodes])

    def _data_with(self, frame: Array, constants: Array, step_s: float) -> Array:
        """Return the data (d, i), stored: the frame does not move within a step."""
        key = step_s, constants.tobytes(), frame.tobytes()
        data = self._last_data.get(key)
        if data is None:
            ends = (frame[1:] - frame[0]).reshape(3, -1, 3)
            same = np.concatenate([ends.swapaxes(0, 1).ravel(), constants])
            indices = self.points.point_indices
            data = np.concatenate(
                [
                    np.broadcast_to(same[:, None], (len(same), len(indices))),
                    self.law.data_of(indices, step_s),
                ]
            )
            self._last_data.clear()
            self._last_data[key] = data
        return data


class StepContact(LocalForce):
    """Contact with one obstacle in one time step of a body with constants θ (k,).

    The obstacle is treated as fixed in the derivatives, and the reaction on it is left out. The
    candidates are stored, and searched again when the state has changed too much. The last active
    points are stored, too: the force at the end of a step is that of the last iteration.

    Parameters
    ----------
    theta : (k,) array
        Constants of the body.
    step_s : float
        Length of the time step over which the pressure is averaged [s]; 0 if it is not.
    """

    def __init__(
        self, law: ContactLaw, theta: Array, pattern: SymmetricPattern, step_s: float
    ) -> None:
        self.depends_on_velocity = law.depends_on_velocity
        self._law = law
        self._constants = theta[law.constant_columns]
        self._pattern = pattern
        self._step_s = step_s
        self._from = np.full((1, 1), np.nan)
        self._last_candidates: ContactCandidates | None = None
        self._last_evaluation: tuple[Array, Array, ActivePoints] | None = None
        # In edges of the surface.
        self._margin_m = 0.25 * law.surface.edge_m

    def force(self, xi: Array, nu: Array) -> Array:
        if self._last_evaluation is not None:
            last_xi, last_nu, points = self._last_evaluation
            if np.array_equal(last_xi, xi) and np.array_equal(last_nu, nu):
                return points.assemble(xi.size)
        candidates = self._candidates(xi[0], nu[0])
        if candidates is None:
            return np.zeros(xi.size)
        push = self._law.point_force_function.evaluate(*self._inputs(candidates, xi, nu))
        return candidates.points.assemble(push, xi.size)

    def active_points(
        self, xi: Array, nu: Array, rates: tuple[float, float]
    ) -> ActivePoints | None:
        candidates = self._candidates(xi[0], nu[0])
        if candidates is None:
            return None
        inputs = self._inputs(candidates, xi, nu)
        force, slopes = self._law.point_force_function.evaluate_with_jacobian(*inputs)
        (touching,) = np.nonzero(force.any(axis=0))
        points = ActivePoints(
            self._law,
            candidates.points,
            indices=touching,
            force=force[:, touching],
            slopes=slopes,
            rates=rates,
        )
        self._last_evaluation = xi, nu, points
        return points

    def _inputs(self, candidates: ContactCandidates, xi: Array, nu: Array) -> tuple[Array, Array]:
        """Return the inputs of the law at candidates in the state ξ and ν, (1, 3n) each."""
        return candidates.inputs(xi[0], nu[0], constants=self._constants, step_s=self._step_s)

    def _candidates(self, xi: Array, nu: Array) -> ContactCandidates | None:
        """Candidates at ξ and ν; searched again if the state left the margin. None without any."""
        ends = xi[None]
        if self._step_s:
            # A pressure that is averaged over a step depends on the states at both ends.
            half_step = self._step_s / 2 * nu
            ends = np.array([xi - half_step, xi + half_step])
        if not np.abs(ends - self._from).max() <= CHANGE * self._margin_m:
            self._from = ends
            self._last_candidates = self._candidates_near(ends)
        return self._last_candidates

    def _candidates_near(self, states: Array) -> ContactCandidates | None:
        """Points within the margin in any of the states (s, 3n) [m]; None without any."""
        law = self._law
        gaps_m = law.gaps(law.surface.points.vectors(states)).min(axis=0)
        is_near = gaps_m < law.widths_m + self._margin_m
        # Others fill the last vector of the compiled law.
        (others,) = np.nonzero(~is_near)
        is_near[others[: -is_near.sum() % POINT_BATCH]] = True
        (chosen,) = np.nonzero(is_near)
        if not len(chosen):
            return None
        return ContactCandidates.from_indices(law, self._pattern, chosen=chosen.tobytes())
