"""A moving body that only a depth camera observes, from `check` to the run folder."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.depth import MATRIX, NOISE_M, POSE, SHAPE, TRUTH, bar, camera_residuals, moved
from kit.problems import smooth_poses, times
from scipy.interpolate import CubicSpline

import collocation_sysid as cs
from collocation_sysid.extras.studies.model_choice import reserve_test_data
from collocation_sysid.methods.starts.stiffness_scan import scan_stiffness
from collocation_sysid.program.depth.visible_surface import VisibleSurface
from collocation_sysid.recording.measurement_selection import first_samples
from collocation_sysid.result.run_record import replays
from collocation_sysid.runs.check import check_problem

MADE = {**TRUTH, "young_pa": 3e5, "gamma_r_s": 5e-3}
SAMPLES, SEEN = 15, [2, 5, 8, 11, 14]


def swung(depth: cs.Depth) -> cs.Experiment:
    t_s = times(SAMPLES)
    held = cs.Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), smooth_poses(t_s))
    kept = cs.Nuisance.none(depth_bias_m=0.005)
    return cs.Experiment(bar(), t_s, [held], name="swing", depths=[depth], nuisance=kept)


@cache
def problem() -> cs.Problem:
    camera, at_s = cs.DepthCamera(MATRIX, pose=POSE), times(SAMPLES)[SEEN]
    blind = cs.Depth("none", at_s, [np.zeros((1, 3))] * len(at_s), 1e-3)
    x, skin = (cs.simulate(swung(blind), MADE).positions_m, VisibleSurface.from_body(bar(), blind))
    images_m = [
        cs.depth_image(
            camera,
            SHAPE,
            (skin.subdivided_triangles(x[k][skin.nodes], 2) - POSE[:3, 3]) @ POSE[:3, :3],
        )
        for k in SEEN
    ]
    noise = NOISE_M * np.random.default_rng(0).normal(size=np.shape(images_m))
    seen = images_m + noise
    depth = cs.Depth.of_images("front", seen, camera, NOISE_M, at_s, spacing_m=0.008)
    unknown = {**MADE, "young_pa": cs.Unknown(2.9e5)}
    simulated = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
    return cs.Problem([swung(depth)], unknown, substeps=1, uncertainty=simulated)


@pytest.fixture(scope="module")
def run() -> cs.Run:
    return cs.run(problem(), seek_causes=False)


@pytest.mark.long
def test_the_interval_contains_the_truth_with_a_step_error(run):
    low, high = run.interval("young_pa")
    assert low < MADE["young_pa"] < high
    # Steps of a whole sample make it stiffer, and the run says by how much.
    found = run.optimum["young_pa"].value, run.estimates["young_pa"].value
    off = [each / MADE["young_pa"] - 1 for each in found]
    assert off[0] > 0.003
    assert abs(off[1]) < 0.5 * off[0]


def test_all_images_are_kept_for_pictures_and_four_with_outlines(run):
    (replay,) = replays(run)
    rows = replay.visible_points["front"]
    points = rows[np.isfinite(rows[:, 4])]
    np.testing.assert_array_equal(np.unique(points[:, 0]), replay.t_s[SEEN])
    assert len(np.unique(rows[np.isnan(rows[:, 3]), 0])) == 4
    assert [len(replay.camera_points_m(t)) > 0 for t in range(SAMPLES)] == [
        t in SEEN for t in range(SAMPLES)
    ]


@pytest.mark.long
def test_a_check_looks_at_the_first_images():
    findings = check_problem(problem())
    assert not findings.derivative_fault
    assert not findings.causes


def test_first_samples_have_the_images_of_their_time():
    (whole,) = problem().experiments
    for count, samples, images in ((3, 9, 3), (12, 12, 4), (15, 15, 5)):
        part = first_samples(whole, count)
        assert (len(part.t_s), len(part.depths[0].sample_times_s)) == (samples, images)


def test_images_that_are_held_out_are_not_fitted():
    known, start_s = reserve_test_data(problem(), "swing")
    (whole,), (left,) = problem().experiments, known.experiments
    np.testing.assert_array_equal(left.depths[0].sample_times_s, times(SAMPLES)[[2, 5, 8]])
    assert left.depths[0].sample_times_s[-1] <= start_s < whole.depths[0].sample_times_s[3]


@pytest.mark.parametrize("late_s", [0.02, -0.02])
def test_a_delay_does_not_extrapolate_between_fine_time_steps(late_s):
    (experiment,) = problem().experiments
    depth = experiment.depths[0].until_time(experiment.t_s[-1] + late_s)
    early = replace(depth, t_s=depth.t_s - late_s)
    experiment = replace(
        experiment, depths=[early], nuisance=cs.Nuisance.none(depth_time_s=abs(late_s))
    )
    described = replace(problem(), experiments=[experiment], substeps=8)
    program = described.collocation()
    fine_s = np.linspace(0.0, experiment.t_s[-1], 8 * (len(experiment.t_s) - 1) + 1)
    nodes_m = CubicSpline(experiment.t_s, cs.simulate(experiment, MADE).positions_m)(fine_s)
    nodes_m += 1e-6 * np.random.default_rng(4).normal(size=nodes_m.shape)
    p = program.guess_p
    place = program.parameter_names.index("swing: time shift of front [s]")
    for share in (1.0, 1.0, 2.0):
        p[place] = share * np.sign(late_s)
        program, p = program.follow_estimates(p, [nodes_m])
        part = program.transcriptions[0]
        (residual,) = camera_residuals(part)
        phi = p[part.nuisance_indices.indices]
        values = residual.observable.evaluate_positions(nodes_m, phi)
        off_m = residual.signed_distances_m(values, phi)
        shown_s = early.t_s + p[place] * abs(late_s)
        within = (shown_s >= 0.0) & (shown_s <= experiment.t_s[-1])
        assert np.isfinite(off_m).any(axis=1)[within].all()
        assert np.isnan(off_m[~within]).all()
        if share == 1.0:
            assert np.sqrt(np.nanmean(off_m**2)) < 2 * NOISE_M


def test_a_scan_sees_the_motion_in_depth_images_of_a_late_camera():
    late_s, pose = 0.02, moved(np.array([0.0, 0.0, 0.02]), np.array([0.003, 0.002, 0.0]))
    camera, at_s = cs.DepthCamera(MATRIX, pose=POSE), times(SAMPLES)[[0, 2, 4, 6, 8, 10, 12]]
    still = {"gravity_m_s2": (0.0, 0.0, 0.0)}
    blind = cs.Depth("none", at_s, [np.zeros((1, 3))] * len(at_s), 1e-3)
    made = replace(swung(blind), **still)
    skin = VisibleSurface.from_body(bar(), blind)
    x = CubicSpline(made.t_s, cs.simulate(made, MADE).positions_m)(at_s + late_s)
    seen = [skin.subdivided_triangles(each[skin.nodes], 2) for each in x]
    images_m = [cs.depth_image(camera, SHAPE, (e - POSE[:3, 3]) @ POSE[:3, :3]) for e in seen]
    images_m += NOISE_M * np.random.default_rng(0).normal(size=np.shape(images_m))
    stated = cs.DepthCamera(MATRIX, pose=pose)
    depth = cs.Depth.of_images("front", images_m, stated, NOISE_M, at_s, spacing_m=0.008)
    nuisance = cs.Nuisance.none(depth_turn_rad=0.02, depth_shift_m=0.005, depth_time_s=late_s)
    experiment = replace(swung(depth), **still, nuisance=nuisance)
    unknown = {**MADE, "young_pa": cs.Unknown()}
    scan = scan_stiffness(cs.Problem([experiment], unknown).collocation())
    assert 0.5 < scan.young_pa[scan.best] / MADE["young_pa"] < 2
