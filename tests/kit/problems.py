"""Small experiments with known parameters: a few nodes, about ten timesteps, noiseless tracks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import cycle, product

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from collocation_sysid.common.array_types import Array
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.methods.solution import Solution
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.lifted.collocation import lifted_variables
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import (
    Experiment,
    Force,
    Grasp,
    Markers,
    Nuisance,
    Obstacle,
    Plane,
    PointMass,
    PoseSequence,
    Pressure,
    Sphere,
    Tendon,
)
from collocation_sysid.testing.small_problems import smooth_poses

TRUTH = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
GUESS = Parameters(
    (
        Parameter("lambda_pa", 400.0, 10.0, 1e5),
        Parameter("mu_pa", 150.0, 10.0, 1e5),
        Parameter("gamma_r_s", 0.02, 1e-5, 1.0),
        Parameter("gamma_m_1_s", 0.5, 1e-3, 100.0),
    )
)


def as_theta(given: Parameters | Mapping[str, float]) -> np.ndarray:
    """Constants of a body of one region in λ and μ, in its order."""
    return np.array([*(given.guesses if isinstance(given, Parameters) else given).values()])


GRAVITY_M_S2 = (0.0, 0.0, -9.81)
IDEAL = Nuisance.none()
EDGE_M = 0.1


@cache
def box(
    size_m: tuple[float, ...] = (EDGE_M,) * 3,
    divisions: tuple[int, ...] = (2, 2, 2),
    element: str = "tet4",
) -> Body:
    """A foam box with a corner at the origin; bodies are shared, their kernels compile once."""
    return Body(box_mesh(size_m, divisions), density_kg_m3=30.0, element=element)


def with_papers_damping(experiment: Experiment) -> Experiment:
    """The experiment with Rayleigh's law."""
    body = experiment.body
    rayleigh = Body(body.mesh, density_kg_m3=30.0, element=body.element.name, damping="rayleigh")
    return replace(experiment, body=rayleigh)


def nodes_where(body: Body, axis: int, value_m: float) -> np.ndarray:
    """Nodes on a plane across an axis."""
    return np.flatnonzero(np.abs(body.nodes_m[:, axis] - value_m) < 1e-9)


def vertex_markers(body: Body, nodes: ArrayLike, t_s: np.ndarray) -> Markers:
    """Markers on mesh vertices, not measured yet."""
    return point_markers(body, body.nodes_m[np.asarray(nodes)], t_s)


def point_markers(body: Body, points_m: np.ndarray, t_s: np.ndarray) -> Markers:
    """Markers at points of the undeformed body, not measured yet."""
    names = [f"m{k}" for k in range(len(points_m))]
    nowhere = np.zeros((len(t_s), len(points_m), 3))
    return Markers(t_s, nowhere, 1e-3, names, points_m).on_body(body)


def times(steps: int, timestep_s: float = 0.01) -> np.ndarray:
    """0, Δt, …, `steps` Δt."""
    return timestep_s * np.arange(steps + 1)


def hung_cube(steps: int = 10, divisions: tuple[int, ...] = (2, 2, 2), **changes) -> Experiment:
    """A cube hung from its top face, swayed and turned from rest."""
    body, t_s = box(divisions=divisions), times(steps)
    grasp = Grasp(nodes_where(body, 2, EDGE_M), smooth_poses(t_s))
    markers = vertex_markers(body, nodes_where(body, 2, 0.0), t_s)
    changes = {"nuisance": IDEAL} | changes
    return Experiment(body, t_s, [grasp], markers, name="hung cube", **changes)


def released_cube(steps: int = 10) -> Experiment:
    """A cube held still at its top face, let go undeformed under gravity."""
    body, t_s = box(), times(steps)
    grasp = Grasp(nodes_where(body, 2, EDGE_M), PoseSequence.fixed())
    markers = vertex_markers(body, nodes_where(body, 2, 0.0), t_s)
    return Experiment(
        body, t_s, [grasp], markers, name="released cube", start="undeformed", nuisance=IDEAL
    )


def bar_in_two_hands(steps: int = 10) -> Experiment:
    """A bar held at both ends, one of which moves."""
    body, t_s = box((0.15, 0.05, 0.05), (4, 1, 1)), times(steps)
    still = Grasp(nodes_where(body, 0, 0.0), PoseSequence.fixed())
    moving = Grasp(nodes_where(body, 0, 0.15), smooth_poses(t_s))
    inside = np.flatnonzero((body.nodes_m[:, 0] > 0.01) & (body.nodes_m[:, 0] < 0.14))
    markers = vertex_markers(body, inside, t_s)
    return Experiment(body, t_s, [still, moving], markers, name="bar in two hands", nuisance=IDEAL)


def cube_with_gaps(steps: int = 12) -> Experiment:
    """The hung cube seen through markers inside elements, a quarter of their samples missing."""
    hung = hung_cube(steps)
    rng = np.random.default_rng(4)
    points = rng.uniform(0.005, 0.6 * EDGE_M, size=(6, 3))
    markers = point_markers(hung.body, points, hung.t_s)
    tracks = np.zeros_like(markers.positions_m)
    tracks[rng.random(tracks.shape[:2]) < 0.25] = np.nan
    unmeasured = replace(markers, positions_m=tracks)
    return Experiment(
        hung.body, hung.t_s, hung.grasps, unmeasured, name="cube with gaps", nuisance=IDEAL
    )


def quadratic_bar(steps: int = 10) -> Experiment:
    """A bar of quadratic elements held at one end, seen at nodes on edges and inside elements."""
    body, t_s = box((0.15, 0.05, 0.05), (2, 1, 1), "tet10"), times(steps)
    grasp = Grasp(nodes_where(body, 0, 0.0), smooth_poses(t_s))
    points = np.vstack([body.nodes_m[-4:], [[0.13, 0.01, 0.02], [0.14, 0.03, 0.04]]])
    markers = point_markers(body, points, t_s)
    return Experiment(body, t_s, [grasp], markers, name="quadratic bar", nuisance=IDEAL)


def bar_let_go(steps: int = 10) -> Experiment:
    """A bar held at both ends; one hand lets go, later a mass joins there and a force pulls."""
    bar = bar_in_two_hands(steps)
    still, moving = bar.grasps
    end, dt = moving.nodes, bar.timestep_s
    return replace(
        bar,
        name="bar let go",
        grasps=(still, replace(moving, until_s=2 * dt)),
        masses=(PointMass(end, 0.004), PointMass(end[:2], 0.003, from_s=3 * dt)),
        forces=(Force(end[-1:], [[0, 0, 0], [0, 0.02, 0.01]], [0.0, steps * dt]),),
    )


def bar_loaded(steps: int = 10) -> Experiment:
    """A bar that a mass joins and leaves, and a force pulls for a while, at unknown times."""
    bar = bar_in_two_hands(steps)
    still, moving = bar.grasps
    end, dt = moving.nodes, bar.timestep_s
    pulling = Force(end[1:], [[0.01, 0.02, 0.01]], from_s=1.3 * dt, until_s=3.9 * dt)
    return replace(
        bar,
        name="bar loaded",
        grasps=(still,),
        masses=(PointMass(end[:2], 0.003, 1.6 * dt, until_s=4.2 * dt), PointMass(end, 0.001)),
        forces=(pulling,),
        nuisance=Nuisance.none(gravity_rad=0.03, joining_s=0.004),
    )


def cube_with_nuisance(steps: int = 10) -> Experiment:
    """The hung cube with everything estimated that an experiment may not know of itself."""
    nuisance = Nuisance(
        marker_offset_m=0.002,
        camera_offset_m=0.001,
        time_shift_s=0.003,
        pose_turn_rad=0.02,
        pose_shift_m=0.002,
        gravity_rad=0.03,
        hand_eye_m=0.002,
        hand_eye_rad=0.02,
    )
    return replace(hung_cube(steps), name="cube with nuisance", nuisance=nuisance)


def bar_with_nuisance(steps: int = 8) -> Experiment:
    """The bar that one hand lets go of, of quadratic elements, off in its grasps and its places."""
    body, t_s = box((0.15, 0.05, 0.05), (2, 1, 1), "tet10"), times(steps)
    still = Grasp(nodes_where(body, 0, 0.0), smooth_poses(t_s))
    moving = Grasp(nodes_where(body, 0, 0.15), smooth_poses(t_s), until_s=3 * t_s[1])
    points = np.array([[0.13, 0.01, 0.02], [0.09, 0.05, 0.04], [0.12, 0.03, 0.0]])
    markers = point_markers(body, points, t_s)
    exact_first = replace(markers, places_sigma_m=np.array([0.0, np.nan, 0.004]), on_surface=True)
    nuisance = Nuisance.none(marker_offset_m=0.003, hand_eye_m=0.002, hand_eye_rad=0.02)
    return Experiment(
        body, t_s, [still, moving], exact_first, name="bar with nuisance", nuisance=nuisance
    )


def driven_bar(steps: int = 8) -> Experiment:
    """A bar with a cavity, held at one end, that a tendon bends and a pressure fills."""
    whole, t_s = box_mesh((0.12, 0.06, 0.06), (3, 3, 3)), times(steps)
    inside = (np.abs(whole.centres_m - [0.06, 0.03, 0.03]) < [0.03, 0.01, 0.01]).all(axis=1)
    body = Body(TetMesh(whole.points_m, whole.tetrahedra[~inside]), density_kg_m3=30.0)
    points = [(x, 0.05, 0.03 + 0.1 * x) for x in (0.0, 0.05, 0.08, 0.118)]
    tip = nodes_where(body, 0, 0.12)
    cavity = Box((0.02, 0.015, 0.015), (0.1, 0.045, 0.045))
    rising = Pressure(cavity, [15.0, 25.0], t_s[[0, -1]], lag_s=0.02)
    return Experiment(
        body,
        t_s,
        [Grasp(nodes_where(body, 0, 0.0), smooth_poses(t_s))],
        vertex_markers(body, tip, t_s),
        name="driven bar",
        tendons=[Tendon(points, 0.02 + 0.5 * t_s, t_s)],
        pressures=[rising],
        nuisance=Nuisance.none(
            tension_factor=0.1,
            tension_lost_n=0.01,
            pressure_factor=0.1,
            pressure_lost_pa=5.0,
            pressure_lag=0.5,
            gravity_rad=0.03,
        ),
    )


SMALL_EXPERIMENTS = {
    "hung-cube": hung_cube,
    "released-cube": released_cube,
    "bar-in-two-hands": bar_in_two_hands,
    "cube-with-gaps": cube_with_gaps,
    "quadratic-bar": quadratic_bar,
    "bar-let-go": bar_let_go,
    "cube-with-nuisance": cube_with_nuisance,
    "bar-with-nuisance": bar_with_nuisance,
    "driven-bar": driven_bar,
}
# Every experiment and every scheme, and all schemes where the rows they reach back to change; what
# an experiment has besides is none of the scheme's.
EXPERIMENTS_AND_SCHEMES = list(
    dict.fromkeys(
        [*zip(SMALL_EXPERIMENTS, cycle(SCHEMES)), *product(("hung-cube", "bar-let-go"), SCHEMES)]
    )
)


def measured(experiment: Experiment, scheme: str = "midpoint", substeps: int = 1) -> Experiment:
    """The experiment with the tracks that `TRUTH` gives it; missing samples stay missing."""
    return measured_with(experiment, TRUTH, scheme, substeps)


def measured_with(
    experiment: Experiment, truth: Mapping[str, float], scheme: str = "midpoint", substeps: int = 1
) -> Experiment:
    """The same with the tracks of any parameters."""
    tracks = simulate(experiment, truth, scheme, substeps=substeps).markers_m
    present = experiment.markers.is_present[:, :, None]
    return with_markers(experiment, np.where(present, tracks, np.nan))


def noisy(
    experiment: Experiment, noise_m: float = 1e-3, scheme: str = "midpoint", seed: int = 7
) -> Experiment:
    """The experiment with the tracks that `TRUTH` gives it, and white noise."""
    made = measured(experiment, scheme)
    tracks = made.markers.positions_m
    noise = noise_m * np.random.default_rng(seed).normal(size=tracks.shape)
    return with_markers(made, tracks + noise)


def relative_errors(solution: Solution) -> np.ndarray:
    """Errors of the four parameters over `TRUTH`."""
    return np.array([solution.parameters[name] / TRUTH[name] - 1 for name in TRUTH])


def some_point(made: Collocation, rng: np.random.Generator | None = None) -> np.ndarray:
    """Variables that satisfy nothing, what is carried neither: rigid, then shaken."""
    return shaken_variables(made, rng or np.random.default_rng(1))


def pressed_cube(steps: int = 5, friction: float | str = 0.0, **changes) -> Experiment:
    """A cube held below, with a ball that comes down upon it and a plate that moves against it."""
    cube = hung_cube(steps, (1, 1, 2))
    body, t_s = cube.body, cube.t_s
    down = np.outer(0.012 * (1 - np.cos(20 * t_s)), [0.3, 0.2, -1.0])
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    turning = Rotation.from_rotvec(np.outer(np.sin(20 * t_s), [0.0, 0.05, 0.1])).as_quat()
    soft = {"stiffness_pa_m": 4e4, "width_m": 0.006, "slip": 0.02}
    ball = Obstacle(
        poses=PoseSequence(t_s, down, still),
        shape=Sphere(0.05, (0.05, 0.05, EDGE_M + 0.052)),
        name="ball",
        friction=friction,
        **soft,
    )
    plate = Obstacle(
        poses=PoseSequence(t_s, 0.2 * down, turning),
        shape=Plane((1.0, 0.0, 0.0), (0.002, 0.0, 0.0)),
        name="plate",
        width_m=0.01,
    )
    held = Grasp(nodes_where(body, 2, 0.0), PoseSequence.fixed())
    markers = vertex_markers(body, nodes_where(body, 2, EDGE_M), t_s)
    made = {"grasps": [held, ball, plate], "markers": markers, "name": "pressed cube"}
    return replace(cube, **(made | changes))


def prescribed_positions(experiment: Experiment, t_s: ArrayLike) -> Array:
    """Coordinates of the prescribed dofs (g,) at some times, (T, g); NaN where a dof is free."""
    positions = experiment.prescribed_displacements(t_s)[1]
    return positions.reshape(len(positions), -1)[:, experiment.prescribed_dofs]


def uneven_box(divisions: int) -> TetMesh:
    """Return the mesh of a box of about 0.10 × 0.12 × 0.09 m with randomly displaced nodes, so that
    no two elements are alike; every call gives the same mesh.

    Parameters
    ----------
    divisions : int
        Number of cells along each edge; each consists of six tetrahedra.
    """
    mesh = box_mesh((0.10, 0.12, 0.09), (divisions,) * 3)
    jitter = np.random.default_rng(1).uniform(-0.008, 0.008, mesh.points_m.shape)
    return TetMesh(mesh.points_m + jitter, mesh.tetrahedra)


def shaken_variables(collocation: Collocation, rng: np.random.Generator) -> Array:
    """Return variables z of a program that satisfy no equation: rigid motions, parameters and
    lifted variables with random errors.

    Lags of sensors are positive. The collocation is not modified.

    Parameters
    ----------
    collocation : Collocation
        Program, with or without lifted variables.
    """
    positions = []
    for transcription in collocation.transcriptions:
        rigid = transcription.experiment.rigid_positions(transcription.dynamics.t_s)
        rigid = rigid.reshape(-1, transcription.dof_count)
        positions.append(rigid + 1e-3 * rng.normal(size=rigid.shape))
    p = collocation.guess_p
    p[: collocation.nq] += 0.1 * rng.normal(size=collocation.nq)
    p[collocation.nq :] += 0.5 * rng.normal(size=collocation.nphi)
    is_lag = np.array(["lag of" in name for name in collocation.parameter_names], dtype=bool)
    p[is_lag] = np.abs(p[is_lag]) + 0.1
    z = collocation.pack(p, positions)
    for lifted in lifted_variables(collocation):
        z[lifted.columns] += 0.01 * rng.normal(size=lifted.count)
    return z
