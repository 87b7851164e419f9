"""What ``result.json`` holds: one tree of plain values, from which pages and pictures are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..arrays import Array
from ..display import short
from ..errors import InputError
from ..fem.constants import is_mode, symbol_of, unit_of
from ..fem.field import FieldShapes
from ..fem.two_phase import PhaseFinding
from ..files import RESULT_FILE, damage_refused, read_json
from ..methods.solution import Iteration, Timing
from ..program.touches import Rubbing
from ..statistics.diagnostics import MarkerDiagnosis
from ..statistics.estimates import Estimate
from ..statistics.numerical import NumericalError
from ..statistics.probes import Probe
from ..statistics.trust import Trust
from ..statistics.uncertainty import Place
from ..tree import optional, read


@dataclass(frozen=True)
class FoundValue(Estimate):
    """A parameter, or a modulus that follows from parameters; these have no `guess`.

    Attributes
    ----------
    ci95_holds : tuple of str
        What `ci95` allows for: "noise", and of "step" and "mesh" what is known.
    ci95_noise : (lower, upper) or None
        The interval for the noise alone.
    whole95 : (lower, upper) or None
        The interval that also holds what is assumed, see `statistics.budget`.
    """

    ci95_holds: tuple[str, ...] = ()
    ci95_noise: tuple[float, float] | None = None
    numerical_error: NumericalError | None = None
    whole95: tuple[float, float] | None = None
    guess: float | None = optional()
    fixed: bool | None = optional()
    tied: bool | None = optional()

    @property
    def by_noise(self) -> Estimate:
        """With the interval for the noise alone."""
        return Estimate(self.value, self.std_error, self.ci95_noise, self.at_bound, self.reason)


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
    friction : by obstacle, of those that rub
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
    friction: Mapping[str, Rubbing] | None = optional()


@dataclass(frozen=True)
class FoundFit:
    """The same of all experiments."""

    rms_m: float
    noise_rms_m: float
    experiments: Mapping[str, FittedExperiment]
    wrench_rms_n: float | None = optional()
    wrench_rms_nm: float | None = optional()


@dataclass(frozen=True)
class SimulatedExperiment:
    """An experiment simulated with the answer; of one that `failed` all else is missing."""

    fitted: bool
    failed: str | None = optional()
    rms_m: float | None = optional()
    max_m: float | None = optional()
    nuisance: Mapping[str, float] | None = optional()
    places_m: Mapping[str, tuple[float, ...]] | None = optional()
    wrench_rms_n: float | None = optional()
    wrench_rms_nm: float | None = optional()
    reading_rms: Mapping[str, float] | None = optional()


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


@dataclass(frozen=True, eq=False)
class Result:
    """The content of ``result.json``, whose names are its keys.

    `basis` says what the values rest on: the law of the damping, and what sets the scale; `budget`
    has each source's share of an estimate's variance; `probes` are there where they were asked for.
    """

    schema: int
    status: str
    converged: bool
    message: str
    missing: str
    trust: Trust
    method: str
    title: str
    parameters: Mapping[str, FoundValue]
    derived: Mapping[str, FoundValue]
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
    def values(self) -> dict[str, FoundValue]:
        """Parameters, then moduli that follow; but the shares of a field."""
        both = {**self.parameters, **self.derived}
        return {name: each for name, each in both.items() if not is_mode(name)}

    @property
    def holds(self) -> tuple[str, ...]:
        """What the intervals hold: "noise", and of "step" and "mesh" what is known."""
        return max((each.ci95_holds for each in self.values.values()), key=len, default=())

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
