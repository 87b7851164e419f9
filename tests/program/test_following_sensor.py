"""Sensors of other packages whose nodes on the body follow the estimates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.lasers import LaserDistance, lit_cube
from kit.problems import TRUTH

import collocation_sysid as cs
from collocation_sysid.program.following_sensor import FollowingSensorResidual


@pytest.fixture(scope="module")
def motion() -> cs.Trajectory:
    return cs.simulate(lit_cube(), TRUTH, "midpoint", substeps=1)


def test_a_beam_ends_at_the_face_that_it_hits(motion: cs.Trajectory):
    cube = motion.experiment
    faces = cube.body.mesh.surface
    at_samples = [sensor.with_samples(cube.t_s, None) for sensor in cube.readings]
    found = cs.simulate(replace(cube, readings=at_samples), TRUTH, "midpoint", substeps=1)
    pairs = zip(found.custom_sensor_values, motion.custom_sensor_values, strict=True)
    for laser, (length_m, between_m) in zip(at_samples, pairs, strict=True):
        assert isinstance(laser, LaserDistance)
        exact_m = [laser.hit(nodes_m[faces])[1] for nodes_m in found.positions_m]
        np.testing.assert_allclose(length_m[:, 0], exact_m, rtol=1e-12)
        assert np.isnan(between_m[-1]).all()
        interpolated_m = np.interp(cube.t_s[:-1] + 0.3 * cube.timestep_s, cube.t_s, exact_m)
        tolerance_m = 0.05 * np.ptp(exact_m)
        np.testing.assert_allclose(between_m[:-1, 0], interpolated_m, atol=tolerance_m)


@pytest.mark.long
def test_the_nodes_follow_the_estimates(motion: cs.Trajectory):
    cube = motion.experiment
    lengths_m = [np.nan_to_num(each, nan=0.4) for each in motion.custom_sensor_values]
    measured = cs.with_readings(cube, lengths_m)
    guess = dict(TRUTH) | {"mu_pa": cs.Unknown(1.5 * TRUTH["mu_pa"])}
    problem = cs.Problem([measured], guess, scheme="midpoint", substeps=1)
    solution = cs.solve(problem, "reduced-space")
    assert solution.parameters["mu_pa"] == pytest.approx(TRUTH["mu_pa"], rel=1e-3)
    (part,) = solution.parts
    residuals = part.transcription.residuals_of(FollowingSensorResidual)
    assert any(len(np.unique(each.point_indices[:-1], axis=0)) > 1 for each in residuals)
    for residual in residuals:
        assert residual.reassociated(part.x, part.phi) is residual.correspondences
