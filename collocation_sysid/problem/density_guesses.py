"""Densities and masses as parameters: [object] and the guesses in [parameters] complete
each other.
"""

from __future__ import annotations

from collections.abc import Mapping

from ..errors import InputError
from ..fem.body import Body
from ..fem.laws.constants import DENSITY, MASS, is_density, without_region
from .schema import ObjectSection, ParameterSection, RegionSection

Sections = Mapping[str, ParameterSection | float]


def with_guessed_densities(section: ObjectSection, parameters: Sections) -> ObjectSection:
    """Return a copy of [object] in which missing densities of the body and of regions are guesses
    of parameters (or their prior means or fixed values).

    A region without a density of its own and without a parameter remains without. If the body has
    neither mass nor density, the mass or the density is taken from the parameters. The argument is
    not modified.

    Parameters
    ----------
    parameters : mapping of name to ParameterSection or float
        Table [parameters]; a number is a fixed value.

    Raises
    ------
    InputError
        If the body states neither mass nor density, and the parameters give none or both of them.
    """
    regions = [_with_guessed_density(region, parameters) for region in section.region]
    changes: dict[str, object] = {"region": regions}
    if section.mass_kg is None and section.density_kg_m3 is None:
        guesses = {name: _guess(parameters, name) for name in (DENSITY.name, MASS.name)}
        known = {name: guess for name, guess in guesses.items() if guess is not None}
        if len(known) != 1:
            names = " and ".join(known) or f"no {MASS.name} or {DENSITY.name}"
            of_rod = "mass_per_length_kg_m, " if section.is_rod else ""
            raise InputError(
                f"found {names}; expected exactly one of {of_rod}{MASS.name}, {DENSITY.name}, here "
                "or with a guess in [parameters]"
            )
        changes |= known
    return section.model_copy(update=changes)


def with_declared_densities(
    parameters: Sections, body: Body
) -> dict[str, ParameterSection | float]:
    """Return a copy of [parameters] in which a density or mass that is to be estimated without a
    guess or prior has the value that the body states as its guess; all others are unchanged.
    """
    return {
        name: section.model_copy(update={"guess": _declared_density(body, name)})
        if isinstance(section, ParameterSection)
        and is_density(name)
        and section.fixed is None
        and section.tied_to is None
        and _guess(parameters, name) is None
        else section
        for name, section in parameters.items()
    }


def _with_guessed_density(region: RegionSection, parameters: Sections) -> RegionSection:
    if region.density_kg_m3 is not None:
        return region
    guess = _guess(parameters, f"{region.name}.{DENSITY.name}")
    return region.model_copy(update={DENSITY.name: guess})


def _guess(parameters: Sections, name: str) -> float | None:
    """Return guess, prior mean or fixed value of a parameter; None without."""
    section = parameters.get(name)
    if not isinstance(section, ParameterSection):
        return section
    if section.guess is None and section.prior is not None:
        return section.prior.mean
    return section.fixed if section.guess is None else section.guess


def _declared_density(body: Body, name: str) -> float | None:
    """Return the value that the body states for a density or mass parameter called `name`; None if
    it has none.

    It is the total mass [kg] if that is the parameter, else the density [kg/m³] of the region that
    the name begins with, or, if no part has this name, of the first part without an own density.
    """
    if without_region(name) == MASS.name:
        return body.mass_kg
    region = name.rpartition(".")[0]
    fitting = [part.density_kg_m3 for part in body.parts if part.name == region]
    shared = [part.density_kg_m3 for part in body.parts if not part.has_own_density]
    return next(iter(fitting or shared), None)
