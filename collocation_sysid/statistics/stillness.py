"""Recordings in which nothing moves, or only slowly: they tell a stiffness, and no damping."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..fem.constants import is_damping
from ..model.parameters import Parameters
from ..recording.experiment import Experiment
from .distributions import chi2_isf

# Probability of noise of sigma_m that moves markers more than still ones move.
RARE = 1e-3
# Held nodes that move less than so many sigma_m do not.
HELD = 2.0


def motionless(experiment: Experiment) -> bool:
    """Whether neither grasps and loads nor markers move or change, but for noise."""
    markers, t_s = experiment.markers, experiment.t_s
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


def stillness_notes(experiments: Iterable[Experiment], parameters: Parameters) -> list[str]:
    """What no recording can tell, if nothing moves in those that are to be fitted."""
    fitted = [experiment for experiment in experiments if not experiment.validation]
    damping = [item.name for item in parameters.free if is_damping(item.name)]
    if not fitted or not damping or not all(e.static or motionless(e) for e in fitted):
        return []
    names = ", ".join(f"'{experiment.name}'" for experiment in fitted)
    if all(experiment.static for experiment in fitted):
        return [
            f"{names} {'is' if len(fitted) == 1 else 'are'} static: no information on damping; fix "
            f"{' and '.join(damping)}, or add a recording of a motion"
        ]
    return [
        f"nothing moves in {names}: no information on damping, and of the stiffness only what the "
        f"sag tells; fix {' and '.join(damping)}, or add a recording of a motion"
    ]
