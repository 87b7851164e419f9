"""Identified body of a run folder, the input of every export.

The body is undeformed and placed rigidly as its grasp holds it at the first sample. Simulators keep
the grasped nodes there, or move them on from there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...errors import InputError, listed, located
from ...fem.body import Body
from ...fem.laws.constants import FIBRE_ANGLE
from ...fem.laws.fibres import ReinforcedMaterial
from ...fem.laws.moduli import engineering_constants
from ...fem.laws.ogden import is_power_law, term_numbers
from ...fem.regions import BodyPart
from ...problem import Problem
from ...program.collocation import Collocation
from ...recording import Experiment, Markers, Obstacle
from ...recording.obstacle_solids import solid_key
from ...result.replay import MotionRecord, damaged_run_refused, read_arrays
from ...runs.ensemble import draw_samples
from ...runs.forward_simulation import ForwardSimulation
from ...runs.result_builder import build_result
from ...runs.result_content import Result
from ...runs.solved_problem import SolvedProblem
from ...runs.warm_start import WarmStart
from ...statistics.budget.combined_intervals import ReportedEstimate


@dataclass(frozen=True, eq=False)
class IdentifiedRegion:
    """Part of the body with its constants."""

    name: str  # name of the region; "body" for elements outside all regions
    cells: Index  # (k,): indices of its elements
    material: str
    constants: Mapping[str, float]  # mapping of name to value: constants of the material
    # Elastic constants at rest and small strain, of the long-term energy; NaN for a cable.
    lambda_pa: float
    mu_pa: float
    young_pa: float
    poisson: float
    density_kg_m3: float
    damping: str  # name of the damping law
    # Stiffness-proportional and mass-proportional damping, see the glossary.
    gamma_r_s: float
    gamma_m_1_s: float
    # "name", "share" (stiffness over the long-term stiffness) and "tau_s" (relaxation time) of each
    # viscoelastic branch; empty without memory.
    branches: tuple[Mapping[str, Any], ...]

    @property
    def kappa_pa(self) -> float:
        """Bulk modulus κ = λ + ⅔ μ [Pa]."""
        return self.lambda_pa + 2 / 3 * self.mu_pa

    def fibre_directions(self, families: int) -> Array:
        """Return the direction (families, 3) of each family of fibres, in the axes of the fibres."""
        angle = self.constants.get(FIBRE_ANGLE.name, 0.0)
        sides = (1, -1)[:families]
        return np.array([[np.cos(angle), side * np.sin(angle), 0.0] for side in sides])

    @property
    def power_terms(self) -> tuple[tuple[float, float, float], ...]:
        """Constants μ_p [Pa], α_p and β_p of the terms of Ogden's law (β_p = 0) or of a compressible
        foam; empty for other materials.
        """
        if not is_power_law(self.material):
            return ()
        c = self.constants
        return tuple(
            (c[f"mu_{p}_pa"], c[f"alpha_{p}"], c.get(f"beta_{p}", 0.0)) for p in term_numbers(c)
        )


def without_obstacles(experiment: Experiment) -> Experiment:
    """Return a copy of an experiment without its obstacles, which simulators have as separate
    objects.

    Measurements are replaced by one marker at the first node with zeros as positions, because an
    experiment must have some and all of them may be of the obstacles. Initial positions and
    velocities are those of the body's nodes alone.

    Raises
    ------
    InputError
        If the body then has no initial equilibrium, because only obstacles support it.
    """
    body = experiment.body
    t_s = experiment.t_s
    own = len(body.nodes.points_m)
    started = {
        name: None if (positions_m := getattr(experiment, name)) is None else positions_m[:own]
        for name in ("start_positions_m", "start_velocities_m_s")
    }
    # Placeholder: see the docstring.
    some = Markers(
        t_s, np.zeros((len(t_s), 1, 3)), sigma_m=1e-3, names=["corner"], places_m=body.nodes_m[:1]
    )
    unmeasured: dict[str, Any] = {"markers": some, "readings": (), "depths": ()}
    try:
        return replace(experiment, grasps=experiment.body_grasps, **started, **unmeasured)
    except InputError as error:
        raise InputError(
            "exports leave obstacles out, and the body has no equilibrium without them; expected a "
            f"recording in which it is grasped, or that starts undeformed: {error}"
        ) from error


@dataclass(frozen=True, eq=False)
class IdentifiedBody:
    """Body as a run identified it, in the grasp of one of its recordings.

    Attributes
    ----------
    title : str
        Title of the problem.
    verdict : str
        Verdict of the run.
    warnings : tuple of str
        Reasons not to use the numbers without care.
    parameters : mapping of name to ReportedEstimate
        Estimates of the run.
    body : Body
        The body, without obstacles.
    theta : (k,)
        Constants of the body at the estimates.
    experiment : Experiment
        The recording with corrected gravity and grasps, and without obstacles.
    simulated_m : (T, n, 3) or None
        Forward simulation of this package at the samples; None if the run has none.
    experiment_with_obstacles : Experiment or None
        The recording with its obstacles, whose friction coefficients are numbers; None without
        obstacles.
    """

    title: str
    verdict: str
    warnings: tuple[str, ...]
    parameters: Mapping[str, ReportedEstimate]
    body: Body
    theta: Array
    experiment: Experiment
    simulated_m: Array | None
    experiment_with_obstacles: Experiment | None = None

    @classmethod
    def read(
        cls, run: str | Path, experiment: str | None = None, allow_code: bool = False
    ) -> IdentifiedBody:
        """Read the body from a run folder, as a run identified it; nothing is written.

        Grasps and gravity of the recording are those that the run corrected with its nuisance
        parameters.

        Parameters
        ----------
        experiment : str, optional
            Name of a fitted experiment; the first by default.
        allow_code : bool
            Whether Python files that the problem names may run.

        Raises
        ------
        InputError
            If it is no run of a problem file, is damaged, has no such fitted recording, or has a
            mesh made under gravity; or if only obstacles support the body.
        """
        folder = Path(run)
        result, answer, problem, collocation = _read_run(folder, allow_code)
        names = [transcription.experiment.name for transcription in collocation.transcriptions]
        if experiment is not None and experiment not in names:
            raise InputError(_not_fitted(experiment, names), folder)
        transcription = collocation.transcriptions[names.index(experiment) if experiment else 0]
        with damaged_run_refused(folder):
            values = {
                item.name: result.parameters[item.name].value
                for item in problem.parameters.components
            }
        phi = answer.apply_to_nuisance(collocation)[0][transcription.nuisance_indices.indices]
        with damaged_run_refused(folder):
            replay = MotionRecord.from_arrays(transcription.experiment.name, read_arrays(folder))
            nodes_m = transcription.body.nodes.points_m
            if replay.undeformed_m.shape != nodes_m.shape:
                raise ValueError("the mesh is not that of the problem file")
        with located(folder):
            return cls._from_experiment(
                result,
                transcription.corrected_experiment(phi),
                values=values,
                simulated_m=replay.rolled_out_positions_m,
                title=problem.title,
            )

    @classmethod
    def from_run(cls, run: SolvedProblem, experiment: str | None = None) -> IdentifiedBody:
        """Build from a run in memory, which needs no problem file.

        Parameters
        ----------
        run : SolvedProblem
            A run, such as the value of `collocation_sysid.run`.
        experiment : str, optional
            Name of a fitted experiment; the first by default.

        Raises
        ------
        InputError
            If no such experiment was fitted, the mesh was made under gravity, or obstacles are
            refused.
        """
        _require_stress_free(run.problem)
        parts = {part.transcription.experiment.name: part for part in run.solution.parts}
        if experiment is not None and experiment not in parts:
            raise InputError(_not_fitted(experiment, list(parts)))
        part = parts[experiment] if experiment else next(iter(parts.values()))
        rollout = run.rollouts[part.transcription.experiment.name]
        return cls._from_experiment(
            build_result(run),
            part.transcription.corrected_experiment(part.phi),
            values=run.parameters,
            simulated_m=rollout.trajectory.positions_m
            if isinstance(rollout, ForwardSimulation)
            else None,
            title=run.problem.title,
        )

    def with_values(self, values: Mapping[str, float]) -> IdentifiedBody:
        """Return the body with other values of the parameters, by name in SI units, as those of one
        draw: without intervals, and without a forward simulation.
        """
        known = {
            name: ReportedEstimate(values[name], fixed=each.fixed, tied=each.tied)
            for name, each in self.parameters.items()
        }
        theta = self.body.theta_from_values(values)
        return replace(self, parameters=known, theta=theta, simulated_m=None)

    @classmethod
    def _from_experiment(
        cls,
        result: Result,
        corrected: Experiment,
        *,
        values: Mapping[str, float],
        simulated_m: Array | None,
        title: str,
    ) -> IdentifiedBody:
        body = corrected.body
        obstacles = tuple(
            replace(o, friction=values[o.friction]) if isinstance(o.friction, str) else o
            for o in corrected.obstacles
        )
        touching = corrected.with_obstacles(obstacles) if obstacles else None
        if obstacles:
            corrected = without_obstacles(corrected)
            body = corrected.body
            simulated_m = None if simulated_m is None else simulated_m[:, : len(body.nodes_m)]
        return cls(
            title,
            result.trust.verdict,
            warnings=_warnings(result),
            parameters={n: each for n, each in result.parameters.items() if n in result.estimates},
            body=body,
            theta=body.theta_from_values(values),
            experiment=corrected,
            simulated_m=simulated_m,
            experiment_with_obstacles=touching,
        )

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles that the body may touch; empty without any."""
        return (
            ()
            if self.experiment_with_obstacles is None
            else self.experiment_with_obstacles.obstacles
        )

    @property
    def start_s(self) -> float:
        """Time of the first sample of the recording [s]."""
        return float(self.experiment.t_s[0])

    @cached_property
    def nodes_m(self) -> Array:
        """Undeformed nodes (n, 3) [m] in the world, placed rigidly as the grasp holds the body at
        the first sample.
        """
        return self.experiment.rigid_positions([self.start_s])[0]

    @cached_property
    def is_prescribed(self) -> NDArray[np.bool_]:
        """Whether each coordinate of each node (n, 3) has a prescribed displacement at the first
        sample.
        """
        return self.experiment.is_prescribed([self.start_s])[0]

    @cached_property
    def prescribed_m(self) -> Array:
        """Prescribed coordinates of the nodes (n, 3) [m] in the world at the first sample; NaN
        where a coordinate is free.
        """
        return self.experiment.prescribed_displacements([self.start_s])[1][0]

    @property
    def is_node_prescribed(self) -> NDArray[np.bool_]:
        """Whether each node (n,) is prescribed along all axes at the first sample."""
        return np.asarray(self.is_prescribed.all(axis=1))

    @property
    def is_quadratic(self) -> bool:
        """Whether the elements have nodes on their edges."""
        return self.body.element.nodes == 10

    @cached_property
    def point_masses_kg(self) -> Array:
        """Point masses attached to the nodes (n,) at the first sample [kg]; zero without any."""
        return self.experiment.point_mass_at_nodes_kg([self.start_s])[0]

    @cached_property
    def node_mass_kg(self) -> Array:
        """Lumped mass of the body at each node (n,) [kg], without point masses."""
        return self.body.mass_of_dofs(self.theta)[::3]

    @cached_property
    def total_node_mass_kg(self) -> Array:
        """Lumped mass at each node (n,) [kg], with point masses."""
        return self.node_mass_kg + self.point_masses_kg

    @cached_property
    def node_loads_n(self) -> Array:
        """Forces on the nodes (n, 3) [N] at the first sample: the declared ones, and the weight of
        point masses, but not that of the body.
        """
        weight = self.point_masses_kg[:, None] * self.experiment.gravity_m_s2
        return self.experiment.declared_node_forces_n([self.start_s])[0] + weight

    @cached_property
    def regions(self) -> tuple[IdentifiedRegion, ...]:
        """Parts of the body with their constants at the estimates, in the order of `Body.parts`."""
        body = self.body
        regions = []
        lame = body.lame(self.theta)
        cables = (each.name for each in body.parts if each.material.name == "cable")
        lame |= dict.fromkeys(cables, (np.nan, np.nan))
        shares = body.split_theta(self.theta)
        densities = body.densities(self.theta)
        for part, share, density in zip(body.parts, shares, densities, strict=True):
            values = {c.name: float(v) for c, v in zip(part.constants, share, strict=True)}
            young, poisson = engineering_constants(*lame[part.name])
            regions.append(
                IdentifiedRegion(
                    part.name or "body",
                    part.cells,
                    part.material.matrix.name,
                    {c.name: values[c.name] for c in part.material.constants},
                    *lame[part.name],
                    young,
                    poisson,
                    density,
                    part.damping.name,
                    values.get("gamma_r_s", 0.0),
                    values.get("gamma_m_1_s", 0.0),
                    tuple(
                        {"name": b.name}
                        | {key: values[f"{b.name}.{key}"] for key in ("share", "tau_s")}
                        for b in part.prony
                    ),
                )
            )
        return tuple(regions)

    @cached_property
    def laws(self) -> tuple[str, ...]:
        """Name of the law of each of the `regions`: its material and the kind of its fibres."""
        names = []
        is_linear = [region.material == "linear" for region in self.regions]
        for part, region in zip(self.body.parts, self.regions, strict=True):
            name = region.material
            if isinstance(part.material, ReinforcedMaterial):
                fibres = part.material.energy.fibres
                kind = "dispersed fibres" if fibres.is_dispersed else "fibres"
                name += f" with {kind}"
                name += "" if fibres.tension_only else " that carry compression"
            elif region.material == "linear" and not all(is_linear):
                name += " beside other laws"  # large displacements are those of the whole body
            names.append(name)
        return tuple(names)

    def fibre_axes(self, part: BodyPart) -> list[tuple[Index, Array]]:
        """Return the elements of a part with fibres by their axes: for each axes (3, 3) in the
        world, whose columns are those of `Fibres.axes`, the indices of the elements.
        """
        assert part.axes is not None
        here = self.nodes_m - self.nodes_m.mean(axis=0)
        undeformed = self.body.nodes_m - self.body.nodes_m.mean(axis=0)
        turn = np.linalg.lstsq(undeformed, here)[0].T  # of the body as its grasp holds it
        axes = np.round(np.einsum("ij,kjl->kil", turn, part.axes), 12)
        different, of_cell = np.unique(axes.reshape(-1, 9), axis=0, return_inverse=True)
        return [
            (part.cells[of_cell.ravel() == k], own)
            for k, own in enumerate(different.reshape(-1, 3, 3))
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return the content of identified.json as a dictionary, with arrays and dataclasses that
        `as_json` converts.

        The keys are "title", "verdict", "warnings", "parameters" (estimates by name), "element",
        "nodes_m", "cells", "node_mass_kg", "tied_mass_kg" (point masses), "regions", "experiment",
        "kind", "start", "gravity_m_s2", "t_s", "grasps", "obstacles" and "node_loads_n". Positions
        are those at the first sample; element and node indices count from 0.
        """
        e = self.experiment
        body = self.body
        names = (
            "value",
            "combined_std_error",
            "combined95",
            "statistical_std_error",
            "statistical95",
            "at_bound",
            "fixed",
        )
        return {
            "title": self.title,
            "verdict": self.verdict,
            "warnings": self.warnings,
            "parameters": {
                name: {key: getattr(value, key) for key in names}
                for name, value in self.parameters.items()
            },
            "element": body.element.name,
            "nodes_m": self.nodes_m,
            "cells": body.cells,
            "node_mass_kg": self.node_mass_kg,
            "tied_mass_kg": self.point_masses_kg,
            "regions": self.regions,
            "experiment": e.name,
            "kind": e.kind,
            "start": e.start,
            "gravity_m_s2": e.gravity_m_s2,
            "t_s": e.t_s,
            "grasps": [
                {
                    "nodes": grasp.nodes,
                    "axes": grasp.axes,
                    "from_s": grasp.from_s,
                    "until_s": grasp.until_s,
                    "positions_m": self.prescribed_m[grasp.nodes],
                    "pose_t_s": grasp.poses.t_s,
                    "pose_positions_m": grasp.poses.positions_m,
                    "pose_quaternions_xyzw": grasp.poses.quaternions_xyzw,
                }
                for grasp in e.grasps
            ],
            "obstacles": [
                {
                    "name": each.name,
                    "shape": {solid_key(each.shape): each.shape},
                    "friction": each.friction,
                    "pose_t_s": each.poses.t_s,
                    "pose_positions_m": each.poses.positions_m,
                    "pose_quaternions_xyzw": each.poses.quaternions_xyzw,
                }
                for each in self.obstacles
            ],
            "node_loads_n": self.node_loads_n,
        }


def _read_run(folder: Path, allow_code: bool) -> tuple[Result, WarmStart, Problem, Collocation]:
    result = Result.read(folder)
    answer = WarmStart.from_result(result, folder)
    home = result.problem_folder(
        folder,
        "which export needs: in Python, export the run itself, "
        'write_export(IdentifiedBody.from_run(run), "mujoco", "deck"), see docs/howto/simulators.md',
    )
    with damaged_run_refused(folder):
        _warnings(result)
    problem = Problem.read(folder / "problem.toml", allow_code=allow_code, folder=home)
    problem = problem.with_lengths({n: each.shapes.length_m for n, each in result.fields.items()})
    if problem.parameters.free:
        problem = answer.apply_to_problem(problem)  # which may state no guess itself
    with located(folder):
        _require_stress_free(problem)
    collocation = problem.collocation()
    return result, answer, problem, collocation


def read_draws(
    run: str | Path, count: int, seed: int = 0, allow_code: bool = False
) -> dict[str, Array]:
    """Return draws (count,) of all parameters and derived moduli of a run folder by name, those of
    `SolvedProblem.samples`.

    Raises
    ------
    InputError
        As `IdentifiedBody.read`; for a run without error bars, or whose search went on beyond the
        bounds of its problem; or if hardly any draw is admissible.
    """
    folder = Path(run)
    result, _, _, collocation = _read_run(folder, allow_code)
    known = result.uncertainty
    covariance = None if known is None else known.draw_covariance
    free = collocation.parameters.free
    if known is None or covariance is None:
        raise InputError("the run has no error bars, and therefore no samples", folder)
    with damaged_run_refused(folder):
        values = {item.name: result.parameters[item.name].value for item in free}
    if np.shape(covariance) != (len(free), len(free)) or any(
        not item.lower <= values[item.name] <= item.upper for item in free
    ):
        raise InputError(
            "an estimate of the run is beyond the bounds of its problem file; expected bounds that "
            "contain it (state lower and upper, and solve again), or in Python write_ensemble(run, …)",
            folder,
        )
    return draw_samples(collocation, values, covariance, known.combinations, count, seed)


def _not_fitted(experiment: str, names: Sequence[str]) -> str:
    return f"no experiment {experiment!r} was fitted; expected one of {', '.join(names)}"


def _require_stress_free(problem: Problem) -> None:
    if any(body.scan_conditions is not None for body in problem.bodies):
        raise InputError(
            "the mesh was made under gravity, but simulators assume a stress-free mesh; "
            "expected a stress-free mesh: write body.stress_free_mesh(theta) to a file, and "
            'solve with that and rest_shape = "stress_free"',
            where="object.rest_shape",
        )


def _warnings(result: Result) -> tuple[str, ...]:
    """Return reasons, as sentences without a period."""
    warnings = []
    if not result.converged:
        warnings.append("the run did not converge")
    if (verdict := result.trust.verdict) != "good":
        warnings.append(f"the verdict on the run is {verdict!r}: {'; '.join(result.trust.reasons)}")
    if result.fields:
        warnings.append(f"{listed(result.fields)} varies in space: the mean is exported")
    for name, each in result.parameters.items():
        if each.at_bound and not each.fixed:
            warnings.append(
                f"{name} = {each.value:.4g} ended at a bound: the best value may lie beyond it"
            )
    return tuple(warnings)
