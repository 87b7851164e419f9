"""An identified body, read back from a run: what every export is made of.

The body is placed as its grasp holds it at the first sample, carried rigidly and so undeformed;
simulators hold the grasped nodes there, or move them on from there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array, Index
from ...errors import InputError, listed, located
from ...fem.body import Body
from ...fem.moduli import engineering
from ...problem import Problem
from ...recording import Experiment, Markers, Obstacle
from ...recording.solids import name_of
from ...runs.result import ReportedEstimate, Result
from ...runs.warm_start import Earlier
from ..replay import Replay, read_arrays, reading_run


@dataclass(frozen=True)
class Branch:
    """A branch of the memory: its share of the long-term stiffness, and its relaxation time."""

    name: str
    share: float
    tau_s: float


@dataclass(frozen=True, eq=False)
class IdentifiedRegion:
    """A part of the body and its constants.

    Attributes
    ----------
    name : str
        "body" for what no region claims.
    cells : (k,) numbers of its cells
    material : str
    constants : mapping of name to value, of the material
    lambda_pa, mu_pa, young_pa, poisson : float
        At rest and small strain, of the long-term energy.
    density_kg_m3 : float
    damping : str
    gamma_r_s, gamma_m_1_s : float
    branches : tuple of Branch
    """

    name: str
    cells: Index
    material: str
    constants: Mapping[str, float]
    lambda_pa: float
    mu_pa: float
    young_pa: float
    poisson: float
    density_kg_m3: float
    damping: str
    gamma_r_s: float
    gamma_m_1_s: float
    branches: tuple[Branch, ...]

    @property
    def kappa_pa(self) -> float:
        """Bulk modulus."""
        return self.lambda_pa + 2 / 3 * self.mu_pa


def alone(experiment: Experiment) -> Experiment:
    """The experiment without obstacles, which targets have beside the body if at all."""
    body, t_s = experiment.body, experiment.t_s
    own = len(body.nodes.points_m)
    started = {
        name: None if (given := getattr(experiment, name)) is None else given[:own]
        for name in ("start_positions_m", "start_velocities_m_s")
    }
    # Nothing here looks at measurements, of which there may be none but of what was touched.
    some = Markers(t_s, np.zeros((len(t_s), 1, 3)), 1e-3, ["corner"], body.nodes_m[:1])
    unmeasured: dict[str, Any] = {"markers": some, "readings": (), "depths": ()}
    try:
        return replace(experiment, grasps=experiment.gripping, **started, **unmeasured)
    except InputError as error:
        raise InputError(
            "exports have no equilibrium of a body that obstacles alone carry; expected a "
            f"recording in which it is grasped, or that starts undeformed: {error}"
        ) from error


@dataclass(frozen=True, eq=False)
class Identified:
    """A body as a run identified it, in the grasp of one of its recordings.

    Attributes
    ----------
    title : str
    verdict : str
    warnings : tuple of str
        What to know before these numbers are used anywhere else.
    parameters : mapping of name to ReportedEstimate
    body : Body
    theta : (k,) its constants
    experiment : Experiment
        With gravity and grasps as they were found.
    rolled_out_m : (T, n, 3) our prediction at the samples, or None
    touching : Experiment, optional
        The same with what the body may touch, where that was found to be; frictions are numbers.
    """

    title: str
    verdict: str
    warnings: tuple[str, ...]
    parameters: Mapping[str, ReportedEstimate]
    body: Body
    theta: Array
    experiment: Experiment
    rolled_out_m: Array | None
    touching: Experiment | None = None

    @classmethod
    def read(
        cls, run: str | Path, experiment: str | None = None, allow_code: bool = False
    ) -> Identified:
        """Read a run folder.

        Parameters
        ----------
        run : str or Path
        experiment : str, optional
            A recording that was fitted; the first by default.
        allow_code : bool
            Whether Python files that the problem names may run.

        Raises
        ------
        InputError
            If it is no run of a problem file, is damaged, or has no such recording.
        """
        folder = Path(run)
        result = Result.read(folder)
        answer = Earlier.of_result(result, folder)
        home = result.home(folder, "which export needs")
        with reading_run(folder):
            warnings = _warnings(result)
        problem = Problem.read(folder / "problem.toml", allow_code=allow_code, folder=home)
        problem = problem.with_lengths(
            {n: each.shapes.length_m for n, each in result.fields.items()}
        )
        if problem.parameters.free:
            problem = answer.started(problem)  # which may state no guess itself
        if any(body.scan is not None for body in problem.bodies):
            raise InputError(
                "the mesh was made under gravity, and targets take meshes as free of stress; "
                "expected a stress-free mesh: write body.stress_free_mesh(theta) to a file, and "
                'solve with that and rest_shape = "stress_free"',
                folder,
                "object.rest_shape",
            )
        collocation = problem.collocation()
        names = [segment.experiment.name for segment in collocation.segments]
        if experiment is not None and experiment not in names:
            raise InputError(
                f"no experiment {experiment!r} was fitted; expected {', '.join(names)}", folder
            )
        segment = collocation.segments[names.index(experiment) if experiment else 0]
        with reading_run(folder):
            values = {
                item.name: result.parameters[item.name].value for item in problem.parameters.items
            }
        phi = answer.nuisance_of(collocation)[0][segment.local.places]
        with reading_run(folder):
            replay = Replay.from_arrays(segment.experiment.name, read_arrays(folder))
            body = segment.body
            if replay.undeformed_m.shape != body.nodes.points_m.shape:
                raise ValueError("the mesh is not that of the problem file")
        corrected, rolled_out_m = segment.corrected(phi), replay.rolled_out_positions_m
        touched = tuple(
            replace(o, friction=values[o.friction]) if isinstance(o.friction, str) else o
            for o in corrected.obstacles
        )
        touching = corrected.with_obstacles(touched) if touched else None
        if touched:
            with located(folder):
                corrected = alone(corrected)
            body = corrected.body
            rolled_out_m = None if rolled_out_m is None else rolled_out_m[:, : len(body.nodes_m)]
        return cls(
            problem.title,
            result.trust.verdict,
            warnings,
            {n: each for n, each in result.parameters.items() if n in result.values},
            body,
            body.theta(values),
            corrected,
            rolled_out_m,
            touching,
        )

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """What it may touch."""
        return () if self.touching is None else self.touching.obstacles

    @property
    def start_s(self) -> float:
        """Time of the first sample."""
        return float(self.experiment.t_s[0])

    @cached_property
    def nodes_m(self) -> Array:
        """(n, 3) undeformed, as the grasp holds the body at the first sample."""
        return self.experiment.rigid_positions([self.start_s])[0]

    @cached_property
    def held(self) -> NDArray[np.bool_]:
        """(n, 3) which coordinates are held at the first sample."""
        return self.experiment.held([self.start_s])[0]

    @cached_property
    def held_m(self) -> Array:
        """(n, 3) where, NaN where a coordinate is free."""
        return self.experiment.grasped([self.start_s])[1][0]

    @property
    def grasped(self) -> NDArray[np.bool_]:
        """(n,) which nodes are held along all axes at the first sample."""
        return np.asarray(self.held.all(axis=1))

    @cached_property
    def moved_m(self) -> Array:
        """(n, 3) how far held coordinates are from where the first grasp has the body, else 0."""
        return np.nan_to_num(self.held_m - self.nodes_m)

    @property
    def quadratic(self) -> bool:
        """Whether its elements have nodes on their edges."""
        return self.body.element.nodes == 10

    @cached_property
    def tied_kg(self) -> Array:
        """(n,) point masses at the first sample."""
        return self.experiment.tied_mass_kg([self.start_s])[0]

    @cached_property
    def node_mass_kg(self) -> Array:
        """(n,) of the body, lumped, without what is tied to it."""
        return self.body.mass_of_dofs(self.theta)[::3]

    @cached_property
    def mass_kg(self) -> Array:
        """(n,) with what is tied to it."""
        return self.node_mass_kg + self.tied_kg

    @cached_property
    def loads_n(self) -> Array:
        """(n, 3) on the nodes at the first sample besides the body's own weight."""
        weight = self.tied_kg[:, None] * self.experiment.gravity_m_s2
        return self.experiment.node_forces_n([self.start_s])[0] + weight

    @cached_property
    def regions(self) -> tuple[IdentifiedRegion, ...]:
        """The parts of the body."""
        body, regions = self.body, []
        lame, shares = body.lame(self.theta), body.split(self.theta)
        densities = body.densities(self.theta)
        for part, share, density in zip(body.parts, shares, densities, strict=True):
            values = {c.name: float(v) for c, v in zip(part.constants, share, strict=True)}
            young, poisson = engineering(*lame[part.name])
            regions.append(
                IdentifiedRegion(
                    part.name or "body",
                    part.cells,
                    part.material.name,
                    {c.name: values[c.name] for c in part.material.constants},
                    *lame[part.name],
                    young,
                    poisson,
                    density,
                    part.damping.name,
                    values.get("gamma_r_s", 0.0),
                    values.get("gamma_m_1_s", 0.0),
                    tuple(
                        Branch(b.name, values[f"{b.name}.share"], values[f"{b.name}.tau_s"])
                        for b in part.prony
                    ),
                )
            )
        return tuple(regions)

    def as_dict(self) -> dict[str, Any]:
        """All of it, for a file."""
        e, body = self.experiment, self.body
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
            "tied_mass_kg": self.tied_kg,
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
                    "positions_m": self.held_m[grasp.nodes],
                    "pose_t_s": grasp.poses.t_s,
                    "pose_positions_m": grasp.poses.positions_m,
                    "pose_quaternions_xyzw": grasp.poses.quaternions_xyzw,
                }
                for grasp in e.grasps
            ],
            "obstacles": [
                {
                    "name": each.name,
                    "shape": {name_of(each.shape): each.shape},
                    "friction": each.friction,
                    "pose_t_s": each.poses.t_s,
                    "pose_positions_m": each.poses.positions_m,
                    "pose_quaternions_xyzw": each.poses.quaternions_xyzw,
                }
                for each in self.obstacles
            ],
            "node_loads_n": self.loads_n,
        }


def _warnings(result: Result) -> tuple[str, ...]:
    """Why not to trust the numbers as they are."""
    warnings = []
    if not result.converged:
        warnings.append("the run did not converge")
    if (verdict := result.trust.verdict) != "good":
        warnings.append(f"the verdict on the run is {verdict!r}: {'; '.join(result.trust.reasons)}")
    if result.fields:
        warnings.append(
            f"{listed(result.fields)} differs from place to place: the mean is exported"
        )
    for name, each in result.parameters.items():
        if each.at_bound and not each.fixed:
            warnings.append(
                f"{name} = {each.value:.4g} ended at a bound: the data would have it elsewhere"
            )
    return tuple(warnings)
