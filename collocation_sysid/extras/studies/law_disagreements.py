"""Dependence of estimates on the material law: estimates in which equally good laws disagree.

If the recordings do not distinguish between laws, an estimate is not more certain than the
difference between the laws' estimates, however small each interval is. This difference is one more
source in the uncertainty budget of the chosen law: the mean square difference of the other laws'
estimates, all equally likely.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...fem.laws.constants import is_damping, symbol_of, symbol_with_unit, without_region
from ...statistics.budget.variance_sources import BudgetLine
from ...statistics.estimates import IntervalCoordinate
from ...statistics.remedies import LAW
from .rows import Row

# Ratio of the largest to the smallest estimate above which equally good models disagree.
LEAST_DISAGREEMENT_RATIO = 1.05
# Moduli at small strain, which mean the same in every law, as damping coefficients do.
MODULI = ("young_pa", "poisson")


@dataclass(frozen=True)
class Disagreement:
    """Parameter in whose value equally good laws disagree."""

    name: str  # name of the parameter
    values: Mapping[str, float]  # mapping of str to float: estimate by law, the chosen one first
    chosen_budget: BudgetLine | None  # budget with the chosen law alone; None if it is not known
    # Combined interval with the difference between laws; None if the budget is not known.
    combined95: tuple[float, float] | None
    share: float  # share of the difference between laws in the variance

    def describe(self) -> str:
        """Return the one or two sentences for the user: the range of the parameter, and how the
        choice of the law widens its interval if that is known.
        """
        low = min(self.values.values())
        high = max(self.values.values())
        symbol = symbol_of(self.name)
        unit = symbol_with_unit(self.name).removeprefix(symbol)
        range_text = (
            f"The models that predict equally well have {symbol} from {low:.3g} to {high:.3g}{unit}"
        )
        conclusion = f"{range_text}: these recordings do not determine it better."
        if self.chosen_budget is None or self.combined95 is None:
            return conclusion
        ends, least = (
            "{:.3g} to {:.3g}".format(*w) for w in (self.combined95, self.chosen_budget.combined95)
        )
        share = f"{self.share:.0%} of the variance"
        return (
            f"{conclusion} Its combined interval is {ends} if the choice of the law is included "
            f"({share}), otherwise {least}."
        )


def is_comparable(name: str) -> bool:
    """Return whether a parameter means the same in every law: a modulus at small strain, or a
    damping coefficient.
    """
    return without_region(name) in MODULI or is_damping(name)


def find_disagreements(rows: Sequence[Row], chosen: Row) -> list[Disagreement]:
    """Return the moduli and damping coefficients whose estimates differ notably between models.

    Compared are Young's modulus, Poisson's ratio and damping coefficients, also of regions, that
    all models have with positive estimates. They differ notably if the largest estimate is more
    than `LEAST_DISAGREEMENT_RATIO` times the smallest. The order is that of the chosen model's
    parameters; empty if none differs.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `model_rows` of models that predict equally well; "model", "parameters" and "budget"
        are used.
    chosen : Row
        Chosen model, one of them (the same object).
    """
    others = [row for row in rows if row is not chosen]
    result = []
    for name in chosen["parameters"]:
        values = {r["model"]: r["parameters"].get(name) for r in (chosen, *others)}
        if is_comparable(name) and all(v and v > 0 for v in values.values()):
            estimates = {model: float(value or 0.0) for model, value in values.items()}
            if max(estimates.values()) > LEAST_DISAGREEMENT_RATIO * min(estimates.values()):
                result.append(
                    _disagreement(name, estimates, budget_line=chosen["budget"].get(name))
                )
    return result


def _disagreement(
    name: str, values: Mapping[str, float], budget_line: Mapping[str, object] | None
) -> Disagreement:
    if budget_line is None:
        return Disagreement(name, values, chosen_budget=None, combined95=None, share=0.0)
    line = BudgetLine(**budget_line)  # type: ignore[arg-type]
    coordinate = IntervalCoordinate.for_estimate(
        name, (*values.values(), *line.combined95), linear=False
    )
    coordinates = np.array([coordinate.from_value(value) for value in values.values()])
    with_law = line.with_source(
        LAW, float(np.sqrt(np.mean((coordinates - coordinates[0]) ** 2))), coordinate=coordinate
    )
    return Disagreement(
        name, values, chosen_budget=line, combined95=with_law.combined95, share=with_law.shares[LAW]
    )
