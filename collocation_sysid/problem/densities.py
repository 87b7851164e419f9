"""Densities that are parameters: their guesses and what [object] states stand in for each other."""

from __future__ import annotations

from collections.abc import Mapping

from ..errors import InputError
from ..fem.body import Body
from ..fem.constants import DENSITY, MASS, bare, is_density
from .schema import ObjectSection, ParameterSection, RegionSection

Sections = Mapping[str, ParameterSection | float]


def completed(section: ObjectSection, parameters: Sections) -> ObjectSection:
    """[object] with the guesses of densities that it leaves out.

    Raises
    ------
    InputError
        Where neither tells the body's mass.
    """
    regions = [_weighed(region, parameters) for region in section.region]
    changes: dict[str, object] = {"region": regions}
    if section.mass_kg is None and section.density_kg_m3 is None:
        guesses = {name: _guess(parameters, name) for name in (DENSITY.name, MASS.name)}
        known = {name: guess for name, guess in guesses.items() if guess is not None}
        if len(known) != 1:
            which = " and ".join(known) or f"no {MASS.name} or {DENSITY.name}"
            raise InputError(
                f"found {which}; expected exactly one of {MASS.name}, {DENSITY.name}, here or with "
                "a guess in [parameters]"
            )
        changes |= known
    return section.model_copy(update=changes)


def guessed(parameters: Sections, body: Body) -> dict[str, ParameterSection | float]:
    """[parameters] with the densities that [object] states as guesses, where there are none."""
    return {
        name: section.model_copy(update={"guess": _stated(body, name)})
        if isinstance(section, ParameterSection)
        and is_density(name)
        and section.fixed is None
        and section.tied_to is None
        and _guess(parameters, name) is None
        else section
        for name, section in parameters.items()
    }


def _weighed(region: RegionSection, parameters: Sections) -> RegionSection:
    if region.density_kg_m3 is not None:
        return region
    guess = _guess(parameters, f"{region.name}.{DENSITY.name}")
    return region.model_copy(update={DENSITY.name: guess})


def _guess(parameters: Sections, name: str) -> float | None:
    section = parameters.get(name)
    if not isinstance(section, ParameterSection):
        return section
    if section.guess is None and section.prior is not None:
        return section.prior.mean
    return section.fixed if section.guess is None else section.guess


def _stated(body: Body, name: str) -> float | None:
    if bare(name) == MASS.name:
        return body.mass_kg
    region = name.rpartition(".")[0]
    fitting = [part.density_kg_m3 for part in body.parts if part.name == region]
    shared = [part.density_kg_m3 for part in body.parts if not part.own_density]
    return next(iter(fitting or shared), None)
