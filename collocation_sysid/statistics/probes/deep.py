"""Deeper checks of a fit: refits of parts of the data, and with assumptions relaxed.

Windows of time and recordings are fitted alone by one Gauss–Newton step from the answer, as for
`recording_scatter`. An assumption that is relaxed joins the linearised fit as one more nuisance
parameter, with the deviation of the budget as its prior and the changes of the residuals as its
derivative, see `consider_analysis`. Where its amplitude is significant, the effect is computed
again at the parameters that the step leads to, and a step is taken from there, until parameters
settle; the remaining error is of second order in the amplitude. Error bars are those of any fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ...common.array_types import Array
from ...common.step_counting import StepUnit, complete_steps, counted_phase
from ...methods.starts.initial_trajectories import simulate_trajectories
from ..budget.consider_analysis import with_relaxed_assumption
from ..distributions import normal_isf
from ..linearised import (
    LinearisedFit,
    ResidualBlock,
    gauss_newton_step,
    least_squares_of_fit,
    linearise_fit,
)
from ..residuals.recording_scatter import blocks_by_recording, fit_part, single_fits
from ..thresholds import CHANCE
from .relaxed_assumptions import (
    MEMORY,
    Kind,
    Probe,
    SolvedFit,
    assumption_name,
    probed_changes,
    relaxed_probe,
)
from .routine import (
    is_alarming,
    is_routine_assumption,
    one_step_probes,
    prior_widening,
    routine_probes,
    significance_limit,
)

# Into so many windows of time the data are cut.
WINDOWS = ("first third", "middle third", "last third")
# Most linear steps of a significant assumption: each is a simulation.
STEPS = 4
# Change of a parameter's logarithm in a step that is the last.
SETTLED = 0.02


def routine_probes_with_steps(fit: SolvedFit) -> tuple[Probe, ...]:
    """Return the probes that relax the routine assumptions by one linear step each, all with
    `routine` set; the one of those that give concern (`is_alarming`) with the largest decrease
    of χ² is iterated.

    A linear step suffices to find that an assumption is wrong, but not for estimates that change by
    much of their value. That assumption therefore takes further steps, see `_iterate_probe`.
    """
    probes = routine_probes(fit)
    alarming = [probe for probe in probes if is_alarming(probe)]
    if not alarming:
        return probes
    worst = max(alarming, key=lambda probe: probe.chi_squared)
    with_steps = replace(
        _iterate_probe(fit, worst, limit=significance_limit(fit.changes, worst.name)), routine=True
    )
    return tuple(with_steps if probe is worst else probe for probe in probes)


def deep_probes(solved_fit: SolvedFit) -> tuple[Probe, ...]:
    """Return the refits of windows of time, of recordings where there are several, and with each
    assumption relaxed, in this order.

    The level of significance is `CHANCE` over the number of tests (Bonferroni). Routine assumptions
    have the same prior and level of significance as in `routine_probes`. Significant assumptions
    are iterated, with simulations, which are reported to the counters of `counted_phase`.
    """
    parts = [*_window_probes(solved_fit), *_recording_probes(solved_fit)]
    relaxed = [*one_step_probes(solved_fit, solved_fit.changes.names)]
    tests = sum(len(probe.moves) for probe in parts) + len(relaxed)
    limit = float(normal_isf(CHANCE / 2 / max(1, tests)))
    limits = {
        probe.name: significance_limit(solved_fit.changes, probe.name)
        if is_routine_assumption(probe.name)
        else limit
        for probe in relaxed
    }
    significant = [p for p in relaxed if p.is_beyond(limits[p.name])]
    with counted_phase(StepUnit.ASSUMPTION, len(significant)):
        iterated = {
            probe.name: _iterate_probe(solved_fit, probe, limit=limits[probe.name])
            for probe in significant
        }
    return (
        *(_with_significant_moves(each, limit) for each in parts),
        *(iterated.get(probe.name, probe) for probe in relaxed),
    )


def _window_probes(at: SolvedFit) -> Iterator[Probe]:
    for k, name in enumerate(WINDOWS):
        cuts = [_third(block, k) for block in at.fit.blocks]
        blocks = [_restrict(block, cut) for block, cut in zip(at.fit.blocks, cuts, strict=True)]
        alone = fit_part(at.fit, blocks, columns=np.arange(len(at.fit.names)))
        yield from _part_probe(at, "window", name, *alone)


def _third(block: ResidualBlock, k: int) -> slice:
    ends = np.round(np.linspace(0, len(block.t_s), len(WINDOWS) + 1)).astype(int)
    return slice(int(ends[k]), int(ends[k + 1]))


def _restrict(block: ResidualBlock, cut: slice) -> ResidualBlock:
    own = ("t_s", "is_present", "residual", "jacobian", "misfit", "components")
    there = {name: each[cut] for name in own if (each := getattr(block, name)) is not None}
    shaken = block.disturbances
    return replace(block, **there, disturbances=None if shaken is None else shaken[:, cut])


def _recording_probes(at: SolvedFit) -> Iterator[Probe]:
    if len(blocks_by_recording(at.fit)) < 2:
        return
    for alone, step in single_fits(at.fit):
        yield from _part_probe(at, "recording", name=alone.blocks[0].name, alone=alone, step=step)


def _part_probe(
    at: SolvedFit, kind: Kind, name: str, alone: LinearisedFit, step: Array
) -> Iterator[Probe]:
    if alone.measurement_count <= len(alone.names):
        return
    uncertainty = at.uncertainty_of_refit(
        alone, at.read_parameters()[: alone.shared_count] + step[: alone.shared_count]
    )
    remaining = least_squares_of_fit(alone)
    falls = remaining.loss(-step) - remaining.loss(np.zeros(len(step)))
    yield Probe(kind, name, chi_squared=falls, moves=at.changes_of_estimates(uncertainty))


def _with_significant_moves(probe: Probe, limit: float) -> Probe:
    """Return significant moves: a part differs by less than its own error bar (Hausman 1978)."""
    significant = (
        n for n, move in probe.moves.items() if abs(move.change) > limit * move.std_error
    )
    return replace(probe, sentences=tuple(significant))


# Freed assumptions --------------------------------------------------------------------------------


def _iterate_probe(at: SolvedFit, probe: Probe, limit: float) -> Probe:
    """Return a significant probe after further steps, from where its first step leads.

    The decrease of χ² remains that of the first step, because the others leave out the second order
    of the amplitude in the residuals. The steps end after `STEPS`, if no shared parameter changes by
    more than `SETTLED`, or if a simulation fails. Memory takes no further step: its effect is not
    linear in the share, and its estimates depend on a relaxation time that is not estimated, so that
    a branch has to be added to the material in any case. `sentences` has the name of the assumption
    if it is still significant.
    """
    if assumption_name(probe.name) == MEMORY:
        complete_steps(StepUnit.ASSUMPTION)
        return replace(probe, sentences=(probe.name,))
    first = len(at.fit.names)
    collocation = at.collocation
    own = assumption_name(probe.name)
    alone = {name: size if name == own else None for name, size in at.deviations.items()}
    wide = with_relaxed_assumption(
        at.fit, at.changes, name=probe.name, widening=prior_widening(probe.name)
    )
    decrease = {"chi_squared": probe.chi_squared, "suffices": probe.suffices}
    p = at.read_parameters()
    _, positions = collocation.unpack(at.z)
    steps = 0
    while steps < STEPS:
        step = gauss_newton_step(wide)[:first]
        p = p + step
        positions, failure = simulate_trajectories(collocation, p, guess=positions)
        if failure is not None:
            break
        z = collocation.pack(p, positions)
        changes = probed_changes(collocation, z, deviations=alone)
        there = linearise_fit(collocation, z).with_disturbances(
            b.disturbances for b in at.fit.blocks
        )
        wide = with_relaxed_assumption(
            there, changes, name=probe.name, widening=prior_widening(probe.name)
        )
        probe = replace(relaxed_probe(at, probe.name, wide=wide, p=p), **decrease)
        steps += 1
        complete_steps(StepUnit.ASSUMPTION, 1 / STEPS)
        if np.abs(step[: wide.shared_count]).max(initial=0.0) < SETTLED:
            break
    complete_steps(StepUnit.ASSUMPTION, 1 - steps / STEPS)
    return replace(probe, sentences=(probe.name,) if probe.is_beyond(limit) else ())
