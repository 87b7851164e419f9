"""A swinging body and the frames of its recording, as live estimation takes them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

import collocation_sysid as cs
from collocation_sysid.extras.live import Frame, LiveEstimator, LiveOptions
from collocation_sysid.extras.live.sources import frames_of_recording
from collocation_sysid.program.least_squares import SquareRootInformation
from collocation_sysid.recording import Nuisance
from kit.problems import GUESS, IDEAL, TRUTH, hung_cube

NOISE_M = 3e-4


# No time to pass anything again.
NO_TIME = LiveOptions(budget_s=1e-9)


@cache
def swing(
    steps: int = 36, nuisance: Nuisance = IDEAL, seed: int = 1, air_density_kg_m3: float = 0.0
) -> cs.Problem:
    """A cube swung by its top, seen with noise, described rightly."""
    hung = hung_cube(steps, nuisance=nuisance, air_density_kg_m3=air_density_kg_m3)
    tracks = cs.simulate(hung, TRUTH, integrator="midpoint", substeps=1).markers_m
    noise = np.random.default_rng(seed).normal(scale=NOISE_M, size=tracks.shape)
    seen = cs.with_markers(hung, tracks + noise)
    seen = replace(seen, markers=replace(seen.markers, sigma_m=NOISE_M))
    return cs.Problem([seen], GUESS)


def frames_of(problem: cs.Problem, live: LiveEstimator) -> list[Frame]:
    return list(frames_of_recording(problem.experiments[0], live.model))


def streamed(problem: cs.Problem, count: int | None = None) -> LiveEstimator:
    """An estimator that has taken so many frames, by default all, and passed none again."""
    live = LiveEstimator(problem, NO_TIME)
    for frame in frames_of(problem, live)[:count]:
        live.process_frame(frame)
    return live


def normal_equations(triangle: np.ndarray) -> np.ndarray:
    return triangle.T @ triangle


def assert_same_information(
    ours: SquareRootInformation, theirs: SquareRootInformation, atol: float
) -> None:
    """The normal equations, each entry by the sizes on the diagonal."""
    found, expected = (normal_equations(each.triangle) for each in (ours, theirs))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=atol)
