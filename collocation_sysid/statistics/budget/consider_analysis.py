"""Consider analysis (Schmidt): changes of the residuals if assumptions are wrong.

Effects on forces, masses and prescribed displacements are propagated to trajectories by one forward
sweep with a column for each assumption, and from these to residuals, at about the cost of one
linearisation of the fit. Nuisance parameters that are not estimated are linearised like estimated
ones, in the same program with them among its parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ...common.array_types import Array, Index
from ...fem.body import Linearisation
from ...program.collocation import Collocation, ExperimentIterate
from ...program.linear_algebra.lapack import one_blas_thread
from ...program.measurement_residual import MeasurementResidual
from ...program.observable_response import ObservableResponse
from ...program.observables import ObservedMotion
from ...program.reactions.forces import GraspForces
from ...program.sweep import ForwardSubstitution, PrescribedColumns, Sweep, SweepColumns
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ...recording.nuisance import KINDS
from ..linearised import LinearisedFit, linearise_fit
from .effect import Effect, ExperimentAtAnswer
from .systematic_effects import ASSUMPTIONS

# A threshold of Huber's loss that no residual reaches.
UNWEIGHTED = 1e9


@dataclass(frozen=True, eq=False)
class _EffectColumns(SweepColumns):
    # (N, 3n, c): changes of the forces at the evaluations [N].
    forces_n: Array = field(kw_only=True)
    rows_n: Array = field(kw_only=True)  # (N, 3n, c): changes of the equations of motion [N]

    def right_hand_sides(
        self,
        rows: slice,
        at: Linearisation,
        acceleration: Array,
        residual: Array | None,
        free: Index,
    ) -> tuple[Array, Array]:
        """Return R (k, free, c) and F_R (k, 3n, c) [N] of k rows."""
        return self.rows_n[rows][:, free].copy(), self.forces_n[rows].copy()


class ResidualChanges(NamedTuple):
    """Changes of the residuals of a fit if assumptions are off by their standard deviations."""

    names: tuple[str, ...]  # (a,) tuple of str: names of the assumptions with their components
    # list of (T, M, 3, a): changes for each block of `LinearisedFit`, in units of σ.
    blocks: list[Array]


def changes_of_assumptions(
    collocation: Collocation,
    z: Array,
    deviations: Mapping[str, float | None],
    of_nuisances: ResidualChanges | None = None,
) -> ResidualChanges:
    """Return the changes of the residuals by all assumptions of a fit and by nuisance parameters
    that are not estimated, each off by its standard deviation.

    Parameters
    ----------
    z : (variables,) array
        Variables that satisfy the equations of motion.
    deviations : mapping of str to float or None
        Standard deviations of assumptions and nuisance parameters by name, in place of those of the
        tables; None for what is exact.
    of_nuisances : ResidualChanges, optional
        Known result of `changes_of_nuisances`.

    Notes
    -----
    Assumptions without an entry have the deviation of their table; those that are None there are
    left out. Columns of `ASSUMPTIONS` come first, then those of nuisance parameters.
    """
    rows = [(row, deviations.get(row.name, row.considered)) for row in ASSUMPTIONS]
    assumptions = [(row, s) for row, s in rows if s is not None]
    of_bodies = changed_residuals(collocation, z, assumptions)
    of_nuisances = of_nuisances or changes_of_nuisances(collocation, z, deviations)
    if not of_nuisances.names:
        return of_bodies
    both = zip(of_bodies.blocks, of_nuisances.blocks, strict=True)
    blocks = [np.concatenate(each, axis=3) for each in both]
    return ResidualChanges(of_bodies.names + of_nuisances.names, blocks)


def changes_of_nuisances(
    collocation: Collocation, z: Array, deviations: Mapping[str, float | None]
) -> ResidualChanges:
    """Return the changes of the residuals by nuisance parameters that are not estimated, each off
    by its standard deviation.

    Parameters
    ----------
    z : array
        Variables at the answer.
    deviations : mapping
        Standard deviation by the name of the nuisance parameter; None for an exact one. For those
        without an entry the standard deviation of the kind is used, if it has one.

    Returns
    -------
    ResidualChanges
        One column for each value of these parameters in each experiment, zero in the blocks of
        other experiments, with the name of the kind; no blocks if all are estimated or exact.
        Huber's weights are not applied.
    """
    wide, at, names = _with_considered(collocation, z, deviations)
    return _changes_by(names, linearise_fit(wide, at)) if names else ResidualChanges((), [])


def unweighted_fit(
    collocation: Collocation, z: Array, deviations: Mapping[str, float | None]
) -> tuple[LinearisedFit, ResidualChanges]:
    """Return the fit without Huber's weights, and the result of `changes_of_nuisances`."""
    wide, at, names = _with_considered(collocation, z, deviations)
    fit = linearise_fit(wide, at)
    own = [wide.parameter_names.index(name) for name in collocation.parameter_names]
    return fit.only(own), _changes_by(names, fit)


def _changes_by(names: Mapping[int, str], fit: LinearisedFit) -> ResidualChanges:
    """Return the changes by some parameters of a fit, by their places."""
    blocks = [block.jacobian[..., [*names]] for block in fit.blocks]
    return ResidualChanges(tuple(names.values()), blocks)


def _with_considered(
    collocation: Collocation, z: Array, deviations: Mapping[str, float | None]
) -> tuple[Collocation, Array, dict[int, str]]:
    """Return the program with the nuisance parameters that are not estimated, whatever Huber's
    weights, its variables, and the places and kinds of these parameters.
    """

    def with_added_nuisances(experiment: Experiment) -> Experiment:
        nuisance = experiment.nuisance
        sigmas = {row: deviations.get(row.name, row.considered) for row in KINDS}
        more = {r.name: s for r, s in sigmas.items() if s and nuisance.sigma(r) is None}
        return replace(experiment, nuisance=replace(nuisance, **more))

    wider = [with_added_nuisances(experiment) for experiment in collocation.experiments]
    wide = replace(collocation, experiments=wider, huber=UNWEIGHTED)
    p, positions = collocation.unpack(z)
    values = dict(zip(collocation.parameter_names, p.tolist(), strict=True))
    at = wide.pack(wide.with_values(values, np.zeros(wide.nq + wide.nphi)), positions)
    kinds: dict[int, str] = {}
    for transcription in wide.transcriptions:
        own = zip(
            transcription.parameter_indices[wide.nq :], transcription.nuisance.entries, strict=True
        )
        kinds |= {int(place): entry.row.name for place, entry in own}
    new = [k for k, name in enumerate(wide.parameter_names) if name not in values]
    return wide, at, {k: kinds[k] for k in new}


@one_blas_thread()
def changed_residuals(
    collocation: Collocation, z: Array, assumptions: Sequence[tuple[Deviation, float]]
) -> ResidualChanges:
    """Return the changes of the residuals by some assumptions, each off by its standard deviation.

    An assumption with several components has a change for each of them, in the order of
    `assumptions`. A change is zero where the assumption has no effect, as in experiments of
    homogeneous specimens that it does not concern.

    Parameters
    ----------
    z : (variables,) array
        Variables that satisfy the equations of motion.
    assumptions : sequence of (Deviation, float)
        Assumptions with their standard deviations, in the unit of each.

    Returns
    -------
    ResidualChanges
        Not multiplied by Huber's weights.
    """
    names = tuple(name for row, _ in assumptions for name in row.components)
    changes: list[Array] = []
    for part in collocation.iterates(z):
        at = ExperimentAtAnswer(part, collocation.parameters)
        effects = [
            (_effect_of(row, at, axis), sigma)
            for row, sigma in assumptions
            for axis in range(len(row.components))
        ]
        changes += _changes_by_effects(at, effects)
    return ResidualChanges(names, changes)


def _effect_of(row: Deviation, at: ExperimentAtAnswer, axis: int) -> Effect | None:
    is_specimen = at.iterate.transcription.experiment.specimen is not None
    effect = at.body.kind.other_effects.get(row.name, row.effect)
    if effect is None or (is_specimen and not row.of_specimens):
        return None
    return effect(at, axis)


def _changes_by_effects(
    fitted: ExperimentAtAnswer, effects: Sequence[tuple[Effect | None, float]]
) -> Iterator[Array]:
    """Yield the changes (T, M, 3, a) of the residuals of each measurement by a effects, in σ; those
    by None are zero and not computed.
    """
    part = fitted.iterate
    present = [k for k, (effect, _) in enumerate(effects) if effect is not None]
    count = len(present)
    transcription = part.transcription
    prescribed = part.equations.prescribed
    x = part.x
    forces = np.zeros((*x.shape, count))
    rows = np.zeros((*x.shape, count))
    displacements_m = np.zeros((*prescribed.positions_m.shape, count))
    start_m = np.zeros((x.shape[1], count))
    for k, (effect, sigma) in enumerate(effects[place] for place in present):
        assert effect is not None
        if effect.force_n is not None:
            forces[..., k] = sigma * effect.force_n
        if effect.mass_kg is not None:
            rows[..., k] -= sigma * effect.mass_kg * fitted.acceleration
        if effect.time_stretch:
            mass = fitted.dynamics.mass.inertia_kg
            rows[..., k] += 2 * sigma * effect.time_stretch * mass * fitted.acceleration
        if effect.displacement_m is not None:
            displacements_m[..., k] = sigma * np.where(
                np.isnan(prescribed.positions_m), 0.0, effect.displacement_m
            )
        if effect.start_m is not None:
            start_m[:, k] = sigma * effect.start_m
    forces[: fitted.dynamics.first_row] = rows[: fitted.dynamics.first_row] = 0.0
    solver = Sweep(transcription)
    columns = _EffectColumns(
        part.equations,
        count,
        has_parameters=False,
        prescribed=PrescribedColumns.from_columns(solver, prescribed.dofs, columns=displacements_m),
        start_m=start_m,
        forces_n=forces,
        rows_n=rows,
    )
    for residual, _, values, changes in propagate_columns(
        part, solver, columns=columns, inertia_n=rows[:, transcription.sensed_dofs]
    ):
        own = residual.residual_changes(values, changes, phi=part.phi)
        complete = np.zeros((*own.shape[:-1], len(effects)))
        complete[..., present] = own
        yield complete


def propagate_columns(
    iterate: ExperimentIterate, solver: Sweep, columns: SweepColumns, inertia_n: Array | float = 0.0
) -> Iterator[tuple[MeasurementResidual, ObservedMotion, Array, Array]]:
    """Propagate columns of a forward substitution to the observables; yield for each measurement of
    the experiment, in their order, its residual, its motion with the changes by the columns, the
    values of its observable, and their changes by the c columns, with the columns as last axis.

    Parameters
    ----------
    solver : Sweep
        Factorised time steps.
    columns : SweepColumns
        Right-hand sides, not by parameters.
    inertia_n : (N, g, c) array or 0
        Changes of the equations of motion of the sensed dofs, which reaction forces do not contain
        [N].
    """
    transcription = iterate.transcription
    x = iterate.x
    phi = iterate.phi
    sensed = GraspForces.zeros(len(x), len(transcription.sensed_dofs), columns=columns.count)
    response = ObservableResponse.from_rows(
        iterate,
        ForwardSubstitution(solver, columns, grasp_forces=sensed).iterate_rows(x),
        grasp_forces=sensed,
    )
    columns_numbered = np.arange(columns.count)
    size = columns.count + len(phi)
    motions = response.motions(is_by_parameters=False)
    for residual, motion in zip(transcription.residuals, motions, strict=True):
        motion = _without_row_changes(motion, inertia_n)
        values, slopes = residual.observable.linearise(
            motion, phi, columns=columns_numbered, size=size
        )
        yield residual, motion, values, slopes.by_common[..., : columns.count]


def _without_row_changes(motion: ObservedMotion, inertia_n: Array | float) -> ObservedMotion:
    """Return the motion with `inertia_n` (N, g, c) [N] taken from the changes of its reactions."""
    reactions = motion.reactions
    if reactions is None:
        return motion
    assert reactions.reaction_by is not None  # along columns
    changed = replace(reactions, reaction_by=reactions.reaction_by - inertia_n)
    return replace(motion, reactions=changed)
