"""Errors of ordinary cameras: estimated, or effects of the budget."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from kit.filmed import (
    DISTORTION,
    EXACT,
    MATRIX,
    NAMES,
    NOISE_PX,
    T_S,
    filming,
    motion_m,
    projected,
    swung,
    tracks_of,
    unknown_young,
)
from scipy.interpolate import CubicSpline

import collocation_sysid as cs
from collocation_sysid.judge.posterior import Effects, Posterior
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Solution
from collocation_sysid.statistics.budget.consider_analysis import (
    changes_of_assumptions,
    changes_of_nuisances,
)
from collocation_sysid.statistics.budget.discretisation_error import estimate_changes
from collocation_sysid.statistics.budget.effect_estimates import effect_concerns
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import AUTO

SINCE_S = T_S - T_S[0]


def seen_at(times_s: np.ndarray) -> np.ndarray:
    """Pixels of the true motion at other times, the same for all points or of each point."""
    pixels = CubicSpline(T_S, projected(filming("front"), motion_m()))
    if times_s.ndim == 1:
        return pixels(times_s)
    return np.stack([pixels(times_s[:, k])[:, k] for k in range(len(NAMES))], axis=1)


def drifting(size: float) -> np.ndarray:
    """Pixels of which one track drifts: the first term of the series of a random walk."""
    pixels = seen_at(T_S)
    angle = np.pi / 2
    duration_s = SINCE_S[-1]
    walk = np.sqrt(2 * duration_s) / angle * np.sin(angle * SINCE_S / duration_s)
    pixels[:, NAMES.index("middle_front"), 1] += size * walk
    return pixels


def zoomed(size: float) -> np.ndarray:
    matrix = np.array(MATRIX)
    matrix[:2, :2] *= 1 + size
    camera = cs.Camera(matrix, DISTORTION, filming("front").pose)
    return projected(camera, motion_m())


# What a camera sees that is off by a size; this size, and the name of the value.
SEEN: dict[str, tuple[Callable[[float], np.ndarray], float, str]] = {
    "image_focal": (zoomed, 4e-3, "image_focal"),
    "image_centre_px": (
        lambda size: seen_at(T_S) + np.array([size, 0.0]),
        1.5,
        "error of the principal point, u, of front",
    ),
    "image_time_s": (lambda size: seen_at(T_S + size), 3e-3, "image_time_s"),
    "image_clock_rate": (lambda size: seen_at(T_S + size * SINCE_S), 5e-3, "image_clock_rate"),
    "image_line_delay_s": (
        lambda size: seen_at(T_S[:, None] + size * seen_at(T_S)[..., 1]),
        1e-5,
        "image_line_delay_s",
    ),
    "image_drift_px": (drifting, 1.0, "drift of middle_front in front, v1"),
}


def problem(pixels: np.ndarray, seed: int | None = None, **sigmas: Any) -> cs.Problem:
    """The recording of a camera that is described as exact, except for what is estimated."""
    if seed is not None:
        pixels = pixels + NOISE_PX * np.random.default_rng(seed).normal(size=pixels.shape)
    tracks = replace(tracks_of(**EXACT), pixels=pixels)
    experiment = swung([tracks], nuisance=cs.Nuisance.none(**sigmas))
    return cs.Problem([experiment], unknown_young(1.4e5), huber=1e9)


def solved(described: cs.Problem) -> Solution:
    return cs.solve(described, ReducedSpace(tolerance=1e-9))


@cache
def faultless() -> Solution:
    return solved(problem(seen_at(T_S)))


def effects_of(described: cs.Problem) -> Posterior:
    """The posterior with the errors of cameras alone, which the data determine."""
    solution = solved(described)
    collocation, z = solution.collocation, solution.z
    usual = Assumptions().collect_deviations()
    of_images = {name: s if name in SEEN else None for name, s in usual.items()}
    changes = changes_of_assumptions(collocation, z, of_images)
    effects = Effects.from_changes(changes, of_images, {}, {})
    fit = linearise_fit(collocation, z)
    return Posterior.from_fit(fit, effects, collocation.parameters, solution.q, AUTO)


@pytest.mark.long
@pytest.mark.parametrize("name", SEEN)
def test_an_error_of_a_camera_is_estimated(name: str) -> None:
    film, size, label = SEEN[name]
    prior: dict[str, Any] = {name: 3 * size}
    solution = solved(problem(film(size), **prior))
    assert abs(solution.nuisance(label) / size - 1) < 0.1
    assert abs(solution.parameters["young_pa"] / 1.5e5 - 1) < 2e-3


@pytest.mark.long
@pytest.mark.parametrize("name", SEEN)
def test_a_considered_error_of_a_camera_moves_the_estimate_as_a_camera_with_the_error(
    name: str,
) -> None:
    film, size, _ = SEEN[name]
    first = faultless()
    changes = changes_of_nuisances(first.collocation, first.z, {name: size})
    told = -estimate_changes(linearise_fit(first.collocation, first.z), changes.blocks)[0]
    own = [k for k, each in enumerate(changes.names) if each == name]
    number = 3 * 2 * NAMES.index("middle_front") + 3 if name == "image_drift_px" else 0
    moved = solved(problem(film(size))).q[0] - first.q[0]
    assert moved == pytest.approx(told[own[number]], rel=0.1, abs=2e-5)


@pytest.mark.long
@pytest.mark.parametrize("name", SEEN)
def test_the_posterior_is_corrected_for_an_error_of_a_camera(name: str) -> None:
    film, _, _ = SEEN[name]
    size = 2 * Assumptions().collect_deviations()[name]
    found = effects_of(problem(film(size), seed=1))
    first = found.parameters.values(found.start)["young_pa"]
    estimate = found.reported("young_pa")
    assert estimate.combined95 is not None
    low, high = estimate.combined95
    assert low < 1.5e5 < high
    right = effects_of(problem(film(0.0), seed=1)).reported("young_pa").value
    assert abs(estimate.value - right) <= abs(first - right) + 30.0
    sum_of_squares = sum(each.surprise**2 for each in found.effect_estimates)
    assert sum_of_squares > 1.0


@pytest.mark.long
def test_faultless_tracks_need_no_error_of_the_camera() -> None:
    for seed in range(3):
        assert effect_concerns(effects_of(problem(seen_at(T_S), seed=seed)).effect_estimates) == []


def test_what_a_camera_states_is_not_considered_again() -> None:
    stated = tracks_of(drift_sigma_px=0.5, clock_rate_sigma=1e-3)
    collocation = cs.Problem([swung([stated])], unknown_young()).collocation()
    names = {each.row.name for each in collocation.transcriptions[0].nuisance.entries}
    assert {"image_drift_px", "image_clock_rate", "image_focal"} <= names
    assert "image_line_delay_s" not in names


def test_a_problem_may_state_a_prior_for_all_cameras() -> None:
    both = [tracks_of("front"), tracks_of("top")]
    experiment = swung(both, nuisance=cs.Nuisance.none(image_line_delay_s=2e-5))
    entries = (
        cs.Problem([experiment], unknown_young()).collocation().transcriptions[0].nuisance.entries
    )
    own = [each for each in entries if each.row.name == "image_line_delay_s"]
    assert [each.label for each in own] == [
        f"error of the line delay of {name} [s]" for name in ("front", "top")
    ]
    assert {each.sigma for each in own} == {2e-5}
