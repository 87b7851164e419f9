"""Collocations of small problems with noise, by name."""

from __future__ import annotations

from functools import cache

from collocation_sysid.program.collocation import Collocation
from kit.problems import GUESS, SMALL_EXPERIMENTS, noisy


@cache
def collocation_of(name: str, noise_m: float = 0.0, steps: int = 10) -> Collocation:
    return Collocation([noisy(SMALL_EXPERIMENTS[name](steps), noise_m)], GUESS)
