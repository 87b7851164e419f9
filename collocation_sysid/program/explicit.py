"""What experiments carry as variables of a program, in their order."""

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
    """Of each experiment the reactions of grasps with a sensor, its memory, what forces carry, the
    pressures of contact as complementarity, and its wrenches.

    Parameters
    ----------
    first_phi : where in z the φ of all experiments begin
    places : where what is carried begins
    """
    found: list[Carried] = []
    for number, segment in enumerate(segments):
        reactions, here = None, (segment, number, first_phi)
        wrenches = [
            (k, reading)
            for k, reading in enumerate(segment.readings)
            if reading.channel.local is None and reading.channel.count
        ]
        if wrenches:
            reactions = Reactions(*here, places)
            found.append(reactions)
            places = reactions.after
        histories = 0
        if segment.body.remembers:
            found.append(Overstress(*here, places, reactions))
            places, histories = found[-1].after, 1
        for history, force in enumerate(segment.dynamics.forces.carrying, histories):
            found.append(ForceRows(*here, places, history, force, reactions))
            places = found[-1].after
            histories = history + 1
        for history, force in enumerate(segment.dynamics.forces.pressing, histories):
            found.append(PressureRows(*here, places, history, force, reactions))
            places = found[-1].after
        for wrench in wrenches:
            assert reactions is not None
            found.append(WrenchRows(*here, places, *wrench, reactions))
            places = found[-1].after
    return tuple(found)
