"""Elastic moduli in whichever pair the user knows: (λ, μ), (E, ν), (κ, μ) or (μ, ν).

A material that has a constant μ takes any of these pairs; one whose shear modulus follows from
constants of its own (Mooney and Rivlin's, Yeoh's) takes κ, λ or ν beside them. A region's own
name, ``core.mu_pa``, goes before the name without it, which all regions share.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..errors import InputError
from .constants import DENSITY, MASS, Constant
from .materials import Material

ELASTIC = ("lambda_pa", "mu_pa", "kappa_pa", "young_pa", "poisson")
LAME = ("lambda_pa", "mu_pa")
ENGINEERING = ("young_pa", "poisson")
_PAIRS = (LAME, ENGINEERING, ("kappa_pa", "mu_pa"), ("mu_pa", "poisson"))
_BESIDE_SHEAR = (("kappa_pa",), ("lambda_pa",), ("poisson",))


@dataclass(frozen=True)
class Source:
    """Where the constants of a region come from.

    Attributes
    ----------
    material : Material
    names : mapping of a constant's bare name to the name that gives it
        For the elastic constants, those of the pair that was given.
    """

    material: Material
    names: Mapping[str, str]

    def constants(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Every constant by its bare name, from the values by the names that were given."""
        given = {own: values[name] for own, name in self.names.items()}
        missing = [c.name for c in self.material.constants if c.name not in given]
        if not missing:
            return given
        if "mu_pa" in given:
            mu = given["mu_pa"]
        elif "young_pa" in given:
            mu = given["young_pa"] / (2 * (1 + given["poisson"]))
        else:
            # With κ = λ = 0 what is left of the shear modulus is the own constants'.
            own = [given.get(c.name, 0.0) for c in self.material.constants]
            mu = self.material.lame(ca.vertcat(*own))[1]
        if "lambda_pa" in given:
            lame = given["lambda_pa"]
        elif "kappa_pa" in given:
            lame = given["kappa_pa"] - 2 / 3 * mu
        else:
            nu = given["poisson"]
            lame = 2 * mu * nu / (1 - 2 * nu)
        return {**given, "mu_pa": mu, "lambda_pa": lame, "kappa_pa": lame + 2 / 3 * mu}


def source_of(
    region: str, material: Material, others: Iterable[Constant], known: Sequence[str]
) -> Source:
    """Find the constants of a region among the names that are known.

    Parameters
    ----------
    region : str
        Its name, "" for the body's own.
    material : Material
    others : iterable of Constant
        Of the region's other terms.
    known : sequence of str

    Raises
    ------
    InputError
        If one is missing or given twice.
    """

    def name_of(own: str) -> str | None:
        prefixed = f"{region}.{own}" if region else own
        return prefixed if prefixed in known else own if own in known else None

    owns = [c.name for c in material.constants]
    elastic = _elastic_choices(owns)
    plain = [own for own in owns if not (elastic and own in ELASTIC)]
    plain += [c.name for c in others]
    names = {own: name for own in plain if (name := name_of(own)) is not None}
    where = f"region '{region}'" if region else "the body"
    what = f"the material {material.name} of {where}"
    if elastic:
        specific = {own for own in ELASTIC if region and f"{region}.{own}" in known}
        there = {own for own in ELASTIC if name_of(own) is not None}
        fitting = [c for c in elastic if set(c) <= there and specific <= set(c)]
        if len(fitting) != 1:
            found = ", ".join(str(name_of(own)) for own in ELASTIC if own in there) or "none"
            raise InputError(
                f"the elastic parameters of {where} are {found}; {what} expects "
                f"{_alternatives(elastic)}"
            )
        names |= {own: str(name_of(own)) for own in fitting[0]}
    if DENSITY.name in plain and MASS.name in known:
        if DENSITY.name in names:
            raise InputError(
                f"{names[DENSITY.name]} and {MASS.name} both give the density of {where}; expected "
                "one of them"
            )
        names[DENSITY.name] = MASS.name
    if lacking := [own for own in plain if own not in names]:
        raise InputError(
            f"{_listed(lacking)} missing: {what} with its damping expects "
            f"{_expected(elastic, plain)}"
        )
    return Source(material, names)


def _elastic_choices(owns: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """The sets of elastic names that a material with these constants may be given by."""
    volumetric = {"lambda_pa", "kappa_pa"} & set(owns)
    if not volumetric:
        return ()
    return _PAIRS if "mu_pa" in owns else _BESIDE_SHEAR


def elastic_names(material: Material) -> tuple[str, ...]:
    """Names that may stand for a material's constants."""
    owns = [c.name for c in material.constants]
    return tuple(dict.fromkeys(name for choice in _elastic_choices(owns) for name in choice))


def _alternatives(elastic: Sequence[Sequence[str]]) -> str:
    return ", or ".join(" and ".join(choice) for choice in elastic)


def _expected(elastic: Sequence[Sequence[str]], plain: Sequence[str]) -> str:
    own = ", ".join(plain)
    return f"{own}, and {_alternatives(elastic)}" if elastic else own


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names)} {'is' if len(names) == 1 else 'are'}"


def engineering(lambda_pa: Any, mu_pa: Any) -> tuple[Any, Any]:
    """(E, ν) of (λ, μ)."""
    return (
        mu_pa * (3 * lambda_pa + 2 * mu_pa) / (lambda_pa + mu_pa),
        lambda_pa / (2 * (lambda_pa + mu_pa)),
    )
