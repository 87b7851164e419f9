"""Reliability of the verdict, for twins without errors and twins with one error in the description.

A soft and a stiffer small body are moved at random, with white noise and the default nuisance
parameters. Twins without errors should be rated "good", at least 95 of 100; twins whose problem is
described wrongly (`wrong_twins`) should not, at most 2 of 100. Input that is refused before it is
solved counts as recognised. Likely errors of the description, whose search needs refits, are sought
only if the answer would be rated "good" without them.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import record
from script_arguments import make_parser
from studies import markdown
from twins import random_poses
from wrong_twins import FAULTS

from collocation_sysid import Run, run
from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh, cylinder_mesh
from collocation_sysid.judge.engine import find_misspecifications
from collocation_sysid.methods.starts.stiffness_scan import typical_constants
from collocation_sysid.model.parameters import Unknown
from collocation_sysid.problem import Problem, UncertaintyOptions
from collocation_sysid.problem.recording_reader import require_plausible_markers
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.plausibility import size_and_density_hypotheses

# Samples, sampling interval [s] and time steps per sample; with fewer steps the verdict would
# report the error of the scheme instead of the fault.
SAMPLES = 60
STEP_S = 0.01
SUBSTEPS = 3
# Standard deviation of each marker coordinate [m].
SIGMA_M = 1e-3
# An answer is right if the errors of all parameters are less than this number of standard errors.
RIGHT_STANDARD_ERRORS = 3.0
# True damping of all twins.
DAMPING = {"gamma_r_s": 0.01, "gamma_m_1_s": 2.0}


@dataclass(frozen=True)
class VerdictOutcome:
    """Verdict on one twin, and the largest error of its parameters."""

    fault: str  # "none", or a key of `FAULTS`
    seed: int
    verdict: str  # "refused" if the problem is rejected before it is solved
    reasons: tuple[str, ...]
    worst_errors: float | None  # largest error, in standard errors; None without estimates
    worst: str | None  # name of the parameter with this error
    named: tuple[str, ...] = ()  # code of the likely mistake that is named first

    @property
    def is_right(self) -> bool:
        """Whether all parameters are within `RIGHT_STANDARD_ERRORS` of the truth."""
        return self.worst_errors is not None and self.worst_errors < RIGHT_STANDARD_ERRORS


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--twins", type=int, default=200, help="number of twins without a fault")
    parser.add_argument("--faulty", type=int, default=9, help="number of twins with each fault")
    parser.add_argument("--only", nargs="*", choices=["none", *FAULTS], default=["none", *FAULTS])
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--json", type=Path, help="file to which one line per twin is appended")
    arguments = parser.parse_args()
    rows = []
    faulty_outcomes = []
    began = time.perf_counter()
    for name in arguments.only:
        count = arguments.twins if name == "none" else arguments.faulty
        outcomes = []
        for seed in range(arguments.first, arguments.first + count):
            outcomes.append(judge_twin(name, seed))
            right = () if name == "none" else FAULTS[name].causes
            if arguments.json:
                record.append(arguments.json, name, right, **asdict(outcomes[-1]))
        faulty_outcomes += outcomes if name != "none" else []
        rows.append(row(name, outcomes))
        print(" | ".join(rows[-1]), flush=True)
    heads = (
        "twins",
        "refused",
        "doubtful",
        "check",
        "good",
        "good and right",
        "most frequent reasons",
    )
    print(markdown(heads, [*rows, row("all with a fault", faulty_outcomes)]))
    print(f"{time.perf_counter() - began:.0f} s")


def row(name: str, outcomes: Sequence[VerdictOutcome]) -> tuple[str, ...]:
    """Return a row of the table: numbers of twins with each verdict, and the most frequent reasons."""
    verdicts = Counter(each.verdict for each in outcomes)
    counts = [str(verdicts[word]) for word in ("refused", "doubtful", "check", "good")]
    right_count = sum(each.verdict == "good" and each.is_right for each in outcomes)
    reasons = Counter(subject(each.reasons[0]) for each in outcomes if each.reasons)
    return (
        name,
        *counts,
        str(right_count),
        "; ".join(f"{n} × {text}" for text, n in reasons.most_common(2)),
    )


def subject(reason: str) -> str:
    """Return the subject of a reason, without its numbers."""
    return re.split(r"[:;,(]| by | that | as if | is | are ", re.sub("likely: '.*?':", "", reason))[
        0
    ].strip()


def judge_twin(fault: str, seed: int) -> VerdictOutcome:
    """Return the verdict on the twin of a seed with a fault; "refused" if the problem is rejected."""
    problem, truth = swung_twin(seed)
    # The stated fault is the only error: the twin has no systematic effects.
    problem = replace(problem, uncertainty=UncertaintyOptions(assumptions=Assumptions.exact()))
    try:
        if fault != "none":
            problem = FAULTS[fault](problem, np.random.default_rng((seed, *fault.encode())))
        for body in problem.bodies:
            size_and_density_hypotheses(body)
        for experiment in problem.experiments:
            require_plausible_markers(experiment, typical_constants(problem.parameters))
        answer = run(problem, seek_causes=False)
        if answer.trust.verdict == "good":
            causes = find_misspecifications(answer.solution, answer.is_consistent)
            answer = replace(answer, causes=causes)
    except (InputError, SimulationError) as error:
        return VerdictOutcome(fault, seed, "refused", (str(error),), None, None)
    errors = errors_of(answer, truth)
    worst_name = max(errors, key=errors.__getitem__) if errors else None
    return VerdictOutcome(
        fault,
        seed,
        answer.trust.verdict,
        answer.trust.reasons,
        errors[worst_name] if worst_name else None,
        worst_name,
        tuple(each.code for each in answer.causes[:1]),
    )


def errors_of(answer: Run, truth: Mapping[str, float]) -> dict[str, float]:
    """Return the error of every parameter in standard errors; parameters without one are left out."""
    standard_errors = {name: answer.std_error(name) for name in truth}
    return {
        name: abs(answer.parameters[name] - value) / error
        for name, value in truth.items()
        if np.isfinite(error := standard_errors[name])
    }


@cache
def bodies() -> tuple[tuple[Body, float], ...]:
    """Return two bodies, each with its smaller true Young's modulus [Pa]; cached."""
    cylinder = cylinder_mesh(0.04, 0.16, 1, 5)
    box = box_mesh((0.04, 0.05, 0.15), (2, 2, 5))
    return (
        (Body(cylinder, density_kg_m3=20.0, damping="rayleigh"), 700.0),
        (Body(box, density_kg_m3=100.0, damping="rayleigh"), 5e3),
    )


@cache
def swung_twin(seed: int) -> tuple[Problem, dict[str, float]]:
    """Return the correct problem of a body that is moved at random, and its true parameters.

    The guesses are wrong by factors of 0.3 to 3.
    """
    rng = np.random.default_rng(seed)
    body, young_pa = bodies()[seed % 2]
    truth = {"young_pa": young_pa * (1, 1.5)[seed // 2 % 2], "poisson": 0.3} | DAMPING
    t_s = STEP_S * np.arange(SAMPLES)
    nodes = body.nodes_m
    length_m = np.ptp(body.nodes_m[:, 2])
    clamped_nodes = np.flatnonzero(nodes[:, 2] < 1e-9)
    marker_candidates = np.setdiff1d(
        np.unique(body.mesh.surface), np.flatnonzero(nodes[:, 2] < 0.3 * length_m)
    )
    places_m = nodes[rng.choice(marker_candidates, 8, replace=False)]
    markers = Markers(t_s, np.zeros((SAMPLES, 8, 3)), SIGMA_M, places_m=places_m)
    grasp = Grasp(clamped_nodes, random_poses(t_s, rng))
    experiment = Experiment(body, t_s, [grasp], markers, name="swing")
    tracks = simulate(experiment, truth).markers_m
    recording = with_markers(experiment, tracks + rng.normal(scale=SIGMA_M, size=tracks.shape))
    guesses = {name: Unknown(float(value * rng.uniform(0.3, 3))) for name, value in truth.items()}
    guesses["poisson"] = Unknown(float(rng.uniform(0.2, 0.45)))
    return Problem([recording], guesses, substeps=SUBSTEPS), truth


if __name__ == "__main__":
    main()
