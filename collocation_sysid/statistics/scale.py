"""What no recording tells, whatever its noise: the scale of stiffness and mass, and a damping.

Multiply all moduli and all densities by one number: without a known force or mass on the body the
equations of motion are the same. Where nothing moves, or only slowly, a stiffness shows and no
damping.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..arrays import Array
from ..errors import listed
from ..fem.body import Body
from ..fem.constants import DENSITY, bare, is_damping, is_density, is_modulus, symbol_of
from ..methods.scan import SOFT_PA, usual_parameters
from ..model.parameters import Parameters, ThetaMap
from ..recording.experiment import Experiment
from .concern import Concern, Grade
from .distributions import chi2_isf

# What is left over of a change of all constants that parameters cannot bring about.
LEFT = 1e-8


def open_scale(experiments: Iterable[Experiment], parameters: Parameters) -> tuple[str, ...]:
    """The parameters of which only ratios can be told, densities among them; mostly none."""
    if not any(is_density(item.name) for item in parameters.free):
        return ()
    return _moved(experiments, parameters, stated=False)


def relative_moduli(experiments: Iterable[Experiment], parameters: Parameters) -> tuple[str, ...]:
    """The parameters that are known relative to densities as stated."""
    return _moved(experiments, parameters, stated=True)


def scale_concerns(
    experiments: Iterable[Experiment], parameters: Parameters, grade: Grade = "check"
) -> list[Concern]:
    """A scale that is open."""
    names = open_scale(experiments, parameters)
    return [Concern("scale/unknown", grade, {"names": names})] if names else []


def relative_sentence(experiments: Iterable[Experiment], parameters: Parameters) -> str | None:
    """What the moduli found rest on, where no force sets the scale."""
    names = relative_moduli(experiments, parameters)
    if not names or open_scale(experiments, parameters):
        return None
    verb = "is" if len(names) == 1 else "are"
    symbols = [symbol_of(name) for name in names]
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
    slopes = []
    changes = []
    for key, body in bodies.items():
        constants = ThetaMap(usual, body)
        theta = constants.theta(usual.guess_q)
        slope = constants.slopes(usual.guess_q)
        change = _multiplied(body, theta, slope, stated)
        if key in held or change is None:
            change = np.zeros(len(slope))
        size = np.where(theta == 0, 1.0, np.abs(theta))
        slopes.append(slope / size[:, None])
        changes.append(change / size)
    matrix = np.concatenate(slopes)
    wanted = np.concatenate(changes)
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


# Probability of noise of sigma_m that moves markers more than still ones move.
RARE = 1e-3
# Held nodes that move less than so many sigma_m do not.
HELD = 2.0


def motionless(experiment: Experiment) -> bool:
    """Whether neither grasps and loads nor markers move or change, but for noise."""
    markers = experiment.markers
    t_s = experiment.t_s
    sigma_m = float(np.median(markers.sigma_m)) if markers.names else 0.0
    held, positions_m = experiment.grasped(t_s)
    lasting = held.all(axis=0)
    if (held.any(axis=0) != lasting).any():
        return False
    moved_m = np.ptp(positions_m[:, lasting], axis=0)
    if moved_m.size and moved_m.max() > HELD * sigma_m:
        return False
    if np.ptp(experiment.tied_mass_kg(t_s), axis=0).any():
        return False
    if np.ptp(experiment.node_forces_n(t_s), axis=0).any():
        return False
    present = markers.present[..., None]
    counts = np.maximum(present.sum(axis=0), 1)
    mean = np.where(present, markers.positions_m, 0.0).sum(axis=0) / counts
    away = np.where(present, markers.positions_m - mean, 0.0) / markers.sigma_m[:, None]
    # Of a mean of n samples, the deviations have n − 1 degrees of freedom.
    freedom = 3 * float(np.maximum(present.sum(axis=0) - 1, 0).sum())
    return bool(np.sum(away**2) <= chi2_isf(RARE, max(freedom, 1.0)))


def stillness_concerns(experiments: Iterable[Experiment], parameters: Parameters) -> list[Concern]:
    """What no recording can tell, if nothing moves in those that are to be fitted."""
    fitted = [experiment for experiment in experiments if not experiment.validation]
    damping = [item.name for item in parameters.free if is_damping(item.name)]
    if not fitted or not damping or not all(e.static or motionless(e) for e in fitted):
        return []
    code = "static" if all(experiment.static for experiment in fitted) else "still"
    names = [f"'{e.name}'" for e in fitted]
    verb = "is" if len(fitted) == 1 else "are"
    data = {"names": names, "verb": verb, "damping": damping}
    return [Concern(f"information/{code}", data=data)]
