"""Contact with obstacles in checks and runs: likely errors, concerns, gaps and pressures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ...common.array_types import Array
from ...methods.solution import Solution
from ...model.contact.summary import ContactSummary, contact_summaries, surface_gaps_and_pressures
from ...program.collocation import ExperimentIterate
from ...recording.experiment import Experiment
from ...recording.obstacle import Obstacle
from ...recording.obstacle_solids import Plane
from ...statistics.concerns import Concern, Topic, concern_if
from ...statistics.misspecification.hypothesis import Hypothesis
from ..feature import Feature
from .obstacles import MESSAGES, obstacle_hypotheses

# Number of faces below which the mesh determines the width of a contact.
FEWEST_FACES = 4.0
# Penetration of a solid from which on a node is inside, over the body's diagonal.
DEEP = 0.01
# Largest share of the nodes that may be inside.
MOST_INSIDE = 0.5


def placement_mistakes(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield hypotheses about parts of a body that no grasp holds, and about each obstacle that
    contains more than half of it; they need no further test.
    """
    yield from _loose_parts(experiment)
    for obstacle in experiment.obstacles:
        yield from _containing(experiment, obstacle)


def _loose_parts(experiment: Experiment) -> Iterator[Hypothesis]:
    """No grasp holds some of the parts; nothing is known without grasps, or with tendons."""
    cells = experiment.body.cells
    count = len(experiment.body.nodes_m)
    first = np.repeat(cells[:, 0], cells.shape[1] - 1)
    edges = coo_array((np.ones(len(first)), (first, cells[:, 1:].ravel())), shape=(count, count))
    _, labels = connected_components(edges, directed=False)
    parts, sizes = np.unique(labels[np.unique(cells)], return_counts=True)
    grasped_labels = [labels[grasp.nodes] for grasp in experiment.body_grasps]
    loose = (
        ~np.isin(parts, np.concatenate(grasped_labels))
        if grasped_labels
        else np.zeros(len(parts), dtype=bool)
    )
    if loose.any() and not experiment.tendons:
        data = {"parts": len(parts), "loose": int(loose.sum()), "nodes": int(sizes[loose].max())}
        yield Hypothesis("mesh-parts", f"'{experiment.name}'", data=data, strength=float(count))


def _containing(experiment: Experiment, obstacle: Obstacle) -> Iterator[Hypothesis]:
    """Blame the normal of a plane with the whole body behind it, else the place of the obstacle."""
    nodes_m = experiment.rigid_positions(experiment.t_s[:1])[
        0, : len(experiment.body.nodes.points_m)
    ]
    rotations, translations_m = obstacle.poses.at(experiment.t_s[:1])
    gaps_m = obstacle.shape.signed_distances_m((nodes_m - translations_m[0]) @ rotations[0])
    deep_m = DEEP * float(np.linalg.norm(np.ptp(nodes_m, axis=0)))
    share = float((gaps_m < -deep_m).mean())
    if share <= MOST_INSIDE:
        return
    reversible = isinstance(obstacle.shape, Plane) and not (gaps_m > deep_m).any()
    code = "obstacle-normal" if reversible else "obstacle-place"
    data = {"obstacle": obstacle.name, "percent": 100 * share}
    yield Hypothesis(code, f"'{experiment.name}'", data=data, strength=100 * share)


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


def hypotheses(experiment: Experiment) -> tuple[Hypothesis, ...]:
    """Return likely errors in the placement of a body, or else in its obstacles and their loads."""
    return tuple(placement_mistakes(experiment)) or tuple(obstacle_hypotheses(experiment))


def fit_hypotheses(solution: Solution) -> Iterator[Hypothesis]:
    """Yield likely errors in the obstacles of the fitted experiments and their loads."""
    for transcription in solution.collocation.transcriptions:
        yield from obstacle_hypotheses(transcription.experiment)


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
    at positions (T, n, 3) [m], (T, F) each; nothing without obstacles.

    Poses are corrected by the nuisance parameters if the experiment was fitted.
    """
    if not experiment.obstacles:
        return {}
    if (part := solution.part_of(experiment.name)) is not None:
        experiment = part.transcription.corrected_experiment(part.phi)
    theta = experiment.body.theta_from_values(solution.parameters)
    gaps_m, pressures_pa = surface_gaps_and_pressures(
        experiment, np.array(theta), x=positions_m.reshape(len(positions_m), -1)
    )
    return {"gaps_m": gaps_m, "pressures_pa": pressures_pa}


CONTACT = Feature(
    topics=TOPICS,
    messages=MESSAGES,
    hypotheses=hypotheses,
    fit_hypotheses=fit_hypotheses,
    guess_concerns=guess_concerns,
    concerns=concerns,
)
