"""Names, units, symbols and admissible values of the constants of the model.

Each term of the model (material, damping law, field, …) declares its constants as `Constant`. A
name ends with its unit, as in the problem file: ``mu_pa``, ``gamma_r_s``. The constant of a named
region is preceded by the region: ``core.mu_pa``.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from ...common.validated_classes import validated
from ...common.validated_types import FileName, Finite, Positive
from ...errors import InputError

Scale = Literal["log", "linear"]

# Unit by the suffix of a name, longest suffix first.
_UNITS = {
    "_kg_m3": "kg/m³",
    "_n_m2": "N m²",
    "friction_n_m": "N m",
    "_1_m": "1/m",
    "_n": "N",
    "_m_s2": "m/s²",
    "_pa_s": "Pa s",
    "_1_s": "1/s",
    "_pa": "Pa",
    "_kg": "kg",
    "_k": "K",
    "_s": "s",
    "_m": "m",
}


@validated
@dataclass(frozen=True)
class Constant:
    """Definition of one constant of the model.

    Attributes
    ----------
    name : str
        Name with unit.
    symbol : str
        Symbol for tables and plots; "" if there is none.
    meaning : str
        Short description.
    bounds : (lower, upper)
        Bounds of an estimate if the problem states none: wide enough for foams and rubbers.
    scale : {"log", "linear"}
        Whether the constant is positive and its logarithm is estimated, or its value of any sign.
    typical : float or None
        Typical change of a linear constant in one step of the solver; None to use its guess.
    usual : float or None
        Value in a soft foam or rubber, used without a guess; None if there is none. Moduli follow
        the stiffness instead, see `usual_value`.
    below : float
        Upper limit of admissible values, exclusive.
    at_least : float
        Smallest admissible value of a linear constant; not used for a logarithmic one.
    prior : (mean, deviation) or None
        Normal prior of an estimate if the problem states none; None for no prior.
    widest : (lower, upper) or None
        Bounds of a second search if the first ended at one of `bounds` that the problem does not
        state: what is physically possible. None for constants without one.
    may_be_negative : bool
        Whether a logarithmic constant may be negative beyond its default bounds: a second search
        that starts at its lower one, or a negative guess, then has a linear scale.

    Raises
    ------
    InputError
        If the scale is unknown, the lower bound is not below the upper one, or the lower bound of
        a logarithmic constant is not positive.
    """

    name: FileName
    symbol: str = ""
    meaning: str = ""
    bounds: tuple[float, float] = (1e-6, 1e9)
    scale: Scale = "log"
    typical: Positive | None = None
    usual: Finite | None = None
    below: float = float("inf")
    at_least: float = -float("inf")
    prior: tuple[Finite, Positive] | None = None
    widest: tuple[float, float] | None = None
    may_be_negative: bool = False

    def __post_init__(self) -> None:
        lower, upper = self.bounds
        if not lower < upper or (self.scale == "log" and lower <= 0):
            zero = "0 < " if self.scale == "log" else ""
            remedy = (
                ', or scale = "linear" for a constant that may be zero or negative' if zero else ""
            )
            raise InputError(
                f"bounds of the constant {self.name!r} are {lower:g} and {upper:g}; expected "
                f"{zero}lower < upper{remedy}"
            )

    @property
    def plausible(self) -> float:
        """Usual value, or 1 without one, within the bounds."""
        return min(max(1.0 if self.usual is None else self.usual, self.bounds[0]), self.bounds[1])


# Default bounds of a stiffness [Pa]: softer than any gel, stiffer than any rubber.
STIFFNESS = (1.0, 1e9)
# Stiffness of anything solid [Pa]; diamond has 1.2e12.
ANY_STIFFNESS = (1e-3, 1e13)
# Factor of a power or of an invariant [Pa], of any sign.
ANY_FACTOR = (-1e13, 1e13)
LAMBDA = Constant(
    "lambda_pa",
    "λ",
    meaning="first Lamé parameter",
    bounds=STIFFNESS,
    widest=ANY_STIFFNESS,
    may_be_negative=True,
)
MU = Constant("mu_pa", "μ", meaning="shear modulus", bounds=STIFFNESS, widest=ANY_STIFFNESS)
KAPPA = Constant("kappa_pa", "κ", meaning="bulk modulus", bounds=(1.0, 1e10), widest=ANY_STIFFNESS)
YOUNG = Constant("young_pa", "E", meaning="Young's modulus", bounds=STIFFNESS, widest=ANY_STIFFNESS)
POISSON = Constant(
    "poisson",
    "ν",
    meaning="Poisson's ratio",
    bounds=(1e-3, 0.495),
    scale="linear",
    typical=0.1,
    usual=0.3,
    below=0.5,
    at_least=-0.99,
    widest=(-0.9, 0.4999),
)
GAMMA_R = Constant(
    "gamma_r_s",
    "γ_r",
    meaning="stiffness-proportional damping",
    bounds=(1e-7, 10.0),
    usual=3e-3,
    widest=(1e-7, 1e4),
)
GAMMA_M = Constant(
    "gamma_m_1_s",
    "γ_m",
    meaning="mass-proportional damping",
    bounds=(1e-4, 1e4),
    usual=0.3,
    widest=(1e-4, 1e7),
)
C10 = Constant(
    "c10_pa",
    "C₁₀",
    meaning="half the shear modulus, or a part of it",
    bounds=STIFFNESS,
    widest=ANY_STIFFNESS,
)
C01 = Constant(
    "c01_pa",
    "C₀₁",
    meaning="factor of the second invariant",
    bounds=STIFFNESS,
    widest=ANY_STIFFNESS,
    may_be_negative=True,
)
C20, C30 = (
    Constant(
        f"c{power}0_pa",
        f"C{subscript}₀",
        meaning=f"factor of (Ī₁ − 3){superscript}",
        bounds=(-1e9, 1e9),
        scale="linear",
        widest=ANY_FACTOR,
    )
    for power, subscript, superscript in ((2, "₂", "²"), (3, "₃", "³"))
)
GENT_LIMIT = Constant("gent_limit", "J_m", meaning="largest Ī₁ − 3", bounds=(1e-2, 1e4), usual=50.0)
CHAIN_STRETCH = Constant(
    "chain_stretch",
    "λ_m",
    meaning="stretch at which the chains lock",
    bounds=(1.01, 100.0),
    usual=5.0,
)
# Most terms of a law in powers of the stretches, see `ogden`.
MOST_TERMS = 4
# Largest |α|, for which `power_traces` is accurate.
LARGEST_EXPONENT = 60.0
_SUBSCRIPTS = "₁₂₃₄"
# The first term gives the scale of the stiffness and is positive. Those after it may be negative,
# as in Ogden's own constants of rubber.
MU_TERMS = (
    Constant(
        "mu_1_pa",
        "μ₁",
        meaning="factor of the first power of the stretches",
        bounds=STIFFNESS,
        widest=ANY_STIFFNESS,
        may_be_negative=True,
    ),
    *(
        Constant(
            f"mu_{p}_pa",
            f"μ{_SUBSCRIPTS[p - 1]}",
            meaning="factor of a power",
            bounds=(-1e9, 1e9),
            scale="linear",
            widest=ANY_FACTOR,
        )
        for p in range(2, MOST_TERMS + 1)
    ),
)
# Usual exponents: different ones, because the derivatives by those of equal terms are equal.
USUAL_EXPONENTS = (2.0, 4.0, -2.0, -4.0)
ALPHA_TERMS = tuple(
    Constant(
        f"alpha_{p}",
        f"α{_SUBSCRIPTS[p - 1]}",
        meaning="exponent of the stretches",
        # The first exponent has the sign of μ₁, which is positive.
        bounds=(0.1 if p == 1 else -25.0, 25.0),
        scale="linear",
        typical=1.0,
        usual=usual,
        below=LARGEST_EXPONENT,
        at_least=-LARGEST_EXPONENT,
        widest=(-0.99 * LARGEST_EXPONENT, 0.99 * LARGEST_EXPONENT),
    )
    for p, usual in enumerate(USUAL_EXPONENTS, start=1)
)
# At β = −⅓ the bulk modulus of a term is zero; ν/(1 − 2ν) of a term alone, usually with ν = 0.3.
BETA_TERMS = tuple(
    Constant(
        f"beta_{p}",
        f"β{_SUBSCRIPTS[p - 1]}",
        meaning="compressibility of a power, ν/(1 − 2ν)",
        bounds=(0.0, 50.0),
        scale="linear",
        typical=0.2,
        usual=0.75,
        at_least=-0.33,
        widest=(-0.32, 1e4),
    )
    for p in range(1, MOST_TERMS + 1)
)
# Shares of the shear modulus in the factors μ_p of a material without guesses. They have the signs
# of the usual exponents, and are not zero, where nothing depends on the exponent.
USUAL_SHARES = (1.0, 0.1, -0.1, -0.05)
# Constants of a branch of the memory, preceded by the name of the branch: ``prony_1.share``.
SHARE = Constant(
    "share", "g", meaning="stiffness that relaxes, relative to the long-term one",
    bounds=(0.0, 20.0), scale="linear", typical=0.1, usual=0.1, at_least=0.0, widest=(0.0, 1e6),
)  # fmt: skip
TAU = Constant(
    "tau_s", "τ", meaning="relaxation time", bounds=(1e-4, 1e3), usual=0.3, widest=(1e-7, 1e8)
)
# Shift of the relaxation times with the temperature, see `time_shift`; the usual values of Williams,
# Landel & Ferry are those at the glass transition.
LOG_SHIFT = Constant(
    "log10_shift",
    "log a_T",
    meaning="logarithm of the relaxation times over those of the reference temperature",
    bounds=(-30.0, 30.0),
    scale="linear",
    typical=1.0,
    usual=0.0,
)
WLF_C1 = Constant(
    "wlf_c1", "C₁", meaning="factor of Williams, Landel & Ferry", bounds=(0.1, 100.0), usual=17.44
)
WLF_C2 = Constant(
    "wlf_c2_k",
    "C₂",
    meaning="temperature of Williams, Landel & Ferry",
    bounds=(1.0, 1e3),
    usual=51.6,
)
DENSITY = Constant("density_kg_m3", "ρ", meaning="density", bounds=(1.0, 1e5))
# Total mass, which replaces the densities of all parts; their ratios are kept.
MASS = Constant("mass_kg", "m", meaning="mass of the whole body", bounds=(1e-6, 1e3))
# Friction coefficient of an obstacle, preceded by the obstacle's name: ``table_friction``.
FRICTION = Constant(
    "friction",
    "friction",
    meaning="coefficient of friction",
    bounds=(0.0, 2.0),
    scale="linear",
    typical=0.1,
    usual=0.3,
    at_least=0.0,
    widest=(0.0, 20.0),
)
# Coefficient of a shape of a field, see `spatial_field`; names are field_1, field_2, ….
FIELD_COEFFICIENT = Constant(
    "field",
    "",
    meaning="coefficient of a shape",
    bounds=(-1e3, 1e3),
    scale="linear",
    typical=1.0,
    usual=0.0,
    prior=(0.0, 1.0),
)
# Constants of fibres, see `fibres`.
FIBRE_STIFFNESS = Constant(
    "fibre_pa", "E_f", meaning="stiffness that fibres add along themselves", bounds=STIFFNESS
)
FIBRE_EXPONENT = Constant(
    "fibre_exponent", "k_f", meaning="stiffening of stretched fibres", bounds=(1e-3, 1e3), usual=1.0
)
FIBRE_DISPERSION = Constant(
    "fibre_dispersion",
    "κ_f",
    meaning="scatter of directions of fibres, 1/3 if isotropic",
    bounds=(0.0, 0.333),
    scale="linear",
    typical=0.1,
    usual=0.1,
    at_least=0.0,
    below=0.334,
)
FIBRE_ANGLE = Constant(
    "fibre_angle_rad",
    "β_f",
    meaning="angle of fibres from their stated direction",
    bounds=(-np.pi / 2, np.pi / 2),
    scale="linear",
    typical=0.1,
)
# Stiffnesses of the section of a slender body, see `fem.rods`.
BENDING = Constant("bending_n_m2", "EI", "bending stiffness", bounds=(1e-7, 1e4), usual=1e-3)
TORSION = Constant("torsion_n_m2", "GJ", "torsional stiffness", bounds=(1e-7, 1e4), usual=1e-3)
AXIAL = Constant("axial_n", "EA", "axial stiffness", bounds=(1e-1, 1e8), usual=1e3)
FRICTION_MOMENT = Constant(
    "friction_n_m", "m_c", "moment at which layers slip", bounds=(1e-9, 1e3), usual=1e-4
)
STICK = Constant(
    "stick_n_m2", "S", "bending stiffness of friction before slip", bounds=(1e-8, 1e4), usual=1e-3
)
NATURAL_STRAINS = tuple(
    Constant(name, symbol, meaning, bounds=(-1e3, 1e3), scale="linear", typical=0.5, usual=0.0)
    for name, symbol, meaning in (
        ("curvature_1_1_m", "κ₁", "natural curvature about the first director"),
        ("curvature_2_1_m", "κ₂", "natural curvature about the second director"),
        ("twist_1_m", "τ", "natural twist"),
    )
)
NaturalCurvature = bool | Literal["affine"]
# Of natural strains that are affine in the arc length; those above are then at the beginning.
NATURAL_ENDS = tuple(
    replace(
        constant,
        name=constant.name.replace("_1_m", "_end_1_m"),
        symbol=f"{constant.symbol} end",
        meaning=f"{constant.meaning} at the end",
    )
    for constant in NATURAL_STRAINS
)
INSTANTANEOUS = Constant(
    "instantaneous_young_pa", "E₀", meaning="instantaneous Young's modulus, before relaxation"
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
        *MU_TERMS,
        *ALPHA_TERMS,
        *BETA_TERMS,
        SHARE,
        TAU,
        LOG_SHIFT,
        WLF_C1,
        WLF_C2,
        DENSITY,
        MASS,
        FRICTION,
        FIBRE_STIFFNESS,
        FIBRE_EXPONENT,
        FIBRE_DISPERSION,
        FIBRE_ANGLE,
        BENDING,
        TORSION,
        AXIAL,
        FRICTION_MOMENT,
        STICK,
        *NATURAL_STRAINS,
        *NATURAL_ENDS,
        INSTANTANEOUS,
    )
}


def without_region(name: str) -> str:
    """Return the name of a constant without its region or branch: what follows the last dot."""
    return name.rpartition(".")[2]


def unit_of(name: str) -> str:
    """Return the unit with which a name ends, as printed ("kg/m³"), or "" if it has none."""
    return next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), "")


def symbol_of(name: str) -> str:
    """Return the symbol of a constant, followed by a blank and the prefix (region or branch) of its
    name if it has one: "μ core"; for an unknown constant the name without its unit.
    """
    region, _, name_in_region = name.rpartition(".")
    symbol = (
        KNOWN[name_in_region].symbol if name_in_region in KNOWN else without_unit(name_in_region)
    )
    return f"{symbol} {region}".strip()


_LETTERS = {
    "α": "alpha",
    "β": "beta",
    "γ": "gamma",
    "κ": "kappa",
    "λ": "lambda",
    "μ": "mu",
    "ν": "nu",
    "ρ": "rho",
    "τ": "tau",
}


def constants_with_symbol(word: str) -> list[str]:
    """Return the names of the constants whose symbol is a word, such as "E", "ν" or "nu", or begins
    with it and an underscore, such as "gamma"; empty for none.
    """

    def spelled(symbol: str) -> str:
        plain = unicodedata.normalize("NFKC", symbol)
        return "".join(_LETTERS.get(unicodedata.normalize("NFKC", a), a) for a in plain).lower()

    symbols = {name: spelled(each.symbol) for name, each in KNOWN.items() if each.symbol}
    sought = spelled(word)
    exact = [name for name, symbol in symbols.items() if symbol == sought]
    return exact or [name for name, symbol in symbols.items() if symbol.startswith(f"{sought}_")]


def symbol_with_unit(name: str) -> str:
    """Return symbol and unit of a constant, as in the heading of a table row: "μ core Pa"."""
    return f"{symbol_of(name)} {unit_of(name)}".strip()


def constant_named(name: str) -> Constant:
    """Return the known constant of this name, or one with default properties if it is unknown.

    The region of the name is ignored, and the result has the name without it. Names that end with
    ``_friction`` are coefficients of friction, ``field_1``, ``field_2``, … coefficients of fields.
    """
    bare_name = without_region(name)
    if bare_name not in KNOWN and bare_name.endswith(f"_{FRICTION.name}"):
        return replace(FRICTION, name=bare_name, symbol=bare_name.replace("_", " "))
    word, _, number = bare_name.rpartition("_")
    if word == FIELD_COEFFICIENT.name and number.isdigit():
        return replace(FIELD_COEFFICIENT, name=bare_name)
    return KNOWN.get(bare_name, Constant(bare_name))


def is_known_constant(name: str) -> bool:
    """Return whether the package defines a constant of this name; the region is ignored. Others are
    constants of user-defined laws, defined by their `Constant` alone.
    """
    return constant_named(name) != Constant(without_region(name))


def field_coefficient(number: int) -> Constant:
    """Return the constant for the coefficient of a shape of a field, by the shape's index."""
    return replace(FIELD_COEFFICIENT, name=f"{FIELD_COEFFICIENT.name}_{number + 1}")


def is_modulus(name: str) -> bool:
    """Return whether a constant scales with the stiffness of its material: its unit is Pa."""
    return unit_of(name) == "Pa"


def is_limitless(name: str, value: float) -> bool:
    """Return whether a value is that of a share of memory so large that no long-term stiffness is
    left, as of a liquid.
    """
    assert SHARE.widest is not None
    return without_region(name) == SHARE.name and value > 0.99 * SHARE.widest[1]


def is_density(name: str) -> bool:
    """Return whether a parameter of this name determines a density: a density or the total mass."""
    return without_region(name) in (DENSITY.name, MASS.name)


def is_damping(name: str) -> bool:
    """Return whether a constant is γ_r or γ_m, which bodies at rest do not determine."""
    return without_region(name) in (GAMMA_R.name, GAMMA_M.name)


T = TypeVar("T")


def with_undamped(statements: Mapping[str, T], constants: Iterable[str]) -> Mapping[str, T | float]:
    """Return statements with zero for those of γ_r and γ_m among the constants that are not stated,
    for specimens, on whose equilibria no damping acts.
    """
    missing = {name: 0.0 for name in constants if is_damping(name) and name not in statements}
    return {**statements, **missing}


def usual_value(name: str, young_pa: float, poisson: float = 0.3) -> float | None:
    """Return a plausible value of a constant in a material of given stiffness; None if unknown.

    A modulus that is not known by name gets the shear modulus. Other constants have their `usual`
    value, whatever the stiffness.

    Parameters
    ----------
    name : str
        Name with or without a region.
    young_pa, poisson : float
        Young's modulus and Poisson's ratio of the material.
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
        **{term.name: share for term, share in zip(MU_TERMS, USUAL_SHARES, strict=True)},
    }
    return shear * shares.get(without_region(name), 1.0)


def without_unit(name: str) -> str:
    """Return a name without the unit with which it ends; the name itself if it ends with none."""
    return next((name.removesuffix(e) for e in _UNITS if name.endswith(e)), name)
