"""What the estimates would be under other assumptions than those of the intervals.

Intervals do not contain everything that may be different. An `Alternative` has the estimates if an
assumption that they rest on is replaced by another one: γ_r of another damping law, or moduli if the
mesh was scanned under gravity. An `OriginAnswer` has the intervals if it were stated how the body was
made or where its mesh comes from. Both follow from the budget to first order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import get_args

import numpy as np

from ...fem.body import Body, Made, MeshOrigin
from ...fem.laws.constants import is_modulus
from ...model.parameters import Parameters
from ..estimates import Estimate, IntervalCoordinate
from .combined_intervals import NORMAL_95
from .systematic_effects import ASSUMPTIONS, Assumptions
from .variance_sources import ALTERNATIVES, BudgetLine, VarianceSources, is_definition

# Smallest relative change of an estimate that is reported.
LEAST_CHANGE = 0.01
YOUNG = "young_pa"
# Relative change of E over the anisotropy along an axis from which on E is the modulus along it.
ALONG = 0.7


@dataclass(frozen=True)
class Alternative:
    """Estimates under another assumption, to first order."""

    assumption: str  # name of the assumption, such as "damping_law"
    condition: str  # what would have to be true, such as "with the damping law material"
    # mapping of str to float: estimates whose interval does not contain the effect, by name.
    values: Mapping[str, float]


@dataclass(frozen=True)
class OriginAnswer:
    """Half widths of the combined intervals for one answer to an open question about the body."""

    key: str  # key of the problem file, and argument of `Body`, that is not stated
    answer: str  # its value, such as "cast"
    # mapping of str to float: half width of the 95 % interval of each estimate over its value, by
    # name.
    half_widths: Mapping[str, float]


def find_alternatives(
    sources: VarianceSources, estimates: Mapping[str, Estimate], parameters: Parameters
) -> tuple[Alternative, ...]:
    """Return the alternatives that change a modulus, or a constant that they define differently, by
    `LEAST_CHANGE` or more; of an assumption with several components the one with the largest change.

    Parameters
    ----------
    sources : VarianceSources
        Sensitivities of the fit.
    estimates : mapping of str to Estimate
        Reported estimates, by name.
    parameters : Parameters
        Parameters with their coordinates and bounds.
    """
    largest: dict[str, tuple[float, Alternative]] = {}
    for name, step in sources.alternatives.items():
        row, _, component = name.partition(" ")
        values = {}
        change = 0.0
        for estimate, by_q in sources.derivatives.items():
            known = estimates.get(estimate)
            if known is None or known.statistical95 is None or sources.covers(row, estimate):
                continue
            linear, (low, high) = parameters.scale_and_bounds(estimate)
            at = IntervalCoordinate.for_estimate(estimate, (known.value,), linear=linear)
            moved = float(by_q @ step) * at.derivative(known.value)
            other = float(np.clip(at.to_value(at.from_value(known.value) + moved), low, high))
            if not moved:
                continue
            values[estimate] = other
            if is_modulus(estimate) or is_definition(row, estimate):
                change = max(change, abs(other - known.value) / max(abs(known.value), 1e-300))
        if change >= max(LEAST_CHANGE, largest.get(row, (0.0, None))[0]):
            condition = ALTERNATIVES[row].alternative.format(component=component)
            largest[row] = change, Alternative(row, condition, values)
    return tuple(alternative for _, alternative in largest.values())


def modulus_axis_sentence(
    sources: VarianceSources, estimates: Mapping[str, Estimate], anisotropy: float | None
) -> str:
    """Return a sentence on the axis of the mesh along which Young's modulus is measured, as in
    bending; "" if there is none, or if the deviation of the anisotropy changes E by less than
    `LEAST_CHANGE`.
    """
    known = estimates.get(YOUNG)
    if not anisotropy or known is None or not known.value or YOUNG not in sources.derivatives:
        return ""
    by_axis = {
        component: float(sources.derivatives[YOUNG] @ way) / known.value / anisotropy
        for name, way in zip(sources.names, sources.sensitivities.T, strict=True)
        for row, _, component in [name.partition(" ")]
        if row == "anisotropy"
    }
    axis = max(by_axis, key=lambda each: by_axis[each], default="")
    if not axis or by_axis[axis] < ALONG or by_axis[axis] * anisotropy < LEAST_CHANGE:
        return ""
    return (
        f"E is mainly the modulus along the {axis} axis of the mesh: if the body is 10 % stiffer "
        f"along it than across it, E is {by_axis[axis]:.0%} of this larger than across it"
    )


def origin_answers(
    sources: VarianceSources,
    lines: Mapping[str, BudgetLine],
    parameters: Parameters,
    body: Body,
    stated: Assumptions,
) -> Iterator[OriginAnswer]:
    """Yield the half widths for each answer to each open question about the origin of a body.

    A question is open if the body does not state the answer, and if an answer would change a
    deviation that `stated` does not have.

    Parameters
    ----------
    sources : VarianceSources
        Sensitivities of the fit.
    """
    rows = [row for row in ASSUMPTIONS if row.by_origin and vars(stated)[row.name] is None]
    for key, words, own, other in (
        ("made", get_args(Made), body.made, body.mesh_from),
        ("mesh_from", get_args(MeshOrigin), body.mesh_from, body.made),
    ):
        if own is not None or (key == "mesh_from" and body.rest_shape is not None):
            continue
        for word in words:
            if not any(word in row.by_origin for row in rows):
                continue
            half_widths = {}
            for name, line in lines.items():
                linear, _ = parameters.scale_and_bounds(name)
                at = IntervalCoordinate.for_estimate(name, (line.value,), linear=linear)
                by_q = sources.derivatives[name] * at.derivative(line.value)
                counted = sources.variances_of_assumptions(name, by_q)
                variance = (line.combined_std_error * at.derivative(line.value)) ** 2
                for row in rows:
                    now = row.usual_considered(other)
                    then = row.by_origin.get(word, now)
                    if then is None or then == now:
                        continue
                    if now is not None:
                        unit = counted.get(row.name, 0.0) / now**2
                    else:
                        unit = sum(
                            float(by_q @ step) ** 2
                            for each, step in sources.alternatives.items()
                            if each.partition(" ")[0] == row.name
                        )
                    variance += (then**2 - (now or 0.0) ** 2) * unit
                deviation = float(np.sqrt(max(0.0, variance))) / at.derivative(line.value)
                half_widths[name] = NORMAL_95 * deviation / max(abs(line.value), 1e-300)
            yield OriginAnswer(key, word, half_widths)
