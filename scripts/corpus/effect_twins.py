"""Twins of a bar in which every effect of the budget is drawn at once.

The bars, motions and constants are those of `bar_twins`. All default assumptions and all default
nuisance parameters of a recording with markers are wrong by random numbers with their default
standard deviations; only the damping law is the stated one, because γ_r and γ_m are constants of
this law. The data are simulated with three tet10 elements across the thickness and with shorter time
steps than the fit has, and extrapolated to infinitely small ones, so that the fit has errors of mesh
and time steps too. Places of the markers are stated, and there are no guesses.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from assumed_twins import SCHEME, with_wrong_assumptions
from bar_twins import CONSTANTS, LENGTH_M, SAMPLE_S, Twin, draw, hand, mesh_of, section_m
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.errors import SimulationError
from collocation_sysid.recording.nuisance import (
    CALIBRATION_DISTORTION,
    CALIBRATION_SCALE,
    CLOCK_RATE,
)
from collocation_sysid.statistics.budget.systematic_effects import ASSUMPTIONS

Array = NDArray[np.float64]
Divisions = tuple[int, int, int]
SAMPLES = 60
# The true motion goes on after the last sample, because of clocks that are late.
SAMPLES_AFTER = 4
POSE_STEP_S = SAMPLE_S / 2
# Time steps per sample of the simulation with all effects; its error is extrapolated with twice as
# many.
SUBSTEPS = 2
# Boxes of the simulations whose difference is extrapolated to infinitely small elements.
COARSE: Divisions = (2, 2, 6)
FINE: Divisions = (3, 3, 9)
AIR = ("air_drag", "added_mass", "buoyancy")
DRAWN = (
    *("body_scale", "mass", "density_gradient", "stiffness_gradient", "anisotropy"),
    *("stiffness_drift", "time_scale", *AIR, "surface", "grip_layer_m", "grasp_edge_m"),
)


def constants(twin: Twin) -> dict[str, float]:
    """Return the true E, ν, γ_r and γ_m."""
    return {name: twin.truth[name] for name in CONSTANTS}


def problem(seed: int, divisions: Divisions) -> cs.Problem:
    """Return the problem of a recording with errors that are drawn; so many boxes are those of its
    mesh.
    """
    twin, rng = draw(seed, exact=True), np.random.default_rng((seed, 1))
    stated = recording(twin, divisions, samples=SAMPLES, step_s=SAMPLE_S)
    tracks_m: Array | None = None
    while tracks_m is None:
        # Some soft bodies with many errors collapse, and nobody would record them.
        with suppress(SimulationError):
            tracks_m = recorded_m(twin, divisions, stated, rng)
    noisy_m = tracks_m + twin.noise_m * rng.standard_normal(tracks_m.shape)
    places_m = stated.markers.predict_positions(stated.body.nodes_m)
    off_m = _size(stated.nuisance.marker_offset_m) * rng.standard_normal(places_m.shape)
    described = at_places(cs.with_markers(stated, noisy_m), places_m + off_m)
    return cs.Problem([described], {name: cs.Unknown() for name in CONSTANTS})


def recording(
    twin: Twin,
    divisions: Divisions,
    samples: int = SAMPLES + SAMPLES_AFTER,
    step_s: float = SAMPLE_S,
) -> cs.Experiment:
    """Return the recording without errors, whose markers are not measured yet."""
    body = cs.Body(
        mesh_of(twin, divisions),
        density_kg_m3=twin.truth["density_kg_m3"],
        element="tet10",
        rest_shape="stress_free",
    )
    unit = np.array(twin.marker_places)
    places_m = np.column_stack(
        [unit[:, :2] / 2 * section_m(twin, unit[:, 2]), LENGTH_M * unit[:, 2]]
    )
    t_s = step_s * np.arange(samples)
    end_s = SAMPLE_S * (SAMPLES + SAMPLES_AFTER)
    pose_s = POSE_STEP_S * np.arange(round(end_s / POSE_STEP_S) + 1)
    rotations, positions_m = hand(twin, pose_s)
    poses = cs.PoseSequence(pose_s, positions_m, rotations.as_quat())
    grasp = cs.Grasp(np.flatnonzero(body.nodes_m[:, 2] < 1e-9), poses)
    tracks_m = np.zeros((samples, len(places_m), 3))
    markers = cs.Markers(t_s, tracks_m, twin.noise_m, places_m=places_m)
    return cs.Experiment(body, t_s, [grasp], markers, name="swing")


def recorded_m(
    twin: Twin, divisions: Divisions, stated: cs.Experiment, rng: np.random.Generator
) -> Array:
    """Return the tracks (T, M, 3) [m] that cameras with errors record of a body with errors."""
    fine = _sampled(twin, FINE, SUBSTEPS)
    nuisance = stated.nuisance
    hand_eye = _size(nuisance.hand_eye_m), _size(nuisance.hand_eye_rad)
    held = displaced(tilted_gravity(fine, rng), *hand_eye, rng)
    moved = with_wrong_assumptions(held, constants(twin), drawn_errors(DRAWN, stated.body, rng))
    # The errors of elements and time steps decrease with the square of their lengths.
    coarse_m = exact_tracks_m(twin, _sampled(twin, COARSE, SUBSTEPS))
    more_steps_m = exact_tracks_m(twin, _sampled(twin, COARSE, 2 * SUBSTEPS))[::2]
    of_steps_m = (more_steps_m - coarse_m) * 4 / 3
    of_mesh_m = (exact_tracks_m(twin, fine) - coarse_m) / ((FINE[0] / COARSE[0]) ** 2 - 1)
    true_m = moved.markers.positions_m + of_steps_m + of_mesh_m
    rate = 1 - _size(CLOCK_RATE.considered) * rng.standard_normal()
    late_s = _size(nuisance.time_shift_s) * rng.standard_normal()
    seen_s = np.clip(rate * stated.t_s - late_s, 0.0, fine.t_s[-1])
    seen_m = CubicSpline(fine.t_s, true_m)(seen_s)
    pivot_m = seen_m[0].mean(axis=0)
    away_m = seen_m - pivot_m
    scale = 1 + _size(CALIBRATION_SCALE.considered) * rng.standard_normal()
    distortion_1_m2 = _size(CALIBRATION_DISTORTION.considered) * rng.standard_normal()
    squares_m2 = np.sum(away_m**2, axis=-1, keepdims=True)
    return pivot_m + away_m * (scale + distortion_1_m2 * squares_m2)


def _sampled(twin: Twin, divisions: Divisions, substeps: int) -> cs.Experiment:
    """Return the longer recording with a sample for each time step."""
    samples = (SAMPLES + SAMPLES_AFTER - 1) * substeps + 1
    return recording(twin, divisions, samples=samples, step_s=SAMPLE_S / substeps)


def exact_tracks_m(twin: Twin, experiment: cs.Experiment) -> Array:
    """Return the tracks (T, M, 3) [m] without errors of the description."""
    return cs.simulate(experiment, constants(twin), SCHEME, substeps=1).markers_m


def drawn_errors(names: Sequence[str], body: cs.Body, rng: np.random.Generator) -> dict[str, float]:
    """Draw errors of the named assumptions, for `with_wrong_assumptions`."""
    errors = {}
    for row in (row for row in ASSUMPTIONS if row.name in names):
        for name in row.components:
            error = _size(row.usual_considered(body.made, body.mesh_from)) * rng.standard_normal()
            # Coefficients of the air are not negative.
            errors[name] = max(error, -0.99) if row.name in AIR else error
    return errors


def tilted_gravity(experiment: cs.Experiment, rng: np.random.Generator) -> cs.Experiment:
    """Return the experiment with gravity tilted by random angles of about 1° about x and y."""
    down = np.array([*np.radians(rng.standard_normal(2)), -1.0])
    gravity_m_s2 = 9.81 * down / np.linalg.norm(down)
    return replace(experiment, gravity_m_s2=tuple(gravity_m_s2.tolist()))


def displaced(
    experiment: cs.Experiment, size_m: float, size_rad: float, rng: np.random.Generator
) -> cs.Experiment:
    """Return the experiment with the body displaced in the gripper by random errors per axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(size_rad * rng.standard_normal(3)).as_matrix()
    matrix[:3, 3] = size_m * rng.standard_normal(3)
    (grasp,) = experiment.grasps
    return replace(experiment, grasps=(cs.Grasp(grasp.nodes, grasp.poses.after(matrix)),))


def at_places(experiment: cs.Experiment, places_m: Array) -> cs.Experiment:
    """Return the experiment with markers at other positions (M, 3) on the body [m]."""
    markers = replace(
        experiment.markers, placement=None, located=None, places_m=places_m, attach="embedded"
    )
    return replace(experiment, markers=markers)


def _size(deviation: float | None) -> float:
    return deviation or 0.0
