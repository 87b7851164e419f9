"""Contact with obstacles in checks and runs: likely errors, concerns, gaps and pressures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...methods.solution import Solution
from ...model.contact.summary import ContactSummary, contact_summaries, surface_gaps_and_pressures
from ...program.collocation import ExperimentIterate
from ...recording.experiment import Experiment
from ...statistics.concerns import Concern, Topic, concern_if

# Number of faces below which the mesh determines the width of a contact.
FEWEST_FACES = 4.0
AT_THE_GUESS = ", at the guess"
TOPICS = {
    "contact": Topic(
        "Contact",
        "contact",
        remedy="Check the position, the normal and the motion of the obstacle, and the mesh in the "
        "contact area.",
        messages={
            "never": "in '{experiment}'{more} the body never touches {obstacle}{guess}; the "
            "smallest gap is {mm:.3g} mm. The contact carries no information: check the place and "
            "the motion of the obstacle, or remove it",
            "coarse": "in '{experiment}'{more} only {faces:.2g} faces, {face_mm:.2g} mm large, "
            "touch {obstacle} at the same time{guess}: the mesh is too coarse for the contact area; "
            "refine it there",
            "pressed": "in '{experiment}'{more} the body touches {obstacle} already at the first "
            "sample{guess}: the beginning of the contact is not recorded; start the "
            "recording earlier",
            "lost": "in '{experiment}'{more} the body leaves {obstacle} at t = {t_s:.4g} s{guess}: "
            "if it remained in contact, check the motion of the obstacle and the guess, or "
            "end window_s before",
        },
    )
}


def guess_concerns(parts: Sequence[ExperimentIterate], is_complete: bool) -> list[Concern]:
    """Return concerns about contact in a simulation at the guess.

    `is_complete` is false if only the first samples were simulated: then there are only concerns
    about penetration at the start.
    """
    concerns = contact_concerns(summaries_of_parts(parts), AT_THE_GUESS)
    return [each for each in concerns if is_complete or each.code == "contact/pressed"]


def concerns(parts: Sequence[ExperimentIterate]) -> list[Concern]:
    """Return concerns about contact in the fit, see `contact_concerns`."""
    return contact_concerns(summaries_of_parts(parts))


def summaries_of_parts(parts: Iterable[ExperimentIterate]) -> Iterator[ContactSummary]:
    """Yield the contact summaries of each obstacle of each experiment, experiment by experiment, at
    the positions of its iterate.
    """
    for part in parts:
        t_s = part.equations.dynamics.t_s[: len(part.x)]
        yield from contact_summaries(part.transcription.experiment, part.x, t_s=t_s)


def contact_concerns(summaries: Iterable[ContactSummary], guess: str = "") -> list[Concern]:
    """Return concerns about obstacles that are never touched, or by too few faces to resolve the
    contact.

    For a simulation at the guess, also about obstacles that lose contact, or are in contact at the
    first sample. A concern that several experiments share is returned once, for the worst of them.

    Parameters
    ----------
    guess : str
        Text that refers to the guess, such as " at the guess"; empty for an answer.

    Notes
    -----
    An obstacle that is never touched is "doubtful" for an answer and "check" at the guess; all
    others are "check". One concern is returned for each code and name of an obstacle: that of the
    experiment with the fewest faces in contact, with the number of the other experiments in its
    message.
    """
    concerns: dict[tuple[str, str], list[Concern]] = {}
    for each in sorted(summaries, key=lambda touch: touch.face_count):
        data = {"experiment": each.experiment, "obstacle": each.obstacle, "guess": guess}
        coarse = 0 < each.face_count < FEWEST_FACES
        sizes = {"faces": each.face_count, "face_mm": each.face_mm}
        for one in (
            *concern_if(
                not each.face_count, not guess, code="contact/never", mm=1e3 * each.gap_m, **data
            ),
            *concern_if(coarse, False, code="contact/coarse", **sizes, **data),
            *concern_if(
                bool(guess) and each.is_initially_in_contact, False, code="contact/pressed", **data
            ),
            *concern_if(
                bool(guess and each.separation_s),
                False,
                code="contact/lost",
                t_s=each.separation_s,
                **data,
            ),
        ):
            concerns.setdefault((one.code, each.obstacle), []).append(one)
    return [
        replace(first, data={**first.data, "more": f" and {len(others)} more" if others else ""})
        for first, *others in concerns.values()
    ]


def contact_fields(
    experiment: Experiment, solution: Solution, positions_m: Array
) -> dict[str, Any]:
    """Return the fields of `MotionRecord` with gap [m] and pressure [Pa] on the boundary triangles
    at positions (T, n, 3) [m], (T, F) each, of an experiment with obstacles.

    Poses are corrected by the nuisance parameters if the experiment was fitted.
    """
    if (part := solution.part_of(experiment.name)) is not None:
        experiment = part.transcription.corrected_experiment(part.phi)
    theta = experiment.body.theta_from_values(solution.parameters)
    gaps_m, pressures_pa = surface_gaps_and_pressures(
        experiment, np.array(theta), x=positions_m.reshape(len(positions_m), -1)
    )
    return {"gaps_m": gaps_m, "pressures_pa": pressures_pa}
