"""What θ holds: the constants that the parts of a body declare, and the names that give them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import InputError, hint_at
from .constants import DENSITY, MASS, Constant
from .moduli import Source, elastic_names, source_of
from .node_force import NodeForce
from .regions import BodyPart

Theta = Sequence[float] | Array


class Model:
    """A sum of terms, part by part.

    Parameters
    ----------
    parts : tuple of BodyPart
    forces : tuple of NodeForce
        Of users.

    Attributes
    ----------
    constants : dict of name to Constant
        What θ holds, in its order: those of the parts, then those of the forces.

    Raises
    ------
    InputError
        If two constants have one name.
    """

    def __init__(self, parts: tuple[BodyPart, ...], forces: tuple[NodeForce, ...] = ()) -> None:
        self.parts, self.forces = parts, forces
        self.constants: dict[str, Constant] = {
            part.full_name(c.name): c for part in parts for c in part.constants
        }
        for force in forces:
            for constant in force.constants:
                if constant.name in self.parameter_names:
                    raise InputError(
                        f"force {force.name!r} has the constant {constant.name!r}, which another "
                        "part of the body has; expected a name of its own"
                    )
                self.constants[constant.name] = constant

    def sources(self, known: Sequence[str]) -> list[Source]:
        """For each part, which of the names that are known give its constants.

        Raises
        ------
        InputError
            If a constant is missing or given twice.
        """
        return [
            source_of(
                part.name, part.material, part.constants[len(part.material.constants) :], known
            )
            for part in self.parts
        ]

    def used_names(self, known: Sequence[str]) -> set[str]:
        """Those of the names that are known which give its constants."""
        own = {name for source in self.sources(known) for name in source.names.values()}
        return own | self._of_forces

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names that a parameter may have: constants, what may stand for them, and shared ones."""
        names = []
        for part in self.parts:
            owns = [c.name for c in part.constants] + list(elastic_names(part.material))
            owns.append(DENSITY.name)
            names += [part.full_name(own) for own in owns] + owns
        return tuple(dict.fromkeys([*names, MASS.name, *self.constants]))

    @property
    def _of_forces(self) -> set[str]:
        return {c.name for force in self.forces for c in force.constants}

    def assembled(self, values: Mapping[str, Any]) -> list[Any]:
        """θ from values by the user's names: numbers, or CasADi expressions.

        Raises
        ------
        InputError
            If a constant is missing or given twice.
        """
        theta = []
        for part, source in zip(self.parts, self.sources(list(values)), strict=True):
            found = source.constants(values)
            if source.names.get(DENSITY.name) == MASS.name:
                found[DENSITY.name] *= part.per_mass_1_m3
            theta += [found[c.name] for c in part.constants]
        for name in list(self.constants)[len(theta) :]:
            if name not in values:
                raise InputError("no value is given of this constant of a force", None, name)
            theta.append(values[name])
        return theta

    def theta(self, values: Mapping[str, float]) -> Array:
        """(k,) constants from values by the user's names; values of other bodies do not matter.

        Raises
        ------
        InputError
            If one is missing or given twice.
        """
        return np.array([float(value) for value in self.assembled(values)])

    def lame(self, theta: Theta) -> dict[str, tuple[float, float]]:
        """Small-strain (λ, μ) [Pa] of each part by its name."""
        found = {}
        for part, mine in zip(self.parts, self.split(np.asarray(theta, dtype=float)), strict=True):
            values = part.material.lame(mine[: len(part.material.constants)]).full().ravel()
            found[part.name] = (float(values[0]), float(values[1]))
        return found

    def weighed_by(self, names: Collection[str]) -> list[str]:
        """Parts whose densities parameters of these names give.

        A density that is stated for a region alone stays, unless ``core.density_kg_m3`` or
        ``mass_kg`` is among them.
        """
        return [
            part.name
            for part in self.parts
            if MASS.name in names
            or part.full_name(DENSITY.name) in names
            or (DENSITY.name in names and not part.own_density)
        ]

    def split(self, theta: Any) -> list[Any]:
        """θ, numbers or a CasADi expression, part by part."""
        return [theta[a:b] for a, b in pairwise(self.starts)]

    @cached_property
    def starts(self) -> list[int]:
        """Where the constants of each part begin in θ, and where the last end."""
        return [0, *np.cumsum([len(part.constants) for part in self.parts]).tolist()]

    def elastic(self, constants: Mapping[str, float]) -> Array:
        """θ without damping.

        Raises
        ------
        InputError
            For a name that the model does not know, or one that is missing.
        """
        for name in constants:
            if name not in self.parameter_names:
                hint = hint_at(name, self.parameter_names)
                raise InputError(
                    f"no constant {name!r}; expected {', '.join(self.constants)}{hint}"
                )
        stored = {p.full_name(c.name) for p in self.parts for c in p.material.constants}
        return self.theta({**dict.fromkeys(set(self.constants) - stored, 0.0), **constants})
