"""Elastic moduli in any usual pair: (λ, μ), (E, ν), (κ, μ) or (μ, ν).

A material that has a constant μ accepts any of these pairs; one whose shear modulus follows from
other constants (Mooney–Rivlin, Yeoh) accepts κ, λ or ν beside them. The name with a region's
prefix, ``core.mu_pa``, takes precedence over the name without it, which all regions share.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ...errors import InputError
from .constants import DENSITY, MASS, Constant
from .materials import Material

ELASTIC = ("lambda_pa", "mu_pa", "kappa_pa", "young_pa", "poisson")
LAME = ("lambda_pa", "mu_pa")
ENGINEERING = ("young_pa", "poisson")
_PAIRS = (LAME, ENGINEERING, ("kappa_pa", "mu_pa"), ("mu_pa", "poisson"))
_VOLUMETRIC_CHOICES = (("kappa_pa",), ("lambda_pa",), ("poisson",))


@dataclass(frozen=True)
class ConstantSource:
    """Names of the parameters that determine the constants of a region."""

    material: Material
    # mapping: for each constant, by its name without region, the name of the parameter that gives
    # it. For the elastic constants, the names of the pair that was given.
    names: Mapping[str, str]

    def evaluate(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return every constant by its name without region.

        If elastic parameters replace constants, the result also contains λ, μ and κ, whether the
        material has them or not. A density given by `MASS` is the value of the mass; the caller
        converts it.

        Parameters
        ----------
        values : mapping
            Numbers or expressions by the names of the parameters; further ones are ignored.
        """
        by_constant = {own_values: values[name] for own_values, name in self.names.items()}
        missing = [c.name for c in self.material.constants if c.name not in by_constant]
        if not missing:
            return by_constant
        if "mu_pa" in by_constant:
            mu = by_constant["mu_pa"]
        elif "young_pa" in by_constant:
            mu = by_constant["young_pa"] / (2 * (1 + by_constant["poisson"]))
        else:
            # With κ = λ = 0 what is left of the shear modulus is the own constants'.
            own_values = [by_constant.get(c.name, 0.0) for c in self.material.constants]
            mu = self.material.lame(ca.vertcat(*own_values))[1]
        if "lambda_pa" in by_constant:
            lame = by_constant["lambda_pa"]
        elif "kappa_pa" in by_constant:
            lame = by_constant["kappa_pa"] - 2 / 3 * mu
        else:
            nu = by_constant["poisson"]
            lame = 2 * mu * nu / (1 - 2 * nu)
        return {**by_constant, "mu_pa": mu, "lambda_pa": lame, "kappa_pa": lame + 2 / 3 * mu}


def find_source(
    region: str, material: Material, others: Iterable[Constant], known: Sequence[str]
) -> ConstantSource:
    """Find the constants of a region among the names of the given parameters.

    A constant is given by "region.constant" or else by the name of the constant alone, which is
    that of the whole body; a density also by `MASS`.

    Parameters
    ----------
    region : str
        Name of the region; "" for the rest of the body.
    others : iterable of Constant
        Constants of the region beside those of its material.
    known : sequence of str
        Names of the given parameters; those that the region does not use are ignored.

    Raises
    ------
    InputError
        If a constant is missing, if the density is given by itself and by the mass, or if the
        elastic parameters do not determine exactly one of the choices of the material. Elastic
        parameters with the prefix of the region must all be used; those without it need not.
    """

    def name_of(own: str) -> str | None:
        """Return the parameter that gives a constant, that of the region first."""
        prefixed = f"{region}.{own}" if region else own
        return prefixed if prefixed in known else own if own in known else None

    material_constants = [c.name for c in material.constants]
    elastic = _elastic_choices(material_constants)
    plain = [own for own in material_constants if not (elastic and own in ELASTIC)]
    plain += [c.name for c in others]
    names = {own: name for own in plain if (name := name_of(own)) is not None}
    where = f"region '{region}'" if region else "the body"
    subject = f"the material {material.name} of {where}"
    if elastic:
        specific = {own for own in ELASTIC if region and f"{region}.{own}" in known}
        available = {own for own in ELASTIC if name_of(own) is not None}
        fitting = [c for c in elastic if set(c) <= available and specific <= set(c)]
        if len(fitting) != 1:
            source_names = (
                ", ".join(str(name_of(own)) for own in ELASTIC if own in available) or "none"
            )
            raise InputError(
                f"the elastic parameters of {where} are {source_names}; {subject} expects "
                f"{_alternatives(elastic)}"
            )
        names |= {own: str(name_of(own)) for own in fitting[0]}
    if DENSITY.name in plain and MASS.name in known:
        if DENSITY.name in names:
            raise InputError(
                f"found {names[DENSITY.name]} and {MASS.name}, which both determine the density of "
                f"{where}; expected only one of them"
            )
        names[DENSITY.name] = MASS.name
    if lacking := [own for own in plain if own not in names]:
        first = f"{region}.{lacking[0]}" if region else lacking[0]
        raise InputError(
            f"{_listed(lacking)} missing: {subject} with its damping expects "
            f"{_expected(elastic, plain)}; write {first} = {{}} to estimate it (in Python "
            "cs.Unknown()), or a number"
        )
    return ConstantSource(material, names)


def _elastic_choices(owns: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Return the sets of elastic names that determine the material; empty without κ and λ."""
    volumetric = {"lambda_pa", "kappa_pa"} & set(owns)
    if not volumetric:
        return ()
    return _PAIRS if "mu_pa" in owns else _VOLUMETRIC_CHOICES


def elastic_names(material: Material) -> tuple[str, ...]:
    """Return the names of elastic parameters that can state or replace a material's constants,
    without repetitions; empty for a material without λ and κ.
    """
    owns = [c.name for c in material.constants]
    return tuple(dict.fromkeys(name for choice in _elastic_choices(owns) for name in choice))


def _alternatives(elastic: Sequence[Sequence[str]]) -> str:
    return ", or ".join(" and ".join(choice) for choice in elastic)


def _expected(elastic: Sequence[Sequence[str]], plain: Sequence[str]) -> str:
    own = ", ".join(plain)
    return f"{own}, and {_alternatives(elastic)}" if elastic else own


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names)} {'is' if len(names) == 1 else 'are'}"


def engineering_constants(lambda_pa: Any, mu_pa: Any) -> tuple[Any, Any]:
    """Return Young's modulus E [Pa] and Poisson's ratio ν from (λ, μ) [Pa], as numbers or
    expressions.
    """
    return (
        mu_pa * (3 * lambda_pa + 2 * mu_pa) / (lambda_pa + mu_pa),
        lambda_pa / (2 * (lambda_pa + mu_pa)),
    )
