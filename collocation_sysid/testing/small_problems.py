"""Small bodies and experiments in which extensions are checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.array_types import Array, Index
from ..fem.body import Body
from ..fem.laws.constants import Constant, is_modulus, usual_value
from ..model.parameters import Parameters, Unknown
from ..program.collocation import Collocation
from ..recording import Experiment, Grasp, Markers, Nuisance, PoseSequence

# A soft foam: stiffness [Pa], Poisson's ratio and density [kg/m³] of the bodies.
YOUNG_PA = 800.0
POISSON = 0.25
DENSITY_KG_M3 = 30.0
# Value of moduli that a soft foam lacks, such as the factor of (Ī₁ − 3)²: their terms count, too.
SMALL_MODULUS_PA = 30.0
# Time between samples [s], and their number: as many as the stencils of all schemes and sensors
# need.
TIMESTEP_S = 0.01
STEPS = 6


def smooth_poses(
    t_s: Array,
    sway_m: Sequence[float] = (0.02, 0.01, -0.015),
    turn_rad: Sequence[float] = (0.2, -0.15, 0.3),
    angular_frequency_rad_s: float = 20.0,
) -> PoseSequence:
    """Return a periodic motion that starts at rest from the identity, sampled from its formula.

    Translation and rotation vector are (1 − cos ωt) times `sway_m` and `turn_rad`.

    Parameters
    ----------
    t_s : (T,) array
        Times [s].
    sway_m, turn_rad : three floats
        Half the largest translation [m] and rotation vector [rad].
    angular_frequency_rad_s : float
        ω [rad/s].
    """
    share = 1 - np.cos(angular_frequency_rad_s * t_s)
    rotations = Rotation.from_rotvec(np.outer(share, turn_rad))
    positions_m = np.outer(share, sway_m)
    return PoseSequence(t_s, positions_m, quaternions_xyzw=rotations.as_quat())


def usual_constants(
    constants: Sequence[Constant], values: Mapping[str, float] | None
) -> dict[str, float]:
    """Return values of constants by name, in their order: those stated, else those of a soft foam,
    else 1.

    Stated values of other names are ignored.

    Parameters
    ----------
    values : mapping of name to value, optional
        Stated values.
    """
    known = dict(values or {})
    return {c.name: float(known.get(c.name, _usual_constant(c.name))) for c in constants}


def _usual_constant(name: str) -> float:
    """Return a value of a constant at which all terms of its law count: that of a soft foam, 1 if
    unknown, and `SMALL_MODULUS_PA` for a modulus that is zero in a soft foam.
    """
    value = usual_value(name, YOUNG_PA, poisson=POISSON)
    if value is None:
        return 1.0
    return SMALL_MODULUS_PA if is_modulus(name) and not value else value


def highest_nodes(points_m: Array) -> Index:
    """Return the indices of the nodes in the upper third of the height (z) of a body with nodes (n,
    3) [m].
    """
    heights_m = points_m[:, 2]
    third_m = np.ptp(heights_m) / 3
    return np.flatnonzero(heights_m > heights_m.max() - third_m)


def swung_experiment(body: Body, **changes: Any) -> Experiment:
    """Return an experiment in which a grasp at the top swings a body with four markers.

    Parameters
    ----------
    changes : Any
        Arguments of `Experiment` that replace those of this one.

    Notes
    -----
    There are no nuisance parameters and no air. The markers are on up to four nodes; their tracks
    are constant, at the undeformed positions, not those of the motion.
    """
    t_s: Array = TIMESTEP_S * np.arange(STEPS + 1, dtype=np.float64)
    points_m = body.nodes_m[:: max(1, len(body.nodes_m) // 4)][:4]
    tracks = np.repeat(points_m[None], len(t_s), axis=0)
    names = [f"m{k}" for k in range(len(points_m))]
    arguments: dict[str, Any] = {
        "grasps": [Grasp(highest_nodes(body.nodes_m), smooth_poses(t_s))],
        "markers": Markers(t_s, tracks, sigma_m=1e-2, names=names, places_m=points_m),
        "nuisance": Nuisance.none(),
        "air_density_kg_m3": "none",
        "name": "check",
    }
    return Experiment(body, t_s, **(arguments | changes))


def program_of(experiment: Experiment, values: Mapping[str, float]) -> Collocation:
    """Return the program of an experiment in which all constants of its body are estimated.

    Parameters
    ----------
    values : mapping of name to float
        Guesses; constants without one have the values of a soft foam.

    Notes
    -----
    A constant whose value is zero is fixed instead, because it has no scale.
    """
    constants = usual_constants(tuple(experiment.body.constants.values()), values)
    unknowns: dict[str, Any] = {name: _unknown(value) for name, value in constants.items()}
    return Collocation([experiment], Parameters.from_mapping(unknowns))


def _unknown(value: float) -> Unknown | float:
    """Return an estimated constant with its guess; zero is fixed, as it has no scale."""
    return Unknown(value) if value else value
