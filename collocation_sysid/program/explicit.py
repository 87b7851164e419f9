"""Lifted variables of all experiments in the order of the program, see `carried`."""

from __future__ import annotations

from collections.abc import Sequence

from .carried import Carried, Places
from .force_rows import ForceRows
from .pressure_rows import PressureRows
from .reaction_rows import Reactions
from .segment import Segment
from .viscoelastic_rows import Overstress
from .wrench_rows import WrenchRows


def carried_by(segments: Sequence[Segment], first_phi: int, places: Places) -> tuple[Carried, ...]:
    """Create the groups of lifted variables of all experiments.

    For each experiment, in this order: reaction forces of instrumented grasps, memory of the
    material, history variables of forces, contact pressures of complementarity problems, and
    measured wrenches. Quantities that an experiment does not have are left out.

    Parameters
    ----------
    segments : sequence of Segment
        Transcriptions of the experiments.
    first_phi : int
        Index in z where the nuisance parameters of all experiments begin.
    places : Places
        Offsets of the first group.
    """
    groups: list[Carried] = []
    for number, segment in enumerate(segments):
        reactions = None
        lift = {"segment": segment, "number": number, "first_phi": first_phi}
        wrenches = [
            (k, reading)
            for k, reading in enumerate(segment.readings)
            if reading.channel.local is None and reading.channel.count
        ]
        if wrenches:
            reactions = Reactions(**lift, places=places)
            groups.append(reactions)
            places = reactions.after
        histories = 0
        if segment.body.remembers:
            groups.append(Overstress(**lift, places=places, reactions=reactions))
            places = groups[-1].after
            histories = 1
        for history, force in enumerate(segment.dynamics.forces.carrying, histories):
            groups.append(
                ForceRows(
                    **lift, places=places, along=history, force_number=force, reactions=reactions
                )
            )
            places = groups[-1].after
            histories = history + 1
        for history, force in enumerate(segment.dynamics.forces.pressing, histories):
            groups.append(
                PressureRows(
                    **lift, places=places, along=history, force_number=force, reactions=reactions
                )
            )
            places = groups[-1].after
        for k, reading in wrenches:
            assert reactions is not None
            groups.append(
                WrenchRows(
                    **lift, places=places, reading_number=k, reading=reading, reactions=reactions
                )
            )
            places = groups[-1].after
    return tuple(groups)
