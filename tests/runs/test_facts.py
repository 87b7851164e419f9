"""Facts of recordings, which are stated before any search or simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from kit.filmed import NAMES, PLACES_M, bar, filming
from kit.problems import TRUTH, vertex_markers

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.recording import Experiment, Grasp, PoseSequence, Wrench
from collocation_sysid.runs.check import check_problem
from collocation_sysid.runs.facts import facts, gaps, loose_parts, motion_at_rest, sentences
from collocation_sysid.statistics.assessment import Assessment
from collocation_sysid.statistics.concerns import Concern

T_S = 0.01 * np.arange(121)
# The hand stands still for 0.4 s.
HAND_M = 0.05 * np.sin(4 * np.clip(T_S - 0.4, 0, None))
SIGMA_M = 5e-4


def columns(shift_m: float, count: int) -> Body:
    """Cubes above each other, at a distance."""
    cube = box_mesh((0.05, 0.05, 0.05), (1, 1, 1))
    n = len(cube.points_m)
    points_m = [cube.points_m - [0, 0, (0.05 + shift_m) * k] for k in range(count)]
    cells = [cube.tetrahedra + n * k for k in range(count)]
    return Body(TetMesh(np.vstack(points_m), np.vstack(cells)), density_kg_m3=30.0)


def held(body: Body, moved_m: np.ndarray = HAND_M, **changes: Any) -> Experiment:
    """A body whose upper end is moved along x, with the tracks of two lower corners as if it were
    rigid.
    """
    shifts_m = np.outer(moved_m, [1.0, 0, 0])
    poses = PoseSequence(T_S, shifts_m, quaternions_xyzw=np.tile([0, 0, 0, 1.0], (len(T_S), 1)))
    top = np.flatnonzero(body.nodes_m[:, 2] > body.nodes_m[:, 2].max() - 1e-9)
    low = np.argsort(body.nodes_m[:, 2])[:2]
    markers = vertex_markers(body, low, T_S)
    tracks_m = body.nodes_m[low] + shifts_m[:, None]
    markers = replace(markers, positions_m=tracks_m, sigma_m=SIGMA_M)
    return Experiment(body, T_S, [Grasp(top, poses)], markers, name="hung", **changes)


def with_motion(experiment: Experiment, moved_m: np.ndarray) -> Experiment:
    """The second marker also moves along y."""
    tracks_m = experiment.markers.positions_m.copy()
    tracks_m[:, 1, 1] += moved_m
    return replace(experiment, markers=replace(experiment.markers, positions_m=tracks_m))


def problem_of(experiment: Experiment) -> cs.Problem:
    return cs.Problem([experiment], {**TRUTH, "mu_pa": cs.Unknown()})


# Parts of the mesh --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shift_m", "count", "loose", "twins"), [(0.0, 2, 1, 4), (0.0, 3, 2, 8), (0.01, 2, 1, 0)]
)
def test_a_part_that_no_grasp_holds_is_refused_before_a_search(shift_m, count, loose, twins):
    problem = problem_of(held(columns(shift_m, count)))
    for command in (check_problem, cs.solve, cs.run):
        with pytest.raises(InputError, match=f"{count} unconnected parts") as refused:
            command(problem)
        assert f"no grasp of 'hung' holds {loose} of these parts" in str(refused.value)
        assert (f"{twins} of {8 * count} nodes coincide" in str(refused.value)) is bool(twins)
        assert "smaller elements" not in str(refused.value)


def test_parts_that_are_held_or_belong_to_a_free_body_are_accepted():
    both = columns(0.01, 2)
    one = held(columns(0.0, 1))
    assert [*loose_parts(one)] == []
    experiment = held(both, start="undeformed")
    lowest = np.flatnonzero(both.nodes_m[:, 2] < both.nodes_m[:, 2].min() + 1e-9)
    grasps = [*experiment.grasps, Grasp(lowest, PoseSequence.fixed())]
    assert [*loose_parts(replace(experiment, grasps=grasps))] == []
    assert [*loose_parts(replace(experiment, grasps=[]))] == []


# Motion before the hand moves ---------------------------------------------------------------------


@pytest.mark.parametrize(("amplitude_m", "period_s"), [(4e-3, 0.6), (3e-3, 0.25), (0.02, 1.5)])
def test_a_marker_that_moves_while_the_poses_stand_still_is_named(rng, amplitude_m, period_s):
    swinging = amplitude_m * np.sin(2 * np.pi * T_S / period_s)
    noise_m = SIGMA_M * rng.normal(size=len(T_S))
    experiment = with_motion(held(columns(0.0, 1)), swinging + noise_m)
    (concern,) = facts(problem_of(experiment))
    assert concern.code == "description/not-at-rest"
    moved_mm = 1e3 * np.ptp(swinging[:41])
    assert float(concern.data["by"].removesuffix(" mm")) == pytest.approx(moved_mm, rel=0.25)
    assert concern.data["sigmas"] == pytest.approx(moved_mm / 0.5, rel=0.25)
    assert concern.data["still_s"] == pytest.approx(0.4, abs=0.02)
    assert experiment.markers.names[1] in concern.message
    assert "window_s" in concern.message


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_noise_is_no_motion(rng, factor):
    noise_m = factor * SIGMA_M * rng.normal(size=len(T_S))
    assert facts(problem_of(with_motion(held(columns(0.0, 1)), noise_m))) == []


@pytest.mark.parametrize("begins_s", [0.4, 0.25])
def test_motion_after_the_hand_or_by_a_clock_is_no_motion_at_rest(begins_s):
    later = 0.05 * np.sin(9 * np.clip(T_S - begins_s, 0, None))
    assert facts(problem_of(with_motion(held(columns(0.0, 1)), later))) == []


def test_a_hand_that_moves_at_once_or_a_body_that_is_not_at_rest_may_move():
    swinging = 0.02 * np.sin(9 * T_S)
    at_once = held(columns(0.0, 1), 0.05 * np.sin(4 * T_S))
    assert [*motion_at_rest(with_motion(at_once, swinging))] == []
    released = held(columns(0.0, 1), start="undeformed")
    assert [*motion_at_rest(with_motion(released, swinging))] == []
    assert [*motion_at_rest(with_motion(held(columns(0.0, 1)), swinging))]


def test_a_point_in_images_that_moves_while_the_poses_stand_still_is_named(rng):
    t_s = 0.01 * np.arange(81)
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    poses[50:, 1, 3] = 0.02
    grasp = Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), poses)
    pixels = 400 + 0.5 * rng.normal(size=(len(t_s), len(NAMES), 2))
    places_m = list(PLACES_M.values())

    def filmed(pixels: np.ndarray) -> Experiment:
        tracks = cs.ImageTracks("front", filming("front"), t_s, pixels, NAMES, places_m, 0.5)
        return Experiment(bar(), t_s, [grasp], name="swing", readings=[tracks])

    assert [*motion_at_rest(filmed(pixels))] == []
    pixels[:, 1, 0] += 5 * np.sin(12 * t_s)
    (concern,) = motion_at_rest(filmed(pixels))
    assert f"point {NAMES[1]} of 'swing' moves by" in concern.message
    assert "times sigma_px" in concern.message


def test_motion_at_rest_is_the_first_reason_with_the_gravest_grade():
    (found,) = motion_at_rest(with_motion(held(columns(0.0, 1)), 0.01 * np.sin(9 * T_S)))
    graver = Concern("solve/no-error-bars", "doubtful")
    first, second = Assessment.from_concerns([graver, found]).concerns
    assert (first.code, first.grade, second) == (found.code, "doubtful", graver)


# Gaps ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [[30, 31, 70], [50], [10, 20, *range(60, 75)]])
def test_samples_that_were_dropped_are_noted(lost):
    experiment = held(columns(0.0, 1))
    t_s = np.delete(T_S, lost)
    wrench = Wrench(t_s, np.zeros((len(t_s), 6)), 0.1, 0.01)
    kept = replace(experiment, grasps=[replace(experiment.grasps[0], wrench=wrench)])
    assert [*gaps(experiment)] == []
    (note,) = sentences(facts(problem_of(kept)))
    assert f"{len(lost)} samples of the wrench are missing" in note
    assert note.endswith(f"lasts {np.diff(t_s).max():.3g} s")
    (moved,) = kept.grasps
    sparse = replace(moved.poses, t_s=t_s, positions_m=np.delete(moved.poses.positions_m, lost, 0),
        quaternions_xyzw=np.delete(moved.poses.quaternions_xyzw, lost, 0))  # fmt: skip
    (note, _) = gaps(replace(kept, grasps=[replace(moved, poses=sparse)]))
    assert "of the poses of grasp 1" in note


def test_waypoints_are_no_gaps(rng):
    experiment = held(columns(0.0, 1))
    t_s = np.unique(np.concatenate([[0.0, 1.2], rng.uniform(0, 1.2, 40)]))
    wrench = Wrench(t_s, np.zeros((len(t_s), 6)), 0.1, 0.01)
    kept = replace(experiment, grasps=[replace(experiment.grasps[0], wrench=wrench)])
    assert [*gaps(kept)] == []


def relaxation(load_late_s: float = 0.0, slack: float = 0.0) -> cs.Problem:
    """A strip with memory whose load is recorded late, or that is loose at first."""
    t_s = np.linspace(0, 5, 101)
    strain = 0.1 * np.minimum(t_s / 0.5, 1)
    there_s = np.clip(t_s - load_late_s, 0, None)
    pulled = np.maximum(0.1 * np.minimum(there_s / 0.5, 1) - slack, 0)
    stress_pa = 2e5 * pulled * (1 + 0.5 * np.exp(-there_s))
    noise_pa = 20 * np.random.default_rng(1).normal(size=len(t_s))
    specimen = cs.Specimen("uniaxial", strain, stress_pa + noise_pa, 20.0, t_s=t_s)
    unknown = {"young_pa": cs.Unknown(), "poisson": 0.45, "a.share": 0.3, "a.tau_s": 1.0}
    return cs.Problem([specimen.experiment(name="relax", prony=("a",))], unknown)


@pytest.mark.parametrize("late_s", [0.1, 0.2, 0.4])
def test_a_load_that_rises_while_the_strain_is_held_is_refused(late_s):
    with pytest.raises(InputError, match=f"while the strain is held, for {late_s:.3g} s"):
        facts(relaxation(late_s))


def test_a_load_in_time_and_a_loose_strip_are_not_refused():
    assert not facts(relaxation())
    assert not facts(relaxation(slack=0.03))
