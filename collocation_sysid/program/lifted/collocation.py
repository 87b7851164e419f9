"""Program with lifted variables, for methods that need sparse exact matrices.

`with_lifted_variables` returns the program in which history variables, measured reactions,
pressures of obstacles and stresses of rods are variables with equations of their own, see
`lifted_variables`. The optimum and the multipliers of the other constraints are those of the program
in which they are eliminated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...common.array_types import Array, Index
from ..collocation import Collocation
from ..experiment_iterate import ExperimentIterate
from ..motion_transcription import Offsets, RowWeights, WeightedHistory
from ..transcription import Transcription
from .force_histories import LiftedForceHistory
from .memory import LiftedMemory
from .pressures import LiftedPressure, LiftedStress
from .reactions import LiftedReactions
from .resultants import LiftedResultant
from .variables import LiftedVariables


@dataclass(frozen=True, eq=False)
class LiftedCollocation(Collocation):
    """Collocation program with lifted variables at the end of z, and their equations at the end of
    g.

    The attributes are those of `Collocation`.
    """

    @property
    def eliminates_variables(self) -> bool:
        return False

    @cached_property
    def lifted(self) -> tuple[LiftedVariables, ...]:
        """Lifted variables, experiment by experiment."""
        return lift_variables(
            self.transcriptions,
            self.phi_columns.start,
            offsets=Offsets(self.phi_columns.stop, self.transcriptions[-1].next_offsets.row),
        )

    @property
    def variable_count(self) -> int:
        return super().variable_count + lifted_count(self)

    @property
    def constraint_count(self) -> int:
        return super().constraint_count + lifted_count(self)

    @property
    def has_eliminated_histories(self) -> bool:
        return False

    @cached_property
    def hessian_diagonals(self) -> tuple[Index, Index]:
        """Those of `Collocation`; to x belong also the stresses of rods."""
        of_q, of_x = super().hessian_diagonals
        ends, _ = self.hessian_structure
        stresses = [ends[1:][each.columns] - 1 for each in self.lifted if each.kind == "stress"]
        return of_q, np.concatenate([of_x, *stresses])

    def pack(self, p: Array, positions: Sequence[Array]) -> Array:
        parts = self.iterates_at(p, positions)
        lifted = [each.consistent_values(parts[each.transcription_index]) for each in self.lifted]
        return np.concatenate([super().pack(p, positions), *lifted])

    def iterates(self, z: Array) -> list[ExperimentIterate]:
        """Return every fitted experiment at the variables z, with lifted variables taken from z."""
        parts = super().iterates(z)
        for each in self.lifted:
            parts[each.transcription_index] = each.with_lifted(parts[each.transcription_index], z)
        return parts

    def bounds(self) -> tuple[Array, Array]:
        """Return lower and upper bounds of z, see `Collocation.bounds`; lifted variables have no
        upper bound.
        """
        lower, upper = super().bounds()
        least = [np.full(each.count, -np.inf) for each in self.lifted]
        return (
            np.concatenate([lower, *least]),
            np.concatenate([upper, np.full(lifted_count(self), np.inf)]),
        )

    def _additional_equations(self, parts: Sequence[ExperimentIterate], z: Array) -> list[Array]:
        return [each.residuals(parts[each.transcription_index], z) for each in self.lifted]

    def _additional_jacobian_entries(self) -> list[tuple[Index, Index]]:
        return [each.jacobian_entries() for each in self.lifted]

    def _additional_jacobian(
        self, parts: Sequence[ExperimentIterate], z: Array
    ) -> list[tuple[Array, Array]]:
        return [each.jacobian_values(parts[each.transcription_index], z) for each in self.lifted]

    def _additional_gradients(self, parts: Sequence[ExperimentIterate]) -> list[Array]:
        return [each.loss_gradient(parts[each.transcription_index]) for each in self.lifted]

    def _additional_weights(
        self, number: int, part: ExperimentIterate, multipliers: Array
    ) -> tuple[Array | float, list[WeightedHistory]]:
        own = [each for each in self.lifted if each.transcription_index == number]
        histories = [
            each.weighted_history(part, multipliers)
            for each in own
            if each.history_index is not None
        ]
        of_rows = sum((each.residual_weights(multipliers) for each in own), start=0.0)
        return of_rows, histories

    def _additional_hessian_entries(self) -> list[tuple[Index, Index]]:
        return [each.hessian_entries() for each in self.lifted]

    def _additional_hessian(
        self,
        parts: Sequence[ExperimentIterate],
        z: Array,
        loss_weight: float,
        multipliers: Array,
        weights: Sequence[RowWeights],
    ) -> list[Array]:
        return [
            each.hessian_values(
                parts[each.transcription_index],
                z,
                loss_weight=loss_weight,
                multipliers=multipliers,
                weights=weights[each.transcription_index],
            )
            for each in self.lifted
        ]


def with_lifted_variables(collocation: Collocation) -> Collocation:
    """Return the program with lifted variables, or the argument itself if it has them already or
    nothing can be lifted.

    The transcriptions are shared with the result, except those of bodies that are no solids.
    """
    is_solid = all(each.body.is_solid for each in collocation.transcriptions)
    if isinstance(collocation, LiftedCollocation) or not (
        collocation.eliminates_variables or not is_solid
    ):
        return collocation
    settings = {field.name: getattr(collocation, field.name) for field in fields(Collocation)}
    lifted = LiftedCollocation(**settings)
    # The same transcriptions, with the values that they have cached.
    vars(lifted)["transcriptions"] = tuple(
        each if each.body.is_solid else _with_given_stresses(each)
        for each in collocation.transcriptions
    )
    return lifted


def _with_given_stresses(transcription: Transcription) -> Transcription:
    """Return the transcription with `Kind.given_stresses` in its equations of motion."""
    theta = transcription.constants.theta(transcription.parameters.guess_q)
    energy_j = transcription.force_n * transcription.length_m
    body = transcription.body
    stresses = body.kind.given_stresses.from_body(body, theta, energy_j)
    dynamics = transcription.dynamics
    own = replace(transcription)
    vars(own)["dynamics"] = replace(dynamics, forces=stresses.added_to(dynamics.forces))
    return own


def lifted_variables(collocation: Collocation) -> tuple[LiftedVariables, ...]:
    """Return the groups of lifted variables of a program; empty for one without."""
    return collocation.lifted if isinstance(collocation, LiftedCollocation) else ()


def lifted_count(collocation: Collocation, kind: str | None = None) -> int:
    """Return the number of lifted variables of a program, which is also that of their equations; 0
    for a program without.

    Parameters
    ----------
    kind : {"memory", "force", "pressure", "stress", "reaction"}, optional
        Kind of lifted variables; None means all.
    """
    return sum(each.count for each in lifted_variables(collocation) if kind in (None, each.kind))


def lifted_nonzeros(collocation: Collocation) -> tuple[int, int]:
    """Return the numbers of additional entries due to lifted variables in the Jacobian, and in the
    upper triangle of the Hessian.
    """
    both = [each.entry_counts for each in lifted_variables(collocation)]
    return sum(each for each, _ in both), sum(each for _, each in both)


def lift_variables(
    transcriptions: Sequence[Transcription], first_phi: int, offsets: Offsets
) -> tuple[LiftedVariables, ...]:
    """Create the groups of lifted variables of all experiments.

    For each experiment, in this order: reaction forces of instrumented grasps, memory of the
    material, history variables of forces, pressures of complementarity problems, and
    measured resultants of reactions. Quantities that an experiment does not have are left out.

    Parameters
    ----------
    transcriptions : sequence of Transcription
        Transcriptions of the experiments.
    first_phi : int
        Index in z where the nuisance parameters of all experiments begin.
    offsets : Offsets
        Offsets of the first group.

    Returns
    -------
    tuple of LiftedVariables
        The groups in the order of their variables in z, and of their equations in g.
    """
    groups: list[LiftedVariables] = []
    for number, transcription in enumerate(transcriptions):
        lift = {
            "transcription": transcription,
            "transcription_index": number,
            "first_phi": first_phi,
        }

        def add(kind: type[LiftedVariables], lift: dict[str, Any] = lift, **own: Any) -> None:
            start = groups[-1].next_offsets if groups else offsets
            groups.append(kind(**lift, offsets=start, **own))

        resultants = [
            (k, residual)
            for k, residual in enumerate(transcription.residuals)
            if residual.observable.local is None and residual.observable.count
        ]
        if resultants:
            add(LiftedReactions)
        reactions = groups[-1] if resultants else None
        if transcription.body.has_memory:
            add(LiftedMemory, reactions=reactions)
        forces = transcription.dynamics.forces
        of_forces = [
            *((LiftedForceHistory, k) for k in forces.terms_with_internal_variables),
            *(
                (LiftedPressure if transcription.body.is_solid else LiftedStress, k)
                for k in forces.complementarity_terms
            ),
        ]
        for history, (kind, k) in enumerate(of_forces, int(transcription.body.has_memory)):
            add(kind, motion_history=history, force_index=k, reactions=reactions)
        for k, residual in resultants:
            add(LiftedResultant, residual_index=k, residual=residual, reactions=reactions)
    return tuple(groups)
