"""Sentences on the precision of the estimates, which the intervals alone do not show."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from ..common.display import LARGEST_CHANGE, predicted_change
from ..errors import listed
from ..fem.laws.constants import is_modulus, symbol_of, unit_of
from ..runs.result_content import Result
from ..statistics.budget.variance_sources import is_definition
from ..statistics.remedies import remedy_for


def alternative_sentences(result: Result) -> Iterator[str]:
    """Yield a sentence on each alternative: the values of constants that it defines differently, or
    else the change of a modulus, without its sign where the direction of gravity is not known.
    """
    known = result.estimates
    for each in result.alternatives:
        defined = [name for name in each.values if is_definition(each.assumption, name)]
        if defined:
            values = [
                f"{symbol_of(name)} about {each.values[name]:.3g} {unit_of(name)}".strip()
                if abs(each.values[name] - known[name].value)
                <= LARGEST_CHANGE * abs(known[name].value)
                else f"{symbol_of(name)} different by more than half"
                for name in defined
            ]
            yield f"{each.condition}: {listed(values)}"
        elif (name := _shown_modulus(each.values)) is not None and known[name].value:
            change = each.values[name] / known[name].value - 1
            if each.assumption == "rest_shape":
                size, end = f"{abs(change):.0%}", " (object.rest_shape is not stated)"
            else:
                size, end = f"{change:+.0%}", f"; {remedy_for(each.assumption)}"
            by = predicted_change(change, f"about {size}")
            yield f"{each.condition}, {symbol_of(name)} would change by {by}{end}"


def origin_sentences(result: Result) -> Iterator[str]:
    """Yield a sentence for each open question about the origin of the body: the half width of the
    interval of a modulus for each answer.
    """
    known = result.estimates
    for key in dict.fromkeys(each.key for each in result.origin_answers):
        answers = [each for each in result.origin_answers if each.key == key]
        name = _shown_modulus(answers[0].half_widths)
        if name is None or (interval := known[name].combined95) is None or not known[name].value:
            continue
        now = (interval[1] - interval[0]) / 2 / abs(known[name].value)
        widths = [f'{each.half_widths[name]:.0%} for "{each.answer}"' for each in answers]
        yield (
            f"object.{key} is not stated: the 95 % interval of {symbol_of(name)} is ±{now:.0%}; it "
            f"would be ±{', ±'.join(widths)}"
        )


def _shown_modulus(names: Iterable[str]) -> str | None:
    """Return Young's modulus among some estimates, or else the first modulus; None without one."""
    moduli = [name for name in names if is_modulus(name)]
    return next((name for name in moduli if name.endswith("young_pa")), next(iter(moduli), None))
