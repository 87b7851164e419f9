"""Check of a problem before it is solved: contents, cost, and likely mistakes.

`check_problem` does everything, `quick_check` what takes no simulation. The modules contribute
`body` (meshes and grasps), `measurements` and `modes` (natural modes and the time grid), and of
`runs` `cost` and `derivatives`. Every warning is one sentence that ends with the remedy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from ...common.array_types import Array
from ...common.limits import TimeLimitReached, time_limit
from ...common.serialisation import content
from ...errors import SimulationError
from ...features.registry import present
from ...fem.schemes import as_scheme
from ...methods.reduced_space import ReducedSpace
from ...methods.solve_recorder import best_iterate
from ...methods.starts.initial_trajectories import initial_variables
from ...methods.starts.stiffness_scan import (
    SOFT_PA,
    start_problem,
    typical_constants,
    typical_parameters,
)
from ...problem import Problem
from ...problem.size import Size
from ...program.collocation import Collocation
from ...program.lifted.collocation import lifted_count, with_lifted_variables
from ...program.modes.stability import Instability, find_instabilities
from ...recording.impact_steps import IMPACT_NOTE
from ...statistics.assessment import rotation_step_concerns, stability_concerns
from ...statistics.budget.discretisation_error import MOST_SUBSTEPS
from ...statistics.combinations import Combination, with_something_to_state
from ...statistics.concerns import Concern
from ...statistics.hypothesis import Hypothesis, rank
from ...statistics.scale_identifiability import scale_reference
from ...statistics.stability_concerns import branch_concerns, strain_stability_concerns
from ..cost import LONG_SOLVE_S, MethodCost, cost_concerns, cost_notes, method_costs, nonzeros
from ..derivatives import derivative_fault, shortened_problem, taylor_rates
from ..expected_precision import expected_precision, views_note, with_measurements
from ..facts import facts, sentences
from .body import (
    BodyCheck,
    ElementShape,
    GraspCheck,
    check_body,
    check_grasps,
    grasp_concerns,
    longest_edges,
    slenderness,
)
from .measurements import MarkerCheck, RecordingCheck, check_recording, recording_concerns
from .modes import ModeCheck, ModesCheck, check_modes, mode_concerns, mode_notes

__all__ = [
    "BodyCheck",
    "CheckResult",
    "ElementShape",
    "GraspCheck",
    "MarkerCheck",
    "MethodCost",
    "ModeCheck",
    "ModesCheck",
    "QuickCheck",
    "RecordingCheck",
    "check_problem",
    "quick_check",
]


# Most recordings of which derivatives, natural modes, costs and the description are examined.
MOST_EXAMINED = 12
EXAMPLES_NOTE = (
    "{} recordings were read, but the description was only examined in the longest {}; check --full "
    "examines all of them"
)
# Longest simulation of the whole recordings that needs no request [s].
LONGEST_SIMULATION_S = 10.0
# Longest check without a request, and longest search for initial values and simulation of the first
# samples in it [s].
LONGEST_CHECK_S = 25.0
LONGEST_START_S = 8.0
# Times of parts of a check over that of the simulation of the first samples, at most: of bodies with
# 600 and 3,300 nodes.
COST_FACTOR = 1.2
DESCRIPTION_FACTOR = 3.0
DERIVATIVE_FACTOR = 5.0
# Power of the edge length in the time of a sweep: that of a finger with 600 and 3,300 nodes.
EDGE_POWER = 4.5
SUBSTEPS_NOTE = (
    "check assumes {} per sample. If transcription.substeps is not given, solve uses "
    f"as many as the error bars require, up to {MOST_SUBSTEPS}"
)


@dataclass(frozen=True, kw_only=True)
class QuickCheck:
    """Findings of `check` without a simulation."""

    bodies: tuple[BodyCheck, ...]  # one for each body
    recordings: tuple[RecordingCheck, ...]
    holds: tuple[GraspCheck, ...]


# Variables that only programs with lifted variables have: group, field of `CheckResult`, name of the
# row of the table, and meaning.
LIFTED_KINDS = (
    ("memory", "overstresses", "memory", "the viscoelastic stresses"),
    ("reaction", "wrenches", "reactions", "the measured wrenches or stresses"),
)


@dataclass(frozen=True, kw_only=True)
class CheckResult(QuickCheck):
    """All findings of `check`."""

    SERIALISED_PROPERTIES: ClassVar = ("memory_mb", "warnings")

    # Numbers of experiments, and of time steps of all fitted experiments.
    experiments: int
    timesteps: int
    # Marker samples that are present and that are missing, of all experiments.
    samples: int
    missing: int
    largest_marker_distance_m: float  # largest distance of a marker from the body
    # RMS distance of the markers in the simulation at the guess; None if only the first samples
    # were simulated.
    rms_at_guess_m: float | None
    motions: tuple[ModesCheck, ...] = ()
    # Size of the program without lifted variables.
    variables: int
    constraints: int
    # Numbers of lifted variables: overstresses of bodies with memory, and wrenches of sensors, for
    # interior point and other methods that need the whole program.
    overstresses: int
    wrenches: int
    # With lifted variables; None if they were not counted.
    jacobian_nonzeros: int | None = None
    hessian_nonzeros: int | None = None
    method: str  # the chosen method
    costs: tuple[MethodCost, ...] = ()
    # Rates of a Taylor test by derivative, see `taylor_rates`, empty if there was none; and a sentence
    # on the term with a wrong derivative, empty if there is none.
    taylor_rates: Mapping[str, float] = field(default_factory=dict)
    derivative_fault: str = ""
    # Likely errors in the description; their sentences are the first warnings.
    causes: tuple[Hypothesis, ...] = ()
    # Combinations of constants that the recordings determine at the guess although a constant alone
    # is not determined; empty unless the complete recordings were simulated.
    combinations: tuple[Combination, ...] = ()
    notes: tuple[str, ...] = ()  # sentences for information, without a remedy
    omitted: tuple[str, ...] = ()  # parts of the check that would take too long
    # Length of the edges over that of the mesh with which the search takes about a minute, or the
    # longest with enough elements across the body, and the time of the search with them [s]; None
    # if none are longer.
    longer_edges: tuple[float, float] | None = None
    # Expected problems, with the remedy; `warnings` are their sentences.
    concerns: tuple[Concern, ...] = ()

    @property
    def chosen_cost(self) -> MethodCost | None:
        """Cost of the chosen method; None if it is not known."""
        return next((cost for cost in self.costs if cost.method == self.method), None)

    @property
    def memory_mb(self) -> float | None:
        """Estimated memory of the chosen method [MB]; None if it is not among the `costs`."""
        return self.chosen_cost.memory_mb if self.chosen_cost else None

    @property
    def lifted_texts(self) -> dict[str, str]:
        """Number and meaning of the lifted variables of each kind that the program has, by the name
        of a row in a table.
        """
        return {
            row: f"{number:,} additional variables and constraints of the method "
            f"interior-point for {meaning}, included in the nonzeros"
            for _, field, row, meaning in LIFTED_KINDS
            if (number := getattr(self, field))
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the concerns; each ends with the remedy."""
        return tuple(concern.message for concern in self.concerns)

    def as_dict(self) -> dict[str, Any]:
        """Return the findings as plain values for JSON and tables.

        The keys are the attributes and `warnings`. NaN and infinity become None; None is kept,
        except in optional attributes of parts, which are left out. Each cause has its message and
        strength, see `Hypothesis.as_dict`.
        """
        return content(replace(self, causes=())) | {"causes": [c.as_dict() for c in self.causes]}


def quick_check(problem: Problem) -> QuickCheck:
    """Return a check of bodies, recordings and grasps without a simulation.

    Parameters without a guess get usual values of a soft body; the problem is not modified.
    """
    usual = typical_parameters(problem.parameters, SOFT_PA)
    return QuickCheck(**_quick_fields(replace(problem, parameters=usual), {}))


def _quick_fields(problem: Problem, positions_m: Mapping[str, Array]) -> dict[str, Any]:
    bodies = _bodies(problem)
    edges_m = {name: body.edges_m[1] for body in bodies for name in body.experiments}
    experiments = problem.experiments
    return {
        "bodies": bodies,
        "recordings": tuple(check_recording(e, positions_m.get(e.name)) for e in experiments),
        "holds": tuple(
            grasp_check
            for e in experiments
            if e.specimen is None
            for grasp_check in check_grasps(e, edges_m[e.name])
        ),
    }


def check_problem(
    problem: Problem, report_progress: Callable[[str], None] | None = None, full: bool = False
) -> CheckResult:
    """Check a problem: simulate it at the guess, test derivatives, and look for likely mistakes.

    Where parameters have no guess, a scan finds where a solve would start.

    Parameters
    ----------
    report_progress : callable, optional
        Called with progress messages.
    full : bool
        Whether everything is done, and the whole recordings are simulated at the guess, however long
        that takes; by default a check ends within half a minute, and a note says what it leaves out.

    Raises
    ------
    InputError
        Where no start is found.
    SimulationError
        If a body has no stress-free shape at the guess. A simulation that fails otherwise raises
        nothing: a note states it, and the body is moved rigidly with the grasp instead.
    """
    report_progress = report_progress or (lambda _: None)
    began_s = time.perf_counter()
    known = facts(problem)
    examined = problem if full else _examples(problem)
    collocation = examined.collocation()
    notes = []
    if problem.parameters.names_without_guess:
        report_progress("searching for initial values, because no guess is given")
        collocation, found_notes = _started(collocation, full)
        examined = replace(examined, parameters=collocation.parameters)
        problem = replace(problem, parameters=collocation.parameters)
        notes += found_notes
    whole = collocation
    if others := len(problem.experiments) - len(examined.experiments):
        whole = problem.collocation()
        notes.append(EXAMPLES_NOTE.format(len(problem.experiments), len(examined.experiments)))
    report_progress("simulating the first samples at the guess")
    started_s = time.perf_counter()
    first = shortened_problem(examined).collocation()
    omitted: list[str] = []
    try:
        with time_limit(np.inf if full else LONGEST_START_S):
            first_z, start_notes = initial_variables(first)
        first_s = time.perf_counter() - started_s
    except TimeLimitReached:
        rigid = [
            each.experiment.rigid_positions(each.dynamics.t_s).reshape(each.grid_times, -1)
            for each in first.transcriptions
        ]
        first_z, start_notes, first_s = first.pack(first.guess_p, rigid), [], np.inf

    def is_possible(factor: float, what: str) -> bool:
        """Whether the time is sufficient for a part of the check."""
        left_s = LONGEST_CHECK_S - (time.perf_counter() - began_s)
        if full or factor * first_s <= left_s:
            return True
        omitted.append(what)
        return False

    rows = _grid_rows(whole)
    total_s = first_s * rows / _grid_rows(first)
    lifted = with_lifted_variables(whole)
    found: dict[str, Any] = {}
    if is_possible(COST_FACTOR, "time and memory of a solve"):
        report_progress("estimating time and memory of the methods")
        jacobian, hessian = nonzeros(examined, lifted)
        # Reduced space as the file has it, whichever method is chosen.
        reduced = next(
            each
            for each in (problem.solver(), problem.solver(ReducedSpace.name), ReducedSpace())
            if isinstance(each, ReducedSpace)
        )
        size = rows / _grid_rows(collocation)
        costs = method_costs(
            collocation, first, size, first_z, jacobian + hessian, reduced.factorisation
        )
        found |= {"jacobian_nonzeros": jacobian, "hessian_nonzeros": hessian, "costs": costs}
    simulated, z = first, first_z
    if full or (not (omitted or others) and total_s <= LONGEST_SIMULATION_S):
        report_progress(f"simulating the recordings at the guess, about {max(1, round(total_s))} s")
        simulated = whole
        (z, start_notes) = initial_variables(whole)
    unstable: Sequence[Instability] = ()
    at_guess: list[Concern] = []
    if is_possible(DESCRIPTION_FACTOR, "natural modes and tests of the description"):
        report_progress("computing natural modes and testing the description")
        found["causes"] = misspecification_hypotheses(examined)
        found["motions"] = tuple(
            check_modes(
                each.experiment,
                as_scheme(collocation.scheme),
                each.dynamics.step_s,
                theta=each.constants.theta(each.parameters.guess_q),
            )
            for each in collocation.transcriptions
            if not each.experiment.is_static
        )
        unstable = find_instabilities(simulated, z)
        parts = simulated.iterates(z)
        at_guess += strain_stability_concerns(parts)
        if not start_notes:  # forces on a body that was only carried by its grasps mean nothing
            at_guess += branch_concerns(parts)
            for kind in present(problem.experiments):
                at_guess += kind.guess_concerns(parts, simulated is not first)
    if simulated is not first and not start_notes:
        report_progress("computing what the recordings determine")
        found["combinations"], of_views = _expected_precision(problem, whole, z)
        notes += of_views
    if is_possible(DERIVATIVE_FACTOR, "the test of derivatives"):
        report_progress("testing derivatives")
        rates = taylor_rates(first, first_z)
        fault = derivative_fault(first, first_z, rates)
        found |= {"taylor_rates": rates, "derivative_fault": fault}
    method = problem.method
    findings = CheckResult(
        **_simulated_fields(problem, simulated, z=z),
        timesteps=rows,
        rms_at_guess_m=None if simulated is first else whole.rms_marker_distance_m(z),
        variables=whole.variable_count,
        constraints=whole.constraint_count,
        **{field: lifted_count(lifted, group) for group, field, _, _ in LIFTED_KINDS},
        method=method if isinstance(method, str) else getattr(method, "name", repr(method)),
        omitted=tuple(omitted),
        **found,
    )
    concerns = (
        *(each for each in known if isinstance(each, Concern)),
        *_concerns(problem, findings, unstable=unstable),
        *at_guess,
    )
    notes += [*start_notes, *(each for m in findings.motions for each in mode_notes(m))]
    chosen_cost = findings.chosen_cost
    notes += cost_notes(chosen_cost, findings.costs) if chosen_cost else []
    if simulated is first and not omitted:
        notes.append(
            "only the first samples of the recordings were simulated at the guess; check --full "
            f"simulates all of them, in about {total_s:.2g} s"
        )
    if problem.substeps == "auto" and findings.motions:
        steps = problem.choose_first_substeps()
        if steps > 1 and any(e.obstacles for e in problem.experiments):
            notes.append(IMPACT_NOTE.format(steps))
        else:
            notes.append(SUBSTEPS_NOTE.format(f"{steps} time step{'s' * (steps > 1)}"))
    if chosen_cost:
        search_s = chosen_cost.time_s
    else:
        largest = max(findings.bodies, key=lambda body: body.nodes)
        search_s = Size(largest.nodes, largest.elements, rows, unknowns=1).time_s()
    rests_on = scale_reference(
        problem.experiments, problem.parameters, problem.assumed_deviations["mass"]
    )
    notes += [] if rests_on is None else [rests_on.sentence]
    warnings = sentences(concerns)
    stated = (each for each in (*problem.notes, *sentences(known)) if each not in warnings)
    return replace(
        findings,
        concerns=concerns,
        longer_edges=_longer_edges(problem, search_s),
        notes=(*stated, *notes),
    )


def _examples(problem: Problem) -> Problem:
    """Return the problem with the longest recording of each kind and the longest others, together
    `MOST_EXAMINED`; itself if it has no more.
    """
    longest = sorted(problem.experiments, key=lambda e: (e.validation, -len(e.t_s)))
    of_kinds = {
        (e.is_static, *e.body.parameter_names, *map(type, (*e.measurements, *e.obstacles))): e
        for e in reversed(longest)
    }
    chosen = [*dict.fromkeys((*of_kinds.values(), *longest))][: max(MOST_EXAMINED, len(of_kinds))]
    if len(chosen) == len(longest):
        return problem
    return replace(problem, experiments=[each for each in problem.experiments if each in chosen])


def _longer_edges(problem: Problem, search_s: float | None) -> tuple[float, float] | None:
    meshed = {each.body for each in problem.experiments if each.specimen is None}
    if search_s is None or len(meshed) != 1 or not (body := meshed.pop()).is_solid:
        return None
    of_a_minute = (search_s / LONG_SOLVE_S) ** (1 / EDGE_POWER)
    longest = longest_edges(body, slenderness(body.mesh)[2])
    ratio = float(np.floor(10 * min(of_a_minute, longest))) / 10  # such a mesh has enough elements
    return (ratio, search_s / ratio**EDGE_POWER) if ratio > 1 else None


def _started(collocation: Collocation, full: bool) -> tuple[Collocation, list[str]]:
    """Return the program with a guess of every parameter, and notes; at the limit of time those of the
    best simulation so far, or usual ones.
    """
    with best_iterate() as best:
        try:
            with time_limit(np.inf if full else LONGEST_START_S):
                start = start_problem(collocation)
        except TimeLimitReached:
            if best.answer:
                parameters = best.solution().collocation.parameters
            else:
                parameters = typical_parameters(collocation.parameters, SOFT_PA)
            return collocation.with_parameters(parameters), [
                f"the search for initial values was ended after {LONGEST_START_S:g} s"
            ]
    notes = (start.scan.sentence if start.scan else "", start.note)
    return start.collocation, [*filter(None, notes)]


def _expected_precision(
    problem: Problem, collocation: Collocation, z: Array
) -> tuple[tuple[Combination, ...], list[str]]:
    """Return combinations, and `views_note` as a list; both empty if they cannot be computed."""
    if not collocation.nq:
        return (), []
    deviations = problem.assumed_deviations
    try:
        found = expected_precision(collocation, z, deviations).combinations()
        found = with_something_to_state(with_measurements(found, collocation, z, deviations))
        return found, [note] if (note := views_note(collocation, z)) else []
    except SimulationError:
        return (), []


def _simulated_fields(problem: Problem, collocation: Collocation, z: Array) -> dict[str, Any]:
    """Return the fields of `QuickCheck`, and the totals of `CheckResult`."""
    positions_m = {}
    for part in collocation.iterates(z):
        at_samples = part.x[part.transcription.sample_rows]
        positions_m[part.transcription.experiment.name] = at_samples.reshape(len(at_samples), -1, 3)
    shared_fields = _quick_fields(problem, positions_m)
    recordings = shared_fields["recordings"]
    distances_m = [r.farthest_marker.distance_m for r in recordings if r.markers]
    return shared_fields | {
        "experiments": len(recordings),
        "samples": sum(recording.samples for recording in recordings),
        "missing": sum(recording.missing for recording in recordings),
        "largest_marker_distance_m": max(distances_m, default=0.0),
    }


def _grid_rows(collocation: Collocation) -> int:
    return sum(transcription.grid_times for transcription in collocation.transcriptions)


def _concerns(
    problem: Problem, findings: CheckResult, unstable: Sequence[Instability]
) -> tuple[Concern, ...]:
    """Return the likeliest mistakes first."""
    experiments, bodies = problem.experiments, findings.bodies
    steps = problem.choose_first_substeps()
    chosen = findings.chosen_cost
    body_of = {name: body for body in bodies for name in body.experiments}
    return (
        *(cause.concern() for cause in findings.causes),
        *(each for body in bodies for each in _body_concerns(body, len(bodies) == 1)),
        *(each for grasp_check in findings.holds for each in grasp_concerns(grasp_check)),
        *(each for motion in findings.motions for each in mode_concerns(motion)),
        *stability_concerns(unstable),
        *(each for e in experiments for each in rotation_step_concerns(e, steps)),
        *(c for r in findings.recordings for c in recording_concerns(r, body_of[r.experiment])),
        *(cost_concerns(chosen, findings.costs) if chosen else ()),
    )


def _bodies(problem: Problem) -> tuple[BodyCheck, ...]:
    guesses = problem.parameters.guesses
    names = [tuple(e.name for e in problem.experiments if e.body is b) for b in problem.bodies]
    specimens = {e.name for e in problem.experiments if e.specimen is not None}
    return tuple(
        check_body(
            body,
            body.theta_from_values(guesses),
            experiments=own,
            is_homogeneous=specimens.issuperset(own),
            point_masses_kg={
                e.name: sum(mass.mass_kg for mass in e.masses)
                for e in problem.experiments
                if e.name in own and e.masses
            },
        )
        for body, own in zip(problem.bodies, names, strict=True)
    )


def _body_concerns(body: BodyCheck, alone: bool) -> tuple[Concern, ...]:
    of = f"in the body of {', '.join(map(repr, body.experiments))}"
    named = (replace(each, data={"of": of, **each.data}) for each in body.concerns)
    return body.concerns if alone else tuple(named)


def misspecification_hypotheses(problem: Problem) -> tuple[Hypothesis, ...]:
    """Return likely errors in the description of a problem, the likeliest first; mostly none.

    Parameters without a guess get usual values.
    """
    from ...judge.modes import find_misspecifications_by_modes

    constants = typical_constants(problem.parameters)
    doubtful = (
        cause
        for e in problem.experiments
        for cause in find_misspecifications_by_modes(e, constants)
    )
    by_kind = (
        cause for e in problem.experiments for kind in present([e]) for cause in kind.described(e)
    )
    return rank((*by_kind, *doubtful))
