"""Plausibility of a description: sizes and densities that soft objects cannot have, which indicate a
wrong unit, and measured values that are copies of others.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..common.array_types import Array
from ..errors import InputError
from ..fem.body import Body
from ..fem.laws.moduli import engineering_constants
from ..recording.experiment import Experiment
from ..recording.markers import Markers
from ..recording.measurement import Measurement
from .concerns import Concern
from .hypothesis import Hypothesis
from .thresholds import DENSITY_DEVIATION, SECTION_RATIO

# Fewest different values of a series that can be a copy of another one.
FEWEST_VALUES = 5
# Densities of soft objects [kg/m³].
DENSITIES_KG_M3 = (10.0, 25_000.0)
# Diagonals of soft objects [m].
SIZES_M = (1e-4, 10.0)
# Densities from which on a body contains metal [kg/m³].
METAL_KG_M3 = 5e3
# Young's modulus [Pa] that a metal exceeds; below the default bound, which tells nothing about it.
SOFTEST_METAL_PA = 9e8
# Factor outside these ranges from which on a value is rejected.
IMPOSSIBLE = 100.0


def size_and_density_hypotheses(body: Body) -> tuple[Hypothesis, ...]:
    """Return hypotheses about an implausible size or density of a body; mostly empty.

    Their strength is the factor by which the value is outside the plausible range.

    Raises
    ------
    InputError
        If a value is outside by more than a factor of a hundred.

    Notes
    -----
    A strength of 1 or less is plausible. The density is the mass of the body over the volume of the
    mesh.
    """
    size_m = float(np.linalg.norm(np.ptp(body.mesh.bounds_m, axis=0)))
    density_kg_m3 = body.mass_kg / body.mesh.volume_m3
    little_m, much_m = SIZES_M
    thin, dense = DENSITIES_KG_M3
    size = {
        "size_m": size_m,
        "least": little_m,
        "most": much_m,
        "likely": _likely_length(body, too_large=size_m > much_m),
    }
    density = {
        "density_kg_m3": density_kg_m3,
        "least": thin,
        "most": dense,
        "likely": _likely_density(body, density_kg_m3, size_m),
    }
    tried = (
        Hypothesis("length-unit/size", data=size, strength=_excess_factor(size_m, SIZES_M)),
        Hypothesis(
            "density", data=density, strength=_excess_factor(density_kg_m3, DENSITIES_KG_M3)
        ),
    )
    for each in tried:
        if each.strength > IMPOSSIBLE:
            raise InputError(each.message, None, where="object")
    return tuple(each for each in tried if each.strength > 1)


# Densities of soft materials [kg/m³] by how a body was made: silicone, gels and polyurethane are cast;
# printed bodies may be hollow; tissue from fat to tendon, without lungs and bones.
DENSITIES_BY_MAKING_KG_M3 = {
    "cast": (900.0, 1250.0),
    "foam": (10.0, 700.0),
    "printed": (100.0, 1300.0),
    "tissue": (900.0, 1150.0),
}


def density_concerns(body: Body) -> list[Concern]:
    """Return one concern, as a list, if the density of a body, its mass over the volume of its mesh,
    is not that of its material (`Body.material_density_kg_m3`), or not one of bodies that were made
    like it (`Body.made`); else empty.
    """
    if any(part.has_free_density for part in body.parts):
        return []
    density_kg_m3 = float(body.mass_kg / body.mesh.volume_m3)
    if body.material_density_kg_m3 is not None:
        ratio = density_kg_m3 / body.material_density_kg_m3
        if abs(np.log(ratio)) > np.log(1 + DENSITY_DEVIATION):
            data = {
                "density_kg_m3": density_kg_m3,
                "stated": body.material_density_kg_m3,
                "times": 1 / ratio,
                "likely": _likely_section(ratio),
            }
            return [Concern("description/density-of-mesh", data=data)]
    if body.made is None:
        return []
    least, most = DENSITIES_BY_MAKING_KG_M3[body.made]
    data = {"made": body.made, "density_kg_m3": density_kg_m3, "least": least, "most": most}
    is_usual = least <= density_kg_m3 <= most
    return [] if is_usual else [Concern("description/density-of-making", data=data)]


def _likely_section(ratio: float) -> str:
    for meshed, real, expected in (("square", "round", np.pi / 4), ("round", "square", 4 / np.pi)):
        if abs(ratio / expected - 1) < SECTION_RATIO:
            return f"a {real} section is meshed as a {meshed} one of the same width"
    return "the section or the length of the mesh is not that of the body, or mass_kg is wrong"


def _likely_length(body: Body, *, too_large: bool) -> str:
    if body.mesh.is_generated:
        return "its lengths, which are in metres"
    unit = 'likely "mm"' if too_large else "the mesh may be in metres already"
    return f"object.length_unit, {unit}"


def _likely_density(body: Body, density_kg_m3: float, size_m: float) -> str:
    thin, dense = DENSITIES_KG_M3
    is_low = density_kg_m3 < thin
    if body.has_declared_mass and (size_m > SIZES_M[1] if is_low else size_m < SIZES_M[0]):
        likely = _likely_length(body, too_large=is_low)
        return f"or rather {likely}: the mesh is {size_m:.3g} m large"
    corrected_kg_m3 = density_kg_m3 * (1e3 if is_low else 1e-3)
    if not thin <= corrected_kg_m3 <= dense:
        return "masses are in kg"
    unit = "the value is in g/cm³" if is_low else "the mass is in g"
    return f"probably {corrected_kg_m3:.4g} kg/m³, if {unit}"


def material_hypothesis(body: Body, theta: Array) -> Hypothesis | None:
    """Return the hypothesis "density/metal" that no material is as dense and as soft as a body with
    constants θ (k,); None if there may be one: with a density below `METAL_KG_M3`, or a Young's
    modulus of the stiffest part above `SOFTEST_METAL_PA`, and for cables of wires.

    Motion determines the stiffness over the density only, so a wrong density leaves no other trace.
    """
    if not body.is_solid:
        return None
    density_kg_m3 = float(body.mass_of_dofs(theta).sum()) / 3 / body.mesh.volume_m3
    young_pa = max(float(engineering_constants(*lame)[0]) for lame in body.lame(theta).values())
    if density_kg_m3 < METAL_KG_M3 or young_pa > SOFTEST_METAL_PA:
        return None
    return Hypothesis("density/metal", data={"density_kg_m3": density_kg_m3, "young_pa": young_pa})


def _excess_factor(value: float, limits: tuple[float, float]) -> float:
    """Return the factor by which a value is outside limits; at most 1 inside."""
    return max(limits[0] / value, value / limits[1])


def copied_measurements(experiments: Iterable[Experiment]) -> list[Hypothesis]:
    """Return each pair of measurements, of the same or of two recordings, with a series of values
    that is exactly the same in both; noise excludes this. Constant series do not count, and of
    markers only those of two recordings, see `same_tracks`.
    """
    first: dict[bytes, tuple[Experiment, Measurement, str]] = {}
    pairs: dict[tuple[Experiment, Measurement, Experiment, Measurement], Hypothesis] = {}
    for experiment in experiments:
        for measurement in experiment.measurements:
            for name, values in measurement.series():
                if len(np.unique(values[np.isfinite(values)])) < FEWEST_VALUES:
                    continue
                found = experiment, measurement, f"{name} of '{experiment.name}'"
                earlier = first.setdefault(values.tobytes(), found)
                is_track = isinstance(measurement, Markers) and earlier[0] is experiment
                if earlier is not found and not is_track:
                    data = {"first": earlier[2], "second": found[2]}
                    twice = Hypothesis("measured-twice", data=data)
                    pairs.setdefault((*earlier[:2], *found[:2]), twice)
    return [*pairs.values()]
