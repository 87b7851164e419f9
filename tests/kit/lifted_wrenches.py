"""Experiments with instrumented grasps whose wrenches are lifted variables."""

from __future__ import annotations

from dataclasses import replace

from collocation_sysid.model.parameters import Parameters, Unknown
from collocation_sysid.recording import Experiment, Nuisance
from kit.memories import recorded
from kit.problems import TRUTH, hung_cube
from kit.wrenches import sensing, wristed_cube

DENSE = TRUTH | {"density_kg_m3": 30.0}


ALL_UNKNOWN = Nuisance.none(
    tare=10.0,
    sensor_time_s=0.004,
    sensor_lag_s=0.01,
    tool_kg=0.2,
    tool_m=0.05,
    gravity_rad=0.1,
    hand_eye_m=1e-3,
    hand_eye_rad=0.02,
)


def free_density() -> Parameters:
    return Parameters.from_mapping({name: Unknown(1.1 * value) for name, value in DENSE.items()})


def weighed(experiment: Experiment) -> Experiment:
    """The experiment, its density not known."""
    return replace(experiment, body=experiment.body.with_free_densities([""]))


def felt_memory(name: str, steps: int = 5, branches: int = 2, **changes) -> Experiment:
    return sensing(recorded(name, steps, branches, **changes))


def several() -> list[Experiment]:
    """One with memory between two that feel, so that every place in z and g is shifted."""
    first = wristed_cube(4, ALL_UNKNOWN, frame="grasp")
    last = sensing(replace(hung_cube(4), name="last"))
    between = replace(felt_memory("hung-cube", 4), name="between")
    return [first, between, last]
