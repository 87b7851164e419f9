"""Energies in powers of the principal stretches with 1 to 4 terms: Ogden's law and Hill's foam.

Ogden (1972), with isochoric stretches λ̄ᵢ = J^(−1/3) λᵢ:

    ψ = Σ μ/α (λ̄₁^α + λ̄₂^α + λ̄₃^α − 3) + ½ κ (J − 1)²,   G = ½ Σ μ α.

Hill (1978) and Storåkers (1986), "hyperfoam" in finite-element programs:

    ψ = Σ 2μ/α² (λ₁^α + λ₂^α + λ₃^α − 3 + (J^(−αβ) − 1)/β),   G = Σ μ,   κ = Σ 2μ (⅓ + β).

Both are functions of Ī₁ − 3, Ī₂ − 3 and J and smooth where stretches coincide, see `power_traces`.
They are also smooth at α = 0 and β = 0, whose limits are finite.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from ..chain_rule import ChainRule, PartialIndex, SymbolicFunction
from .constants import MOST_TERMS
from .invariants import reduced_invariants
from .power_traces import PowerTraces

# (tr C̄^(α/2) − 3) / α² as a function of α.
ScaledExcess = Callable[[ca.SX], ca.SX]

# Rates |r| below which (e^(r x) − 1 − r x)/r² is a power series: the quotient loses digits like
# 10⁻¹⁶/r².
SERIES_RATE = 0.02
# Number of invariants, which come before the constants among the arguments of an energy.
INVARIANTS = 3


@dataclass(frozen=True, eq=False)
class PowerLawEnergy:
    """Energy density in powers of the principal stretches, with a number of terms."""

    # ``density(J, scaled_excess, constants) -> ψ`` with constants by name.
    density: Callable[[ca.SX, ScaledExcess, Mapping[str, ca.SX]], ca.SX]
    names: tuple[str, ...]  # names of the constants in the order of θ

    def __call__(self, F: ca.SX, **constants: ca.SX) -> ca.SX:
        first, second, ratio = ca.vertsplit(reduced_invariants(F))
        traces = PowerTraces(first, second)
        return self.density(ratio, lambda alpha: traces.scaled_excess(alpha)(()), constants)

    def symbolic(self, F: ca.SX, values: ca.SX) -> SymbolicFunction:
        """Return the energy density as a function of the invariants of F and the constants.

        Its partial derivatives are evaluated with all terms sharing the nodes, see `power_traces`.

        Parameters
        ----------
        F : (3, 3) SX
        values : (c,) SX
            Constants in the order of `names`.
        """
        arguments = ca.vertcat(reduced_invariants(F), values)
        y = ca.SX.sym("y", arguments.numel())
        first, second, ratio = ca.vertsplit(y[:INVARIANTS])
        constants = {name: y[INVARIANTS + k] for k, name in enumerate(self.names)}
        traces = PowerTraces(first, second)
        excesses: list[SymbolicFunction] = []

        def scaled_excess(alpha: ca.SX) -> ca.SX:
            partial = traces.scaled_excess(alpha)
            excess = SymbolicFunction(
                ca.vertcat(first, second, alpha), lambda indices: list(map(partial, indices))
            )
            excesses.append(excess)
            return excess.symbol()

        partials: dict[PartialIndex, ca.SX] = {(): self.density(ratio, scaled_excess, constants)}
        rule = ChainRule(tuple(excesses))

        def partial(index: PartialIndex) -> ca.SX:
            if index not in partials:
                partials[index] = rule.jacobian(partial(index[:-1]), y[index[-1]])
            return partials[index]

        def evaluate(indices: Sequence[PartialIndex]) -> list[ca.SX]:
            return ca.substitute(rule.eliminate(list(map(partial, indices))), [y], [arguments])

        return SymbolicFunction(arguments, evaluate)


def is_power_law(material: str) -> bool:
    """Return whether a material of this name is Ogden's or a compressible foam: "ogden-…" or
    "hyperfoam-…".
    """
    return material.startswith(("ogden-", "hyperfoam-"))


def term_numbers(names: Iterable[str]) -> range:
    """Return the numbers 1, 2, … of the terms of a law with these constants, one for each
    ``alpha_``.
    """
    return range(1, 1 + sum(name.startswith("alpha_") for name in names))


def _ogden_density(
    ratio: ca.SX, scaled_excess: ScaledExcess, constants: Mapping[str, ca.SX]
) -> ca.SX:
    energy = 0.5 * constants["kappa_pa"] * (ratio - 1) ** 2
    for p in term_numbers(constants):
        alpha = constants[f"alpha_{p}"]
        energy += constants[f"mu_{p}_pa"] * alpha * scaled_excess(alpha)
    return energy


def _hyperfoam_density(
    ratio: ca.SX, scaled_excess: ScaledExcess, constants: Mapping[str, ca.SX]
) -> ca.SX:
    log_j = ca.log(ratio)
    energy = ca.SX(0)
    for p in term_numbers(constants):
        alpha = constants[f"alpha_{p}"]
        beta = constants[f"beta_{p}"]
        # λ₁^α + λ₂^α + λ₃^α = J^(α/3) tr C̄^(α/2); the terms linear in ln J cancel.
        shape = ca.exp(alpha / 3 * log_j) * scaled_excess(alpha)
        volume = _exponential_remainder(alpha / 3, log_j) / 3
        volume += beta * _exponential_remainder(-alpha * beta, log_j)
        energy += 2 * constants[f"mu_{p}_pa"] * (shape + volume)
    return energy


def _exponential_remainder(rate: ca.SX, x: ca.SX) -> ca.SX:
    """Return (e^(r x) − 1 − r x) / r², which tends to x²/2 for small rates r."""
    is_small = ca.fabs(rate) < SERIES_RATE
    # The branch that is not taken must be finite, because derivatives multiply it with zero.
    safe_rate = ca.if_else(is_small, SERIES_RATE, rate)
    quotient = (ca.exp(safe_rate * x) - 1 - safe_rate * x) / safe_rate**2
    small = ca.if_else(is_small, rate, 0) * x
    series = ca.SX(1)
    # The error is below 10⁻¹⁶ for |r x| < 0.1, which is |ln J| < 5.
    for k in range(8, 0, -1):
        series = 1 + small / (k + 2) * series
    return ca.if_else(is_small, x**2 / 2 * series, quotient)


# Energies of Ogden's material, "ogden-1" to "ogden-4", with the constants mu_1_pa, alpha_1,
# mu_2_pa, … and, last, kappa_pa.
OGDEN = {
    f"ogden-{terms}": PowerLawEnergy(
        _ogden_density,
        (*(name for p in range(1, terms + 1) for name in (f"mu_{p}_pa", f"alpha_{p}")), "kappa_pa"),
    )
    for terms in range(1, MOST_TERMS + 1)
}
# Energies of Hill's compressible foam, "hyperfoam-1" to "hyperfoam-4", with the constants mu_1_pa,
# alpha_1, beta_1, mu_2_pa, ….
HYPERFOAM = {
    f"hyperfoam-{terms}": PowerLawEnergy(
        _hyperfoam_density,
        tuple(
            name for p in range(1, terms + 1) for name in (f"mu_{p}_pa", f"alpha_{p}", f"beta_{p}")
        ),
    )
    for terms in range(1, MOST_TERMS + 1)
}
