"""Lifted variables of all experiments in the order of the program, see `lifted_variables`."""

from __future__ import annotations

from collections.abc import Sequence

from ..transcription import Transcription
from .lifted_force_histories import LiftedForceHistory
from .lifted_memory import LiftedMemory
from .lifted_pressures import LiftedPressure
from .lifted_reactions import LiftedReactions
from .lifted_resultants import LiftedResultant
from .lifted_variables import LiftedOffsets, LiftedVariables


def lift_variables(
    transcriptions: Sequence[Transcription], first_phi: int, offsets: LiftedOffsets
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
    offsets : LiftedOffsets
        Offsets of the first group.

    Returns
    -------
    tuple of LiftedVariables
        The groups in the order of their variables in z, and of their equations in g.
    """
    groups: list[LiftedVariables] = []
    for number, transcription in enumerate(transcriptions):
        reactions = None
        lift = {"transcription": transcription, "segment_index": number, "first_phi": first_phi}
        resultants = [
            (k, reading)
            for k, reading in enumerate(transcription.residuals)
            if reading.observable.local is None and reading.observable.count
        ]
        if resultants:
            reactions = LiftedReactions(**lift, offsets=offsets)
            groups.append(reactions)
            offsets = reactions.next_offsets
        histories = 0
        if transcription.body.has_memory:
            groups.append(LiftedMemory(**lift, offsets=offsets, reactions=reactions))
            offsets = groups[-1].next_offsets
            histories = 1
        for history, force in enumerate(
            transcription.dynamics.forces.find_terms_with_internal_variables(), histories
        ):
            groups.append(
                LiftedForceHistory(
                    **lift,
                    offsets=offsets,
                    motion_history=history,
                    force_index=force,
                    reactions=reactions,
                )
            )
            offsets = groups[-1].next_offsets
            histories = history + 1
        for history, force in enumerate(
            transcription.dynamics.forces.find_complementarity_terms(), histories
        ):
            groups.append(
                LiftedPressure(
                    **lift,
                    offsets=offsets,
                    motion_history=history,
                    force_index=force,
                    reactions=reactions,
                )
            )
            offsets = groups[-1].next_offsets
        for k, reading in resultants:
            assert reactions is not None
            groups.append(
                LiftedResultant(
                    **lift, offsets=offsets, residual_index=k, residual=reading, reactions=reactions
                )
            )
            offsets = groups[-1].next_offsets
    return tuple(groups)
