"""Tests of two assumptions in every solve: constant stiffness, and clocks of equal rate.

A drift of the stiffness and a rate of the cameras' clock join the linearised fit as one more column
each, see `relaxation`. The uncertainty budget needs these columns anyway, so that a probe costs one
least-squares problem and no simulation. `probes` (``solve --probe``) relaxes all other assumptions,
refits parts of the data, and follows effects that are too large for one linear step.

A probe is *significant* if its amplitude is farther from zero than noise explains, and *relevant*
if relaxing the assumption changes what is reported. Only what is both gives concern, see
`trust.probe_concerns`: with much data any imperfection is significant, and with little data any
change is large.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..recording.nuisance import CLOCK_RATE
from .assumptions import ASSUMPTIONS
from .considered import Changes
from .distributions import normal_isf
from .relaxation import DRIFT, Answered, Probe, relaxed_probe, with_freedom

# Assumptions that are probed in every solve: both can be wrong while the residuals look white, bias
# the estimates, and are determined by a single recording.
ROUTINE = (DRIFT, CLOCK_RATE.name)
# Probability that any routine probe of a faultless run is significant, as of every other test of
# the verdict. The first order that a probe rests on is not exact: at a level of 1/200 one of six
# draws of the noise of one faultless recording was significant.
FALSE_ALARMS = 1e-4
# Standard deviation of the prior of a probe's amplitude, in deviations of the budget: it must not
# shrink towards the assumption that it tests, and stay bounded where the data say nothing.
WIDENING = 10.0
# Least change of an estimate that is relevant, in half widths of its statistical interval. A bias
# of a quarter of that (half a standard error) lowers the coverage of a 95 % interval to 92 %.
RELEVANT = 0.25


def probed_deviations(deviations: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return deviations in which none of the routine probes is None.

    That something is stated as exact is a reason to leave it out of the budget, but none to leave
    it untested: the table's own deviation stands in.

    Parameters
    ----------
    deviations : mapping of assumption or nuisance parameter to its deviation, None if exact
    """
    usual = {row.name: row.sigma for row in ASSUMPTIONS}
    usual[CLOCK_RATE.name] = CLOCK_RATE.considered or 0.0
    exact = [name for name in ROUTINE if deviations.get(name) is None]
    return {**deviations, **{name: usual[name] for name in exact}}


def routine_probes(answered: Answered) -> tuple[Probe, ...]:
    """Relax each routine assumption by one linear step from the answer.

    Parameters
    ----------
    answered : Answered
        An assumption that has no column in its `changes`, because it is estimated or changes
        nothing, is not probed.

    Returns
    -------
    tuple of Probe
        With `routine` set; `told` is empty where the amplitude is not significant.
    """
    limit = significance(answered.changes)
    found = []
    for name in ROUTINE:
        wide = with_freedom(answered.fit, answered.changes, name, WIDENING)
        if any(block.slope[..., len(answered.fit.names) :].any() for block in wide.blocks):
            probe = relaxed_probe(answered, name, wide, answered.p)
            told = (name,) if probe.is_beyond(limit) else ()
            found.append(replace(probe, routine=True, told=told))
    return tuple(found)


def significance(changes: Changes) -> float:
    """Return the least significant amplitude of a routine probe, in its standard errors.

    By Bonferroni's bound over all amplitudes: a drift has one, the clock rate one a recording. With
    both and one recording it is 3.0.
    """
    amplitudes = sum(name in ROUTINE for name in changes.names)
    return float(normal_isf(FALSE_ALARMS / 2 / max(1, amplitudes)))


def is_alarming(probe: Probe) -> bool:
    """Whether a relaxed assumption is significant, and relevant to what is reported."""
    return bool(probe.told) and probe.kind == "assumption" and (probe.relevance or 0.0) >= RELEVANT
