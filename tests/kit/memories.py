"""Small experiments with viscoelastic bodies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np

from collocation_sysid.fem.body import Body
from collocation_sysid.model.parameters import Parameters, Unknown
from collocation_sysid.recording import Experiment
from kit.problems import SMALL_EXPERIMENTS, TRUTH, measured_with

ONE = TRUTH | {"prony_1.share": 0.4, "prony_1.tau_s": 0.03}
TWO = ONE | {"prony_2.share": 0.25, "prony_2.tau_s": 0.15}


@cache
def _remembering(body: Body, branches: int) -> Body:
    names = [f"prony_{k + 1}" for k in range(branches)]
    return Body(body.mesh, density_kg_m3=30.0, element=body.element.name, prony=names)


def remembering(name: str, steps: int, branches: int = 1, **changes) -> Experiment:
    """A small experiment whose body has so many branches, not measured yet."""
    plain = SMALL_EXPERIMENTS[name](steps)
    return replace(plain, body=_remembering(plain.body, branches), **changes)


def truth(branches: int) -> dict[str, float]:
    """Parameters of such a body."""
    return {0: TRUTH, 1: ONE, 2: TWO}[branches]


def guesses(values: Mapping[str, float], factor: float = 1.5) -> Parameters:
    """All of them to be estimated, from guesses that are off by a factor."""
    return Parameters.from_mapping(
        {name: Unknown(guess=factor * value) for name, value in values.items()}
    )


def recorded(name: str, steps: int, branches: int = 1, scheme: str = "midpoint", **changes):
    """The experiment with the tracks that the truth gives it."""
    return measured_with(remembering(name, steps, branches, **changes), truth(branches), scheme)


def theta(values: Mapping[str, float], body: Body) -> np.ndarray:
    """Constants in the order of the body."""
    return body.theta_from_values(values)
