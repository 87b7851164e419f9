"""What the choice of a law is worth: numbers about which laws that predict alike disagree.

Recordings that do not tell laws apart do not tell a number better than by what these laws say of
it, however sure each of them is. That is one more source in the budget of the law that is chosen:
the mean square of how far the others are from it, each being as likely.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..display import Table
from ..fem.constants import bare, is_damping, symbol_of, with_unit
from ..statistics.budget import BudgetLine
from ..statistics.estimates import Coordinate
from ..statistics.remedies import LAW
from .table import Row

# Ratio of what alike models find beyond which they disagree.
APART = 1.05
# Moduli at small strain, which every law has; with dampings what means the same by any.
MODULI = ("young_pa", "poisson")


@dataclass(frozen=True)
class Disagreement:
    """A number that laws which predict alike disagree about.

    Attributes
    ----------
    name : str
    values : mapping of law to number, that of the chosen first
    without : BudgetLine or None
        The chosen one's, where its budget is known.
    combined95 : (lower, upper) or None
        Its combined interval, with what the laws disagree by.
    share : float
        Of its variance.
    """

    name: str
    values: Mapping[str, float]
    without: BudgetLine | None
    combined95: tuple[float, float] | None
    share: float

    @property
    def sentence(self) -> str:
        """For people."""
        low, high, symbol = (
            min(self.values.values()),
            max(self.values.values()),
            symbol_of(self.name),
        )
        unit = with_unit(self.name).removeprefix(symbol)
        said = f"By those that predict alike, {symbol} is {low:.3g} to {high:.3g}{unit}"
        told = f"{said}: these recordings do not tell it better."
        if self.without is None or self.combined95 is None:
            return told
        ends, least = (
            "{:.3g} to {:.3g}".format(*w) for w in (self.combined95, self.without.combined95)
        )
        share = f"{self.share:.0%} of the variance"
        return f"{told} Its combined interval is {ends} with the law ({share}), {least} without."


def disagreements(rows: Sequence[Row], chosen: Row) -> list[Disagreement]:
    """The numbers that models disagree about, of which the chosen one is one.

    Parameters
    ----------
    rows : sequence of Row
        Of those that predict alike.
    chosen : Row
    """
    others = [row for row in rows if row is not chosen]
    told = []
    for name in chosen["parameters"]:
        values = {r["model"]: r["parameters"].get(name) for r in (chosen, *others)}
        if (bare(name) in MODULI or is_damping(name)) and all(v and v > 0 for v in values.values()):
            found = {model: float(value or 0.0) for model, value in values.items()}
            if max(found.values()) > APART * min(found.values()):
                told.append(_of_number(name, found, chosen["budget"].get(name)))
    return told


def _of_number(
    name: str, values: Mapping[str, float], known: Mapping[str, object] | None
) -> Disagreement:
    if known is None:
        return Disagreement(name, values, None, None, 0.0)
    line = BudgetLine(**known)  # type: ignore[arg-type]
    at = Coordinate.of(name, (*values.values(), *line.combined95), False)
    places = np.array([at.at(value) for value in values.values()])
    with_law = line.widened(LAW, float(np.sqrt(np.mean((places - places[0]) ** 2))), at)
    return Disagreement(name, values, line, with_law.combined95, with_law.shares[LAW])


def law_table(told: Sequence[Disagreement]) -> Table:
    """The numbers by law, with their spread and the chosen one's intervals."""
    laws = dict.fromkeys(model for each in told for model in each.values)
    rows = []
    for each in told:
        values = [each.values[law] for law in laws]
        spread = 100 * (max(values) / min(values) - 1)
        intervals = (
            w and "{:.3g} … {:.3g}".format(*w)
            for w in (each.without and each.without.combined95, each.combined95)
        )
        cells = (f"{value:.4g}" for value in values)
        rows.append(
            (with_unit(each.name), *cells, f"{spread:.0f} %", *(w or "" for w in intervals))
        )
    heads = ("", *laws, "spread", "combined interval", "with the law")
    return Table("Which law?", heads, tuple(rows))
