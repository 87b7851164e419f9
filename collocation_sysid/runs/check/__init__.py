"""Look at a problem before solving it: what it holds, what it will cost, and what will go wrong.

Every warning is one sentence that ends with the remedy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from ...arrays import Array
from ...methods.reduced_space import ReducedSpace
from ...methods.scan import SOFT_PA, started, usual_constants, usual_parameters
from ...methods.start import initial_variables
from ...model.schemes import as_scheme
from ...problem import Problem
from ...program.collocation import Collocation
from ...program.stability import Instability, instabilities
from ...program.touches import touched
from ...statistics.cameras import camera_mistakes
from ...statistics.concern import Concern
from ...statistics.hypothesis import Hypothesis, ranked
from ...statistics.modal import doubts
from ...statistics.numerical import MOST_SUBSTEPS
from ...statistics.placement_causes import placement_mistakes
from ...statistics.plausible import oddities
from ...statistics.scale import scale_concerns, stillness_concerns
from ...statistics.trust import contact_concerns, stability_concerns, turn_concerns
from ...statistics.wrench_causes import CHECKED_SAMPLES, wrench_mistakes
from ...tree import content
from .body import BodyFinding, ElementShape, Hold, body_finding, hold_concerns, holds_of
from .cost import Cost, cost_concerns, cost_notes, costs, nonzeros
from .derivatives import derivative_errors, shortened
from .measurements import MarkerFinding, Recording, recording_concerns, recording_of
from .motion import ModeFinding, Motion, motion_concerns, motion_notes, motion_of

__all__ = [
    "BodyFinding",
    "Cost",
    "ElementShape",
    "Findings",
    "Glance",
    "Hold",
    "MarkerFinding",
    "ModeFinding",
    "Motion",
    "Recording",
    "check_problem",
    "glance",
]


# A simulation of the whole recordings that takes longer than this is left out unless asked for.
PATIENCE_S = 10.0
# A fit of the first samples to the markers takes about as long as so many simulations of them.
FIT_SIMULATIONS = 15.0
# Agreement with fourth-order central differences that rounding allows.
AGREEMENT = 1e-6
GUESSED = ", at the guess"
CHOSEN = (
    "one step a sample is counted here. Where transcription.substeps is not given, solve "
    f"takes as many as the error bars need, up to {MOST_SUBSTEPS}"
)


@dataclass(frozen=True, kw_only=True)
class Glance:
    """What `check` sees without a simulation.

    Attributes
    ----------
    bodies : tuple of BodyFinding
    recordings : tuple of Recording, one for each experiment
    holds : tuple of Hold, one for each grasp
    """

    bodies: tuple[BodyFinding, ...]
    recordings: tuple[Recording, ...]
    holds: tuple[Hold, ...]


@dataclass(frozen=True, kw_only=True)
class Findings(Glance):
    """What `check` reports.

    Attributes
    ----------
    samples, missing : int
        Marker samples that are there and that are not, of all experiments.
    largest_marker_distance_m : float
    rms_at_guess_m : float or None
        Distance of the markers from their measurements in the simulation at the guess; None where
        that is left out.
    motions : tuple of Motion, one for each fitted experiment that moves
    variables, constraints : int
        Of the program, without memory and wrenches.
    overstresses, wrenches : int
        As many of either are there beside them, of bodies with memory and of sensors, for interior
        point and others that see the whole program.
    jacobian_nonzeros, hessian_nonzeros : int
        With these.
    method : str
        The chosen one; `memory_mb` is what it takes, if it is among the `costs`.
    costs : tuple of Cost, one for each method of which they are known
    jacobian_error, hessian_error : float
        Largest relative deviation from central differences along random directions.
    causes : tuple of Hypothesis
        What is likely described wrongly; their sentences are the first warnings.
    notes : tuple of str
    concerns : tuple of Concern
        What will go wrong, with the remedy; `warnings` are their sentences.
    """

    TOLD: ClassVar = ("warnings",)

    experiments: int
    timesteps: int
    samples: int
    missing: int
    largest_marker_distance_m: float
    rms_at_guess_m: float | None
    motions: tuple[Motion, ...]
    variables: int
    constraints: int
    overstresses: int
    wrenches: int
    jacobian_nonzeros: int
    hessian_nonzeros: int
    method: str
    memory_mb: float | None
    costs: tuple[Cost, ...]
    jacobian_error: float
    hessian_error: float
    causes: tuple[Hypothesis, ...]
    notes: tuple[str, ...] = ()
    concerns: tuple[Concern, ...] = ()

    @property
    def chosen_cost(self) -> Cost | None:
        """That of the chosen method."""
        return next((cost for cost in self.costs if cost.method == self.method), None)

    @property
    def derivatives_agree(self) -> bool:
        """Whether both derivative checks pass."""
        return max(self.jacobian_error, self.hessian_error) < AGREEMENT

    @property
    def warnings(self) -> tuple[str, ...]:
        """What will go wrong, a sentence each that ends with the remedy."""
        return tuple(concern.sentence for concern in self.concerns)

    def as_dict(self) -> dict[str, Any]:
        """For JSON and tables."""
        return content(replace(self, causes=())) | {"causes": [c.as_dict() for c in self.causes]}


def glance(problem: Problem) -> Glance:
    """What is seen at once: bodies, recordings and grasps; missing guesses are usual ones."""
    usual = usual_parameters(problem.parameters, SOFT_PA)
    return Glance(**_seen(replace(problem, parameters=usual), {}))


def _seen(problem: Problem, positions_m: Mapping[str, Array]) -> dict[str, Any]:
    """Fields of `Glance`, with the motions (T, n, 3) of experiments at the guess where known."""
    bodies = _bodies(problem)
    edges_m = {name: body.edges_m[1] for body in bodies for name in body.experiments}
    experiments = problem.experiments
    return {
        "bodies": bodies,
        "recordings": tuple(recording_of(e, positions_m.get(e.name)) for e in experiments),
        "holds": tuple(hold for e in experiments for hold in holds_of(e, edges_m[e.name])),
    }


def check_problem(
    problem: Problem, say: Callable[[str], None] | None = None, full: bool = False
) -> Findings:
    """Validate a loaded problem further and measure it.

    Where parameters have no guess, a scan finds where a solve would start.

    Parameters
    ----------
    problem : Problem
    say : callable, optional
        Called with what is being done now, a text.
    full : bool
        Whether the whole recordings are simulated at the guess however long that takes; by default
        their first samples where it is more than some ten seconds.

    Raises
    ------
    InputError
        Where no start is found.
    """
    say = say or (lambda _: None)
    collocation, notes = problem.collocation(), []
    if problem.parameters.unguessed:
        say("looking for a start, as there is no guess")
        collocation, scan = started(collocation)
        problem = replace(problem, parameters=collocation.parameters)
        notes = [scan.sentence] if scan else []
    say("simulating the first samples at the guess")
    began, first = time.perf_counter(), shortened(problem).collocation()
    first_z, start_notes = initial_variables(first)
    whole_s = (time.perf_counter() - began) * _rows(collocation) / _rows(first)
    say("comparing derivatives with differences")
    jacobian_error, hessian_error = derivative_errors(first, first_z)
    say("estimating what methods take")
    program = _program(problem, collocation, first, first_z)
    simulated, z = first, first_z
    if full or whole_s <= PATIENCE_S:
        say(f"simulating the recordings at the guess, about {max(1, round(whole_s))} s")
        simulated, (z, start_notes) = collocation, initial_variables(collocation)
    say("looking at modes and at the description")
    causes = description_causes(problem)
    fit_s = FIT_SIMULATIONS * whole_s * min(1.0, CHECKED_SAMPLES / _rows(collocation))
    sensed = any(e.wrenches and e.markers.samples for e in problem.experiments)
    if sensed and not causes and (full or fit_s <= PATIENCE_S):
        say("comparing the wrenches with what the markers predict")
        causes = ranked(wrench_mistakes(collocation))
    elif sensed and not causes:
        notes.append(
            "the wrenches were not compared with what the markers predict: it would take about "
            f"{fit_s:.2g} s; check --full does it"
        )
    findings = Findings(
        **_measured(problem, simulated, z),
        timesteps=_rows(collocation),
        rms_at_guess_m=None if simulated is first else collocation.rms_m(z),
        motions=_motions(problem, collocation),
        **program,
        jacobian_error=jacobian_error,
        hessian_error=hessian_error,
        causes=causes,
    )
    # Nothing is said of contact by a body that was only carried.
    touching = () if start_notes else _contacts(simulated, z, whole=simulated is not first)
    concerns = (*_concerns(problem, findings, instabilities(simulated, z)), *touching)
    notes += [*start_notes, *(each for m in findings.motions for each in motion_notes(m))]
    notes += cost_notes(findings.chosen_cost, findings.costs) if findings.chosen_cost else []
    if simulated is first:
        notes.append(
            f"the recordings were not simulated at the guess but for their first samples: it would "
            f"take about {whole_s:.2g} s; check --full does it"
        )
    notes += [CHOSEN] * (problem.substeps == "auto" and bool(findings.motions))
    findings = replace(findings, concerns=concerns)
    known = [note for note in problem.notes if note not in findings.warnings]
    return replace(findings, notes=(*known, *notes))


def _measured(problem: Problem, collocation: Collocation, z: Array) -> dict[str, Any]:
    """Bodies, recordings and grasps; the program may be of the first samples."""
    positions_m = {}
    for part in collocation.parts(z):
        at_samples = part.x[part.segment.markers.grid_rows]
        positions_m[part.segment.experiment.name] = at_samples.reshape(len(at_samples), -1, 3)
    seen = _seen(problem, positions_m)
    recordings = seen["recordings"]
    distances_m = [r.farthest.distance_m for r in recordings if r.markers]
    return seen | {
        "experiments": len(recordings),
        "samples": sum(recording.samples for recording in recordings),
        "missing": sum(recording.missing for recording in recordings),
        "largest_marker_distance_m": max(distances_m, default=0.0),
    }


def _rows(collocation: Collocation) -> int:
    return sum(segment.grid_rows for segment in collocation.segments)


def _program(
    problem: Problem, collocation: Collocation, first: Collocation, first_z: Array
) -> dict[str, Any]:
    """How large the program is, and what methods take for it: fields of `Findings`."""
    whole = collocation.made_explicit()
    jacobian, hessian = nonzeros(problem, whole)
    # Reduced space as the file has it, whichever method is chosen.
    named = (problem.solver(), problem.solver(ReducedSpace.name), ReducedSpace())
    reduced = next(each for each in named if isinstance(each, ReducedSpace))
    method = problem.method
    name = method if isinstance(method, str) else getattr(method, "name", repr(method))
    counted = costs(collocation, first, first_z, jacobian + hessian, reduced.factorisation)
    return {
        "variables": collocation.variables,
        "constraints": collocation.constraints,
        "overstresses": whole.added("memory"),
        "wrenches": whole.added("wrench"),
        "jacobian_nonzeros": jacobian,
        "hessian_nonzeros": hessian,
        "method": name,
        "memory_mb": next((cost.memory_mb for cost in counted if cost.method == name), None),
        "costs": counted,
    }


def _motions(problem: Problem, collocation: Collocation) -> tuple[Motion, ...]:
    scheme, guesses = as_scheme(collocation.scheme), problem.parameters.guesses
    return tuple(
        motion_of(s.experiment, scheme, s.dynamics.step_s, s.body.theta(guesses))
        for s in collocation.segments
        if not s.experiment.static
    )


def _concerns(
    problem: Problem, findings: Findings, unstable: Sequence[Instability]
) -> tuple[Concern, ...]:
    """What will go wrong, the likeliest mistakes first."""
    experiments, parameters = problem.experiments, problem.parameters
    bodies, chosen = findings.bodies, findings.chosen_cost
    body_of = {name: body for body in bodies for name in body.experiments}
    return (
        *(cause.concern() for cause in findings.causes),
        *stillness_concerns(experiments, parameters),
        *scale_concerns(experiments, parameters),
        *(each for body in bodies for each in _of_body(body, len(bodies) == 1)),
        *(each for hold in findings.holds for each in hold_concerns(hold)),
        *(each for motion in findings.motions for each in motion_concerns(motion)),
        *stability_concerns(unstable),
        *(each for e in experiments for each in turn_concerns(e, problem.first_substeps)),
        *(c for r in findings.recordings for c in recording_concerns(r, body_of[r.experiment])),
        *(cost_concerns(chosen, findings.costs) if chosen else ()),
    )


def _contacts(simulated: Collocation, z: Array, whole: bool) -> list[Concern]:
    """What is touched at the guess; of first samples only whether it is already."""
    found = contact_concerns(touched(simulated.parts(z)), GUESSED)
    return [each for each in found if whole or each.code == "contact/pressed"]


def _bodies(problem: Problem) -> tuple[BodyFinding, ...]:
    """Each body, with the names of the experiments that it is in."""
    guesses = problem.parameters.guesses
    names = [tuple(e.name for e in problem.experiments if e.body is b) for b in problem.bodies]
    pairs = zip(problem.bodies, names, strict=True)
    return tuple(body_finding(body, body.theta(guesses), own) for body, own in pairs)


def _of_body(body: BodyFinding, alone: bool) -> tuple[Concern, ...]:
    """Those of a body, with the names of its experiments where it is not alone."""
    of = f"in the body of {', '.join(map(repr, body.experiments))}"
    named = (replace(each, data={"of": of, **each.data}) for each in body.concerns)
    return body.concerns if alone else tuple(named)


def description_causes(problem: Problem) -> tuple[Hypothesis, ...]:
    """What is likely wrong with a problem's description; mostly nothing.

    Odd sizes and densities come first, as the rest may follow from them; then the likeliest.

    Raises
    ------
    InputError
        For a size or a density that no body can have.
    """
    constants = usual_constants(problem.parameters)
    odd = (oddity for body in problem.bodies for oddity in oddities(body))
    doubtful = (cause for e in problem.experiments for cause in doubts(e, constants, problem.huber))
    blind = (cause for e in problem.experiments for cause in camera_mistakes(e))
    placed = (cause for e in problem.experiments for cause in placement_mistakes(e))
    return (*odd, *ranked((*placed, *blind, *doubtful)))
