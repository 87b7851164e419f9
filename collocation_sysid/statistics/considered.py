"""How the residuals of a fit change where what it assumes is off.

Trajectories follow the changes of forces, masses and goals by one sweep forward with a column for
each assumption, and residuals from these, so that all together cost about as much as one
linearisation of the fit. Nuisance parameters that are considered have their slopes as estimated
ones do, of the same program with them among its parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ..arrays import Array, Index
from ..fem.body import Linearisation
from ..program.channel import Forced, Motion
from ..program.collocation import Collocation, Part
from ..program.lapack import one_blas_thread
from ..program.reaction import HeldForces
from ..program.reading import Reading
from ..program.sweep import Columns, Forward, GraspMotion, Sweep
from ..recording.experiment import Experiment
from ..recording.nuisance import ROWS
from .assumptions import ASSUMPTIONS, CORRELATION_KEY, Assumption, Effect, Fitted
from .linearised import linearised_fit
from .shape_error import CORRELATION

# A threshold of Huber's loss that no residual reaches.
UNWEIGHTED = 1e9


@dataclass(frozen=True, eq=False)
class _Changed(Columns):
    """Columns by changes of forces and of rows."""

    forces_n: Array = field(default_factory=lambda: np.zeros(0))  # (N, 3n, c)
    rows_n: Array = field(default_factory=lambda: np.zeros(0))  # (N, 3n, c)

    def sides(
        self,
        rows: slice,
        at: Linearisation,
        acceleration: Array,
        residual: Array | None,
        free: Index,
    ) -> tuple[Array, Array]:
        return self.rows_n[rows][:, free].copy(), self.forces_n[rows].copy()


class Changes(NamedTuple):
    """How the residuals of a fit change where what is assumed is off by its deviation.

    Attributes
    ----------
    names : (a,) of assumptions, with their components
    blocks : of each block of `LinearisedFit` (T, M, 3, a) in standard deviations
    """

    names: tuple[str, ...]
    blocks: list[Array]

    def without(self, assumptions: Iterable[str]) -> Changes:
        """Return the changes by all others than some assumptions, each with all its components."""
        left_out = set(assumptions)
        kept = [k for k, name in enumerate(self.names) if name.partition(" ")[0] not in left_out]
        names = tuple(self.names[k] for k in kept)
        return Changes(names, [block[..., kept] for block in self.blocks])


def assumed(collocation: Collocation, z: Array, deviations: Mapping[str, float | None]) -> Changes:
    """The changes by all that a fit assumes.

    Parameters
    ----------
    collocation : Collocation
    z : (variables,) a point that satisfies the equations of motion
    deviations : mapping of the name of an assumption, or nuisance parameter, to its deviation
        In place of those of the tables; None for what is known exactly.
    """
    rows = [(row, deviations.get(row.name, row.sigma)) for row in ASSUMPTIONS]
    stated = [(row, s) for row, s in rows if s is not None]
    correlation = deviations.get(CORRELATION_KEY) or CORRELATION
    of_bodies = changed_residuals(collocation, z, stated, surface_correlation=correlation)
    of_nuisances = considered(collocation, z, deviations)
    both = zip(of_bodies.blocks, of_nuisances.blocks, strict=True)
    blocks = [np.concatenate(each, axis=3) for each in both]
    return Changes(of_bodies.names + of_nuisances.names, blocks)


def considered(
    collocation: Collocation, z: Array, deviations: Mapping[str, float | None]
) -> Changes:
    """Those by nuisance parameters that are not estimated, see `assumed`."""

    def widened(experiment: Experiment) -> Experiment:
        nuisance = experiment.nuisance
        sigmas = {row: deviations.get(row.name, row.considered) for row in ROWS}
        more = {r.name: s for r, s in sigmas.items() if s and nuisance.sigma(r) is None}
        return replace(experiment, nuisance=replace(nuisance, **more))

    wider = [widened(experiment) for experiment in collocation.experiments]
    wide = replace(collocation, experiments=wider, huber=UNWEIGHTED)  # whatever their weights
    p, positions = collocation.unpack(z)
    known = dict(zip(collocation.names, p.tolist(), strict=True))
    at = wide.pack(np.array([known.get(name, 0.0) for name in wide.names]), positions)
    new = np.array([k for k, name in enumerate(wide.names) if name not in known], dtype=np.int64)
    names: dict[int, str] = {}
    for segment in wide.segments:
        own = zip(segment.places[wide.nq :], segment.nuisance.entries, strict=True)
        names |= {int(place): entry.row.name for place, entry in own}
    blocks = [block.slope[..., new] for block in linearised_fit(wide, at).blocks]
    return Changes(tuple(names[k] for k in new.tolist()), blocks)


@one_blas_thread()
def changed_residuals(
    collocation: Collocation,
    z: Array,
    assumptions: Sequence[tuple[Assumption, float]],
    *,
    surface_correlation: float = CORRELATION,
) -> Changes:
    """Return the changes by assumptions, each with its deviation, see `assumed`."""
    names = tuple(name for row, _ in assumptions for name in row.components)
    changes: list[Array] = []
    for part in collocation.parts(z):
        at = Fitted(part, collocation.parameters, surface_correlation)
        effects = [
            (row.effect(at, axis), sigma)
            for row, sigma in assumptions
            for axis in range(len(row.components))
        ]
        changes += _changes(at, effects)
    return Changes(names, changes)


def _changes(at: Fitted, effects: Sequence[tuple[Effect | None, float]]) -> Iterator[Array]:
    part = at.part
    count = len(effects)
    segment = part.segment
    held = part.setting.held
    x = part.x
    forces = np.zeros((*x.shape, count))
    rows = np.zeros((*x.shape, count))
    moved = np.zeros((*held.positions_m.shape, count))
    for k, (effect, sigma) in enumerate(effects):
        if effect is None:
            continue
        if effect.force_n is not None:
            forces[..., k] = sigma * effect.force_n
        if effect.mass_kg is not None:
            rows[..., k] -= sigma * effect.mass_kg * at.acceleration
        if effect.stretched:
            mass = at.dynamics.mass.kg
            rows[..., k] += 2 * sigma * effect.stretched * mass * at.acceleration
        if effect.moved_m is not None:
            moved[..., k] = sigma * np.where(np.isnan(held.positions_m), 0.0, effect.moved_m)
    forces[: at.dynamics.first_row] = rows[: at.dynamics.first_row] = 0.0
    solver = Sweep(segment)
    columns = _Changed(
        part.setting,
        count,
        by_p=False,
        grasped=GraspMotion.along(solver, held.dofs, moved),
        forces_n=forces,
        rows_n=rows,
    )
    for reading, _, looked, by in followed(part, solver, columns, rows[:, segment.sensed_dofs]):
        yield reading.changes(looked, by, part.phi)


def followed(
    part: Part, solver: Sweep, columns: Columns, inertia_n: Array | float = 0.0
) -> Iterator[tuple[Reading, Motion, Array, Array]]:
    """Each reading along columns that are no parameters: its motion, what it looks at, and by them.

    Parameters
    ----------
    inertia_n : (N, g, c), optional
        What the rows of sensed dofs change by themselves: reactions are what they lack.
    """
    segment = part.segment
    x = part.x
    phi = part.phi
    sensed = HeldForces.nothing(len(x), len(segment.sensed_dofs), columns.count)
    response = part.sensing.read_along(Forward(solver, columns, held=sensed).rows(x), sensed)
    numbers = np.arange(columns.count)
    size = columns.count + len(phi)
    motions = part.sensing.moving(x, response, by_p=False)
    for reading, motion in zip(segment.readings, motions, strict=True):
        motion = _with_inertia(motion, inertia_n)
        looked, slopes = reading.channel.linearised(motion, phi, numbers, size)
        yield reading, motion, looked, slopes.by[..., : columns.count]


def _with_inertia(motion: Motion, inertia_n: Array | float) -> Motion:
    def forced() -> Forced:
        lacking = motion.forced
        assert lacking.reaction_by is not None  # along columns
        return replace(lacking, reaction_by=lacking.reaction_by - inertia_n)

    return Motion(motion.x, forced, motion.by)
