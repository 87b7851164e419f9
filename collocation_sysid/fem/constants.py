"""The constants that terms of the model declare: what they are called, and what values make sense.

A term names each constant with its unit, as the problem file does: ``mu_pa``, ``gamma_r_s``. The
constant of a named region has the region in front, ``core.mu_pa``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

Scale = Literal["log", "linear"]

# Units by the ending of a name, longest first.
_UNITS = {
    "_kg_m3": "kg/m³",
    "_m_s2": "m/s²",
    "_1_s": "1/s",
    "_pa": "Pa",
    "_kg": "kg",
    "_s": "s",
    "_m": "m",
}


@dataclass(frozen=True)
class Constant:
    """One constant of a term.

    Attributes
    ----------
    name : str
        With its unit.
    symbol : str
        For tables and pictures; the name without its unit by default.
    meaning : str
        In a few words.
    bounds : (lower, upper)
        Of an estimate for which the problem gives none: wide enough for foams and rubbers alike.
    scale : {"log", "linear"}
        Whether the constant is a positive number whose logarithm is estimated, or any number.
    typical : float or None
        What a linear one may change by in a step, where its guess does not tell.
    usual : float or None
        Value in a soft foam or rubber, where there is no guess; moduli follow the stiffness.
    below : float
        Values are less than this.
    at_least : float
        Smallest value of a linear one.
    """

    name: str
    symbol: str = ""
    meaning: str = ""
    bounds: tuple[float, float] = (1e-6, 1e9)
    scale: Scale = "log"
    typical: float | None = None
    usual: float | None = None
    below: float = float("inf")
    at_least: float = -float("inf")

    @property
    def least(self) -> float:
        """Smallest value that makes sense."""
        return 0.0 if self.scale == "log" else self.at_least


STIFFNESS = (1.0, 1e9)
LAMBDA = Constant("lambda_pa", "λ", "first Lamé parameter", STIFFNESS)
MU = Constant("mu_pa", "μ", "shear modulus", STIFFNESS)
KAPPA = Constant("kappa_pa", "κ", "bulk modulus", (1.0, 1e10))
YOUNG = Constant("young_pa", "E", "Young's modulus", STIFFNESS)
POISSON = Constant("poisson", "ν", "Poisson's ratio", (1e-3, 0.495), "linear", 0.1, 0.3, 0.5)
GAMMA_R = Constant("gamma_r_s", "γ_r", "stiffness-proportional damping", (1e-7, 10.0), usual=3e-3)
GAMMA_M = Constant("gamma_m_1_s", "γ_m", "mass-proportional damping", (1e-4, 1e4), usual=0.3)
C10 = Constant("c10_pa", "C₁₀", "half the shear modulus, or a share of it", STIFFNESS)
C01 = Constant("c01_pa", "C₀₁", "factor of the second invariant", STIFFNESS)
C20 = Constant("c20_pa", "C₂₀", "factor of (Ī₁ − 3)²", (-1e9, 1e9), "linear")
C30 = Constant("c30_pa", "C₃₀", "factor of (Ī₁ − 3)³", (-1e9, 1e9), "linear")
GENT_LIMIT = Constant("gent_limit", "J_m", "largest Ī₁ − 3", (1e-2, 1e4), usual=50.0)
CHAIN_STRETCH = Constant(
    "chain_stretch", "λ_m", "stretch at which the chains lock", (1.01, 100.0), usual=5.0
)
# Of a branch of the memory, whose name goes in front: ``prony_1.share``.
SHARE = Constant(
    "share", "g", "stiffness that relaxes, over the long-term one", (0.0, 20.0), "linear", 0.1, 0.1,
    at_least=0.0,
)  # fmt: skip
TAU = Constant("tau_s", "τ", "relaxation time", (1e-4, 1e3), usual=0.3)
DENSITY = Constant("density_kg_m3", "ρ", "density", (1.0, 1e5))
# In place of the densities of all parts, which keep their ratios.
MASS = Constant("mass_kg", "m", "mass of the whole body", (1e-6, 1e3))
# Of an obstacle; names end with it, ``table_friction``.
FRICTION = Constant(
    "friction", "friction", "coefficient of friction", (0.0, 2.0), "linear", 0.1, 0.3, at_least=0.0
)
# Of a field, see `field`: how much of its first shape, of its second and so on.
MODE = Constant("field", "", "share of a shape", (-1e3, 1e3), "linear", 1.0, 0.0)
# Of a field with prior "two-phase", see `two_phase`; 1 in a body of one material.
CONTRAST = Constant("contrast", "contrast", "inclusion over surroundings", (0.02, 50.0), usual=1.0)
INSTANTANEOUS = Constant(
    "instantaneous_young_pa", "E₀", "Young's modulus at once, before anything has relaxed"
)

# The constants that have a symbol, by name: what tables and pictures look up.
KNOWN: Mapping[str, Constant] = {
    constant.name: constant
    for constant in (
        LAMBDA,
        MU,
        KAPPA,
        YOUNG,
        POISSON,
        GAMMA_R,
        GAMMA_M,
        C10,
        C01,
        C20,
        C30,
        GENT_LIMIT,
        CHAIN_STRETCH,
        SHARE,
        TAU,
        DENSITY,
        MASS,
        FRICTION,
        CONTRAST,
        INSTANTANEOUS,
    )
}


def bare(name: str) -> str:
    """The name of a constant without its region."""
    return name.rpartition(".")[2]


def unit_of(name: str) -> str:
    """The unit that a name ends with, "" if none."""
    return next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), "")


def symbol_of(name: str) -> str:
    """How a constant is written: its symbol, and its region behind."""
    region, _, own = name.rpartition(".")
    symbol = KNOWN[own].symbol if own in KNOWN else without_unit(own)
    return f"{symbol} {region}".strip()


def with_unit(name: str) -> str:
    """Symbol and unit of a constant, as at the head of its row."""
    return f"{symbol_of(name)} {unit_of(name)}".strip()


def constant_named(name: str) -> Constant:
    """The known constant of this name, or one of which nothing but the name is known."""
    own = bare(name)
    if own not in KNOWN and own.endswith(f"_{FRICTION.name}"):
        return replace(FRICTION, name=own, symbol=own.replace("_", " "))
    return replace(MODE, name=own) if is_mode(own) else KNOWN.get(own, Constant(own))


def mode(number: int) -> Constant:
    """The share of a shape of a field."""
    return replace(MODE, name=f"{MODE.name}_{number + 1}")


def is_mode(name: str) -> bool:
    """Whether a constant is the share of a shape of a field."""
    word, _, number = bare(name).rpartition("_")
    return word == MODE.name and number.isdigit()


def is_modulus(name: str) -> bool:
    """Whether a constant scales with the stiffness of its material."""
    return unit_of(name) == "Pa"


def is_density(name: str) -> bool:
    """Whether a parameter of this name gives a density."""
    return bare(name) in (DENSITY.name, MASS.name)


def is_damping(name: str) -> bool:
    """Whether a constant is one of the dampings, of which bodies at rest tell nothing."""
    return bare(name) in (GAMMA_R.name, GAMMA_M.name)


def usual_value(name: str, young_pa: float, poisson: float = 0.3) -> float | None:
    """A sensible value of a constant in a material of given stiffness; None where none is known.

    A modulus that is not known by name has the size of the shear modulus.
    """
    if not is_modulus(name):
        return constant_named(name).usual
    shear = young_pa / (2 * (1 + poisson))
    shares = {
        "lambda_pa": 2 * poisson / (1 - 2 * poisson),
        "kappa_pa": 2 * (1 + poisson) / (3 * (1 - 2 * poisson)),
        "young_pa": 2 * (1 + poisson),
        "c10_pa": 0.5,
        "c01_pa": 0.1,
        "c20_pa": 0.0,
        "c30_pa": 0.0,
    }
    return shear * shares.get(bare(name), 1.0)


def without_unit(name: str) -> str:
    """A name without the unit that it ends with."""
    return next((name.removesuffix(e) for e in _UNITS if name.endswith(e)), name)
