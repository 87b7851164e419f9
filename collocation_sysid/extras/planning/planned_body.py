"""Body of a planned motion: that of a problem at its guesses, or as a run identified it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.files import RESULT_FILE, require_run_folder
from ...errors import InputError, hint_at, located
from ...problem import Problem
from ...recording import Experiment, Markers, Nuisance, Obstacle, PoseSequence
from ...recording.nuisance import GRIP
from ...result.replay import damaged_run_refused
from ...runs.result_builder import build_result
from ...runs.result_content import Result
from ...runs.solved_problem import SolvedProblem
from ...runs.warm_start import WarmStart
from ...statistics.budget.effect_estimates import JointPosterior
from .signals import Commands, commanded


@dataclass(frozen=True, eq=False)
class PlannedBody:
    """Body with its parameters, and the recording whose grasp, loads and surroundings a plan keeps."""

    problem: Problem  # problem with scheme and parameters, whose guesses are the values of the plan
    template: Experiment  # recording with grasps and gravity as identified
    q: Array  # (nq,): parameters in the solver's coordinates
    # (nq, nq) or None: covariance of q due to noise; None if it is not known.
    statistical_covariance: Array | None
    # dict of name to (3,): places of the markers on the undeformed body [m]; NaN where a place is
    # not known.
    marker_places_m: dict[str, Array]
    # Standard deviation of a coordinate of a point by errors of the description [m]: by how much
    # the residuals of the markers in the fit exceed their noise.
    description_std_m: float = 0.0
    # Joint posterior of what acts on the body, relative to q and the template; None if not known.
    joint: JointPosterior | None = None
    # mapping of name to float: pose of the body in the gripper, which the template contains, by name
    # of the nuisance parameter in its unit.
    grip: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # reasons not to rely on the constants without care
    run: Path | None = None  # run folder; None for a problem or a run in memory
    # Folder to which names of files in the problem are relative; None for a problem of Python.
    home: Path | None = None

    def __post_init__(self) -> None:
        with located(self.problem.path, f"experiment '{self.template.name}'"):
            _require_plannable(self.template)

    @classmethod
    def read(
        cls,
        source: str | Path | Problem | SolvedProblem,
        experiment: str | None = None,
        allow_code: bool = False,
    ) -> PlannedBody:
        """Return the body of a problem file, run folder, `Problem` or `Run`.

        Parameters
        ----------
        source : path, Problem or SolvedProblem
            Problem, whose guesses are used, or run, whose estimates are used.
        experiment : str, optional
            Name of the recording whose grasp is planned; the first that is not static by default,
            or the first.
        allow_code : bool
            Whether Python files that a problem file names may run.

        Raises
        ------
        InputError
            For a damaged run, a parameter without a guess, an experiment that does not exist, or
            has no grasp that holds all axes throughout.
        """
        if isinstance(source, Problem):
            return cls._from_problem(source, experiment)
        if isinstance(source, SolvedProblem):
            return cls._from_solved(source, experiment)
        path = Path(source)
        if path.is_dir():
            return cls._from_folder(path, experiment, allow_code=allow_code)
        if path.name == RESULT_FILE:
            require_run_folder(path)
        return cls._from_problem(
            Problem.read(path, allow_code=allow_code, simulation=True), experiment
        )

    @classmethod
    def _from_problem(cls, problem: Problem, experiment: str | None) -> PlannedBody:
        problem.require_guesses(
            "but a motion is planned for a value of each parameter",
            ", or a run that identified it: collocation-sysid solve",
            with_set=False,
        )
        template = _select(problem, problem.experiments, experiment)
        places = _stated_places(template)
        guess = problem.parameters.guess_q
        return cls(problem, template, guess, None, places, home=_home(problem))

    @classmethod
    def _from_solved(cls, run: SolvedProblem, experiment: str | None) -> PlannedBody:
        parts = {part.transcription.experiment.name: part for part in run.solution.parts}
        chosen = _select(
            run.problem, [part.transcription.experiment for part in parts.values()], experiment
        )
        part = parts[chosen.name]
        names = chosen.markers.names
        places = dict(zip(names, part.transcription.marker_places_m(part.phi), strict=True))
        problem = WarmStart.of(run.solution).apply_to_problem(run.problem)
        result = build_result(run)
        return cls(
            problem,
            part.transcription.corrected_experiment(part.phi),
            problem.parameters.guess_q,
            _statistical_covariance(result, problem),
            places,
            _description_std_m(result),
            result.joint,
            _grip(part.transcription.nuisance.iterate_values(part.phi)),
            warnings=_warnings(result),
            home=_home(run.problem),
        )

    @classmethod
    def _from_folder(cls, folder: Path, experiment: str | None, allow_code: bool) -> PlannedBody:
        result = Result.read(folder)
        answer = WarmStart.from_result(result, folder)
        home = result.problem_folder(
            folder,
            "which a plan needs: in Python, plan with the run itself, cs.plan_motion(run, …)",
        )
        problem = Problem.read(folder / "problem.toml", allow_code=allow_code, folder=home)
        problem = problem.with_lengths(
            {name: each.shapes.length_m for name, each in result.fields.items()}
        )
        if problem.parameters.free:
            problem = answer.apply_to_problem(problem)
        collocation = answer.apply_to_places(problem.collocation())
        fitted = {each.experiment.name: each for each in collocation.transcriptions}
        chosen = _select(problem, [each.experiment for each in fitted.values()], experiment)
        transcription = fitted[chosen.name]
        phi = answer.apply_to_nuisance(collocation)[0][transcription.nuisance_indices.indices]
        places = dict(zip(chosen.markers.names, transcription.marker_places_m(phi), strict=True))
        with damaged_run_refused(folder):
            covariance = _statistical_covariance(result, problem)
            _require_shapes(result.joint)
            warnings = _warnings(result)
        return cls(
            problem,
            transcription.corrected_experiment(phi),
            problem.parameters.guess_q,
            covariance,
            places,
            _description_std_m(result),
            result.joint,
            _grip(transcription.nuisance.iterate_values(phi)),
            warnings=warnings,
            run=folder,
            home=home,
        )

    @property
    def grasp_number(self) -> int:
        """Index of the planned grasp among the grasps: the first that holds all axes throughout."""
        return next(k for k, each in enumerate(self.template.grasps) if _is_held(each))

    @cached_property
    def start_pose(self) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,) [m] of the planned grasp at the first sample of the
        recording: a grasped node at X is at R X + p.
        """
        poses = self.template.grasps[self.grasp_number].poses
        rotations, translations = poses.at(self.template.t_s[:1])
        return rotations[0], translations[0]

    @cached_property
    def hand_m(self) -> Array:
        """Middle (3,) of the grasped nodes on the undeformed body [m]."""
        grasp = self.template.grasps[self.grasp_number]
        return np.asarray(self.template.body.nodes_m[grasp.nodes].mean(axis=0), dtype=np.float64)

    def experiment(
        self,
        poses: PoseSequence | None,
        t_s: Array,
        points: dict[str, Array],
        commands: Commands | None = None,
    ) -> Experiment:
        """Return the experiment of a plan: the recording with other poses of the planned grasp and
        other times, from equilibrium, with points in place of the measurements.

        Other grasps and obstacles stay where they are at the first sample of the recording, and
        tendons and pressures keep their values.

        Parameters
        ----------
        poses : PoseSequence or None
            Poses of the planned grasp over the times; None if it stays where it is, too.
        t_s : (T,) array
            Times, from the first sample of the recording on.
        points : dict of name to (3,) array
            Places of the points on the undeformed body [m].
        commands : mapping, optional
            Times and tensions [N] or pressures [Pa] of planned tendons and pressures, by name.
        """
        template = self.template
        grasps = []
        for number, grasp in enumerate(template.grasps):
            is_planned = number == self.grasp_number and poses is not None
            moved = poses if is_planned else _standing(grasp.poses, template.t_s)
            grasps.append(replace(grasp, poses=moved, wrench=None))
        changes: dict[str, Any] = {
            **{
                kind: commanded(
                    getattr(template, kind),
                    template.t_s[0],
                    commands or {},
                    is_static=template.is_static,
                )
                for kind in ("tendons", "pressures")
            },
            "start_positions_m": None,
            "start_velocities_m_s": None,
            "start_velocity_m_s": None,
            "start_spin_rad_s": None,
        }
        markers = Markers(
            t_s,
            np.zeros((len(t_s), len(points), 3)),
            1e-3,
            [*points],
            np.array([*points.values()]).reshape(-1, 3),
            attach="embedded",  # estimated places are not moved to nodes
        )
        return replace(
            template,
            t_s=t_s,
            grasps=tuple(grasps),
            markers=markers,
            start="equilibrium",
            start_rule="standard",
            loaded_since_s=np.inf,
            validation=False,
            nuisance=Nuisance.none(),
            readings=(),
            depths=(),
            **changes,
        )

    def gripper_poses(self, poses: PoseSequence) -> PoseSequence:
        """Return poses of the body in the planned grasp as poses of the gripper, in the format of
        the problem: without the identified hand–eye transform and `gripper_to_body`, which the
        poses of a recording contain as their first motion.
        """
        identified = self.template.grasps[self.grasp_number].poses.first_motion
        return replace(poses.after(np.linalg.inv(identified)), first_motion=np.eye(4))


def _select(problem: Problem, experiments: Any, name: str | None) -> Experiment:
    """Return the experiment with a name; if `name` is None, the first that is not static, or the
    first.
    """
    known = {each.name: each for each in experiments}
    if name is None:
        return next((e for e in known.values() if not e.is_static), next(iter(known.values())))
    if name not in known:
        raise InputError(
            f"found {name!r}{hint_at(name, known)}; expected one of the experiments: "
            f"{', '.join(known)}",
            problem.path,
            where="--experiment",
        )
    return known[name]


def _is_held(grasp: Any) -> bool:
    return (
        not isinstance(grasp, Obstacle)
        and grasp.axes == "xyz"
        and bool(np.isinf(grasp.from_s) and np.isinf(grasp.until_s))
    )


def _require_plannable(template: Experiment) -> None:
    """Raise an `InputError` if no grasp holds all axes throughout."""
    if not any(_is_held(each) for each in template.grasps):
        raise InputError(
            "no grasp holds the body along all axes throughout; expected one, whose motion is "
            "planned"
        )


def _standing(poses: PoseSequence, t_s: Array) -> PoseSequence:
    """Return the pose at the first of the times, for all times."""
    rotations, translations = poses.at(t_s[:1])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotations[0], translations[0]
    return PoseSequence.from_matrices(t_s[:1], matrix[None])


def _home(problem: Problem) -> Path | None:
    return None if problem.path is None else problem.path.parent


def _stated_places(experiment: Experiment) -> dict[str, Array]:
    """Return the stated places of the markers on the undeformed body [m]; NaN where there is none."""
    markers = experiment.markers
    if not markers.names:
        return {}
    placed = markers.predict_positions(experiment.body.nodes_m[None])[0]
    placed = np.where(np.asarray(markers.located)[:, None], placed, np.nan)
    return dict(zip(markers.names, placed, strict=True))


def _require_shapes(joint: JointPosterior | None) -> None:
    """Raise a `ValueError` if a stored posterior is damaged."""
    if joint is None:
        return
    r, s = len(joint.names), len(joint.sources)
    for shape, array in (
        ((r,), joint.offset),
        ((r, r), joint.covariance),
        ((r, s), joint.by_source),
    ):
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(f"joint: expected finite numbers of shape {shape}")


def _statistical_covariance(result: Result, problem: Problem) -> Array | None:
    """Return the statistical covariance (nq, nq) of q, zero for coefficients of fields; None without
    error bars.
    """
    uncertainty = result.uncertainty
    if uncertainty is None:
        return None
    names = [item.name for item in problem.parameters.free]
    places = np.ix_(*[[names.index(name) for name in uncertainty.names]] * 2)
    statistical = np.zeros((len(names), len(names)))
    statistical[places] = uncertainty.covariance
    return statistical


def _grip(values: Iterable[tuple[Any, str, float]]) -> dict[str, float]:
    """Return the nuisance parameters of the grip by name, from (entry, name, value) of all."""
    return {name: value for entry, name, value in values if entry.row in GRIP}


def _description_std_m(result: Result) -> float:
    """Return the standard deviation of a coordinate by which residuals exceed their noise [m]."""
    excess = result.fit.rms_m**2 - result.fit.noise_rms_m**2
    return float(np.sqrt(max(0.0, excess) / 3))


def _warnings(result: Result) -> tuple[str, ...]:
    warnings = [] if result.converged else ["the run did not converge"]
    if result.trust.verdict != "good":
        reasons = "; ".join(result.trust.reasons)
        warnings.append(f"the verdict on the run is {result.trust.verdict!r}: {reasons}")
    return tuple(warnings)
