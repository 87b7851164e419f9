"""A swung cube with a measured wrench and noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

import collocation_sysid as cs
from collocation_sysid.program.simulation import simulate, with_markers, with_wrenches
from collocation_sysid.recording import Experiment, Nuisance
from kit.problems import GUESS, TRUTH, hung_cube
from kit.wrenches import SIGMA_N, SIGMA_NM, sensing

NOISE_M = 1e-3


UNKNOWN = {item.name: cs.Unknown(item.guess, item.lower, item.upper) for item in GUESS.items}


@cache
def swung(seed: int = 0, nuisance: Nuisance | None = None, steps: int = 40) -> Experiment:
    """The cube swung for a while, seen and felt with noise, all by the midpoint rule."""
    rng = np.random.default_rng(seed)
    cube = sensing(replace(hung_cube(steps), nuisance=nuisance or Nuisance.none()), frame="grasp")
    found = simulate(cube, TRUTH, "midpoint", substeps=1)
    tracks = found.markers_m + NOISE_M * rng.normal(size=found.markers_m.shape)
    noise = np.repeat([SIGMA_N, SIGMA_NM], 3)
    wrenches = [values + noise * rng.normal(size=values.shape) for values in found.wrenches]
    return with_wrenches(with_markers(cube, tracks), wrenches)
