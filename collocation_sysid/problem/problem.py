"""Estimation problem: experiments, parameters to estimate, and options of the solve."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, field, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from ..common.array_types import Array
from ..common.declarations import declaration, key
from ..common.validated_classes import validated
from ..common.validated_types import Positive, Substeps
from ..errors import InputError, located
from ..fem.body import Body
from ..fem.laws.constants import with_undamped
from ..fem.schemes import Scheme, as_scheme
from ..methods import METHODS, require_method
from ..methods.interior_point import InteriorPoint
from ..methods.solution import Method
from ..model.nuisance_map import nuisance_indices
from ..model.parameters import Parameters, Tied, Unknown
from ..program.collocation import Collocation
from ..program.lifted.collocation import with_lifted_variables
from ..program.simulation import require_steps
from ..recording import Experiment
from ..recording.impact_steps import impact_steps
from .options import Origin, RolloutOptions, UncertaintyOptions


def _unconverted(parameters: Parameters | Mapping[str, Unknown | Tied | float]) -> Any:
    """A mapping is converted when the bodies are known."""
    return parameters


def _as_parameters(
    parameters: Parameters | Mapping[str, Unknown | Tied | float], experiments: Iterable[Experiment]
) -> Parameters:
    """Without a recording, γ_r and γ_m of a mapping are 0 if they are not stated."""
    if isinstance(parameters, Parameters):
        return parameters
    if not isinstance(parameters, Mapping):
        kind = type(parameters).__name__
        raise InputError(
            f"parameters of the problem are a {kind}; expected a table of names with a number (a "
            "known value) or Unknown(), such as {'mu_pa': Unknown()}"
        )
    definitions = {
        name: constant for each in experiments for name, constant in each.body.constants.items()
    }
    if all(each.specimen is not None for each in experiments):
        parameters = with_undamped(parameters, definitions)
    return Parameters.from_mapping(parameters, definitions=definitions)


@declaration
class Problem:
    """Experiments that share parameters, and how the parameters are estimated.

    Parameters
    ----------
    experiments : sequence of Experiment
        Experiments with different names; those for validation are predicted, not fitted. Their
        bodies may differ.
    parameters : Parameters, or mapping of name to Unknown, Tied or a fixed number
        Parameters of the bodies, estimated or fixed. What a mapping omits (bounds, scale, prior)
        follows from the `Constant` of the body; if all experiments are specimens, γ_r and γ_m that
        it omits are 0.
    scheme : str or Scheme, default "midpoint"
        Time discretisation.
    substeps : int or "auto"
        Grid steps between samples. "auto", the default, solves with one step; if this moves a
        parameter by more than half a standard error, the problem is solved again with as many steps
        as needed, at most 8. Motions with obstacles have the number of `impact_steps` instead.
    explicit_grasps : bool, default False
        Whether prescribed displacements are constraints instead of bounds.
    huber : float, optional
        Threshold of Huber's loss in standard deviations; the loss is quadratic by default.
    method : str or Method, default "reduced-space"
        A name in `methods` or `METHODS`, or a callable that solves a `Collocation`.
    methods : mapping of name to Method
        Methods by name; other names mean a method of `METHODS` with its default options.
    rollout : RolloutOptions
        Options of the forward simulation that checks the solution.
    uncertainty : UncertaintyOptions
        Options of the uncertainties.
    title : str
        Title in reports.
    notes : sequence of str
        Assumptions that were made when the files were read; notes on the meshes are added.
    origin : Origin, optional
        Problem file; None if the problem was made in Python.

    Raises
    ------
    InputError
        For experiments with equal names, parameters that do not match the constants of the bodies,
        an unknown scheme or method, or a profile of a parameter that is not estimated.
    """

    experiments: tuple[Experiment, ...] = key(converter=tuple[Experiment, ...])
    parameters: Parameters = key(converter=_unconverted)
    _: KW_ONLY
    scheme: str | Scheme = "midpoint"
    substeps: int | Literal["auto"] = key(Substeps | Literal["auto"], default="auto")
    explicit_grasps: bool = False
    huber: float | None = key(Positive | None, default=None)
    method: str | Method = "reduced-space"
    methods: Mapping[str, Method] = key(converter=dict[str, Method], default_factory=dict)
    rollout: RolloutOptions = field(default_factory=RolloutOptions)
    uncertainty: UncertaintyOptions = field(default_factory=UncertaintyOptions)
    title: str = ""
    notes: tuple[str, ...] = key(converter=tuple[str, ...], default=())
    origin: Origin | None = None

    def __post_init__(self) -> None:
        """Complete the bodies with free densities, the parameters with those of fields, and the
        notes; then validate the problem.
        """
        vars(self)["parameters"] = _as_parameters(self.parameters, self.experiments)
        vars(self)["experiments"] = _with_free_densities(self.experiments, self.parameters)
        vars(self)["parameters"] = self.parameters.with_fields(self.bodies)
        cleaned = (note for body in self.bodies for note in (*body.mesh.notes, *body.notes))
        vars(self)["notes"] = tuple(dict.fromkeys((*cleaned, *self.notes)))
        self._validate()

    def __repr__(self) -> str:
        """Return the title (if there is one), the names of the experiments and the parameters as
        text.
        """
        names = ", ".join(repr(experiment.name) for experiment in self.experiments)
        title = f"{self.title!r}, " if self.title else ""
        return f"Problem({title}experiments {names}; {self.parameters!r})"

    @classmethod
    @validated
    def read(
        cls,
        path: str | Path,
        overrides: Sequence[str] = (),
        allow_code: bool = False,
        simulation: bool = False,
        folder: str | Path | None = None,
        say: Callable[[str], None] | None = None,
    ) -> Problem:
        """Read a problem file (TOML) and the files that it names.

        Parameters
        ----------
        path : str or Path
            Problem file.
        overrides : sequence of str
            Values that replace those of the file, "dotted.key=value".
        allow_code : bool
            Whether to run the Python files that materials, forces and sensors name.
        simulation : bool
            Whether the problem is to be simulated. Files of measurements may then be missing:
            markers with a `reference_m` are sampled at the times of the poses. All experiments may
            be for validation.
        folder : str or Path, optional
            Folder that contains the named files; that of the problem file by default.
        say : callable, optional
            Function that is called with a sentence before work that takes long.

        Raises
        ------
        InputError
            For the first mistake in the file, or if this machine's memory is too small.
        """
        from .loading import problem_arguments  # the schema is only built to read a file

        path = Path(path)
        contents = problem_arguments(
            path, overrides, allow_code=allow_code, simulation=simulation, folder=folder, say=say
        )
        with located(path):
            return cls(**contents)

    @property
    def path(self) -> Path | None:
        """Path of the problem file; None if there is none."""
        return None if self.origin is None else self.origin.path

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Bodies of the experiments, each object once, in the order of the experiments."""
        return tuple({id(e.body): e.body for e in self.experiments}.values())

    @property
    def assumed_deviations(self) -> dict[str, float | None]:
        """Standard deviations of all systematic effects by name, None for what is exact: the stated
        ones, and the defaults of bodies that were made like those of the problem.
        """
        return self.uncertainty.assumptions.collect_deviations(self.bodies, self.parameters)

    @property
    def is_declared_simulated(self) -> bool:
        """Whether the assumptions state that the damping law is exact, which declares that the
        recordings were simulated: the law of a real body is never known.
        """
        return self.uncertainty.assumptions.damping_law == "none"

    @property
    def lengths_m(self) -> dict[str, float]:
        """Correlation lengths of spatially varying constants [m], by name of the
        constant with its region; empty without fields.
        """
        return {name: each for body in self.bodies for name, each in body.field_lengths_m.items()}

    def with_lengths(self, lengths_m: Mapping[str, float]) -> Problem:
        """Return the problem with other correlation lengths of spatially varying constants.

        This problem is not modified; it is returned itself if the lengths are those it has.

        Parameters
        ----------
        lengths_m : mapping of str to float
            Correlation length [m] of every such constant, by the names of the property `lengths_m`;
            a missing one is a KeyError, and other names are ignored.
        """
        if dict(lengths_m) == self.lengths_m:
            return self
        bodies = {id(body): body.with_field_lengths(lengths_m) for body in self.bodies}
        return replace(
            self, experiments=[replace(e, body=bodies[id(e.body)]) for e in self.experiments]
        )

    def choose_first_substeps(self) -> int:
        """Return the grid steps between samples in the first solve, and where nothing is solved:
        for "auto" those of `impact_steps`, 1 without obstacles, at least 2 in motions of slender
        bodies, because steps of 10 ms leave stiff motions along them undamped.
        """
        if self.substeps != "auto":
            return self.substeps
        fitted = (each for each in self.experiments if not each.validation)
        return max(
            (max(impact_steps(e), 1 if e.body.is_solid or e.is_static else 2) for e in fitted),
            default=1,
        )

    def collocation(self, lifted: bool = False) -> Collocation:
        """Return a new nonlinear program of the problem, with `choose_first_substeps`.

        Parameters
        ----------
        lifted : bool
            Whether history variables, measured reactions and pressures of obstacles are variables
            with equations of their own, which `Collocation.casadi` needs; they follow all others.
        """
        program = Collocation(
            self.experiments,
            self.parameters,
            scheme=self.scheme,
            substeps=self.choose_first_substeps(),
            has_grasp_constraints=self.explicit_grasps,
            huber=self.huber,
        )
        return with_lifted_variables(program) if lifted else program

    def solver(self, method: str | Method | None = None) -> Method:
        """Return the method for a name, or the method itself; None means the method of the problem.

        A name is looked up in `methods` first, then in `METHODS`, whose methods get default
        options.

        Raises
        ------
        InputError
            For an unknown name, or a method that does not support the experiments.
        """
        chosen = self.method if method is None else method
        if isinstance(chosen, str) and chosen in self.methods:
            chosen = self.methods[chosen]
        elif isinstance(chosen, str):
            require_method(chosen, "method")
            chosen = METHODS[chosen]()
        if not callable(chosen):
            raise InputError(
                f"method is {chosen!r}; expected one of {', '.join(METHODS)}, or a method"
            )
        if isinstance(chosen, InteriorPoint):
            # Validation recordings are only simulated forward, by the energies of obstacles.
            chosen.require(each for each in self.experiments if not each.validation)
        return cast(Method, chosen)

    def require_guesses(self, why: str, otherwise: str = "", *, with_set: bool = True) -> None:
        """Raise an `InputError`, naming the parameter and the remedy, if one has no guess.

        Parameters
        ----------
        why : str
            Why a value is needed, as a clause that begins with "and" or "but".
        otherwise : str
            Another remedy, behind that of a stated guess.
        with_set : bool
            Whether the option --set may state it.
        """
        if names := self.parameters.names_without_guess:
            key = f"parameters.{names[0]}"
            guess = f"--set {key}.guess=VALUE" if with_set else "a guess"
            raise InputError(
                f"this parameter has no guess, {why}; expected {guess}{otherwise}",
                self.path,
                where=key,
            )

    def _validate(self) -> None:
        names = [experiment.name for experiment in self.experiments]
        if not names:
            raise InputError("there is no experiment; expected at least one")
        if repeated := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"two experiments are named {repeated[0]!r}; expected different names")
        if self.choose_first_substeps() != 1 and all(each.is_static for each in self.experiments):
            raise InputError(
                f"found {self.substeps}, but every experiment is static, and there are no time steps "
                "between equilibria; expected no substeps",
                where="transcription.substeps",
            )
        self.parameters.require_constants_of(self.bodies)
        _require_rest_shapes(self.bodies, self.parameters)
        _require_equal_fields(self.bodies)
        nuisance_indices([each for each in self.experiments if not each.validation], 0)
        for experiment in self.experiments:
            with located(where=f"experiment '{experiment.name}'"):
                _require_plausible_noise(experiment)
                as_scheme(self.scheme, experiment.start_rule)
                if self.rollout.timestep_s is not None:
                    require_steps(experiment, self.rollout.timestep_s)
        self.solver()
        free = [item.name for item in self.parameters.free]
        scalars = [item.name for item in self.parameters.free_scalars]
        for name in self.uncertainty.profile:
            if name not in free:
                raise InputError(
                    f"found {name!r}; expected estimated parameters, {', '.join(scalars)}",
                    where="uncertainty.profile",
                )


def _require_plausible_noise(experiment: Experiment) -> None:
    if not experiment.markers.sample_count:
        return
    sigma_m = float(np.min(experiment.markers.sigma_m))
    size_m = float(np.ptp(experiment.body.nodes_m, axis=0).max())
    if sigma_m > size_m:
        raise InputError(
            f"found {sigma_m:g} m, but the body is {size_m:.3g} m long; expected the standard deviation "
            f"of the noise of one coordinate in metres (0.5 mm are 0.0005)",
            where="markers.sigma_m",
        )


def _require_rest_shapes(bodies: Iterable[Body], parameters: Parameters) -> None:
    """Refuse a mesh without stress-free shape at the guess, if there is one."""
    if any(item.guess is None for item in parameters.components if item.tied is None):
        return
    for body in bodies:
        theta = body.theta_from_values(parameters.values(parameters.guess_q))
        if (unreachable := body.rest_shape_failure(theta)) is not None:
            raise InputError(unreachable, where="object.rest_shape")


def _require_equal_fields(bodies: Iterable[Body]) -> None:
    shapes_by_name: dict[str, Array] = {}
    for name, shapes in (
        (part.field_name, part.field.shapes) for body in bodies for part in body.parts if part.field
    ):
        if not np.array_equal(shapes_by_name.setdefault(name, shapes), shapes):
            raise InputError(
                f"two bodies have a field of {name}, whose shapes differ as their "
                "meshes do; expected one body, or fields of regions with names of their own"
            )


def _with_free_densities(
    experiments: Iterable[Experiment], parameters: Parameters
) -> tuple[Experiment, ...]:
    """Experiments without such a body are the same objects."""
    bodies = {}
    experiments = tuple(experiments)
    for body in {id(e.body): e.body for e in experiments}.values():
        bodies[id(body)] = body.with_free_densities(body.parts_with_free_density(parameters.names))
    return tuple(
        e if bodies[id(e.body)] is e.body else replace(e, body=bodies[id(e.body)])
        for e in experiments
    )
