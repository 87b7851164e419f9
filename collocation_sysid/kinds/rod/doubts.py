"""Likely mistakes in the description of a rod."""

from __future__ import annotations

from dataclasses import replace

from ...common.array_types import Array
from ...judge.doubt import Correction, Doubt
from ...recording.experiment import Experiment
from ...recording.loads import PointMass
from .effects import end_mass_effect, free_end


def _with_end_mass(experiment: Experiment, size: Array) -> Correction:
    mass_kg = float(size[0])
    if mass_kg <= 0:
        return None
    end = PointMass(free_end(experiment), mass_kg)
    return replace(experiment, masses=[*experiment.masses, end]), {"mass_g": 1e3 * mass_kg}


ROWS = (Doubt("end-mass", "kg", _with_end_mass, effect=end_mass_effect, mean=0.0, wide=0.1),)
