"""Does a designed motion tell what it is predicted to? The shipped swing against designed ones.

    python scripts/study_design.py [--twins 100] [--duration 0.4] [--limits FILE] [--for NAMES]

The foam cylinder's own swing, at the truth, against a motion designed at equal duration, within
the swing's own ranges, speeds and accelerations or within those of a file. Then twins: the designed
motion is simulated, gets noise (and nuisance parameters drawn from their priors, where there are
any) and is identified; the spread of the answers is compared with the prediction.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from make_foam_cylinder import FOLDER, SWING, TRUTH
from scipy.spatial.transform import Rotation

from collocation_sysid.extras.design import (
    Design,
    DesignCriterion,
    DesignOptions,
    Limits,
    design_motion,
)
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Nuisance
from collocation_sysid.statistics.linearised import DerivedModuli

FINE_S = 1e-4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=100)
    parser.add_argument("--duration", type=float, default=SWING.duration_s)
    parser.add_argument(
        "--limits", type=Path, help="the shipped swing's own by default"
    )
    parser.add_argument("--evaluations", type=int, default=300)
    parser.add_argument("--substeps", type=int, default=2)
    parser.add_argument("--waves", type=int, default=1)
    parser.add_argument(
        "--for", dest="names", default="", help="parameters that count"
    )
    parser.add_argument(
        "--nuisance", choices=("none", "default"), default="none"
    )
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    problem = cylinder(given.duration, given.nuisance, given.substeps)
    limits = Limits.read(given.limits) if given.limits else own_limits()
    names = tuple(given.names.split(",")) if given.names else ()
    options = DesignOptions(
        given.evaluations, pairs=0, waves=given.waves, seed=given.seed
    )
    found = design_motion(
        problem,
        limits,
        given.duration,
        DesignCriterion("worst", names),
        options,
        say=print,
    )
    print(table(found), features(found), sep="\n\n", flush=True)
    if given.twins:
        print("", spread(found, given.twins, given.seed), sep="\n")


def cylinder(duration_s: float, nuisance: str, substeps: int) -> Problem:
    """The shipped problem at the truth, moved by its swing for so long."""
    guesses = [
        f"parameters.{name}.guess={value}" for name, value in TRUTH.items()
    ]
    overrides = [*guesses, f"transcription.substeps={substeps}"]
    shipped = Problem.read(FOLDER / "problem.toml", overrides)
    (experiment,) = shipped.experiments
    (grasp,) = experiment.grasps
    step_s = experiment.timestep_s
    t_s = np.arange(round(duration_s / step_s) + 1) * step_s
    swung = replace(SWING, duration_s=duration_s).poses(step_s / 4)
    unseen = np.zeros((len(t_s), len(experiment.markers.names), 3))
    longer = replace(
        experiment,
        t_s=t_s,
        grasps=(replace(grasp, poses=swung),),
        markers=replace(experiment.markers, t_s=t_s, positions_m=unseen),
        nuisance=Nuisance() if nuisance == "default" else Nuisance.none(),
    )
    return Problem(
        [longer], shipped.parameters, scheme=shipped.scheme, substeps=substeps
    )


def own_limits() -> Limits:
    """Ranges, speeds and accelerations of the shipped swing. Its hand is the body's origin."""
    poses = SWING.poses(FINE_S)
    place = poses.positions_m
    turns = Rotation.from_quat(poses.quaternions_xyzw)
    speed = np.gradient(place, FINE_S, axis=0)
    angular = (turns[1:] * turns[:-1].inv()).as_rotvec() / FINE_S

    def largest(vectors: np.ndarray) -> float:
        return float(np.linalg.norm(vectors[2:-2], axis=1).max())

    def in_degrees(vectors: np.ndarray) -> float:
        return float(np.degrees(largest(vectors)))

    low, high = (
        tuple(side.tolist()) for side in (place.min(axis=0), place.max(axis=0))
    )
    return Limits.model_validate(
        {
            "workspace_m": (low, high),
            "speed_m_s": largest(speed),
            "acceleration_m_s2": largest(np.gradient(speed, FINE_S, axis=0)),
            "rotation_deg": in_degrees((turns * turns[0].inv()).as_rotvec()),
            "angular_speed_deg_s": in_degrees(angular),
            "angular_acceleration_deg_s2": in_degrees(
                np.gradient(angular, FINE_S, axis=0)
            ),
        }
    )


def table(found: Design) -> str:
    """Relative error bars of both motions."""
    assert found.before is not None
    lines = [f"limits {found.limits!r}", f"shares used {found.shares}"]
    lines.append("|  | swing % | designed % | ratio |\n|---|---|---|---|")
    for name, after in found.after.relative.items():
        before = found.before.relative[name]
        lines.append(
            f"| {name} | {100 * before:.3g} | {100 * after:.3g} | {before / after:.2f} |"
        )
    free = [item.name for item in found.recording.problem.parameters.free]
    before, after = (
        max(b.relative[n] for n in free) for b in (found.before, found.after)
    )
    lines.append(
        f"| worst | {100 * before:.3g} | {100 * after:.3g} | {before / after:.2f} |"
    )
    return "\n".join(lines)


def features(found: Design) -> str:
    """Return a table of the RMS acceleration along each coordinate, and its mean frequency.

    Rotations and shifts are in the axes of the body at the start: along the cylinder, and across.
    """
    motion = found.motion
    (rotation, _) = found.recording.start_pose
    place, rate, growth = motion.derivatives(motion.grid_s)
    lines = [
        "|  | RMS | RMS acceleration | frequency Hz |",
        "|---|---|---|---|",
    ]
    for kind, columns, unit in (
        ("shift", slice(3), "m"),
        ("turn", slice(3, 6), "rad"),
    ):
        own = [each[:, columns] @ rotation for each in (place, rate, growth)]
        for name, axes in (("along", [2]), ("across", [0, 1])):
            size, speed, most = (
                float(np.sqrt(np.mean(np.sum(e[:, axes] ** 2, axis=1))))
                for e in own
            )
            lines.append(
                f"| {kind} {name} | {size:.4f} {unit} | {most:.3g} {unit}/s² | "
                f"{most / max(speed, 1e-300) / (2 * np.pi):.2f} |"
            )
    return "\n".join(
        [*lines, f"window {motion.active_s:.3g} of {motion.duration_s:.3g} s"]
    )


# Twins --------------------------------------------------------------------------------------------


def spread(found: Design, twins: int, seed: int) -> str:
    """Standard deviations of the twins' answers over the predicted ones."""
    rng = np.random.default_rng(seed)
    answers = [twin(found, rng) for _ in range(twins)]
    good = [each for each in answers if each is not None]
    lines = [f"{twins - len(good)} of {twins} twins did not converge"]
    lines.append(
        "|  | predicted % | spread % | ratio | bias % |\n|---|---|---|---|---|"
    )
    for name, predicted in found.after.relative.items():
        logarithms = np.log([each[name] for each in good])
        deviation = logarithms.std(ddof=1)
        bias = logarithms.mean() - np.log(found.after.values[name])
        lines.append(
            f"| {name} | {100 * predicted:.3g} | {100 * deviation:.3g} | "
            f"{deviation / predicted:.3f} | {100 * bias:.2g} |"
        )
    return "\n".join(lines)


def twin(found: Design, rng: np.random.Generator) -> dict[str, float] | None:
    """The answer for one recording of the designed motion; None where there is none."""
    problem = found.recording.problem
    experiment = found.experiment
    options = (
        problem.parameters,
        problem.scheme,
        problem.choose_first_substeps(),
    )
    (segment,) = Collocation([experiment], *options).transcriptions
    phi = segment.compute_guess_phi() + rng.normal(size=segment.nuisance.size)
    values = problem.parameters.guesses
    _, scheme, substeps = options
    actual = simulate(
        segment.corrected_experiment(phi), values, scheme, substeps=substeps
    )
    tracks = segment.markers.predict_samples(actual.positions_m, phi)
    noise = experiment.markers.sigma_m[:, None] * rng.normal(size=tracks.shape)
    seen = with_markers(experiment, tracks + noise)
    solution = ReducedSpace(tolerance=1e-6, ladder=(1.0,))(
        Collocation([seen], *options)
    )
    if not solution.status.converged:
        return None
    derived = DerivedModuli.from_bodies(
        (s.constants for s in solution.collocation.transcriptions), solution.q
    ).values
    return solution.parameters | dict(derived)


if __name__ == "__main__":
    main()
