"""Where the grasps hold a body's dofs, as a function of how it is off in them.

A grasped node is at U_t H(φ) X, see `nuisance`, along the axes that are held.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from ..experiment.experiment import Experiment
from ..experiment.grasp import held_dofs
from .nuisance import NuisanceMap


@dataclass(frozen=True, eq=False)
class Held:
    """Goals of the dofs that are grasped at some time, on the time grid.

    Attributes
    ----------
    dofs : (g,) ascending
    positions_m : (N, g) NaN while free
    by_phi : (N, g, m) derivatives by the φ that move the body, zero while free; m = 0 where none
        of them moves the grasps
    """

    dofs: Index
    positions_m: Array
    by_phi: Array

    @property
    def moves(self) -> bool:
        """Whether the goals depend on φ."""
        return self.by_phi.shape[2] > 0


@dataclass(frozen=True, eq=False)
class Grasping:
    """The grasps of an experiment on its time grid.

    Attributes
    ----------
    experiment : Experiment
    nuisance : NuisanceMap
    t_s : (N,)
    """

    experiment: Experiment
    nuisance: NuisanceMap
    t_s: Array

    @cached_property
    def dofs(self) -> Index:
        """(g,) dofs that are grasped at some time."""
        return held_dofs(self.experiment.grasps)

    def at(self, phi: Array) -> Held:
        """The goals at φ."""
        if not self.nuisance.moves_grasps:
            return self._fixed
        moved, slopes = (each[self._node] for each in self.nuisance.carried(self._places_m, phi))
        rotated = np.zeros((*self._shifts.shape, len(self.nuisance.moving)))
        rotated[..., self._columns] = np.einsum("tgj,gjk->tgk", self._turns, slopes)
        positions = np.einsum("tgj,gj->tg", self._turns, moved) + self._shifts
        for number, grasp in enumerate(self.experiment.grasps):
            rows = np.flatnonzero(grasp.holds(self.t_s))
            for axis, place in zip(grasp.zero, self.nuisance.zero(number), strict=False):
                along = np.searchsorted(self.dofs, 3 * grasp.nodes + "xyz".index(axis))
                column = np.flatnonzero(self.nuisance.moving == place)
                positions[np.ix_(rows, along)] += self.nuisance.scales[place] * phi[place]
                rotated[np.ix_(rows, along, column)] = self.nuisance.scales[place]
        rotated[np.isnan(positions)] = 0.0
        return Held(self.dofs, positions, rotated)

    def curvature(self, phi: Array, weights: Array) -> Array:
        """Σ weights[t, g] ∂²goal/∂φ² (m, m), for weights (N, g) that are zero while free."""
        second = self.nuisance.carried_curvature(self._places_m, phi)
        pulled = np.einsum("tgj,tg->gj", np.nan_to_num(self._turns), weights)
        found = np.zeros((len(self.nuisance.moving),) * 2)
        of_dofs = np.einsum("gj,gjkl->kl", pulled, second[self._node])
        found[np.ix_(self._columns, self._columns)] = of_dofs
        return found

    @cached_property
    def _nodes(self) -> tuple[Index, Index]:
        """Nodes that are grasped at some time, and of each dof the place of its node in them."""
        nodes, places = np.unique(self.dofs // 3, return_inverse=True)
        return nodes, places

    @property
    def _node(self) -> Index:
        return self._nodes[1]

    @property
    def _places_m(self) -> Array:
        return self.experiment.body.nodes_m[self._nodes[0]]

    @property
    def _columns(self) -> Index:
        """Among the φ that move the body, those that move it in its grasps."""
        return np.flatnonzero(np.isin(self.nuisance.moving, self.nuisance.of_grasps))

    @cached_property
    def _fixed(self) -> Held:
        held = self.experiment.grasped(self.t_s)[1].reshape(len(self.t_s), -1)
        return Held(self.dofs, held[:, self.dofs], np.zeros((len(held), len(self.dofs), 0)))

    @cached_property
    def _poses(self) -> tuple[Array, Array]:
        """Of each dof its row of U_t, (N, g, 3) and (N, g), NaN while free."""
        turns, shifts = (np.full((len(self.t_s), len(self.dofs), *s), np.nan) for s in ((3,), ()))
        for grasp in self.experiment.grasps:
            here = np.flatnonzero(grasp.holds(self.t_s))
            place, axis = np.searchsorted(self.dofs, grasp.dofs), grasp.dofs % 3
            turned, moved = grasp.poses.at(self.t_s[here])
            turns[np.ix_(here, place)] = turned[:, axis]
            shifts[np.ix_(here, place)] = moved[:, axis]
        return turns, shifts

    @property
    def _turns(self) -> Array:
        return self._poses[0]

    @property
    def _shifts(self) -> Array:
        return self._poses[1]
