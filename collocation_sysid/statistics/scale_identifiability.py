"""Quantities that no recording can determine, whatever its noise: a common scale of stiffness and
mass, and damping without motion.

If all moduli and all densities are multiplied by one number, the equations of motion are the same
unless a force or mass is known. Slow or static experiments determine stiffness but no damping.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..common.array_types import Array
from ..errors import listed
from ..fem.body import Body
from ..fem.laws.constants import (
    AXIAL,
    BENDING,
    DENSITY,
    FRICTION_MOMENT,
    STICK,
    TORSION,
    is_damping,
    is_density,
    is_modulus,
    symbol_of,
    without_region,
)
from ..methods.starts.stiffness_scan import SOFT_PA, typical_parameters
from ..model.parameters import Parameters, ThetaMap
from ..recording.experiment import Experiment
from .concerns import Concern
from .distributions import chi2_isf

# Relative error up to which parameters can multiply all constants by a common factor.
LEAST_REMAINDER = 1e-8


def parameters_of_open_scale(
    experiments: Iterable[Experiment], parameters: Parameters
) -> tuple[str, ...]:
    """Return the names of the estimated parameters, densities among them, of which only ratios can
    be determined; empty if no density is estimated, or if a known force or a prior sets the
    scale.

    Experiments for validation are ignored.
    """
    if not any(is_density(item.name) for item in parameters.free):
        return ()
    return _scaled_parameters(experiments, parameters, includes_declared=False)


def relative_moduli(experiments: Iterable[Experiment], parameters: Parameters) -> tuple[str, ...]:
    """Return the names of the estimated parameters that are determined relative to the stated
    densities only; empty if a known force or a prior sets the scale. Experiments for validation
    are ignored.
    """
    return _scaled_parameters(experiments, parameters, includes_declared=True)


def scale_concerns(experiments: Iterable[Experiment], parameters: Parameters) -> list[Concern]:
    """Return one doubtful concern "scale/unknown", as a list, if `parameters_of_open_scale` has
    names; else empty.
    """
    names = parameters_of_open_scale(experiments, parameters)
    return [Concern("scale/unknown", "doubtful", data={"names": names})] if names else []


@dataclass(frozen=True)
class ScaleReference:
    """The stated mass, to which the moduli of a motion without measured forces are relative."""

    SERIALISED_PROPERTIES: ClassVar = ("sentence",)

    names: tuple[str, ...]  # parameters of which only the ratio to the density is determined
    density_kg_m3: float  # mass of all fitted bodies over their volume, as stated
    # Relative standard deviation of the mass, which the intervals contain; None if the mass counts
    # as exact.
    deviation: float | None
    # Whether the density of the material is stated as well, with which the mass is compared.
    is_compared: bool = False

    @property
    def sentence(self) -> str:
        """What the moduli rest on, in one sentence."""
        symbols = listed([symbol_of(name) for name in self.names])
        verb = "is" if len(self.names) == 1 else "are"
        share = "none" if self.deviation is None else f"{100 * self.deviation:.2g} %"
        return (
            f"{symbols} {verb} relative to the stated density of {self.density_kg_m3:.4g} kg/m³, "
            "because no force was measured: an error of the mass is an equal error of the moduli "
            f"(contained in the intervals: {share})"
            + (
                ", and only that beyond 5 % is seen beside the density of the material"
                if self.is_compared
                else ", which no test shows unless object.material_density_kg_m3 is stated"
            )
        )


def scale_reference(
    experiments: Iterable[Experiment], parameters: Parameters, deviation: float | None
) -> ScaleReference | None:
    """Return the mass to which moduli are relative; None if a force or a prior sets the scale, or
    if the scale is open (`parameters_of_open_scale`). `deviation` is that of the mass.
    """
    fitted = [each for each in experiments if not each.validation]
    names = relative_moduli(fitted, parameters)
    if not names or parameters_of_open_scale(fitted, parameters):
        return None
    bodies = {id(each.body): each.body for each in fitted}.values()
    density = sum(body.mass_kg for body in bodies) / sum(body.mesh.volume_m3 for body in bodies)
    is_compared = all(body.material_density_kg_m3 is not None for body in bodies)
    return ScaleReference(names, float(density), deviation, is_compared)


def _scaled_parameters(
    experiments: Iterable[Experiment], parameters: Parameters, includes_declared: bool
) -> tuple[str, ...]:
    """Return no names if data or priors determine the common factor."""
    fitted = [experiment for experiment in experiments if not experiment.validation]
    bodies = {id(e.body): e.body for e in fitted}
    with_known_force = {id(e.body) for e in fitted if e.has_known_force()}
    if len(with_known_force) == len(bodies):
        return ()
    usual = typical_parameters(parameters, SOFT_PA)
    slopes = []
    changes = []
    for key, body in bodies.items():
        constants = ThetaMap(usual, body)
        theta = constants.theta(usual.guess_q)
        slope = constants.jacobian(usual.guess_q)
        change = _common_scaling(body, theta, slope=slope, includes_declared=includes_declared)
        if key in with_known_force or change is None:
            change = np.zeros(len(slope))
        size = np.where(theta == 0, 1.0, np.abs(theta))
        slopes.append(slope / size[:, None])
        changes.append(change / size)
    matrix = np.concatenate(slopes)
    scaling = np.concatenate(changes)
    if not scaling.any():
        return ()
    solution = np.linalg.lstsq(matrix, scaling, rcond=None)[0]
    moves = np.abs(solution) > LEAST_REMAINDER * np.abs(solution).max(initial=0.0)
    priors = np.array([item.prior is not None for item in usual.free], dtype=bool)
    if np.abs(matrix @ solution - scaling).max() > LEAST_REMAINDER or (moves & priors).any():
        return ()
    return tuple(item.name for item, is_moved in zip(usual.free, moves, strict=True) if is_moved)


def _common_scaling(
    body: Body, theta: Array, slope: Array, includes_declared: bool
) -> Array | None:
    """Return the change of θ (k,) if all moduli and densities change by a common factor, to first
    order: θ for those, zero for other constants; None if a density cannot change.
    """
    if not includes_declared and not all(part.has_free_density for part in body.parts):
        return None

    def is_scaled(place: int, name: str) -> bool:
        """Stiffnesses along and about a rod hardly matter where they are stated."""
        constant = without_region(name)
        if constant in (DENSITY.name, TORSION.name, AXIAL.name):
            return bool(slope[place].any()) or not includes_declared
        return is_modulus(name) or constant in (BENDING.name, FRICTION_MOMENT.name, STICK.name)

    scaled = [is_scaled(place, name) for place, name in enumerate(body.constants)]
    return np.where(scaled, theta, 0.0)


# Probability that noise of a motionless marker is taken for motion.
FALSE_MOTION = 1e-3
# Displacement of grasped nodes up to which they count as motionless, over sigma_m.
LEAST_RESTRAINT = 2.0


def is_motionless(experiment: Experiment) -> bool:
    """Whether neither grasps, loads nor markers of an experiment change, except for the noise of
    the markers.

    False if a grasp begins or ends within the recording. Markers count as motionless unless a χ²
    test at the level `FALSE_MOTION` finds their deviations from their means larger than σ; grasped nodes
    may move by `LEAST_RESTRAINT` times the median σ.
    """
    markers = experiment.markers
    t_s = experiment.t_s
    sigma_m = float(np.median(markers.sigma_m)) if markers.names else 0.0
    is_prescribed, positions_m = experiment.prescribed_displacements(t_s)
    lasting = is_prescribed.all(axis=0)
    if (is_prescribed.any(axis=0) != lasting).any():
        return False
    displacement_m = np.ptp(positions_m[:, lasting], axis=0)
    if displacement_m.size and displacement_m.max() > LEAST_RESTRAINT * sigma_m:
        return False
    if np.ptp(experiment.point_mass_at_nodes_kg(t_s), axis=0).any():
        return False
    if np.ptp(experiment.declared_node_forces_n(t_s), axis=0).any():
        return False
    present = markers.is_measured
    counts = np.maximum(present.sum(axis=0), 1)
    mean = np.where(present, markers.positions_m, 0.0).sum(axis=0) / counts
    deviations = np.where(present, markers.positions_m - mean, 0.0) / markers.sigma_m[:, None]
    # Of a mean of n samples, the deviations have n − 1 degrees of freedom.
    freedom = float(np.maximum(present.sum(axis=0) - 1, 0).sum())
    return bool(np.sum(deviations**2) <= chi2_isf(FALSE_MOTION, max(freedom, 1.0)))


def static_concerns(experiments: Iterable[Experiment], parameters: Parameters) -> list[Concern]:
    """Return one concern, as a list, if a damping is estimated and nothing moves in all fitted
    recordings, so that damping cannot be determined; else empty.

    The code is "information/static" if all recordings are static tests, else "information/still".
    Experiments for validation are ignored.
    """
    fitted = [experiment for experiment in experiments if not experiment.validation]
    damping = [item.name for item in parameters.free if is_damping(item.name)]
    if not fitted or not damping or not all(e.is_static or is_motionless(e) for e in fitted):
        return []
    code = "static" if all(experiment.is_static for experiment in fitted) else "still"
    names = [f"'{e.name}'" for e in fitted]
    verb = "is" if len(fitted) == 1 else "are"
    data = {"names": names, "verb": verb, "damping": damping}
    return [Concern(f"information/{code}", data=data)]
