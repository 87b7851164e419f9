"""Errors of the description that residuals show badly or not at all, in twins of a foam block and of
a bent bar.

A block of foam is moved at random, as in `twins`. Its tracks are simulated with an effect that the
described body does not have, or with another body. The estimated parameters absorb such errors, so
that the residuals look like noise. The bent bar differs from its mirror images.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from assumed_twins import anisotropic_law
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt
from twins import random_poses
from wrong_twins import FAULTS

import collocation_sysid as cs
from collocation_sysid.statistics.budget.systematic_effects import KnownEffect

TRUTH = {"young_pa": 5e3, "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 2.0}
UNKNOWN = {name: cs.Unknown() for name in TRUTH}
# Edges of the block [m], numbers of elements along them, and density.
SIZE_M = (0.05, 0.05, 0.1)
DIVISIONS = (2, 2, 5)
DENSITY_KG_M3 = 100.0
# Number of samples, the time between them [s], and the number of markers with their noise [m].
SAMPLES = 80
STEP_S = 0.01
MARKERS = 8
NOISE_M = 5e-4
# Sizes of the errors: mass of a marker [kg], share and relaxation time [s] of a branch of memory,
# lengths that the gripper holds or the mesh lacks [m], and relative difference of the stiffness at
# the ends of the body from that in its middle.
MARKER_MASS_KG = 5e-4
MEMORY = {"prony_1.share": 0.3, "prony_1.tau_s": 0.1}
HELD_M = 1e-3
LACKING_M = 1e-2
GRADIENT = 0.1
# Bent bar: edges and bend at its end [m], elements and density. Errors of its description: relative
# width, frequency of a low-pass filter [Hz].
BAR_M = (0.04, 0.04, 0.12)
BEND_M = (0.03, 0.012, 0.0)
BAR_DIVISIONS = (2, 2, 6)
BAR_DENSITY_KG_M3 = 100.0
WIDE = 0.04
LOW_PASS_HZ = 6.0
SCAN_GRAVITY_M_S2 = (0.0, -9.81, 0.0)
# Stiffness along the bar, by fibres, over that across it, less one.
FIBRES = 0.3
# Mass of three markers [kg], and the density of the bar that weighs 61.5 g.
HEAVY_KG = 1.5e-3
HEAVY_BAR_KG_M3 = 0.0615 / np.prod(BAR_M)
# Mass of the gripper over that of the body, and noise of the force [N] and torque [N m] sensor.
GRIPPER_SHARE = 0.3
WRENCH_N, WRENCH_NM = 2e-3, 1e-4
# Delay of half of the markers [s].
LATE_S = 0.016
# Quadratic elements of the description and of the body, and those of the body with a skin.
STATED_DIVISIONS, REAL_DIVISIONS = (1, 1, 6), (2, 2, 12)
# "auto" takes minutes for these bodies.
FINE_STEPS = ("midpoint", 8)
# Stiffness of the outer layer over that inside.
SKIN_DIVISIONS = (4, 4, 6)
SKIN = 0.3
# A motion that is so many times slower, and a branch of memory that relaxes during it.
SLOWER = 10.0
CREEP = {"prony_1.share": 0.3, "prony_1.tau_s": 2.0}


@dataclass(frozen=True)
class HiddenError:
    """Real recording and its description."""

    actual: cs.Experiment  # simulated experiment
    described: cs.Experiment  # experiment that is fitted, with the markers at the same places
    # Constants of the simulated body beside `TRUTH`.
    more_constants: Mapping[str, float] = field(default_factory=dict)
    assumptions: cs.Assumptions = field(default_factory=cs.Assumptions)
    # Returns the recorded tracks (T, M, 3) from those with noise [m].
    recorded: Callable[[np.ndarray], np.ndarray] = field(default=lambda tracks_m: tracks_m)
    unknown: tuple[str, ...] = tuple(TRUTH)  # others are known
    # Scheme and time steps per sample of the simulation.
    scheme: tuple[str, int | Literal["auto"]] = ("newmark", "auto")


def block(height_m: float = SIZE_M[2], **options) -> cs.Body:
    """Return the block, or one of another height; options are those of `Body`."""
    mesh = cs.box_mesh((*SIZE_M[:2], height_m), DIVISIONS)
    return cs.Body(mesh, density_kg_m3=DENSITY_KG_M3, **options)


def recording(body: cs.Body, seed: int) -> cs.Experiment:
    """Return the block, held at its lower face and moved at random, with markers on the upper part
    that every body of the study has.
    """
    rng = np.random.default_rng(seed)
    t_s = STEP_S * np.arange(SAMPLES)
    nodes_m = block().nodes_m
    high = np.flatnonzero(
        (nodes_m[:, 2] > 0.3 * SIZE_M[2]) & (nodes_m[:, 2] < SIZE_M[2] - LACKING_M)
    )
    places_m = nodes_m[rng.choice(high, MARKERS, replace=False)]
    markers = cs.Markers(t_s, np.zeros((SAMPLES, MARKERS, 3)), NOISE_M, places_m=places_m)
    held = np.flatnonzero(body.nodes_m[:, 2] < body.nodes_m[:, 2].min() + 1e-9)
    return cs.Experiment(body, t_s, [cs.Grasp(held, random_poses(t_s, rng))], markers, name="swing")


def no_error(seed: int) -> HiddenError:
    """Return a correct description."""
    experiment = recording(block(), seed)
    return HiddenError(experiment, experiment)


def with_heavy_markers(seed: int) -> HiddenError:
    """Return a body with markers whose mass is not stated."""
    described = recording(block(), seed)
    nodes_m = described.body.nodes_m
    places_m = described.markers.predict_positions(nodes_m)
    masses = [
        cs.PointMass([int(np.linalg.norm(nodes_m - place_m, axis=1).argmin())], MARKER_MASS_KG)
        for place_m in places_m
    ]
    return HiddenError(replace(described, masses=masses), described)


def with_stated_markers(seed: int) -> HiddenError:
    """Return the same body with the mass of the markers stated in the budget."""
    stated = KnownEffect(mean=MARKER_MASS_KG, deviation=0.1 * MARKER_MASS_KG)
    return replace(with_heavy_markers(seed), assumptions=cs.Assumptions(marker_mass_kg=stated))


def with_memory(seed: int) -> HiddenError:
    """Return a body whose material has a branch of memory; the true E is the long-term modulus."""
    actual = recording(block(prony=["prony_1"]), seed)
    return HiddenError(actual, recording(block(), seed), MEMORY)


def held_higher(seed: int) -> HiddenError:
    """Return a body that the gripper holds up to a greater height than described."""
    described = recording(block(), seed)
    mesh = cs.box_mesh((*SIZE_M[:2], SIZE_M[2] - HELD_M), DIVISIONS)
    shorter = cs.TetMesh(mesh.points_m + np.array([0, 0, HELD_M]), mesh.tetrahedra)
    body = cs.Body(shorter, density_kg_m3=DENSITY_KG_M3)
    return HiddenError(recording(body, seed), described)


def with_lacking_end(seed: int) -> HiddenError:
    """Return a body whose free end is missing in the mesh."""
    lower = block(SIZE_M[2] - LACKING_M)
    return HiddenError(recording(block(), seed), recording(lower, seed))


def with_gradient(seed: int) -> HiddenError:
    """Return a body whose stiffness grows linearly from its lower to its upper end."""
    body = block()
    centres_m = body.nodes_m[body.cells, 2].mean(axis=1)
    shares = GRADIENT * (2 * centres_m / SIZE_M[2] - 1)
    actual = recording(body.with_stiffness_factors(1 + shares), seed)
    return HiddenError(actual, recording(body, seed))


def _bend_at(z_m: np.ndarray) -> np.ndarray:
    """Return the share of the bend at heights (n,), straight between the layers of `BAR_DIVISIONS`."""
    layers_m = np.linspace(0, BAR_M[2], BAR_DIVISIONS[2] + 1)
    return np.interp(z_m, layers_m, (layers_m / BAR_M[2]) ** 2)


def bent_bar(
    shape: np.ndarray | None = None,
    *,
    divisions: tuple[int, int, int] = BAR_DIVISIONS,
    density_kg_m3: float = BAR_DENSITY_KG_M3,
    **options,
) -> cs.Body:
    """Return a bar that is bent along x and y, so that it differs from its mirror images; a diagonal
    `shape` (3,) multiplies its coordinates.
    """
    mesh = cs.box_mesh(BAR_M, divisions)
    bend = _bend_at(mesh.points_m[:, 2])
    points_m = mesh.points_m + np.outer(bend, BEND_M)
    points_m[:, :2] -= np.array(BAR_M[:2]) / 2
    points_m = points_m * (np.ones(3) if shape is None else shape)
    cells = (
        mesh.tetrahedra if shape is None or np.prod(shape) > 0 else mesh.tetrahedra[:, [0, 2, 1, 3]]
    )
    return cs.Body(cs.TetMesh(points_m, cells), density_kg_m3=density_kg_m3, **options)


def bar_recording(seed: int, body: cs.Body | None = None) -> cs.Experiment:
    """Return the bent bar, held at its lower face and moved at random, with markers on the same
    nodes whose places are estimated.
    """
    rng = np.random.default_rng(seed)
    body = bent_bar(rest_shape="stress_free") if body is None else body
    t_s = STEP_S * np.arange(SAMPLES)
    high = np.flatnonzero(body.nodes_m[:, 2] > 0.3 * BAR_M[2])
    places_m = body.nodes_m[rng.choice(high, MARKERS, replace=False)]
    markers = cs.Markers(t_s, np.zeros((SAMPLES, MARKERS, 3)), NOISE_M, places_m=places_m)
    held = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    poses = random_poses(t_s, rng)
    return cs.Experiment(body, t_s, [cs.Grasp(held, poses)], markers, name="swing")


def without_places(experiment: cs.Experiment) -> cs.Experiment:
    """Return the experiment with markers at unknown places."""
    return replace(experiment, markers=unplaced(experiment.markers))


def unplaced(markers: cs.Markers) -> cs.Markers:
    """Return the markers at unknown places."""
    return replace(markers, placement=None, located=None, places_m=None)


def bar_without_error(seed: int) -> HiddenError:
    """Return a correct description of the bent bar."""
    actual = bar_recording(seed)
    return HiddenError(actual, without_places(actual))


def mirrored(seed: int) -> HiddenError:
    """Return the bent bar, with the mirror image of its mesh in the description."""
    return scaled(np.array([-1.0, 1.0, 1.0]), seed)


def wide(seed: int) -> HiddenError:
    """Return the bent bar, with a mesh in the description that is too wide along x."""
    return scaled(np.array([1 + WIDE, 1.0, 1.0]), seed)


def scaled(shape: np.ndarray, seed: int) -> HiddenError:
    """Return the bent bar, with its mesh multiplied by factors (3,) in the description."""
    described = bar_recording(seed, bent_bar(shape, rest_shape="stress_free"))
    return HiddenError(bar_recording(seed), without_places(described))


def scanned_while_hanging(seed: int) -> HiddenError:
    """Return the bent bar, whose mesh is the shape that it has under its weight."""
    held = np.flatnonzero(bent_bar().nodes_m[:, 2] < 1e-9)
    scanned = bent_bar(rest_shape=cs.UnderGravity(held, gravity_m_s2=SCAN_GRAVITY_M_S2))
    return HiddenError(bar_recording(seed, scanned), without_places(bar_recording(seed)))


def filtered(seed: int) -> HiddenError:
    """Return the bent bar, whose tracks were low-passed by the software of the cameras."""
    actual = bar_recording(seed)
    sections = butter(2, LOW_PASS_HZ, output="sos", fs=1 / STEP_S)
    return HiddenError(
        actual, without_places(actual), recorded=lambda x: sosfiltfilt(sections, x, axis=0)
    )


def twice(seed: int) -> HiddenError:
    """Return the bent bar, with one track in place of that of another marker."""
    actual = bar_recording(seed)

    def doubled(tracks_m: np.ndarray) -> np.ndarray:
        noise = np.random.default_rng((seed, 2)).normal(
            scale=NOISE_M / 5, size=tracks_m[:, 0].shape
        )
        return np.concatenate([(tracks_m[:, 1] + noise)[:, None], tracks_m[:, 1:]], axis=1)

    return HiddenError(actual, actual, recorded=doubled)


def with_other_law(seed: int) -> HiddenError:
    """Return the bent bar of another material and damping law."""
    body = bent_bar(rest_shape="stress_free", material="st-venant-kirchhoff", damping="material")
    actual = bar_recording(seed, body)
    return HiddenError(actual, without_places(bar_recording(seed)))


def with_fibres(seed: int) -> HiddenError:
    """Return the bent bar with fibres along it; the true E is that across them."""
    law = anisotropic_law([0.0, 0.0, FIBRES])
    body = bent_bar(rest_shape="stress_free", material=law, evaluator="casadi")
    return HiddenError(bar_recording(seed, body), without_places(bar_recording(seed)))


def with_coarse_mesh(seed: int) -> HiddenError:
    """Return the bent bar of quadratic elements, with linear ones on the same mesh in the
    description.
    """
    actual = bar_recording(seed, bent_bar(rest_shape="stress_free", element="tet10"))
    body = bent_bar(rest_shape="stress_free")
    held = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    grasp = cs.Grasp(held, actual.grasps[0].poses)
    markers = unplaced(actual.markers)
    return HiddenError(actual, replace(actual, body=body, grasps=[grasp], markers=markers))


def quadratic_bar(divisions: tuple[int, int, int] = STATED_DIVISIONS, **options) -> cs.Body:
    """Return the bent bar of quadratic elements, by default those of the description."""
    return bent_bar(divisions=divisions, element="tet10", rest_shape="stress_free", **options)


def real_bar(**options) -> cs.Body:
    """Return the bent bar with half as long elements, as it is in truth."""
    return quadratic_bar(REAL_DIVISIONS, **options)


def moved(seed: int, body: cs.Body) -> cs.Experiment:
    """Return the recording of another body, with markers at the places of `bar_recording`."""
    experiment = bar_recording(seed)
    places_m = experiment.markers.predict_positions(experiment.body.nodes_m)
    markers = replace(experiment.markers, placement=None, located=None, places_m=places_m)
    held = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    grasp = cs.Grasp(held, experiment.grasps[0].poses)
    return replace(experiment, body=body, grasps=[grasp], markers=markers)


def quadratic_without_error(seed: int) -> HiddenError:
    """Return a correct description, whose elements are longer than those of the body."""
    stated = without_places(moved(seed, quadratic_bar()))
    return HiddenError(moved(seed, real_bar()), stated, scheme=FINE_STEPS)


def with_three_heavy_markers(seed: int) -> HiddenError:
    """Return a bar of 61.5 g, three of whose eight markers are heavy."""
    actual = moved(seed, real_bar(density_kg_m3=HEAVY_BAR_KG_M3))
    nodes_m = actual.body.nodes_m
    places_m = actual.markers.predict_positions(nodes_m)[:3]
    nodes = [int(np.linalg.norm(nodes_m - place_m, axis=1).argmin()) for place_m in places_m]
    masses = [cs.PointMass([node], HEAVY_KG) for node in nodes]
    described = moved(seed, quadratic_bar(density_kg_m3=HEAVY_BAR_KG_M3))
    return HiddenError(replace(actual, masses=masses), without_places(described), scheme=FINE_STEPS)


def weighed_with_gripper(seed: int) -> HiddenError:
    """Return a bar on a force sensor, whose stated mass contains that of the gripper."""

    def sensed(body: cs.Body) -> cs.Experiment:
        experiment = moved(seed, body)
        (grasp,) = experiment.grasps
        zero = np.zeros((SAMPLES, 6))
        wrench = cs.Wrench(experiment.t_s, zero, WRENCH_N, WRENCH_NM, frame="grasp")
        return replace(experiment, grasps=[replace(grasp, wrench=wrench)])

    stated_kg_m3 = (1 + GRIPPER_SHARE) * BAR_DENSITY_KG_M3
    described = sensed(quadratic_bar(density_kg_m3=stated_kg_m3))
    return HiddenError(sensed(real_bar()), without_places(described), scheme=FINE_STEPS)


def with_other_quaternions(seed: int) -> HiddenError:
    """Return the bar, with poses whose quaternions are in another order."""
    stated = moved(seed, quadratic_bar())
    described = FAULTS["wxyz as xyzw"].change(stated, np.random.default_rng(seed))
    return HiddenError(moved(seed, real_bar()), without_places(described), scheme=FINE_STEPS)


def with_two_clocks(seed: int) -> HiddenError:
    """Return the bar, half of whose markers are seen by cameras that are late."""
    correct = quadratic_without_error(seed)
    t_s = correct.actual.t_s

    def recorded(tracks_m: np.ndarray) -> np.ndarray:
        late_m = CubicSpline(t_s, tracks_m)(np.maximum(t_s - LATE_S, 0.0))
        half = MARKERS // 2
        return np.concatenate([tracks_m[:, :half], late_m[:, half:]], axis=1)

    return replace(correct, recorded=recorded)


def with_soft_skin(seed: int) -> HiddenError:
    """Return the bar with a soft outer layer; the true E is that inside."""
    body = quadratic_bar(SKIN_DIVISIONS)
    middles_m = cs.box_mesh(BAR_M, SKIN_DIVISIONS).points_m[body.mesh.tetrahedra].mean(axis=1)
    outwards = np.abs(middles_m[:, :2] / BAR_M[:2] - 0.5)
    is_inside = (outwards < 0.5 - 1 / SKIN_DIVISIONS[0]).all(axis=1)
    soft = body.with_stiffness_factors(np.where(is_inside, 1.0, SKIN))
    described = without_places(moved(seed, quadratic_bar()))
    return HiddenError(moved(seed, soft), described, scheme=FINE_STEPS)


def creeping(seed: int) -> HiddenError:
    """Return a slowly moved bar with memory; the true E is the long-term modulus."""

    def slow(body: cs.Body) -> cs.Experiment:
        experiment = moved(seed, body)
        (grasp,) = experiment.grasps
        poses = replace(grasp.poses, t_s=SLOWER * grasp.poses.t_s)
        t_s = SLOWER * experiment.t_s
        return replace(
            experiment,
            t_s=t_s,
            grasps=[cs.Grasp(grasp.nodes, poses)],
            markers=replace(experiment.markers, t_s=t_s, located=None),
        )

    actual = slow(real_bar(prony=["prony_1"]))
    described = without_places(slow(quadratic_bar()))
    return HiddenError(actual, described, CREEP, unknown=("young_pa", "poisson"))


ERRORS: dict[str, tuple[str, Callable[[int], HiddenError]]] = {
    "none": ("none", no_error),
    "markers": ("8 markers of 0.5 g on the body of 25 g", with_heavy_markers),
    "stated-markers": ("the same, with `marker_mass_kg` stated", with_stated_markers),
    "memory": ("memory: share 0.3, 0.1 s", with_memory),
    "grasp": ("the gripper holds 1 mm more", held_higher),
    "mesh": ("the mesh lacks 10 mm at the free end", with_lacking_end),
    "bar": ("none, a bent bar of foam", bar_without_error),
    "mirrored": ("the same, mesh mirrored", mirrored),
    "wide": ("the same, mesh 4 % too wide along x", wide),
    "hanging": (
        "the same, mesh scanned under its weight and declared stress-free",
        scanned_while_hanging,
    ),
    "filtered": ("the same, tracks low-passed at 6 Hz", filtered),
    "twice": ("the same, one track in place of another", twice),
    "law": ("the same, another material and damping law", with_other_law),
    "coarse": (
        "the same, linear elements where the body is that of quadratic ones",
        with_coarse_mesh,
    ),
    "fibres": ("the same, fibres along the bar: E along it 30 % larger", with_fibres),
    "gradient": ("stiffness ± 10 % at the ends", with_gradient),
    "quadratic": (
        "none, the bent bar of quadratic elements, half as long ones in truth",
        quadratic_without_error,
    ),
    "heavy": (
        "the same, the bar weighs 61.5 g, three of eight markers 1.5 g each",
        with_three_heavy_markers,
    ),
    "gripper": (
        "the same on a force sensor, weighed with its gripper: 30 % heavier",
        weighed_with_gripper,
    ),
    "quaternions": ("the same, quaternions wxyz as xyzw", with_other_quaternions),
    "clocks": ("the same, half of the markers 16 ms late", with_two_clocks),
    "skin": ("the same, outer layer of 30 % of the stiffness", with_soft_skin),
    "creep": ("the same, moved slowly, memory: share 0.3, 2 s", creeping),
}


def twin(name: str, seed: int, parameters: Mapping[str, cs.Unknown] = UNKNOWN) -> cs.Problem:
    """Simulate a twin with an error, a key of `ERRORS`, and return its wrong problem."""
    error = ERRORS[name][1](seed)
    values = TRUTH | dict(error.more_constants)
    simulated = cs.simulate(error.actual, values, error.scheme[0], substeps=error.scheme[1])
    rng = np.random.default_rng((seed, 1))
    noise_m = rng.normal(scale=NOISE_M, size=simulated.markers_m.shape)
    described = cs.with_markers(error.described, error.recorded(simulated.markers_m + noise_m))
    (grasp,) = described.grasps
    if grasp.wrench is not None:
        noise = rng.normal(size=(SAMPLES, 6)) * np.repeat([WRENCH_N, WRENCH_NM], 3)
        wrench = replace(grasp.wrench, values=simulated.wrenches[0] + noise)
        described = replace(described, grasps=[replace(grasp, wrench=wrench)])
    unknown = {name: parameters[name] for name in error.unknown}
    return cs.Problem(
        [described],
        TRUTH | unknown,
        uncertainty=cs.UncertaintyOptions(assumptions=error.assumptions),
    )
