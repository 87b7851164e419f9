"""The scale of stiffness and mass, which a motion without known forces does not tell.

Multiply all moduli and all densities by one number: without a known force or mass on the body the
equations of motion are the same.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..arrays import Array
from ..errors import listed
from ..fem.body import Body
from ..fem.constants import DENSITY, bare, is_density, is_modulus, symbol_of
from ..methods.scan import SOFT_PA, usual_parameters
from ..model.parameters import Parameters, ThetaMap
from ..recording.experiment import Experiment

# What is left over of a change of all constants that parameters cannot bring about.
LEFT = 1e-8
REMEDY = "fix a density, give a known mass, or measure a wrench"


def open_scale(experiments: Iterable[Experiment], parameters: Parameters) -> tuple[str, ...]:
    """The parameters of which only ratios can be told, densities among them; mostly none."""
    if not any(is_density(item.name) for item in parameters.free):
        return ()
    return _moved(experiments, parameters, stated=False)


def relative_moduli(experiments: Iterable[Experiment], parameters: Parameters) -> tuple[str, ...]:
    """The parameters that are known relative to densities as stated."""
    return _moved(experiments, parameters, stated=True)


def scale_notes(experiments: Iterable[Experiment], parameters: Parameters) -> list[str]:
    """What to do about a scale that is open."""
    found = scale_concern(experiments, parameters)
    return [] if found is None else [f"{found}; {REMEDY}"]


def scale_concern(experiments: Iterable[Experiment], parameters: Parameters) -> str | None:
    """The same of an answer, None where the scale is known."""
    names = open_scale(experiments, parameters)
    if not names:
        return None
    return (
        f"only the ratios of {listed(names)} can be told (E/ρ): no known force or mass sets their "
        "scale"
    )


def relative_sentence(experiments: Iterable[Experiment], parameters: Parameters) -> str | None:
    """What the moduli found rest on, where no force sets the scale."""
    names = relative_moduli(experiments, parameters)
    if not names or open_scale(experiments, parameters):
        return None
    verb, symbols = "is" if len(names) == 1 else "are", [symbol_of(name) for name in names]
    return f"no known force sets the scale: {listed(symbols)} {verb} relative to the stated density"


def _moved(
    experiments: Iterable[Experiment], parameters: Parameters, stated: bool
) -> tuple[str, ...]:
    """Free parameters that multiply all moduli and densities; none where data or priors resist.

    With `stated`, densities that are not estimated are multiplied along.
    """
    fitted = [experiment for experiment in experiments if not experiment.validation]
    bodies = {id(e.body): e.body for e in fitted}
    held = {id(e.body) for e in fitted if e.knows_a_force}
    if len(held) == len(bodies):
        return ()
    usual = usual_parameters(parameters, SOFT_PA)
    slopes, changes = [], []
    for key, body in bodies.items():
        constants = ThetaMap(usual, body)
        theta, slope = constants.theta(usual.guess_q), constants.slopes(usual.guess_q)
        change = _multiplied(body, theta, slope, stated)
        if key in held or change is None:
            change = np.zeros(len(slope))
        size = np.where(theta == 0, 1.0, np.abs(theta))
        slopes.append(slope / size[:, None])
        changes.append(change / size)
    matrix, wanted = np.concatenate(slopes), np.concatenate(changes)
    if not wanted.any():
        return ()
    way = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    moves = np.abs(way) > LEFT * np.abs(way).max(initial=0.0)
    priors = np.array([item.prior is not None for item in usual.free], dtype=bool)
    if np.abs(matrix @ way - wanted).max() > LEFT or (moves & priors).any():
        return ()
    return tuple(item.name for item, here in zip(usual.free, moves, strict=True) if here)


def _multiplied(body: Body, theta: Array, slope: Array, stated: bool) -> Array | None:
    """How θ changes when all moduli and densities do; None where a density cannot."""
    if not stated and not all(part.free_density for part in body.parts):
        return None
    scaled = [
        is_modulus(name) or (bare(name) == DENSITY.name and not (stated and not slope[place].any()))
        for place, name in enumerate(body.constants)
    ]
    return np.where(scaled, theta, 0.0)
