"""Where the grasps hold a body's dofs, as a function of how it is off in them.

A grasped node is at U_t H(φ) X, see `nuisance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from ..experiment.experiment import Experiment
from ..experiment.grasp import held_nodes
from ..fem.pattern import dofs_of
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
    def nodes(self) -> Index:
        """(h,) nodes that are grasped at some time."""
        return held_nodes(self.experiment.grasps)

    @cached_property
    def dofs(self) -> Index:
        """(3h,) their dofs."""
        return dofs_of(self.nodes)

    def at(self, phi: Array) -> Held:
        """The goals at φ."""
        if not self.nuisance.moves_grasps:
            return self._fixed
        moved, slopes = self.nuisance.carried(self._places_m, phi)
        rotated = np.zeros((*self._translations.shape, len(self.nuisance.moving)))
        rotated[..., self._columns] = np.einsum("thij,hjk->thik", self._rotations, slopes)
        positions = np.einsum("thij,hj->thi", self._rotations, moved) + self._translations
        rows = len(self.t_s)
        free = np.isnan(positions)
        rotated[free] = 0.0
        return Held(
            self.dofs,
            positions.reshape(rows, -1),
            rotated.reshape(rows, len(self.dofs), -1),
        )

    def curvature(self, phi: Array, weights: Array) -> Array:
        """Σ weights[t, g] ∂²goal/∂φ² (m, m), for weights (N, g) that are zero while free."""
        second = self.nuisance.carried_curvature(self._places_m, phi)
        by_node = weights.reshape(len(self.t_s), -1, 3)
        pulled = np.einsum("thij,thi->hj", np.nan_to_num(self._rotations), by_node)
        found = np.zeros((len(self.nuisance.moving),) * 2)
        found[np.ix_(self._columns, self._columns)] = np.einsum("hj,hjkl->kl", pulled, second)
        return found

    @property
    def _places_m(self) -> Array:
        return self.experiment.body.nodes_m[self.nodes]

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
        """Rotations (N, h, 3, 3) and translations (N, h, 3) of every node, NaN while free."""
        rows, count = len(self.t_s), len(self.nodes)
        rotations, translations = (np.full((rows, count, *s), np.nan) for s in ((3, 3), (3,)))
        for grasp in self.experiment.grasps:
            here = np.ix_(
                np.flatnonzero(grasp.holds(self.t_s)), np.searchsorted(self.nodes, grasp.nodes)
            )
            turned, moved = grasp.poses.at(self.t_s[here[0].ravel()])
            rotations[here] = turned[:, None]
            translations[here] = moved[:, None]
        return rotations, translations

    @property
    def _rotations(self) -> Array:
        return self._poses[0]

    @property
    def _translations(self) -> Array:
        return self._poses[1]
