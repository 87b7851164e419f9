"""Warm start: an earlier solution, from its run folder or from memory, as the start of a solve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..common.array_types import Array
from ..common.files import RESULT_FILE, damage_refused
from ..errors import InputError
from ..methods.solution import Solution
from ..methods.starts.initial_trajectories import simulate_trajectories
from ..methods.starts.start import Start
from ..problem import Problem
from ..program.collocation import Collocation
from ..program.transcription import Transcription
from ..statistics.linearised import parameter_values
from .result_content import Result


@dataclass(frozen=True)
class WarmStart:
    """Estimates of an earlier solution, by name, as the start of another solve."""

    folder: Path  # run folder, for messages; empty for a solution from memory
    # mapping of name to value: physical values of the parameters, and of moduli derived from them,
    # in SI units.
    values: Mapping[str, float]
    # mapping of name to value: nuisance parameters by "experiment: label", as in
    # `Collocation.parameter_names`, in the unit of the label.
    nuisance: Mapping[str, float]
    # mapping of experiment to mapping of marker to (3,): places of the markers on the undeformed
    # body [m].
    places_m: Mapping[str, Mapping[str, Array]]
    substeps: int = 1  # time steps per sample
    # Program, its variables, and its multipliers or None, from which another of the same layout
    # begins; None if only the estimates are known.
    variables: tuple[Collocation, Array, Array | None] | None = None

    @classmethod
    def read(cls, folder: str | Path) -> WarmStart:
        """Return the estimates in a run folder.

        Raises
        ------
        InputError
            If the folder is no run folder, or damaged, or a value is not finite.
        """
        return cls.from_result(Result.read(folder, "the folder of an earlier run"), Path(folder))

    @classmethod
    def from_result(cls, result: Result, folder: Path) -> WarmStart:
        """Return the estimates of a result at its optimum, that is without the correction for
        discretisation errors.

        No file is read: `folder` is stored, and named in messages.

        Raises
        ------
        InputError
            If a value is not finite; `folder` is named in the message.
        """
        both = {**result.parameters, **result.derived}
        # The optimum solves the equations of the trajectory in the folder, not the corrected value.
        values = {
            name: each.value if each.optimum is None else each.optimum
            for name, each in both.items()
        }
        nuisance = {
            f"{experiment}: {name}": each.value
            for experiment, named in result.nuisance.items()
            for name, each in named.items()
        }
        places_m = {
            experiment: {name: place.position_m for name, place in named.items()}
            for experiment, named in result.places.items()
        }
        with damage_refused(folder, RESULT_FILE, remedy="solve that problem again"):
            points = np.array([place for named in places_m.values() for place in named.values()])
            all_values = np.array(
                [*values.values(), *nuisance.values(), *points.reshape(-1, 3).flat]
            )
            if not np.isfinite(all_values).all():
                raise ValueError("a value that is not finite")
        return cls(
            folder, values, nuisance=nuisance, places_m=places_m, substeps=result.problem.substeps
        )

    @classmethod
    def of(cls, solution: Solution) -> WarmStart:
        """Return the estimates of a solution in memory, without the correction for discretisation
        errors, also of one that has not converged.
        """
        return cls.at(solution.collocation, solution.z)

    @classmethod
    def from_object(cls, start: object, problem: Problem) -> WarmStart:
        """Return the start that `solve` accepts: a warm start, a solution or a run, the folder of a
        run, or the variables of `problem.collocation()`, alone or with the multipliers.

        Raises
        ------
        InputError
            If it is none of these.
        """
        if isinstance(start, WarmStart):
            return start
        if isinstance(start, (str, Path)):
            return cls.read(start)
        solution = getattr(start, "solution", start)
        if isinstance(solution, Solution):
            known = solution.collocation, solution.z, solution.multipliers
            return replace(cls.of(solution), variables=known)
        pair = start if isinstance(start, tuple) else (start, None)
        collocation = problem.collocation()
        sizes = (collocation.variable_count, collocation.constraint_count)
        largest = problem.collocation(lifted=True)
        try:
            z, multipliers = (None if n is None else np.array(n, dtype=float).ravel() for n in pair)
        except (ValueError, TypeError):
            z = multipliers = None
        if (
            z is None
            or len(z) not in (sizes[0], largest.variable_count)
            or (
                (multipliers is not None)
                and len(multipliers) not in (sizes[1], largest.constraint_count)
            )
        ):
            kind = type(start).__name__
            found = f"a {kind}" if z is None else f"{len(z)} variables"
            found += "" if multipliers is None else f" and {len(multipliers)} multipliers"
            raise InputError(
                f"found {found}; expected a solution, a run or its folder, or the {sizes[0]} variables "
                f"of problem.collocation(), also with its {sizes[1]} multipliers: (x, lam_g)",
                where="start",
            )
        z = z[: sizes[0]]  # lifted variables are last
        known = None if multipliers is None else multipliers[: sizes[1]]
        return replace(cls.at(collocation, z), variables=(collocation, z, known))

    @classmethod
    def at(cls, collocation: Collocation, z: Array) -> WarmStart:
        """Return the estimates at variables z of a program."""
        nuisance = {}
        places_m = {}
        for part in collocation.iterates(z):
            transcription = part.transcription
            name = transcription.experiment.name
            nuisance |= {
                f"{name}: {e.label}": v
                for e, _, v in transcription.nuisance.iterate_values(part.phi)
            }
            markers = transcription.experiment.markers.names
            places = transcription.marker_places_m(part.phi)
            places_m[transcription.experiment.name] = dict(zip(markers, places, strict=True))
        values = parameter_values(collocation, z[: collocation.nq])
        return cls(
            Path(), values, nuisance=nuisance, places_m=places_m, substeps=collocation.substeps
        )

    def apply_to_problem(self, problem: Problem) -> Problem:
        """Return the problem with these estimates as its guesses, clipped to its bounds.

        Raises
        ------
        InputError
            If no estimated parameter has a name among the values.
        """
        free = problem.parameters.free
        known = {i.name: self.values[i.name] for i in free if i.name in self.values}
        if not known:
            raise InputError(
                f"found the parameters {', '.join(self.values)}; expected at least one of those that are "
                f"estimated, {', '.join(i.name for i in problem.parameters.free_scalars)}",
                self.folder / RESULT_FILE if self.folder.name else None,
                where=None if self.folder.name else "start",
            )
        return replace(problem, parameters=problem.parameters.with_estimates(known))

    def apply_to_places(self, collocation: Collocation) -> Collocation:
        """Return the discretised problem in which markers whose place is estimated start at the
        earlier places; markers without an earlier place keep theirs. Their prior is then centred
        there; the given problem is not modified.
        """
        places_m = []
        for transcription in collocation.transcriptions:
            here = transcription.marker_places_m(transcription.guess_phi)
            for m, place in self._known_places(transcription).items():
                here[m] = place
            places_m.append(here)
        return collocation.with_marker_places(places_m)

    def _known_places(self, transcription: Transcription) -> dict[int, Array]:
        """Return the earlier place (3,) [m] of markers with estimated places."""
        places_m = self.places_m.get(transcription.experiment.name, {})
        names = transcription.experiment.markers.names
        estimated = transcription.association.markers.estimated.tolist()
        return {m: places_m[names[m]] for m in estimated if names[m] in places_m}

    def apply_to_nuisance(self, collocation: Collocation) -> tuple[Array, int]:
        """Return p (np,), the guesses of parameters and nuisance parameters in the solver's
        coordinates with the earlier nuisance parameters, and the number of replaced guesses.

        Nuisance parameters are in units of their prior standard deviations. Only those with the
        same experiment and label are replaced, and not limited to their bounds. The entries of the
        places of markers are never replaced, nor counted: `apply_to_places` sets the places of
        the discretised problem beforehand. Every parameter must have a guess.
        """
        p = collocation.guess_p
        matches = 0
        for transcription in collocation.transcriptions:
            for place, entry in zip(
                transcription.nuisance_indices.indices, transcription.nuisance.entries, strict=True
            ):
                name = f"{transcription.experiment.name}: {entry.label}"
                if name in self.nuisance:
                    p[place] = self.nuisance[name] / entry.sigma
                    matches += 1
        return p, matches

    @property
    def has_multipliers(self) -> bool:
        """Whether multipliers are known."""
        return self.variables is not None and self.variables[2] is not None

    def start(self, collocation: Collocation, is_whole: bool = False) -> Start:
        """Return the start at the guesses with the earlier places of markers and nuisance parameters,
        limited to their bounds.

        For a method that begins at all positions (`is_whole`) these are the earlier ones where they
        are known on the same grids and nodes; otherwise they are simulated. It has no variables if
        the simulation fails, or, unless `is_whole`, if no nuisance parameter or place matches. Every
        parameter must have a guess.
        """
        collocation = self.apply_to_places(collocation)
        p, matches = self.apply_to_nuisance(collocation)
        matches += sum(
            len(self._known_places(transcription)) for transcription in collocation.transcriptions
        )
        p = np.clip(p, *collocation.parameter_bounds)
        if is_whole and self.variables is not None:
            earlier, z, multipliers = self.variables
            positions = earlier.unpack(z)[1]
            if _layout(earlier) == _layout(collocation):
                known = _rescaled(multipliers, earlier, collocation)
                return Start(collocation, collocation.pack(p, positions), multipliers=known)
        if not matches and not is_whole:
            return Start(collocation)
        positions, failure = simulate_trajectories(collocation, p)
        variables = None if failure is not None else collocation.pack(p, positions)
        return Start(collocation, variables)


def _layout(collocation: Collocation) -> list[tuple[str, int, int, int]]:
    """Name and numbers of grid times, dofs and constraints of each experiment."""
    return [
        (s.experiment.name, s.grid_times, s.dof_count, s.constraint_count)
        for s in collocation.transcriptions
    ]


def _rescaled(
    multipliers: Array | None, earlier: Collocation, collocation: Collocation
) -> Array | None:
    """Return multipliers of an earlier program in the scales of another one of the same layout."""
    if multipliers is None:
        return None
    scaled = multipliers.copy()
    for before, now in zip(earlier.transcriptions, collocation.transcriptions, strict=True):
        of_motion = ~now.is_grasp_constraint
        scaled[now.rows][of_motion] *= now.force_n / before.force_n
    return scaled * collocation.loss_scale / earlier.loss_scale
