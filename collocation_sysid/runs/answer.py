"""A solved problem with its checks: what is known of an answer, however it is shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np

from ..errors import InputError, hint_at
from ..fem.constants import is_mode, unit_of
from ..methods.solution import Solution
from ..model.parameters import Parameter, Parameters
from ..problem import Problem
from ..statistics.budget import BudgetLine, Sources, budget
from ..statistics.concern import Concern
from ..statistics.diagnostics import MarkerDiagnosis
from ..statistics.estimates import Estimate
from ..statistics.fields import FieldEstimate, fields_of
from ..statistics.hypothesis import Hypothesis
from ..statistics.identifiability import verdicts
from ..statistics.linearised import Derived
from ..statistics.numerical import Refinement
from ..statistics.profile import Profile
from ..statistics.relaxation import Probe
from ..statistics.trust import Trust, cause_concerns, numerical_concerns, probe_concerns
from ..statistics.uncertainty import Place, Uncertainty, places_of
from .check.motion import Motion
from .forward_simulation import Rollout
from .result import FoundValue
from .verdict import concerns, expected_rms_m, motions_of


@dataclass(frozen=True, eq=False)
class Answer:
    """A solved problem with its checks.

    Attributes
    ----------
    problem : Problem
    solution : Solution
    rollouts : mapping of experiment name to Rollout, or to the reason why there is none
    uncertainty : Uncertainty or None, where the solve did not converge
    diagnoses : tuple of MarkerDiagnosis, what the residuals suggest
    profiles : tuple of Profile, those asked for
    notes : tuple of str
        What went wrong after the solve.
    causes : tuple of Hypothesis
        What is likely described wrongly, likeliest first.
    refinement : Refinement or None
        What the discretisation does: solved again where that was asked for, else what the step
        does, to first order, from finer forward simulations; None where these are missing.
    missing : str
        What Ctrl-C left out after there was an answer.
    sources : Sources or None
        What moves the estimates beside the noise, where there are error bars.
    probes : tuple of Probe
        Refits with an assumption relaxed: the two of every solve, see `routine_probes`; or all, and
        of parts of the data, where these were asked for. Empty without error bars.
    """

    problem: Problem
    solution: Solution
    rollouts: Mapping[str, Rollout | str]
    uncertainty: Uncertainty | None
    diagnoses: tuple[MarkerDiagnosis, ...] = ()
    profiles: tuple[Profile, ...] = ()
    notes: tuple[str, ...] = ()
    causes: tuple[Hypothesis, ...] = ()
    refinement: Refinement | None = None
    missing: str = ""
    sources: Sources | None = None
    probes: tuple[Probe, ...] = ()

    def __repr__(self) -> str:
        solution = self.solution
        free = [item.name for item in self.problem.parameters.free]
        values = ", ".join(f"{name} = {_with_error(self.estimates[name])}" for name in free)
        rms = f"{1e3 * solution.rms_m:.3g} mm RMS"
        said = f"{solution.method}, {solution.status.value}, {self.trust.verdict}"
        return f"Run({said}: {values}; {rms})"

    @property
    def parameters(self) -> dict[str, float]:
        """Every parameter, by name."""
        return self.solution.parameters

    @property
    def started_from(self) -> Parameters:
        """The parameters with the guesses that the search started from."""
        return self.solution.collocation.parameters

    @cached_property
    def derived(self) -> dict[str, float]:
        """Moduli that follow from the parameters, by name."""
        constants = (segment.constants for segment in self.solution.collocation.segments)
        return dict(Derived.of(constants, self.solution.q).values)

    @cached_property
    def estimates(self) -> dict[str, FoundValue]:
        """Parameters and derived moduli, with intervals for all that `interval_holds` names."""
        errors = {} if self.refinement is None else self.refinement.errors
        items, values = {item.name: item for item in self.started_from.items}, {}
        for name, by_noise in self.noise_estimates.items():
            item, error = items.get(name), errors.get(name)
            ci95 = by_noise.ci95 if error is None else error.ci95
            guess, tied = item and item.guess, item and item.tied is not None
            values[name] = FoundValue(
                **vars(replace(by_noise, ci95=ci95)),
                ci95_holds=() if ci95 is None else self.interval_holds,
                ci95_noise=by_noise.ci95,
                numerical_error=error,
                whole95=self.budget[name].whole95 if name in self.budget else None,
                guess=np.nan if item and guess is None else guess,
                fixed=item and (item.fixed or tied),
                tied=tied or None,
            )
        return values

    @cached_property
    def budget(self) -> dict[str, BudgetLine]:
        """What the variance of each estimate is made of, by name; empty without error bars."""
        if self.uncertainty is None or self.sources is None:
            return {}
        errors = {} if self.refinement is None else self.refinement.errors
        linear = [item.name for item in self.started_from.items if item.scale == "linear"]
        return budget(self.sources, self.uncertainty, errors, linear)

    @property
    def interval_holds(self) -> tuple[str, ...]:
        """What the intervals hold: "noise", and of "step" and "mesh" what is known."""
        if self.uncertainty is None:
            return ()
        return ("noise",) if self.refinement is None else self.refinement.holds

    @cached_property
    def noise_estimates(self) -> dict[str, Estimate]:
        """The same with intervals for the noise alone."""
        bars = self.uncertainty
        known = {} if bars is None else {**bars.estimates, **bars.derived}
        values = self.parameters | self.derived
        return {name: known.get(name, Estimate(value)) for name, value in values.items()}

    @cached_property
    def places(self) -> dict[str, dict[str, Place]]:
        """Where the markers sit on the undeformed body, by fitted experiment and by marker."""
        named = ((part.segment.experiment.name, part) for part in self.solution.parts)
        return {name: places_of(part, self.uncertainty) for name, part in named}

    @cached_property
    def trust(self) -> Trust:
        """How far the answer can be trusted, in one word, with the reasons."""
        of_fit = concerns(
            self.solution, self.rollouts, self.motions.values(), self.uncertainty, self.diagnoses
        )
        numerical = numerical_concerns(self.estimates, self.refinement)
        of_fields = [concern for field in self.fields.values() for concern in field.concerns]
        if not self.missing:
            probed = probe_concerns(self.probes, [item.name for item in self._reported])
            causes = cause_concerns(self.causes)
            return Trust.of((*causes, *of_fit, *of_fields, *probed, *numerical))
        interrupted = Concern("solve/interrupted", "doubtful", {"left_out": self.missing})
        return Trust.of((interrupted, *(of_fit if self.uncertainty is not None else ())))

    @property
    def _reported(self) -> list[Parameter]:
        """The estimated parameters, without the shares of fields."""
        return [item for item in self.started_from.free if not is_mode(item.name)]

    @cached_property
    def motions(self) -> dict[str, Motion]:
        """How each experiment's body oscillates with the answer, by name."""
        return motions_of(self.problem, self.solution)

    @cached_property
    def fields(self) -> dict[str, FieldEstimate]:
        """The constants that differ from place to place, by name."""
        collocation, q = self.solution.collocation, self.solution.q
        bodies = dict.fromkeys(segment.body for segment in collocation.segments)
        known = (fields_of(b, collocation.parameters, q, self.uncertainty) for b in bodies)
        return {field.name: field for each in known for field in each}

    @property
    def noise_rms_m(self) -> float:
        """RMS distance of the fitted markers that noise of the sigma_m given would leave."""
        return expected_rms_m(self.solution, self.uncertainty)

    def interval(self, name: str) -> tuple[float, float] | None:
        """95 % interval of a parameter or derived modulus; None where there is none.

        It holds what `interval_holds` names.

        Raises
        ------
        InputError
            For an unknown name.
        """
        return self._estimate(name).ci95

    def std_error(self, name: str) -> float | None:
        """Standard error of a parameter or derived modulus; None where there is none.

        Raises
        ------
        InputError
            For an unknown name.
        """
        return self._estimate(name).std_error

    def to_frame(self) -> Any:
        """The estimates as a pandas DataFrame, a row each.

        Columns value, std_error, lower, upper, interval_holds, verdict, guess, unit.

        Raises
        ------
        InputError
            Without pandas.
        """
        try:
            pandas = import_module("pandas")
        except ImportError as error:
            raise InputError("a data frame needs pandas: pip install pandas") from error
        rows = {}
        for name, each in self.estimates.items():
            lower, upper = each.ci95 or (np.nan, np.nan)
            rows[name] = {
                "value": each.value,
                "std_error": np.nan if each.std_error is None else each.std_error,
                "lower": lower,
                "upper": upper,
                "interval_holds": ", ".join(each.ci95_holds),
                "verdict": self.trust.verdict,
                "guess": np.nan if each.tied or each.guess is None else each.guess,
                "unit": unit_of(name),
            }
        return pandas.DataFrame.from_dict(rows, orient="index")

    def _estimate(self, name: str) -> Estimate:
        if name not in self.estimates:
            known = list(self.estimates)
            expected = f"expected one of {', '.join(known)}{hint_at(name, known)}"
            raise InputError(f"no parameter {name!r}; {expected}")
        return self.estimates[name]

    @property
    def all_notes(self) -> tuple[str, ...]:
        """What the user should know after the solve, and what the data say of the parameters."""
        if self.uncertainty is None:
            return self.notes
        said = (*self.notes, *self.uncertainty.notes, *verdicts(self.uncertainty))
        return (*dict.fromkeys(said), *(profile.sentence for profile in self.profiles))


def _with_error(estimate: Estimate) -> str:
    error = "" if estimate.std_error is None else f" ± {estimate.std_error:.2g}"
    interval = "" if estimate.ci95 is None else " [{:.5g}, {:.5g}]".format(*estimate.ci95)
    return f"{estimate.value:.5g}{error}{interval}"
