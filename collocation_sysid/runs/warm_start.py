"""An earlier answer, from its run folder, as the start of another solve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..files import RESULT_FILE, damage_refused
from ..methods.solution import Solution
from ..methods.start import marched
from ..problem import Problem
from ..program.collocation import Collocation
from ..program.segment import Segment
from ..statistics.linearised import values_of
from .result import Result


@dataclass(frozen=True)
class Earlier:
    """What an earlier run found.

    Attributes
    ----------
    folder : Path
    values : mapping of name to value, of parameters and of moduli derived from them
    nuisance : mapping of experiment and name to value, by names as in `Collocation.names`
    places_m : mapping of experiment to places (3,) by marker
    substeps : int
        Time steps per sample that it was found with.
    """

    folder: Path
    values: Mapping[str, float]
    nuisance: Mapping[str, float]
    places_m: Mapping[str, Mapping[str, Array]]
    substeps: int = 1

    @classmethod
    def read(cls, folder: str | Path) -> Earlier:
        """Read a run folder.

        Raises
        ------
        InputError
            If it is not one, or damaged.
        """
        return cls.of_result(Result.read(folder, "the folder of an earlier run"), Path(folder))

    @classmethod
    def of_result(cls, result: Result, folder: Path) -> Earlier:
        """What the result of a run's folder holds.

        Raises
        ------
        InputError
            If it is damaged.
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
        points = np.array([place for named in places_m.values() for place in named.values()])
        with damage_refused(folder, RESULT_FILE, "solve that problem again"):
            numbers = np.array([*values.values(), *nuisance.values(), *points.reshape(-1, 3).flat])
            if not np.isfinite(numbers).all():
                raise ValueError("a value that is not finite")
        return cls(folder, values, nuisance, places_m, result.problem.substeps)

    @classmethod
    def of(cls, solution: Solution) -> Earlier:
        """What was just found."""
        collocation, nuisance, places_m = solution.collocation, {}, {}
        for part in solution.parts:
            segment = part.segment
            name = segment.experiment.name
            nuisance |= {f"{name}: {e.label}": v for e, _, v in segment.nuisance.valued(part.phi)}
            markers = segment.experiment.markers.names
            places = segment.places_m(part.phi)
            places_m[segment.experiment.name] = dict(zip(markers, places, strict=True))
        values = values_of(collocation, solution.q)
        return cls(Path(), values, nuisance, places_m, collocation.substeps)

    def started(self, problem: Problem) -> Problem:
        """The problem with what was found as its guesses, clipped to its bounds.

        Raises
        ------
        InputError
            If no estimated parameter has a name that was found.
        """
        free = problem.parameters.free
        known = {i: self.values[i.name] for i in free if i.name in self.values}
        if not known:
            raise InputError(
                f"found {', '.join(self.values)}; expected at least one of the parameters that are "
                f"estimated, {', '.join(item.name for item in free)}",
                self.folder / RESULT_FILE,
            )
        guesses = {i.name: float(np.clip(value, i.lower, i.upper)) for i, value in known.items()}
        return replace(problem, parameters=problem.parameters.with_guess(guesses))

    def placed(self, collocation: Collocation) -> Collocation:
        """The problem with markers that are to be placed where they were found."""
        places_m = []
        for segment in collocation.segments:
            here = segment.places_m(segment.guess_phi)
            for m, place in self._known_places(segment).items():
                here[m] = place
            places_m.append(here)
        return collocation.placed_at(places_m)

    def _known_places(self, segment: Segment) -> dict[int, Array]:
        places_m = self.places_m.get(segment.experiment.name, {})
        names = segment.experiment.markers.names
        estimated = segment.chart.estimated.tolist()
        return {m: places_m[names[m]] for m in estimated if names[m] in places_m}

    def nuisance_of(self, collocation: Collocation) -> tuple[Array, int]:
        """Return p at the guess with the nuisance parameters that were found, and how many were.

        Places are those of the problem.
        """
        p, matches = collocation.guess_p, 0
        for segment in collocation.segments:
            for place, entry in zip(segment.local.places, segment.nuisance.entries, strict=True):
                name = f"{segment.experiment.name}: {entry.label}"
                if name in self.nuisance:
                    p[place] = self.nuisance[name] / entry.sigma
                    matches += 1
        return p, matches

    def variables(self, collocation: Collocation) -> Array | None:
        """Simulated variables z at the guess with the nuisance parameters that were found.

        None where there are none, or the simulation fails: the guess is all that is known then.
        Places are those of the problem.
        """
        p, matches = self.nuisance_of(collocation)
        matches += sum(len(self._known_places(segment)) for segment in collocation.segments)
        if not matches:
            return None
        p = np.clip(p, *collocation.bounds_p)
        positions, failure = marched(collocation, p)
        return None if failure is not None else collocation.pack(p, positions)
