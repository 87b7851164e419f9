"""Content of ``result.json``: one tree of plain values, from which pages and pictures are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from ..common.array_types import Array
from ..common.display import short
from ..common.files import RESULT_FILE, damage_refused, read_json
from ..common.serialisation import optional, read
from ..errors import InputError
from ..features import registry  # noqa: F401 (declares the messages of stored concerns)
from ..features.measurements import FitResult, ForwardResult
from ..fem.laws.constants import field_coefficient, symbol_of, unit_of
from ..fem.spatial_field import FieldResolution
from ..methods.solution import Iteration, Timing
from ..methods.starts.start import ScanSummary
from ..statistics.assessment import Assessment
from ..statistics.budget.combined_intervals import ReportedEstimate
from ..statistics.budget.discretisation_error import DiscretisationError, known_kinds
from ..statistics.budget.effect_estimates import EffectEstimate, JointPosterior
from ..statistics.combinations import Combination, Direction
from ..statistics.concerns import remedy_for
from ..statistics.profile_likelihood import Profile
from ..statistics.residuals.diagnostics import MarkerDiagnosis
from ..statistics.scale_identifiability import ScaleReference
from ..statistics.uncertainty import MarkerPlace

# Largest part of its prior deviation by which rounding moves a nuisance parameter without effect.
UNMOVED = 1e-6


@dataclass(frozen=True)
class Limit:
    """What limits the precision of an estimate."""

    determined: bool  # whether the combined interval is not wider than the value
    source: str  # largest source of the variance in the budget
    share: float  # its share of the variance
    remedy: str  # what to measure or to state in order to reduce it, an imperative phrase


@dataclass(frozen=True)
class NuisanceResult:
    """A nuisance parameter."""

    value: float  # estimate, in the unit that its label states
    prior: float  # standard deviation of its prior, in the same unit
    std_error: float | None  # statistical standard error; None without error bars


@dataclass(frozen=True)
class FieldResult:
    """A constant that varies in space; its arrays are in ``trajectory.npz``."""

    shapes: FieldResolution  # number of shapes, and how much of the prior variance they represent
    range: tuple[float, float]  # (least, most): range of its values in the elements
    # Share of the volume where the interval is less than half as wide as the prior's; None without
    # intervals.
    determined_share: float | None
    # Number of independent shapes that the data determine; None without intervals.
    identified: int | None
    # mapping of length in metres to float: logarithm of the evidence of other correlation lengths,
    # relative to the chosen one.
    likelier: Mapping[str, float]

    def coefficient_names(self, name: str) -> list[str]:
        """Return the names of the coefficients of the field.

        Parameters
        ----------
        name : str
            Name of the constant that varies, with its region.
        """
        region, dot, _ = name.rpartition(".")
        return [f"{region}{dot}{field_coefficient(k).name}" for k in range(self.shapes.modes)]

    def sentence(self, name: str) -> str:
        """Return a one-line summary of the field; `name` is the name of its constant."""
        least, most = self.range
        sentence = f"{symbol_of(name)} from {least:.3g} to {most:.3g} {unit_of(name)}".strip()
        if self.identified is None or self.determined_share is None:
            return sentence
        shapes = f"{self.identified} of the {self.shapes.modes} shapes of its field"
        share = f"halve the prior uncertainty in {self.determined_share:.0%} of the volume"
        details = [
            f"resolved details: above {short(1e3 * self.shapes.detail_m)} mm",
            f"values are those of a field smoothed over {short(1e3 * self.shapes.length_m)} mm, so "
            "that a small inclusion with a sharp boundary differs more; the intervals contain this",
        ]
        if len(self.likelier) > 1:
            each = ", ".join(f"{length} m {gain:+.1f}" for length, gain in self.likelier.items())
            details.append(
                f"correlation length {self.shapes.length_m:g} m; relative log evidence of the "
                f"lengths: {each}"
            )
        return f"{sentence}: the data determine {shapes} and {share} ({'; '.join(details)})"


@dataclass(frozen=True)
class RecordingsAgreement:
    """Estimates of a parameter from single recordings, to first order, and their agreement."""

    # mapping of recording to float: estimates from single recordings; NaN where a recording does
    # not determine the parameter.
    values: Mapping[str, float]
    # mapping of recording to float: their standard deviations, in the coordinate of the estimate.
    deviations: Mapping[str, float]
    chi_squared: float  # χ² of their differences
    # Number of recordings that determine the parameter, less one, at least 0.
    degrees_of_freedom: int
    disagree: bool  # whether the differences are significant


@dataclass(frozen=True, eq=False)
class UncertaintyResult:
    """Statistics behind the error bars.

    Matrices refer to the logarithms (or other coordinates) of the k parameters in `names`;
    coefficients of fields are left out.

    Attributes
    ----------
    noise : {"given", "estimated", "by-marker"}
        Source of the variance: stated σ, one common factor, or one factor for each marker.
    errors : {"independent", "autocorrelated"}
        Correlation of the errors.
    reduced_chi_squared : float
        χ² over the degrees of freedom.
    noise_factors : mapping of str to float
        Standard deviation of the errors of each marker or other observable over σ, by name.
    autocorrelation : float
        Autocorrelation of the residuals between consecutive samples.
    names : tuple of str
        Estimated parameters.
    correlation, covariance : (k, k) arrays
        Statistical correlation and covariance.
    quantiles : (k,) array
        Half width of a statistical 95 % interval over the standard error.
    combined_covariance : (k, k) array or None
        Covariance due to noise, discretisation and systematic effects, whose 95 % intervals have
        half widths of 1.96 standard deviations; None if systematic effects were not evaluated.
    draw_covariance : (n, n) array or None
        Covariance in SI units of draws of all n estimated parameters, also of those at a bound; None
        if systematic effects were not evaluated.
    verdicts : tuple of str
        Sentences on what the data determine.
    combinations : tuple of Combination
        Combinations of constants that are determined although a constant alone is not.
    directions : tuple of Direction
        Independent combinations of all constants that are not at a bound, the best determined
        first; intervals are combined.
    recordings : mapping of str to RecordingsAgreement, or None
        Agreement of the recordings, by parameter; None if it was not evaluated.
    profiles : mapping of str to Profile
        Requested profile likelihoods, by parameter.
    """

    noise: str
    errors: str
    reduced_chi_squared: float
    noise_factors: Mapping[str, float]
    autocorrelation: float
    names: tuple[str, ...]
    correlation: Array
    covariance: Array
    quantiles: Array
    verdicts: tuple[str, ...]
    recordings: Mapping[str, RecordingsAgreement] | None
    profiles: Mapping[str, Profile]
    combined_covariance: Array | None = optional()  # noqa: RUF009, it returns a field
    draw_covariance: Array | None = optional()  # noqa: RUF009, it returns a field
    combinations: tuple[Combination, ...] = ()
    directions: tuple[Direction, ...] = ()


@dataclass(frozen=True)
class DynamicsResult:
    """Residuals of the equations of motion."""

    max_violation_n: float  # largest residual [N]
    max_violation_relative: float  # largest residual relative to the largest other force
    largest: tuple[str, ...]  # sentences on where the residual is largest


@dataclass(frozen=True)
class ProgramSize:
    """Size of the discretised problem and its scheme."""

    # Numbers of nodes and elements of all bodies.
    nodes: int
    elements: int
    substeps: int  # time steps per sample
    timesteps: int  # time steps of all fitted experiments
    # Size of the nonlinear program.
    variables: int
    constraints: int
    scheme: str  # name of the time scheme


@dataclass(frozen=True)
class Provenance:
    """Software, platform and problem files from which the result was made."""

    # Versions of this package, CasADi, NumPy and Python, and the platform.
    version: str
    casadi: str
    numpy: str
    python: str
    platform: str
    # Path of the problem file and hash of its text as it was run; None for a problem without a
    # file.
    problem_file: str | None
    problem_sha256: str | None
    mesh_sha256: tuple[str, ...]  # hash of the mesh of each body


@dataclass(frozen=True)
class Elapsed:
    """Wall-clock time of the parts of a run [s]."""

    # From the problem to the optimum: finding a start, and every search that led to the answer,
    # also with finer steps.
    search: float = 0.0
    checks: float = 0.0  # forward simulations, uncertainties, budget and likely causes
    # Drawing and writing the pictures; None if they have not been drawn.
    pictures: float | None = None


@dataclass(frozen=True, eq=False)
class Result:
    """The content of ``result.json``; the attributes are its keys.

    Attributes
    ----------
    schema : int
        Version of the format.
    status, message : str
        How the search ended, as a keyword and as a sentence.
    converged : bool
        Whether an optimum was found.
    missing : str
        Checks that were left out after Ctrl-C; empty if all were done.
    trust : Assessment
        Verdict with its concerns.
    method, title : str
        Name of the method, and title of the problem.
    parameters, derived : mapping of name to ReportedEstimate
        All parameters, coefficients of fields included, and moduli that follow from them.
    basis : tuple of str
        Sentences on what the values refer to: the damping law, what sets the scale, and the
        axis of E.
    budget : mapping of name to mapping of source to float
        Share of each source in the variance of each estimate, largest first; empty without error
        bars.
    effects : tuple of EffectEstimate
        Prior and posterior of each effect of the budget, the most surprising first; empty without
        error bars.
    joint : JointPosterior or None
        Joint posterior of what acts on the body, for predictions of other motions; None without error
        bars.
    scale : ScaleReference or None
        The stated mass to which moduli are relative; None if a force or a prior sets their scale.
    places : mapping of experiment to mapping of marker to MarkerPlace
        Estimated places of the markers on the undeformed body.
    nuisance : mapping of experiment to mapping of label to NuisanceResult
        Other nuisance parameters.
    fields : mapping of name to FieldResult
        Constants that vary in space.
    uncertainty : UncertaintyResult or None
        Statistics behind the error bars; None without error bars.
    scan : ScanSummary or None
        Scan of the stiffness; None if there was none.
    fit, rollout : FitResult, ForwardResult
        Errors of the fit and of the forward simulations.
    residuals : tuple of MarkerDiagnosis
        Findings in the residuals.
    dynamics : DynamicsResult
        Residuals of the equations of motion.
    iterations, evaluations : int
        Numbers of iterations and of evaluations of the search that gave the solution, with those
        of one with fewer substeps before it; searches from other starts do not count.
    timing_s : Timing
        Time of the method's iterations alone.
    elapsed_s : Elapsed
        Time of the complete run.
    problem : ProgramSize
        Size of the discretised problem.
    notes : tuple of str
        Notes on the problem, the solve and its uncertainty.
    history : tuple of Iteration
        Iterations of the search.
    provenance : Provenance
        Software and files.
    """

    SERIALISED_PROPERTIES: ClassVar = ("limits",)

    schema: int
    status: str
    converged: bool
    message: str
    missing: str
    trust: Assessment
    method: str
    title: str
    parameters: Mapping[str, ReportedEstimate]
    derived: Mapping[str, ReportedEstimate]
    basis: tuple[str, ...]
    budget: Mapping[str, Mapping[str, float]]
    effects: tuple[EffectEstimate, ...]
    joint: JointPosterior | None
    scale: ScaleReference | None
    places: Mapping[str, Mapping[str, MarkerPlace]]
    nuisance: Mapping[str, Mapping[str, NuisanceResult]]
    fields: Mapping[str, FieldResult]
    uncertainty: UncertaintyResult | None
    scan: ScanSummary | None
    fit: FitResult
    residuals: tuple[MarkerDiagnosis, ...]
    dynamics: DynamicsResult
    rollout: ForwardResult
    iterations: int
    evaluations: int
    timing_s: Timing
    elapsed_s: Elapsed
    problem: ProgramSize
    notes: tuple[str, ...]
    history: tuple[Iteration, ...]
    provenance: Provenance

    @classmethod
    def read(cls, run: str | Path, expected: str = "a run folder") -> Result:
        """Read the result in a run folder.

        Parameters
        ----------
        expected : str
            What is expected, for the message if the folder has no result.

        Raises
        ------
        InputError
            If it is no run folder, or damaged.
        """
        folder = Path(run)
        content = read_json(folder / RESULT_FILE, expected)
        with damage_refused(folder, RESULT_FILE, remedy="solve the problem again"):
            return read(cls, content)

    @property
    def limits(self) -> dict[str, Limit]:
        """What limits the precision of each estimate with a budget, by name."""
        estimates = self.estimates
        return {
            name: Limit(estimates[name].is_determined, source, share, remedy_for(source))
            for name, shares in self.budget.items()
            if name in estimates
            for source, share in [*shares.items()][:1]
        }

    @property
    def estimates(self) -> dict[str, ReportedEstimate]:
        """Scalar parameters, then derived moduli, by name."""
        coefficients = {
            coefficient
            for name, field in self.fields.items()
            for coefficient in field.coefficient_names(name)
        }
        both = {**self.parameters, **self.derived}
        return {name: each for name, each in both.items() if name not in coefficients}

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """Combinations of constants that are determined although a constant alone is not."""
        return () if self.uncertainty is None else self.uncertainty.combinations

    @property
    def discretisation_kinds(self) -> tuple[str, ...]:
        """Kinds of discretisation error that a refinement measured: "step", "mesh"."""
        return known_kinds(self.numerical_errors.values())

    @property
    def numerical_errors(self) -> dict[str, DiscretisationError]:
        """Measured discretisation errors, by name of the estimate."""
        errors = ((name, each.numerical_error) for name, each in self.estimates.items())
        return {name: error for name, error in errors if error is not None}

    def problem_folder(self, run: str | Path, purpose: str) -> Path:
        """Return the folder of the problem file that the run was made from; whether it still exists
        is not checked.

        Parameters
        ----------
        run : str or Path
            The run folder, for the message.
        purpose : str
            Who needs the file, for the message, such as "which refine needs".

        Raises
        ------
        InputError
            If the run was not made from a problem file.
        """
        if self.provenance.problem_file is None:
            raise InputError(f"the run has no problem file, {purpose}", run)
        return Path(self.provenance.problem_file).parent
