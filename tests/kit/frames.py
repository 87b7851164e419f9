"""A swinging body whose recording is streamed as frames."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

import collocation_sysid as cs
from collocation_sysid.recording import Nuisance
from kit.problems import GUESS, IDEAL, TRUTH, hung_cube

NOISE_M = 3e-4


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
