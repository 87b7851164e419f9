"""Tendons and pressures over time, and on the way from one time to another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems_small import driven_bar, hung_cube

from collocation_sysid.nlp.drives import Drives

# Of a tendon whose tension grows and a pressure that stays: both, and shapes to be driven in.
BAR = driven_bar()
FROM_S, TO_S, SHARE = np.array([0.02, 0.03]), np.array([0.05, 0.07]), 0.25


@pytest.fixture
def xi(rng) -> np.ndarray:
    nodes_m = BAR.body.nodes_m
    return np.stack([(nodes_m + rng.normal(scale=2e-4, size=nodes_m.shape)).ravel() for _ in "ab"])


def tension_n(t_s: np.ndarray) -> np.ndarray:
    return 0.02 + 0.5 * t_s


def test_forces_are_those_of_lengths_and_volumes_times_what_drives_them(xi):
    drives = Drives.of(BAR, FROM_S)
    tendon, pressure = BAR.actuators
    expected = -tension_n(FROM_S)[:, None] * tendon.measure.gradient(xi)
    expected += 20.0 * pressure.measure.gradient(xi)
    np.testing.assert_allclose(drives.force(xi), expected, atol=1e-12)


def test_on_the_way_to_other_times_they_are_those_of_the_times_between(xi):
    here, there = Drives.of(BAR, FROM_S), Drives.of(BAR, TO_S)
    between = here.towards(there, SHARE)
    np.testing.assert_allclose(between.t_s, [0.0275, 0.04])
    expected = Drives.of(BAR, np.array([0.0275, 0.04])).force(xi)
    np.testing.assert_allclose(between.force(xi), expected, atol=1e-14)
    for share, end in ((0.0, here), (1.0, there)):
        np.testing.assert_allclose(here.towards(there, share).force(xi), end.force(xi), atol=1e-14)
    assert np.abs(here.force(xi) - there.force(xi)).max() > 1e-3


def test_a_share_is_one_of_all_forces_and_of_their_slopes(xi):
    whole = Drives.of(BAR, FROM_S)
    part = replace(whole, share=0.25)
    np.testing.assert_allclose(part.force(xi), 0.25 * whole.force(xi), atol=1e-14)
    for ours, theirs in zip(linearised(part, xi), linearised(whole, xi), strict=True):
        np.testing.assert_allclose(ours, 0.25 * theirs, atol=1e-10)


def test_some_of_the_times_are_told_by_their_rows(xi):
    last = Drives.of(BAR, FROM_S).rows(slice(1, 2))
    np.testing.assert_allclose(last.t_s, FROM_S[1:])
    np.testing.assert_array_equal(last.force(xi[1:]), Drives.of(BAR, FROM_S).force(xi)[1:])


def test_factors_and_losses_are_those_of_each(xi):
    tendon, pressure = BAR.actuators
    drives = Drives.of(BAR, FROM_S).off_by(np.array([[1.2, 0.003], [0.9, 2.0]]))
    expected = -tendon.off_by(1.2, 0.003).amplitude(FROM_S)[:, None] * tendon.measure.gradient(xi)
    lost = pressure.off_by(0.9, 2.0).amplitude(FROM_S)[:, None]
    expected -= lost * pressure.measure.gradient(xi)
    np.testing.assert_allclose(drives.force(xi), expected, atol=1e-12)


def test_without_any_nothing_is_added():
    cube = hung_cube()
    none = Drives.none(cube.body)
    assert none.force(cube.body.nodes_m.ravel()[None]) == 0.0
    at = cube.body.linearise(*still(cube.body, 1))
    assert none.added_to(at, cube.body.nodes_m.ravel()[None]) is at
    x, v, theta = still(cube.body, 1)
    bent = cube.body.curvature(x, v, x, theta)
    assert none.bent(bent, x, x) is bent


def still(body, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The undeformed body at rest, of no stiffness and damping to speak of."""
    x = np.tile(body.nodes_m.ravel(), (rows, 1))
    return x, np.zeros_like(x), np.array([1e-9, 1e-9, 0.0, 0.0])


def linearised(drives: Drives, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What is added to the body's forces, to their slopes by position, and those by θ."""
    x, v, theta = still(BAR.body, len(xi))
    own = BAR.body.linearise(x, v, theta)
    before = own.force.copy(), drives.joined.spread(own.by_position), own.by_theta.shape[2]
    found = drives.added_to(own, xi)
    return (
        found.force - before[0],
        found.by_position - before[1],
        found.by_theta[:, :, before[2] :],
    )


def test_slopes_are_those_of_the_forces(xi):
    drives = Drives.of(BAR, FROM_S)
    force, by_position, by_theta = linearised(drives, xi)
    np.testing.assert_allclose(force, drives.force(xi), atol=1e-12)
    way = np.random.default_rng(2).normal(size=xi.shape)
    step = 1e-6
    expected = (drives.force(xi + step * way) - drives.force(xi - step * way)) / (2 * step)
    found = drives.joined.pattern.products(by_position, way)
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())
    given = np.array([[1.0, 0.0], [1.0, 0.0]])
    for k in range(4):
        off = np.zeros(4)
        off[k] = 1e-4
        ends = (drives.off_by(given + s * off.reshape(2, 2)).force(xi) for s in (1, -1))
        slope = np.subtract(*ends) / 2e-4
        np.testing.assert_allclose(by_theta[:, :, k], slope, atol=1e-7 * np.abs(slope).max())


def test_second_derivatives_are_those_of_the_slopes(xi):
    drives, step = Drives.of(BAR, FROM_S), 1e-6
    w, way = np.random.default_rng(3).normal(size=(2, *xi.shape))
    x, v, theta = still(BAR.body, len(xi))
    own = BAR.body.curvature(x, v, w, theta)
    found = drives.bent(own, xi, w)
    before, constants = drives.joined.spread(own.position_position), own.position_theta.shape[2]
    ends = [linearised(drives, xi + sign * step * way) for sign in (1, -1)]

    ahead, behind = (drives.joined.pattern.products(each[1], w) for each in ends)
    expected = (ahead - behind) / (2 * step)
    turned = drives.joined.pattern.products(found.position_position - before, way)
    np.testing.assert_allclose(turned, expected, atol=1e-5 * np.abs(expected).max())

    ahead, behind = (np.einsum("ti,tik->tk", w, each[2]) for each in ends)
    expected = (ahead - behind) / (2 * step)
    along = np.einsum("ti,tik->tk", way, found.position_theta[:, :, constants:])
    np.testing.assert_allclose(along, expected, atol=1e-5 * np.abs(expected).max())
