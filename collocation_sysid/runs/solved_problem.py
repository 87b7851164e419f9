"""A solved problem with its checks: estimates, uncertainties and verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..common.validated_types import AtLeastOne, Count
from ..errors import InputError, hint_at
from ..fem.laws.constants import unit_of
from ..judge.posterior import BudgetLine, Posterior
from ..methods.solution import Solution
from ..problem import Problem
from ..recording.measurement import Measurement
from ..statistics.assessment import (
    OPEN_CAUSES,
    Assessment,
    cause_concerns,
    fit_concerns,
    numerical_concerns,
)
from ..statistics.budget.combined_intervals import ReportedEstimate, combine
from ..statistics.budget.discretisation_error import Refinement
from ..statistics.budget.effect_estimates import EffectEstimate, JointPosterior, effect_concerns
from ..statistics.budget.systematic_effects import DISCRETISATION
from ..statistics.combinations import (
    Combination,
    Direction,
    Fix,
    identifiability_sentences,
    principal_directions,
    vague_constants,
    with_something_to_state,
)
from ..statistics.concerns import Concern
from ..statistics.estimates import Estimate, relative_derivatives
from ..statistics.field_estimates import FieldEstimate, field_estimates
from ..statistics.hypothesis import Hypothesis
from ..statistics.linearised import DerivedModuli, LinearisedFit
from ..statistics.profile_likelihood import Profile
from ..statistics.residuals.diagnostics import MarkerDiagnosis
from ..statistics.uncertainty import MarkerPlace, Uncertainty, marker_places
from .check.modes import ModesCheck
from .ensemble import draw_samples
from .facts import facts
from .forward_simulation import ForwardSimulation
from .mesh_resolution import mesh_resolution_concerns, mesh_resolution_notes
from .result_content import Elapsed
from .verdict import expected_rms_m, modes_by_experiment, solution_concerns, unknown_concerns

# Most draws of `SolvedProblem.samples`, which take an hour.
MOST_DRAWS = 1_000_000


@dataclass(frozen=True, eq=False)
class SolvedProblem:
    """A solved problem with its checks."""

    problem: Problem  # the problem that was solved
    solution: Solution  # its solution, converged or not
    # mapping of experiment name to ForwardSimulation or str: forward simulations, or the reason why
    # there is none.
    rollouts: Mapping[str, ForwardSimulation | str]
    uncertainty: Uncertainty | None  # none if the solve did not converge
    # Linearised fit at the solution, without the noise of the poses; None if the solve did not
    # converge or cannot be linearised.
    fit: LinearisedFit | None = None
    diagnoses: tuple[MarkerDiagnosis, ...] = ()  # findings in the residuals
    # mapping of parameter to Profile: profile likelihoods that were requested.
    profiles: Mapping[str, Profile] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # problems after the solve
    # Likely errors in the description of the problem, likeliest first.
    causes: tuple[Hypothesis, ...] = ()
    # Discretisation errors that solves at finer discretisations measured; None without these.
    refinement: Refinement | None = None
    omitted_checks: str = ""  # checks that were left out after Ctrl-C; empty if all were done
    posterior: Posterior | None = None  # with all effects of the budget; None without error bars
    # Effects beyond the budget, the best first; empty for a consistent fit.
    suspects: Sequence[EffectEstimate] = ()
    # Changes of the estimates over their values by elements of half the size; None if unknown.
    by_mesh: Mapping[str, float] | None = None
    # mapping of frozenset of str to Fix: the sensor or test that would determine the constants of a
    # combination best, by their names.
    added_measurements: Mapping[frozenset[str], Fix] = field(default_factory=dict)
    elapsed_s: Elapsed = field(default_factory=Elapsed)  # durations of search and checks

    def __repr__(self) -> str:
        solution = self.solution
        values = ", ".join(
            f"{item.name} = {_estimate_text(self.estimates[item.name])}"
            for item in self.problem.parameters.free_scalars
        )
        rms = f"{1e3 * solution.rms_m:.3g} mm RMS"
        summary = f"{solution.method}, {solution.status.value}, {self.trust.verdict}"
        return f"Run({summary}: {values}; {rms})"

    @property
    def parameters(self) -> dict[str, float]:
        """Values of all parameters by name in SI units, also fixed ones, with the corrections of the
        posterior.
        """
        return {name: self.estimates[name].value for name in self.solution.parameters}

    @cached_property
    def derived(self) -> dict[str, float]:
        """Moduli that follow from the parameters at the optimum, by name, in SI units."""
        constants = (
            transcription.constants for transcription in self.solution.collocation.transcriptions
        )
        return dict(DerivedModuli.from_bodies(constants, self.solution.q).values)

    @cached_property
    def estimates(self) -> dict[str, ReportedEstimate]:
        """Parameters, also fixed ones, coefficients of fields and derived moduli with their
        combined and statistical intervals, by name.
        """
        values = self.solution.parameters | self.derived
        return {name: self._report_estimate(name, value) for name, value in values.items()}

    def _report_estimate(self, name: str, optimum: float) -> ReportedEstimate:
        posterior = self.posterior
        known = self._statistical.get(name, Estimate(optimum))
        item = next(
            (each for each in self.solution.collocation.parameters.components if each.name == name),
            None,
        )
        if posterior is None or name not in self.budget:
            combined = ReportedEstimate(**vars(known))
        else:
            combined = posterior.reported(name)
            besides = self._besides_discretisation
            combined = replace(
                combined,
                systematic=besides.systematic(name),
                known_effect=besides.change(name, optimum),
            )
        combined = replace(combined, optimum=optimum)
        if self.refinement is not None and name in self.refinement.errors:
            linear, bounds = self.solution.collocation.parameters.scale_and_bounds(name)
            combined = combine(
                name,
                combined.at_optimum(name, linear=linear),
                error=self.refinement.errors[name],
                systematic=combined.systematic,
                known_effect=combined.known_effect or 0.0,
                linear=linear,
                bounds=bounds,
            )
        if item is None:
            return combined
        guess = np.nan if item.guess is None else item.guess
        tied = item.tied is not None
        return replace(combined, guess=guess, fixed=item.is_fixed or tied, tied=tied or None)

    @cached_property
    def _statistical(self) -> dict[str, Estimate]:
        bars = self.uncertainty
        return {} if bars is None else {**bars.estimates, **bars.derived}

    @cached_property
    def _besides_discretisation(self) -> Posterior:
        """The posterior without the errors of mesh and time step, which a refinement measures."""
        assert self.posterior is not None
        return self.posterior.without(row.name for row in DISCRETISATION)

    @property
    def optimum(self) -> dict[str, Estimate]:
        """Parameters, also fixed ones, and derived moduli at the optimum of the discretised problem,
        by name, with statistical intervals where they are known.
        """
        linear = self.solution.collocation.parameters.linear_names
        return {
            name: each.at_optimum(name, linear=name in linear)
            for name, each in replace(self, refinement=None).estimates.items()
        }

    @property
    def budget(self) -> dict[str, BudgetLine]:
        """The uncertainty budget of each estimate, by name; empty without error bars."""
        return {} if self.posterior is None else self.posterior.budget

    @property
    def effects(self) -> tuple[EffectEstimate, ...]:
        """Posterior of each effect of the budget, the most surprising first; empty without error
        bars.
        """
        return () if self.posterior is None else self.posterior.effect_estimates

    @property
    def joint(self) -> JointPosterior | None:
        """Joint posterior of what acts on the body, relative to the solution; None without error bars."""
        return None if self.posterior is None else self.posterior.joint(
            self.solution.collocation.transcriptions
        )  # fmt: skip

    @cached_property
    def is_consistent(self) -> bool:
        """Whether residuals, effects and nuisance parameters are as expected of a true description."""
        if self.uncertainty is None or self.posterior is None:
            return False
        return not (
            fit_concerns(self.uncertainty)
            or effect_concerns(self.effects)
            or unknown_concerns(self.solution, self.posterior)
        )

    @cached_property
    def places(self) -> dict[str, dict[str, MarkerPlace]]:
        """Places of all markers on the undeformed body at the solution, by name of the fitted
        experiment and of the marker, also those that were exactly known (prior of zero).

        An experiment without markers has an empty entry; see `marker_places`.
        """
        named = ((part.transcription.experiment.name, part) for part in self.solution.parts)
        return {name: marker_places(part, self.uncertainty) for name, part in named}

    @cached_property
    def trust(self) -> Assessment:
        """Verdict (good, check or doubtful) with its concerns.

        It is computed from estimates, budget and natural modes at the first access. After an
        interruption it is doubtful, and contains concerns about the solution only if the error bars
        were computed.
        """
        stated = [each for each in facts(self.problem) if isinstance(each, Concern)]
        effects = effect_concerns(self.effects, self.suspects)
        grade = effects[0].grade if effects else None
        if not (self.solution.collocation.nq or self.posterior is None or self.effects):
            grade = "doubtful"  # nothing but the stated constants explains a difference
        of_fit = list(
            solution_concerns(
                self.solution,
                self.rollouts,
                motions=self.modes_by_experiment.values(),
                uncertainty=self.uncertainty,
                posterior=self.posterior,
                surprise=grade,
                is_step_known=self.posterior is not None
                and self.is_consistent
                and "time_step" in self.posterior.considered.names,
            )
        )
        # What is far from its prior hides another error if it cannot be so far, or leaves residuals.
        leaves = any(e.code == "noise/larger" and e.grade == "doubtful" for e in of_fit)
        hiding = "nuisance/" if leaves else "nuisance/large"
        of_fit.sort(key=lambda each: each.code.startswith(hiding))
        if not self.solution.collocation.nq:
            effects = []
        uncertainties = {name: each.combined_std_error for name, each in self.estimates.items()}
        numerical = numerical_concerns(self.optimum, uncertainties, refinement=self.refinement)
        of_fields = [concern for field in self.fields.values() for concern in field.list_concerns()]
        if not self.omitted_checks:
            causes = cause_concerns(self.causes)
            if any(each.suffices for each in self.suspects):
                causes = [each for each in causes if each.code != "description/insufficient"]
            meshes = mesh_resolution_concerns(self.problem, self.refinement, self.by_mesh)
            # Effects are judged with this mesh, so that a coarse one is as grave, and those of the budget
            # explain nothing where residuals remain.
            known = [*meshes] if effects else []
            if effects and not effects[0].data["suffices"]:
                known += [e for e in of_fit if e.code in ("residuals/shared", "noise/larger")]
            known = [replace(each, grade=effects[0].grade) for each in known]
            # What is farther from its prior than an effect may distort the effects.
            surprise = effects[0].data["surprise"] if effects else np.inf
            farther = [
                each
                for each in of_fit
                if each.data.get("deviations", 0.0) > surprise and not each.code.startswith(hiding)
            ]
            return Assessment.from_concerns(
                (
                    *(e for e in causes if e.code not in OPEN_CAUSES or e.grade == "doubtful"),
                    *known,
                    *farther,
                    *effects,
                    *causes,
                    *(each for each in of_fit if each not in farther),
                    *of_fields,
                    *numerical,
                    *([] if effects else meshes),
                    *stated,
                )
            )
        interrupted = Concern(
            "solve/interrupted", "doubtful", data={"left_out": self.omitted_checks}
        )
        return Assessment.from_concerns(
            (interrupted, *stated, *(of_fit if self.uncertainty is not None else ()))
        )

    @cached_property
    def modes_by_experiment(self) -> dict[str, ModesCheck]:
        """Natural modes of the body at the estimates, by name of the experiment, also of those for
        validation; see `verdict.modes_by_experiment`.

        Static experiments are left out, and those whose modes cannot be computed. Empty if the
        solve did not converge.
        """
        return modes_by_experiment(self.problem, self.solution)

    @cached_property
    def fields(self) -> dict[str, FieldEstimate]:
        """Estimated fields (spatially varying constants), by name of the constant; empty without
        fields. Without error bars their standard deviations are NaN.
        """
        collocation = self.solution.collocation
        q = self._q
        bodies = dict.fromkeys(transcription.body for transcription in collocation.transcriptions)
        known = (
            field_estimates(b, collocation.parameters, q=q, uncertainty=self.uncertainty)
            for b in bodies
            if b.field_lengths_m
        )
        return {field.name: field for each in known for field in each}

    @property
    def noise_rms_m(self) -> float:
        """RMS distance [m] of the fitted markers that is expected from noise with the
        stated `sigma_m`, less what the fitted parameters absorb; 0 without markers.
        """
        return expected_rms_m(self.solution, self.uncertainty)

    @validated
    def interval(self, name: str) -> tuple[float, float]:
        """Return the combined 95 % interval (lower, upper) of a parameter or derived modulus in its
        SI unit, the one to publish.

        Both ends are NaN if there is none: the solve has not converged, or the parameter was not
        estimated, is at a bound or has no error bar, see `ReportedEstimate`.

        Raises
        ------
        InputError
            For an unknown name.
        """
        return self._estimate(name).combined95 or (np.nan, np.nan)

    @validated
    def std_error(self, name: str) -> float:
        """Return the combined standard uncertainty of a parameter or derived modulus, in its SI
        unit.

        NaN under the same conditions as `interval`.

        Raises
        ------
        InputError
            For an unknown name.
        """
        return _or_nan(self._estimate(name).combined_std_error)

    def covariance(
        self,
        kind: Literal["combined", "statistical"] = "combined",
        units: Literal["relative", "si"] = "relative",
    ) -> Array:
        """Return the covariance (k, k) of the estimated parameters, in the order of
        `uncertainty.names`.

        The diagonal of the combined covariance has the squares of the combined standard
        uncertainties of the table.

        Parameters
        ----------
        kind : {"combined", "statistical"}
            Due to noise, discretisation and systematic effects together, or to noise alone.
        units : {"relative", "si"}
            Of the logarithms of the parameters (of a parameter that may be negative, of its value
            over its size), or of the parameters in their SI units.

        Returns
        -------
        (k, k) array
            NaN in rows and columns of parameters at a bound, and in those that have no combined
            uncertainty.

        Raises
        ------
        InputError
            For an unknown kind or unit, or without error bars.
        """
        for name, found, known in (
            ("kind", kind, ("combined", "statistical")),
            ("units", units, ("relative", "si")),
        ):
            if found not in known:
                raise InputError(f"{name}: found {found!r}; expected one of {', '.join(known)}")
        if self.uncertainty is None or self.posterior is None:
            raise InputError("the run has no error bars, and therefore no covariance")
        matrix = self.uncertainty.covariance
        by_value = self._relative_by_value()
        if kind == "combined":
            deviations = self._collect_relative_deviations()
            # The budget adds little to the sum of the contributions, such as Student's quantiles.
            factors = deviations / np.sqrt(np.diag(self._complete_covariance))
            matrix = self._complete_covariance * np.outer(factors, factors)
        return matrix if units == "relative" else matrix / np.outer(by_value, by_value)

    @validated
    def samples(self, count: Annotated[AtLeastOne, Field(le=MOST_DRAWS)], seed: Count = 0) -> Any:
        """Return draws from the combined distribution of the parameters as a pandas DataFrame, one
        row each, for simulations with random constants.

        The columns are all parameters, also fixed and tied ones, and the derived moduli, in SI
        units (`attrs["units"]`). The distribution is normal in the coordinates in which the
        intervals are symmetric, usually logarithms, with the correlations of `covariance`, within
        the bounds of the parameters and with moduli of a stable material. A parameter that the
        data do not determine varies between its bounds; one at a bound varies on one side of it.

        Parameters
        ----------
        count : int
            Number of draws, from 1 to `MOST_DRAWS`.
        seed : int
            Seed, at least 0, of the random numbers; the same seed gives the same draws.

        Raises
        ------
        InputError
            Without error bars or pandas, for another count, or if hardly any draw is admissible.
        """
        pandas = _optional_package("pandas", "a data frame")
        if self.uncertainty is None or self.posterior is None:
            raise InputError("the run has no error bars, and therefore no samples")
        draws = draw_samples(
            self.solution.collocation,
            self.parameters,
            self.draw_covariance,
            self.combinations,
            count,
            seed,
        )
        frame = pandas.DataFrame(draws)
        frame.index.name = "sample"
        frame.attrs["units"] = {name: unit_of(name) for name in frame.columns}
        return frame

    @property
    def draw_covariance(self) -> Array:
        """Covariance (k, k) of the draws of `samples` in SI units, of all estimated parameters: wide,
        not NaN, where one is not determined. The run must have error bars.
        """
        complete = self._complete_covariance
        factors = self._collect_relative_deviations() / np.sqrt(np.diag(complete))
        factors = np.nan_to_num(factors, nan=1.0) / self._relative_by_value()
        return complete * np.outer(factors, factors)

    def predicted(self) -> dict[str, Any]:
        """Return the predictions of the fit as labelled arrays.

        Returns
        -------
        dict of str to xarray.DataArray
            By "experiment: measurement", with the dimensions time [s] and quantity and the unit in
            `attrs`; NaN where a sample was not predicted. Points of depth cameras, which have no
            labels, are left out.

        Raises
        ------
        InputError
            Without xarray.
        """
        return {
            title: self._labelled(measurement, values)
            for title, measurement, values in self._iterate_fitted()
        }

    def residuals(self) -> dict[str, Any]:
        """Return the measured values less the predictions of the fit, as `predicted`; NaN also
        where nothing was measured. `attrs["sigma"]` has the stated standard deviation of each
        quantity.

        Raises
        ------
        InputError
            Without xarray.
        """
        return {
            title: self._labelled(measurement, measurement.measured_values - values).assign_attrs(
                sigma=measurement.value_sigmas.tolist()
            )
            for title, measurement, values in self._iterate_fitted()
        }

    def _iterate_fitted(self) -> Iterator[tuple[str, Measurement, Array]]:
        """Yield title, measurement and prediction (S, m) of every measurement with labels."""
        for part in self.solution.parts:
            experiment = part.transcription.experiment
            fitted = self.solution.fitted_values[experiment.name]
            titles = Counter[str]()
            for measurement, values in zip(experiment.measurements, fitted, strict=True):
                if not isinstance(values, np.ndarray) or not measurement.measured_values.size:
                    continue
                titles[measurement.title] += 1
                number = titles[measurement.title]
                which = f" {number}" if number > 1 else ""
                yield f"{experiment.name}: {measurement.title}{which}", measurement, values

    @staticmethod
    def _labelled(measurement: Measurement, values: Array) -> Any:
        """Return numbers (S, m) of a measurement as an array with labels."""
        xarray = _optional_package("xarray", "a labelled array")
        return xarray.DataArray(
            values,
            dims=("time", "quantity"),
            coords={
                "time": ("time", measurement.sample_times_s, {"units": "s"}),
                "quantity": list(measurement.number_names),
            },
            name=measurement.title,
            attrs={"units": measurement.unit},
        )

    def _relative_by_value(self) -> Array:
        """Return the derivatives (k,) of relative coordinates by values."""
        parameters = self.solution.collocation.parameters
        by_value = relative_derivatives(parameters, self._q)
        values = parameters.values(self._q)
        for k, item in enumerate(parameters.free):
            by_value[k] /= item.value_derivative(values[item.name])
            if item.scale == "log" and self.estimates[item.name].value:
                by_value[k] = 1 / self.estimates[item.name].value
        return by_value

    def _collect_relative_deviations(self) -> Array:
        """Return their combined standard uncertainties, or NaN."""
        known = [_or_nan(self.estimates[n].combined_std_error) for n in self._estimated_names]
        return np.abs(self._relative_by_value()) * np.array(known)

    @property
    def _q(self) -> Array:
        return self.solution.q if self.posterior is None else self.posterior.reported_q

    @property
    def _estimated_names(self) -> tuple[str, ...]:
        return tuple(item.name for item in self.solution.collocation.parameters.free)

    @cached_property
    def _complete_covariance(self) -> Array:
        """Finite combined covariance (k, k) of relative coordinates."""
        assert self.uncertainty is not None
        assert self.posterior is not None
        parameters = self.solution.collocation.parameters
        return self.posterior.combine_covariance(
            self.uncertainty.complete_covariance, relative_derivatives(parameters, self._q)
        )

    @cached_property
    def combinations(self) -> tuple[Combination, ...]:
        """Combinations of constants that are determined although a constant alone is not, then
        constants that are not determined and in no combination but would be by one of their
        `fixes`; empty without error bars. Coefficients of fields and parameters at a bound are left
        out.
        """
        return with_something_to_state(self.vague_constants)

    @cached_property
    def vague_constants(self) -> tuple[Combination, ...]:
        """`combinations`, and the constants that none of their `fixes` would determine."""
        names, values, covariance = self._stated_covariance()
        if not names or self.uncertainty is None:
            return ()
        vague = {name for name in names if not self.estimates[name].is_determined}
        places = [self._estimated_names.index(name) for name in names]
        noise = self.uncertainty.complete_covariance[np.ix_(places, places)]
        moduli = self._modulus_slopes(names)
        return vague_constants(
            names, values, covariance, noise, vague, moduli, self.added_measurements
        )

    @cached_property
    def principal_directions(self) -> tuple[Direction, ...]:
        """Independent combinations of the constants of `combinations`, the best determined first."""
        return principal_directions(*self._stated_covariance())

    def _stated_covariance(self) -> tuple[list[str], Array, Array]:
        """Names, values and covariance of scalars that are not at a bound."""
        if self.uncertainty is None or self.posterior is None:
            return [], np.zeros(0), np.zeros((0, 0))
        free = enumerate(self._estimated_names)
        kept = {k: n for k, n in free if n in self._statistical and not self.estimates[n].at_bound}
        values = np.array([self.parameters[name] for name in kept.values()])
        return [*kept.values()], values, self._complete_covariance[np.ix_([*kept], [*kept])]

    def _modulus_slopes(self, names: Sequence[str]) -> dict[str, Array]:
        """Return ∂ln of the derived moduli by logarithms of parameters (k,)."""
        assert self.posterior is not None
        sizes = relative_derivatives(self.solution.collocation.parameters, self._q)
        places = [self._estimated_names.index(name) for name in names]
        by_q = self.posterior.derivatives
        return {
            modulus: (by_q[modulus] / sizes)[places] / value
            for modulus, value in self.derived.items()
            if value
        }

    def nuisance(self, name: str) -> float:
        """Return the value of a nuisance parameter of a recording in its unit; `name` is as in
        `Solution.nuisance`, for example "swing: time shift [s]".

        Raises
        ------
        InputError
            If no nuisance parameter has this name, or several, even with equal values.
        """
        return self.solution.nuisance(name)

    def to_frame(self) -> Any:
        """Return the estimates as a pandas DataFrame, one row each with the name of the parameter
        or derived modulus as index.

        Columns: value, combined_std_error, combined_lower, combined_upper, statistical_std_error,
        statistical_lower, statistical_upper, verdict, guess, unit. Lower and upper are ends of 95 %
        intervals. Numbers are in the SI unit of the column unit, empty if there is none; NaN stands
        for what is unknown, and for the guess of a tied parameter. The verdict (good, check or
        doubtful) is that of the complete solve, the same in all rows.

        Raises
        ------
        InputError
            Without pandas.
        """
        pandas = _optional_package("pandas", "a data frame")
        rows = {name: self._row(name) for name in self.estimates}
        return pandas.DataFrame.from_dict(rows, orient="index")

    def _row(self, name: str) -> dict[str, float | str]:
        each = self.estimates[name]
        combined = each.combined95 or (np.nan, np.nan)
        statistical = each.statistical95 or (np.nan, np.nan)
        return {
            "value": each.value,
            "combined_std_error": _or_nan(each.combined_std_error),
            "combined_lower": combined[0],
            "combined_upper": combined[1],
            "statistical_std_error": _or_nan(each.statistical_std_error),
            "statistical_lower": statistical[0],
            "statistical_upper": statistical[1],
            "verdict": self.trust.verdict,
            "guess": np.nan if each.tied else _or_nan(each.guess),
            "unit": unit_of(name),
        }

    def _estimate(self, name: str) -> ReportedEstimate:
        if name not in self.estimates:
            known = list(self.estimates)
            expected = f"expected one of {', '.join(known)}{hint_at(name, known)}"
            raise InputError(f"no parameter {name!r}; {expected}")
        return self.estimates[name]

    @property
    def all_notes(self) -> tuple[str, ...]:
        """Notes on the solve, and with error bars also those on coarse meshes and on the
        uncertainty, sentences on what the data determine, and the messages of
        profiles. Notes that are equal appear once.
        """
        if self.uncertainty is None:
            return self.notes
        notes = (
            *self.notes,
            *mesh_resolution_notes(self.problem, self.by_mesh),
            *self.uncertainty.notes,
            *identifiability_sentences(self.uncertainty, self.combinations),
        )
        return (*dict.fromkeys(notes), *(profile.sentence for profile in self.profiles.values()))


def _optional_package(name: str, purpose: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(f"{purpose} needs {name}: pip install {name}") from error


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def _estimate_text(estimate: ReportedEstimate) -> str:
    """Return "value ± uncertainty [interval]" without unit, as far as known."""
    error = "" if estimate.combined_std_error is None else f" ± {estimate.combined_std_error:.2g}"
    interval = (
        "" if estimate.combined95 is None else " [{:.5g}, {:.5g}]".format(*estimate.combined95)
    )
    return f"{estimate.value:.5g}{error}{interval}"
