"""What ``result.json`` holds: one tree of plain values, from which pages and pictures are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from ..arrays import Array
from ..display import short
from ..errors import InputError
from ..fem.constants import is_mode, symbol_of, unit_of
from ..fem.field import FieldShapes
from ..fem.two_phase import PhaseFinding
from ..files import RESULT_FILE, damage_refused, read_json
from ..methods.solution import Iteration, Timing
from ..program.depth_comparison import DepthError
from ..program.touches import Rubbing
from ..statistics.diagnostics import MarkerDiagnosis
from ..statistics.estimates import Coordinate, Estimate
from ..statistics.numerical import NumericalError, known_kinds
from ..statistics.relaxation import Probe
from ..statistics.trust import Trust
from ..statistics.uncertainty import Place
from ..tree import optional, read
from .prediction import CopyError, PredictionError


@dataclass(frozen=True)
class ReportedEstimate(Estimate):
    """A parameter or derived modulus as it is reported; derived moduli have no `guess`.

    `value` is corrected for the known discretisation error, and `statistical95` is centred on it.

    Attributes
    ----------
    combined_std_error : float or None
        Standard uncertainty due to noise, discretisation and systematic effects; None for what was
        not estimated, is at a bound, or if systematic effects were not evaluated.
    combined95 : (lower, upper) or None
        95 % interval due to the same, the one to publish; None as above.
    optimum : float or None
        The optimum of the discretised problem, without the correction; None in a study's summary.
    systematic : float or None
        Standard deviation of the systematic effects in the coordinate of the estimate, see
        `statistics.budget`.
    known_effect : float or None
        Correction for known effects, such as the compliance of a machine, in the coordinate of the
        estimate; None if there is none.
    known_correction : float or None
        The same correction as part of `value`; None if there is none.
    numerical_error : NumericalError or None
        Discretisation error as far as it is known.
    guess : float or None
        Initial guess.
    fixed, tied : bool or None
        Whether the parameter was not estimated, or followed another one.
    """

    combined_std_error: float | None = None
    combined95: tuple[float, float] | None = None
    optimum: float | None = None
    systematic: float | None = None
    known_effect: float | None = optional()
    known_correction: float | None = optional()
    numerical_error: NumericalError | None = None
    guess: float | None = optional()
    fixed: bool | None = optional()
    tied: bool | None = optional()

    def at_optimum(self, name: str, *, linear: bool) -> Estimate:
        """Return the estimate before the correction of the discretisation error.

        Parameters
        ----------
        name : str
        linear : bool
            Whether the parameter is its own coordinate, see `Coordinate`.
        """
        if self.optimum is None or self.statistical95 is None or self.optimum == self.value:
            optimum = self.value if self.optimum is None else self.optimum
            return replace(self._statistical, value=optimum)
        at = Coordinate.of(name, (self.value, self.optimum, *self.statistical95), linear)
        correction = at.at(self.value) - at.at(self.optimum)
        low, high = (at.value(at.at(end) - correction) for end in self.statistical95)
        spread = self.statistical_std_error
        if spread is not None:
            spread *= at.slope(self.value) / at.slope(self.optimum)
        return Estimate(self.optimum, spread, (low, high), self.at_bound, self.reason)

    @property
    def _statistical(self) -> Estimate:
        """The value with its statistical uncertainty alone."""
        return Estimate(
            self.value,
            self.statistical_std_error,
            self.statistical95,
            self.at_bound,
            self.reason,
        )

    @property
    def is_determined(self) -> bool:
        """Whether the combined interval is not wider than the value; false if there is none."""
        if self.combined95 is None:
            return False
        low, high = self.combined95
        return high - low <= abs(self.value)

    @property
    def systematic_std_error(self) -> float | None:
        """Part of the combined standard uncertainty that is not statistical; None if unknown."""
        if self.combined_std_error is None or self.statistical_std_error is None:
            return None
        difference = self.combined_std_error**2 - self.statistical_std_error**2
        return max(0.0, difference) ** 0.5


@dataclass(frozen=True)
class FoundNuisance:
    """A nuisance parameter in its unit, with the deviation of its prior."""

    value: float
    prior: float
    std_error: float | None


@dataclass(frozen=True)
class FoundField:
    """A constant that differs from place to place; its arrays are in ``trajectory.npz``.

    Attributes
    ----------
    range : (least, most)
        Of its values in the elements.
    share_told : float or None
        Of the volume, where the interval is less than half as wide as the prior's.
    identified : int or None
        How many independent shapes the data tell.
    likelier : mapping of length in metres to the logarithm of how much likelier it is
    phases : PhaseFinding or None
        Contrast and volume of the inclusion of a two-phase field; None of a smooth one.
    """

    shapes: FieldShapes
    range: tuple[float, float]
    share_told: float | None
    identified: int | None
    likelier: Mapping[str, float]
    phases: PhaseFinding | None = None

    def sentence(self, name: str) -> str:
        """What it is, in a line."""
        least, most = self.range
        said = f"{symbol_of(name)} from {least:.3g} to {most:.3g} {unit_of(name)}".strip()
        if self.identified is None or self.share_told is None:
            return said
        if self.phases is not None:
            lower, contrast, upper = self.phases.contrast
            least_m3, volume_m3, most_m3 = self.phases.volume_m3
            return (
                f"{said}: two phases, contrast {contrast:.3g} ({lower:.3g} to {upper:.3g}), "
                f"inclusion {1e6 * volume_m3:.3g} cm³ ({1e6 * least_m3:.3g} to "
                f"{1e6 * most_m3:.3g}); the phase of {self.share_told:.0%} of the volume is known"
            )
        shapes = f"{self.identified} of {self.shapes.modes} shapes of its field"
        told = f"{self.share_told:.0%} of the volume better than the prior by half"
        beside = [f"details above {short(1e3 * self.shapes.detail_m)} mm"]
        if len(self.likelier) > 1:
            each = ", ".join(f"{length} m {gain:+.1f}" for length, gain in self.likelier.items())
            beside.append(f"length {self.shapes.length_m:g} m, ln evidence of {each}")
        return f"{said}: the data tell {shapes}, and {told} ({'; '.join(beside)})"


@dataclass(frozen=True)
class RecordingsAgreement:
    """What each recording says by itself of a parameter, to first order, and how they agree."""

    values: Mapping[str, float]
    deviations: Mapping[str, float]
    chi_squared: float
    degrees_of_freedom: int
    disagree: bool


@dataclass(frozen=True)
class FoundProfile:
    """A profile likelihood, as how much the loss rises."""

    interval: tuple[float | None, float | None]
    values: Array
    rises: Array
    threshold: float
    sentence: str


@dataclass(frozen=True, eq=False)
class FoundUncertainty:
    """Where the error bars come from; covariance of the logarithms, by `names`."""

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
    profiles: Mapping[str, FoundProfile]


@dataclass(frozen=True, eq=False)
class FoundScan:
    """The scan of the stiffness that found a start."""

    reason: str
    young_pa: Array
    misfit: Array
    best: int
    samples: int
    time_s: float
    sentence: str


@dataclass(frozen=True)
class FittedExperiment:
    """How far an experiment's markers and wrenches are from the fit.

    Attributes
    ----------
    static : bool
    beside : tuple of str
        What was estimated of this recording alone, in words.
    wrench_sigma_n, wrench_sigma_nm, reading_sigma
        What is stated of the noise.
    reading_unit : mapping of name to str, optional
        Units of the readings that state one.
    friction : by obstacle, of those that rub
    depth : by depth camera, distances of its points from the fitted surface
    air_density_kg_m3 : float
        Of the air around the body in the model; zero in a vacuum.
    """

    rms_m: float
    samples: int
    missing: int
    static: bool
    beside: tuple[str, ...]
    wrench_rms_n: float | None = optional()
    wrench_rms_nm: float | None = optional()
    reading_rms: Mapping[str, float] | None = optional()
    wrench_sigma_n: float | None = optional()
    wrench_sigma_nm: float | None = optional()
    reading_sigma: Mapping[str, float] | None = optional()
    reading_unit: Mapping[str, str] | None = optional()
    friction: Mapping[str, Rubbing] | None = optional()
    depth: Mapping[str, DepthError] | None = optional()
    air_density_kg_m3: float = 0.0


@dataclass(frozen=True)
class FoundFit:
    """The same of all experiments.

    Attributes
    ----------
    symmetry : mapping of experiment to int, optional
        Of those whose loads are reported for the whole specimen, how many times the loads of the
        modelled part they are. Energies of friction and nuisance parameters are those of the
        modelled part.
    """

    rms_m: float
    noise_rms_m: float
    experiments: Mapping[str, FittedExperiment]
    wrench_rms_n: float | None = optional()
    wrench_rms_nm: float | None = optional()
    symmetry: Mapping[str, int] | None = optional()


@dataclass(frozen=True)
class SimulatedExperiment:
    """An experiment simulated with the answer; of one that `failed` all else is missing.

    Attributes
    ----------
    depth : by depth camera, distances of its points from the simulated surface
    blind : PredictionError, optional
        Of an experiment for validation, with the nuisance parameters of the fitted recordings in
        place of its own.
    copied : CopyError, optional
        Of an experiment for validation, with the measurements of the nearest fitted recording as
        the prediction.
    not_copied : str, optional
        Why there is no such copy.
    """

    fitted: bool
    failed: str | None = optional()
    rms_m: float | None = optional()
    max_m: float | None = optional()
    reading_unit: Mapping[str, str] | None = optional()
    nuisance: Mapping[str, float] | None = optional()
    places_m: Mapping[str, tuple[float, ...]] | None = optional()
    wrench_rms_n: float | None = optional()
    wrench_rms_nm: float | None = optional()
    reading_rms: Mapping[str, float] | None = optional()
    depth: Mapping[str, DepthError] | None = optional()
    blind: PredictionError | None = optional()  # noqa: RUF009, it returns a field
    copied: CopyError | None = optional()  # noqa: RUF009, it returns a field
    not_copied: str | None = optional()


@dataclass(frozen=True)
class FoundRollout:
    """Forward simulations with the answer; distances of those that were fitted."""

    rms_m: float | None
    max_m: float | None
    experiments: Mapping[str, SimulatedExperiment]


@dataclass(frozen=True)
class FoundDynamics:
    """How far the equations of motion are violated."""

    max_violation_n: float
    max_violation_relative: float
    largest: tuple[str, ...]


@dataclass(frozen=True)
class ProgramSize:
    """The discretised problem."""

    nodes: int
    elements: int
    substeps: int
    timesteps: int
    variables: int
    constraints: int
    scheme: str


@dataclass(frozen=True)
class Provenance:
    """What made the result, of which problem."""

    version: str
    casadi: str
    numpy: str
    python: str
    platform: str
    problem_file: str | None
    problem_sha256: str | None
    mesh_sha256: tuple[str, ...]


@dataclass(frozen=True)
class Elapsed:
    """Wall-clock time of the parts of a run [s].

    Attributes
    ----------
    search : float
        From the problem to the optimum: finding a start, and every search that led to the answer,
        also with finer steps.
    checks : float
        What follows: forward simulations, uncertainties, budget, probes and likely causes.
    pictures : float or None
        Drawing and writing the pictures; None if they have not been drawn.
    """

    search: float = 0.0
    checks: float = 0.0
    pictures: float | None = None


@dataclass(frozen=True, eq=False)
class Result:
    """The content of ``result.json``, whose names are its keys.

    `timing_s` is about the iterations of the method alone, `elapsed_s` about the whole run.
    `basis` says what the values rest on: the law of the damping, and what sets the scale; `budget`
    has each source's share of an estimate's variance; `probes` are
    refits with an assumption relaxed and, where that was asked for, of parts of the data.
    """

    schema: int
    status: str
    converged: bool
    message: str
    missing: str
    trust: Trust
    method: str
    title: str
    parameters: Mapping[str, ReportedEstimate]
    derived: Mapping[str, ReportedEstimate]
    basis: tuple[str, ...]
    budget: Mapping[str, Mapping[str, float]]
    probes: tuple[Probe, ...]
    places: Mapping[str, Mapping[str, Place]]
    nuisance: Mapping[str, Mapping[str, FoundNuisance]]
    fields: Mapping[str, FoundField]
    uncertainty: FoundUncertainty | None
    scan: FoundScan | None
    fit: FoundFit
    residuals: tuple[MarkerDiagnosis, ...]
    dynamics: FoundDynamics
    rollout: FoundRollout
    iterations: int
    evaluations: int
    timing_s: Timing
    elapsed_s: Elapsed
    problem: ProgramSize
    notes: tuple[str, ...]
    history: tuple[Iteration, ...]
    provenance: Provenance

    @classmethod
    def read(cls, run: str | Path, what: str = "a run folder") -> Result:
        """Read a run folder, which is said to be `what` where it is none.

        Raises
        ------
        InputError
            If it is no run folder, or damaged.
        """
        folder = Path(run)
        content = read_json(folder / RESULT_FILE, what)
        with damage_refused(folder, RESULT_FILE, "solve the problem again"):
            return read(cls, content)

    @property
    def values(self) -> dict[str, ReportedEstimate]:
        """Parameters, then moduli that follow; but the shares of a field."""
        both = {**self.parameters, **self.derived}
        return {name: each for name, each in both.items() if not is_mode(name)}

    @property
    def covers(self) -> tuple[str, ...]:
        """Which discretisation errors the combined intervals contain: "step", "mesh"."""
        return known_kinds(self.numerical_errors.values())

    @property
    def numerical_errors(self) -> dict[str, NumericalError]:
        """What is known of them, by name."""
        errors = ((name, each.numerical_error) for name, each in self.values.items())
        return {name: error for name, error in errors if error is not None}

    def home(self, run: str | Path, needs: str) -> Path:
        """The folder of the problem file, which `needs` one.

        Raises
        ------
        InputError
            If the run is of no problem file.
        """
        if self.provenance.problem_file is None:
            raise InputError(f"the run is of no problem file, {needs}", run)
        return Path(self.provenance.problem_file).parent
