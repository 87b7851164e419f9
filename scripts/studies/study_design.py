"""Standard errors of designed motions: predictions, and the spread of the estimates of twins.

    python scripts study_design [--twins 100] [--duration 0.4] [--limits FILE] [--for NAMES]

The swing of the shipped foam cylinder is compared, at the true parameters, with a motion that is
designed for the same duration, within the ranges, speeds and accelerations of this swing or of a
file. For twins the designed motion is simulated with noise (and with nuisance parameters drawn from
their priors, if there are any) and identified; the spread of the estimates is compared with the
prediction.
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
from collocation_sysid.recording import Experiment, Nuisance
from collocation_sysid.statistics.linearised import DerivedModuli

# Time step for the numerical derivatives of the swing [s].
FINE_S = 1e-4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=100)
    parser.add_argument("--duration", type=float, default=SWING.duration_s)
    parser.add_argument("--limits", type=Path, help="the shipped swing's own by default")
    parser.add_argument("--evaluations", type=int, default=300)
    parser.add_argument("--substeps", type=int, default=2)
    parser.add_argument("--waves", type=int, default=1)
    parser.add_argument("--for", dest="names", default="", help="parameters that count")
    parser.add_argument("--nuisance", choices=("none", "default"), default="none")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    problem = cylinder(arguments.duration, arguments.nuisance, arguments.substeps)
    limits = Limits.read(arguments.limits) if arguments.limits else own_limits()
    names = tuple(arguments.names.split(",")) if arguments.names else ()
    options = DesignOptions(
        arguments.evaluations, pairs=0, waves=arguments.waves, seed=arguments.seed
    )
    design = design_motion(
        problem, limits, arguments.duration, DesignCriterion("worst", names), options, say=print
    )
    print(table(design), features(design), sep="\n\n", flush=True)
    if arguments.twins:
        print("", spread(design, arguments.twins, arguments.seed), sep="\n")


def cylinder(duration_s: float, nuisance: str, substeps: int) -> Problem:
    """Return the shipped problem with the truth as guess, and with its swing for `duration_s` [s].

    `nuisance` is "default" or "none".
    """
    guesses = [f"parameters.{name}.guess={value}" for name, value in TRUTH.items()]
    overrides = [*guesses, f"transcription.substeps={substeps}"]
    shipped = Problem.read(FOLDER / "problem.toml", overrides)
    (experiment,) = shipped.experiments
    (grasp,) = experiment.grasps
    step_s = experiment.timestep_s
    t_s = np.arange(round(duration_s / step_s) + 1) * step_s
    swing_poses = replace(SWING, duration_s=duration_s).poses(step_s / 4)
    no_tracks = np.zeros((len(t_s), len(experiment.markers.names), 3))
    longer_experiment = replace(
        experiment,
        t_s=t_s,
        grasps=(replace(grasp, poses=swing_poses),),
        markers=replace(experiment.markers, t_s=t_s, positions_m=no_tracks),
        nuisance=Nuisance() if nuisance == "default" else Nuisance.none(),
    )
    return Problem(
        [longer_experiment], shipped.parameters, scheme=shipped.scheme, substeps=substeps
    )


def own_limits() -> Limits:
    """Return the ranges, speeds and accelerations of the shipped swing, of the origin of the body."""
    poses = SWING.poses(FINE_S)
    positions_m = poses.positions_m
    rotations = Rotation.from_quat(poses.quaternions_xyzw)
    speed = np.gradient(positions_m, FINE_S, axis=0)
    angular = (rotations[1:] * rotations[:-1].inv()).as_rotvec() / FINE_S

    def largest(vectors: np.ndarray) -> float:
        return float(np.linalg.norm(vectors[2:-2], axis=1).max())

    def in_degrees(vectors: np.ndarray) -> float:
        return float(np.degrees(largest(vectors)))

    low, high = (
        tuple(side.tolist()) for side in (positions_m.min(axis=0), positions_m.max(axis=0))
    )
    return Limits.model_validate(
        {
            "workspace_m": (low, high),
            "speed_m_s": largest(speed),
            "acceleration_m_s2": largest(np.gradient(speed, FINE_S, axis=0)),
            "rotation_deg": in_degrees((rotations * rotations[0].inv()).as_rotvec()),
            "angular_speed_deg_s": in_degrees(angular),
            "angular_acceleration_deg_s2": in_degrees(np.gradient(angular, FINE_S, axis=0)),
        }
    )


def table(design: Design) -> str:
    """Return the table of the relative standard errors with the swing and with the designed motion."""
    assert design.before is not None
    lines = [f"limits {design.limits!r}", f"shares used {design.shares}"]
    lines.append(
        "| standard error of | with the swing, % | with the designed motion, % | ratio |\n|---|---|---|---|"
    )
    for name, after in design.after.relative.items():
        before = design.before.relative[name]
        lines.append(f"| {name} | {100 * before:.3g} | {100 * after:.3g} | {before / after:.2f} |")
    free = [item.name for item in design.recording.problem.parameters.free]
    before, after = (max(b.relative[n] for n in free) for b in (design.before, design.after))
    lines.append(f"| worst | {100 * before:.3g} | {100 * after:.3g} | {before / after:.2f} |")
    return "\n".join(lines)


def features(design: Design) -> str:
    """Return a table of the RMS acceleration along each coordinate, and its mean frequency.

    Rotations and shifts are in the axes of the body at the start: along the cylinder, and across.
    """
    motion = design.motion
    (rotation, _) = design.recording.start_pose
    place, rate, growth = motion.derivatives(motion.grid_s)
    lines = ["| motion | RMS | RMS acceleration | mean frequency, Hz |", "|---|---|---|---|"]
    for kind, columns, unit in (("shift", slice(3), "m"), ("turn", slice(3, 6), "rad")):
        body_axes = [each[:, columns] @ rotation for each in (place, rate, growth)]
        for name, axes in (("along", [2]), ("across", [0, 1])):
            size, speed, acceleration = (
                float(np.sqrt(np.mean(np.sum(e[:, axes] ** 2, axis=1)))) for e in body_axes
            )
            lines.append(
                f"| {kind} {name} | {size:.4f} {unit} | {acceleration:.3g} {unit}/s² | "
                f"{acceleration / max(speed, 1e-300) / (2 * np.pi):.2f} |"
            )
    return "\n".join([*lines, f"window {motion.active_s:.3g} of {motion.duration_s:.3g} s"])


# Twins --------------------------------------------------------------------------------------------


def spread(design: Design, twins: int, seed: int) -> str:
    """Return the table of the standard deviations of the estimates of twins over the predicted
    ones.
    """
    rng = np.random.default_rng(seed)
    answers = [twin(design, rng) for _ in range(twins)]
    converged = [each for each in answers if each is not None]
    lines = [f"{twins - len(converged)} of {twins} twins did not converge"]
    lines.append(
        "| parameter | predicted standard error, % | standard deviation of estimates, % "
        "| ratio | bias, % |\n|---|---|---|---|---|"
    )
    for name, predicted in design.after.relative.items():
        logarithms = np.log([each[name] for each in converged])
        deviation = logarithms.std(ddof=1)
        bias = logarithms.mean() - np.log(design.after.values[name])
        lines.append(
            f"| {name} | {100 * predicted:.3g} | {100 * deviation:.3g} | "
            f"{deviation / predicted:.3f} | {100 * bias:.2g} |"
        )
    return "\n".join(lines)


def twin(design: Design, rng: np.random.Generator) -> dict[str, float] | None:
    """Return the estimates from one twin of the designed motion; None if the solve does not
    converge.
    """
    problem = design.recording.problem
    experiment = design.experiment

    def collocation_of(recording: Experiment) -> Collocation:
        return Collocation(
            [recording], problem.parameters, problem.scheme, problem.choose_first_substeps()
        )

    (transcription,) = collocation_of(experiment).transcriptions
    phi = transcription.guess_phi + rng.normal(size=transcription.nuisance.size)
    values = problem.parameters.guesses
    motion = simulate(
        transcription.corrected_experiment(phi),
        values,
        problem.scheme,
        substeps=problem.choose_first_substeps(),
    )
    tracks = transcription.markers.predict_samples(motion.sampled, phi)
    noise = experiment.markers.sigma_m[:, None] * rng.normal(size=tracks.shape)
    noisy_recording = with_markers(experiment, tracks + noise)
    solution = ReducedSpace(tolerance=1e-6, ladder=(1.0,))(collocation_of(noisy_recording))
    if not solution.status.converged:
        return None
    derived = DerivedModuli.from_bodies(
        (s.constants for s in solution.collocation.transcriptions), solution.q
    ).values
    return solution.parameters | dict(derived)


if __name__ == "__main__":
    main()
