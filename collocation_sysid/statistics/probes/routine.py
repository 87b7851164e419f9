"""Tests of four assumptions in every solve: constant stiffness, a material without memory, clocks
of equal rate, and an isotropic material.

A drift of the stiffness, a branch of viscoelastic memory with each of several relaxation times, a
rate of the cameras' clock, and a stiffness that is higher along one axis of the mesh join the
linearised fit as one more column each, see `relaxed_assumptions`. The columns are computed together
with those of the uncertainty budget, so that a probe costs one least-squares problem and no
simulation. `deep_probes` (``solve --probe``) relaxes all other assumptions, refits parts of the data,
and follows effects that are too large for one linear step.

A probe is *significant* if its amplitude is farther from zero than noise explains, also where the
priors of fields do not smooth them, and *relevant* if relaxing the assumption changes what is
reported. Only what is both, and explains the residuals, gives concern, see
`assessment.probe_concerns`: with much data any imperfection is significant, with little data any
change is large, and any error of the model is absorbed by any assumption in part.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from ...model.parameters import FieldCoefficients
from ..budget.consider_analysis import ResidualChanges, with_relaxed_assumption
from ..budget.systematic_effects import DEVIATIONS
from ..distributions import normal_isf
from ..linearised import gauss_newton_step
from ..thresholds import RARE, RELEVANT, WIDENING_OF_FIELDS
from .relaxed_assumptions import MEMORY, Probe, SolvedFit, assumption_name, relaxed_probe

# Deviations that are tested in every solve, by name: each can occur while the residuals look white,
# biases the estimates, and is determined by a single recording.
ROUTINE = {name: row for name, row in DEVIATIONS.items() if "test" in row.modes}


def probed_deviations(deviations: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return a copy of deviations in which none of the routine probes is None.

    A quantity stated as exact (None), or without an entry, is left out of the budget but still
    tested, with the default deviation of the table.

    Parameters
    ----------
    deviations : mapping of str to float or None
        Standard deviation of each assumption or nuisance parameter; None if exact.
    """
    exact = [row for row in ROUTINE.values() if deviations.get(row.name) is None]
    return {**deviations, **{row.name: row.considered or row.tested for row in exact}}


def routine_probes(solved_fit: SolvedFit) -> tuple[Probe, ...]:
    """Return the probes that relax each component of a routine assumption by one linear step from
    the answer, in the order of the changes; none is left out because it is not significant.

    Parameters
    ----------
    solved_fit : SolvedFit
        The fit. An assumption that has no column in its `changes`, because it is estimated or has
        no effect, is not probed.

    Returns
    -------
    tuple of Probe
        Probes with `routine` set; `sentences` is empty where the amplitude is not significant.
    """
    names = filter(is_routine_assumption, solved_fit.changes.names)
    loose = _with_loose_fields(solved_fit)
    probes = []
    for probe in one_step_probes(solved_fit, names):
        limit = significance_limit(solved_fit.changes, probe.name)
        is_significant = probe.is_beyond(limit)
        if is_significant and loose is not None:
            (of_loose,) = one_step_probes(loose, [probe.name])
            is_significant = of_loose.is_beyond(limit)
        probes.append(
            replace(probe, routine=True, sentences=(probe.name,) if is_significant else ())
        )
    return tuple(probes)


def _with_loose_fields(solved_fit: SolvedFit) -> SolvedFit | None:
    """Return the fit with wider priors: what a prior smooths away is in the residuals."""
    items = solved_fit.collocation.parameters.items
    fields = [item for item in items if isinstance(item, FieldCoefficients)]
    coefficients = {each.name for item in fields for each in item.components}
    if not coefficients:
        return None
    fit = solved_fit.fit
    scale = np.where([name in coefficients for name in fit.names], 1 / WIDENING_OF_FIELDS, 1.0)
    loose = replace(
        fit, prior_residual=scale * fit.prior_residual, prior_jacobian=scale * fit.prior_jacobian
    )
    return replace(solved_fit, fit=loose.after_step(gauss_newton_step(loose)))


def one_step_probes(solved_fit: SolvedFit, names: Iterable[str]) -> Iterator[Probe]:
    """Yield a probe for each of the named assumptions, with components, that changes any residual,
    relaxed by one linear step; a name that occurs several times has one probe.
    """
    for name in dict.fromkeys(names):
        wide = with_relaxed_assumption(
            solved_fit.fit, solved_fit.changes, name=name, widening=prior_widening(name)
        )
        if any(block.jacobian[..., len(solved_fit.fit.names) :].any() for block in wide.blocks):
            yield relaxed_probe(solved_fit, name, wide=wide, p=solved_fit.read_parameters())


def prior_widening(name: str) -> float:
    """Return the standard deviation of an assumption's prior, in deviations of the budget, for its
    name with component: `Deviation.widening` of routine assumptions, else 1.
    """
    row = ROUTINE.get(assumption_name(name))
    return row.widening or 1.0 if row else 1.0


def is_routine_assumption(name: str) -> bool:
    """Return whether an assumption, given by its name with its component, is probed in every
    solve.
    """
    return assumption_name(name) in ROUTINE


def significance_limit(changes: ResidualChanges, name: str) -> float:
    """Return the least significant amplitude of a routine probe, in its standard errors.

    The probability of a false alarm is divided equally among the routine assumptions, and that of
    an assumption among its amplitudes (Bonferroni): a drift has one, memory one for each relaxation
    time of the table, also for those that the recording cannot show, and the clock rate one for
    each recording. The amplitudes of memory are correlated, so that the bound is conservative.

    Parameters
    ----------
    changes : ResidualChanges
        Changes whose `names` are counted.
    name : str
        Name of the assumption, with or without its component.
    """
    amplitudes = Counter(map(assumption_name, filter(is_routine_assumption, changes.names)))
    tests = max(1, len(amplitudes)) * max(1, amplitudes[assumption_name(name)])
    return float(normal_isf(RARE / 2 / tests))


def is_possible(probe: Probe) -> bool:
    """Whether a body can have the size of a relaxed assumption: no material has a memory with a
    negative share.
    """
    return assumption_name(probe.name) != MEMORY or (probe.size or 0.0) > 0


def is_alarming(probe: Probe) -> bool:
    """Whether a probe relaxes an assumption that is possible, significant (it has `sentences`),
    relevant to the estimates (`relevance` at least `RELEVANT`), and explains the residuals
    (`suffices`); false for parts of the data.
    """
    return (
        is_possible(probe)
        and probe.suffices
        and bool(probe.sentences)
        and probe.kind == "assumption"
        and (probe.relevance or 0.0) >= RELEVANT
    )
