"""The problem file's keys: SI units, the unit in the key; unknown keys are refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    model_validator,
)

from ..fem.elements import ELEMENTS
from ..fem.materials import MATERIALS
from ..methods import METHODS
from ..methods.casadi_nlp import why_not
from ..nlp.schemes import SCHEMES

# TOML tells text, numbers and truth values apart, so a "30" or true for a number is a slip.
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Boundless = Annotated[float, Field(strict=True)]
Whole = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, Field(min_length=1)]
Vector = tuple[Finite, Finite, Finite]
Corner = tuple[Boundless, Boundless, Boundless]
Unit = Literal["m", "cm", "mm", "in"]


def _offered(name: Any) -> Any:
    reason = why_not(name) if isinstance(name, str) else None
    if reason is not None:
        raise ValueError(reason)
    return name


if TYPE_CHECKING:
    MaterialName = ElementName = SchemeName = MethodName = str
else:
    MaterialName = Literal[tuple(MATERIALS)]
    ElementName = Literal[tuple(ELEMENTS)]
    SchemeName = Literal[tuple(SCHEMES)]
    MethodName = Annotated[Literal[tuple(METHODS)], BeforeValidator(_offered)]


class Section(BaseModel):
    """A table of the problem file; messages quote the fields' descriptions as what is expected."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ObjectSection(Section):
    """The soft object: its mesh or surface, mass and material."""

    mesh: Text | None = Field(None, description="Tetrahedral mesh in any meshio format.")
    surface: Text | None = Field(None, description="Closed surface to fill with tetrahedra.")
    edge_length_m: Positive | None = Field(None, description="Wanted edge length of a surface.")
    length_unit: Unit = Field("m", description="Unit of the coordinates in the file.")
    mass_kg: Positive | None = Field(None, description="Weighed mass of the whole object.")
    density_kg_m3: Positive | None = Field(None, description="Uniform density instead of a mass.")
    material: MaterialName = "neo-hookean"
    element: ElementName = "tet4"
    evaluator: Literal["auto", "simd", "casadi"] = Field(
        "auto", description="How element kernels are evaluated."
    )

    @model_validator(mode="after")
    def _one_of_each(self) -> ObjectSection:
        _exactly_one(self, "mesh", "surface")
        if (self.surface is None) != (self.edge_length_m is None):
            raise ValueError("edge_length_m belongs to surface; expected both or neither")
        _exactly_one(self, "mass_kg", "density_kg_m3")
        return self


class PriorSection(Section):
    """A normal prior on the logarithm of a parameter."""

    mean: Positive
    relative: Positive = Field(description="Relative standard deviation, such as 0.2 for 20 %.")


class ParameterSection(Section):
    """One parameter: estimated from a guess within bounds, or fixed."""

    guess: Positive | None = None
    lower: Positive | None = None
    upper: Positive | None = None
    fixed: NotNegative | None = Field(None, description="Value that is not estimated.")
    prior: PriorSection | None = None

    @model_validator(mode="after")
    def _guess_or_fixed(self) -> ParameterSection:
        _exactly_one(self, "guess", "fixed")
        useless = _given(self, "lower", "upper", "prior")
        if self.fixed is not None and useless:
            raise ValueError(
                f"found fixed beside {', '.join(useless)}; expected fixed alone, or guess in its "
                "place to estimate the parameter"
            )
        return self


class ParametersSection(Section):
    """λ and μ, or E and ν, and the two dampings."""

    lambda_pa: ParameterSection | None = Field(None, description="First Lamé parameter λ [Pa].")
    mu_pa: ParameterSection | None = Field(None, description="Shear modulus μ [Pa].")
    young_pa: ParameterSection | None = Field(None, description="Young's modulus E [Pa].")
    poisson: ParameterSection | None = Field(None, description="Poisson's ratio ν.")
    gamma_r_s: ParameterSection = Field(description="Stiffness-proportional damping γ_r [s].")
    gamma_m_1_s: ParameterSection = Field(description="Mass-proportional damping γ_m [1/s].")

    @model_validator(mode="after")
    def _one_pair(self) -> ParametersSection:
        given = _given(self, "lambda_pa", "mu_pa", "young_pa", "poisson")
        if given not in (["lambda_pa", "mu_pa"], ["young_pa", "poisson"]):
            raise ValueError(
                f"the elastic parameters are {', '.join(given) or 'missing'}; "
                "expected lambda_pa and mu_pa, or young_pa and poisson"
            )
        for name in ("mu_pa", "young_pa"):
            if name in given and getattr(self, name).fixed == 0:
                raise ValueError(f"found {name} = {{ fixed = 0 }}; expected a stiffness above 0")
        return self


class NodesSection(Section):
    """A selection of mesh nodes, by exactly one of these."""

    box_m: tuple[Corner, Corner] | None = Field(
        None, description="Lowest and highest corner [[x, y, z], [x, y, z]]."
    )
    ball_m: tuple[Vector, Positive] | None = Field(
        None, description="Centre and radius [[x, y, z], radius]."
    )
    indices: list[Whole] | None = Field(
        None, description="List of node numbers as in the mesh file, counted from 0."
    )
    name: Text | None = Field(None, description="A point array of the mesh, 1 where selected.")

    @model_validator(mode="after")
    def _one(self) -> NodesSection:
        _exactly_one(self, *type(self).model_fields)
        return self


# Where a key takes one of two forms, a tag in <> tells them apart; messages leave the tag out.


def _nodes_form(value: Any) -> str:
    return "<name>" if isinstance(value, str) else "<table>"


Nodes = Annotated[
    Annotated[NodesSection, Tag("<table>")] | Annotated[Text, Tag("<name>")],
    Discriminator(_nodes_form),
]


class GraspSection(Section):
    """Nodes held by a gripper, and how it moves."""

    nodes: Nodes = Field(
        description="Selection: a table of box_m, ball_m or indices, or the name of a point array."
    )
    poses: Text | None = Field(
        None, description="Poses, CSV or .npz; held where they are without poses or markers."
    )
    quaternion: Literal["xyzw", "wxyz"] | None = Field(
        None, description="Order of a quaternion whose columns in poses do not name it."
    )
    length_unit: Unit | None = Field(
        None, description="Unit of the positions in poses, where they do not state it."
    )
    markers: dict[str, Vector] | None = Field(
        None,
        description="Place [x, y, z] on the undeformed body for each marker that is tied to the "
        "gripper, by name; poses are fitted to their tracks.",
    )
    weights: dict[str, NotNegative] = Field(
        default_factory=dict, description="Weight in that fit by marker name, 1 by default."
    )
    max_residual_m: Positive | None = Field(
        None, description="Residual of that fit above which a frame is reported."
    )
    interpolation: Literal["linear", "hold"] = "linear"
    from_s: Finite | None = Field(None, description="First time at which it holds.")
    until_s: Finite | None = Field(
        None,
        description="Last time at which it holds; at the start's, the body is let go from its "
        "equilibrium in this grasp.",
    )

    @model_validator(mode="after")
    def _window(self) -> GraspSection:
        if self.from_s is not None and self.until_s is not None and self.from_s > self.until_s:
            raise ValueError(
                f"found from_s = {self.from_s:g} and until_s = {self.until_s:g}; "
                "expected from_s <= until_s"
            )
        return self

    @model_validator(mode="after")
    def _one_source_of_poses(self) -> GraspSection:
        if self.poses is not None and self.markers is not None:
            raise ValueError("found poses and markers; expected one of them")
        for owner, keys in (
            ("poses", _given(self, "quaternion", "length_unit")),
            ("markers", [*_given(self, "max_residual_m"), *(["weights"] if self.weights else [])]),
        ):
            if keys and getattr(self, owner) is None:
                raise ValueError(f"found {keys[0]} without {owner}; it belongs to {owner}")
        if self.markers is not None:
            _at_least_three(self.markers, "markers")
            _all_among(self.weights, self.markers, "weights")
        return self


def _sigma_form(value: Any) -> str:
    return "<by marker>" if isinstance(value, dict) else "<for all>"


Sigma = Annotated[
    Annotated[Positive, Tag("<for all>")] | Annotated[dict[str, Positive], Tag("<by marker>")],
    Discriminator(_sigma_form),
]


class MarkersSection(Section):
    """Tracked points."""

    file: Text | None = Field(
        None,
        description="Marker tracks: C3D, TRC, Qualisys TSV, Motive CSV or plain CSV; only "
        "`simulate` can do without.",
    )
    sigma_m: Sigma = Field(
        1e-3, description="Standard deviation of a coordinate, for all or by marker name."
    )
    names: list[str] | None = Field(
        None, description="List of the names of markers to use; all by default."
    )
    labels: dict[str, Text] = Field(
        default_factory=dict, description="Name here for a label in the file, by label."
    )
    weights: dict[str, NotNegative] = Field(
        default_factory=dict,
        description="Weight in the loss by marker name, 1 by default; 0 leaves the marker out.",
    )
    length_unit: Unit | None = Field(
        None, description="Unit of the coordinates, where the file does not state it."
    )
    rate_hz: Positive | None = Field(
        None, description="Frame rate, where the file states neither it nor times."
    )
    template_m: dict[str, Vector] | None = Field(
        None,
        description="Place [x, y, z] in the body's frame for at least three markers, by name; all "
        "tracks are moved rigidly so that these fit.",
    )
    template_window_s: tuple[Finite, Finite] | None = Field(
        None, description="First and last time [start, end] to average for the template."
    )
    max_template_residual_m: Positive | None = Field(
        None, description="Farthest a marker may be from its place in the template."
    )
    reference_m: dict[str, Vector] = Field(
        default_factory=dict,
        description="Place [x, y, z] on the undeformed body for each marker, by name.",
    )
    attach: Literal["auto", "vertex", "embedded"] = "auto"
    max_distance_m: Positive | None = Field(
        None, description="Farthest a marker may be from the body; the mean edge length by default."
    )

    @model_validator(mode="after")
    def _template(self) -> MarkersSection:
        given = _given(self, "template_m", "template_window_s", "max_template_residual_m")
        if given and not {"template_m", "template_window_s"} <= set(given):
            raise ValueError(
                f"found {', '.join(given)}; expected template_m and template_window_s, both or "
                "neither"
            )
        if self.template_m is not None:
            _at_least_three(self.template_m, "template_m")
        if (window := self.template_window_s) is not None and not window[0] <= window[1]:
            raise ValueError(
                f"found template_window_s = {list(window)}; expected [start, end] with start <= end"
            )
        return self


def _file_name(name: str) -> str:
    if not name or name.startswith(".") or any(mark in name for mark in '/\\:*?"<>|\n'):
        raise ValueError(
            f"found {name!r}; expected a name that files can have: not empty, no dot in front, "
            'none of / \\ : * ? " < > |'
        )
    return name


class MassSection(Section):
    """A rigid point mass tied to nodes: inertia and weight."""

    nodes: Nodes = Field(description="Nodes that carry it in equal parts, selected as in a grasp.")
    mass_kg: Positive
    from_s: Finite | None = Field(None, description="When it joins the body; always by default.")


class ForceSection(Section):
    """A force on nodes besides gravity."""

    nodes: Nodes = Field(
        description="Nodes that it acts on in equal parts, selected as in a grasp."
    )
    force_n: Vector | None = Field(None, description="Constant force [x, y, z].")
    file: Text | None = Field(None, description="CSV with the columns t_s, fx_n, fy_n, fz_n.")

    @model_validator(mode="after")
    def _one(self) -> ForceSection:
        _exactly_one(self, "force_n", "file")
        return self


class LengthPrior(Section):
    """How well a length is known."""

    prior_m: Positive = Field(description="Standard deviation [m].")


class TimePrior(Section):
    """How well a time is known."""

    prior_s: Positive = Field(description="Standard deviation [s].")


class AnglePrior(Section):
    """How well a direction is known."""

    prior_rad: Positive = Field(description="Standard deviation [rad].")


class PosePrior(Section):
    """How well a pose is known; what is left out is taken as exact."""

    prior_rad: Positive | None = Field(None, description="Standard deviation of a turn [rad].")
    prior_m: Positive | None = Field(None, description="Standard deviation of a shift [m].")

    @model_validator(mode="after")
    def _some(self) -> PosePrior:
        if not _given(self, "prior_rad", "prior_m"):
            raise ValueError("found neither prior_rad nor prior_m; expected one or both")
        return self


class EstimateSection(Section):
    """What is estimated of this recording alone, each with a prior around zero."""

    marker_offsets: LengthPrior | None = Field(
        None, description="A constant offset of every marker from its place: prior_m."
    )
    time_shift: TimePrior | None = Field(
        None, description="Delay of the markers' clock against the grasps': prior_s."
    )
    pose: PosePrior | None = Field(
        None, description="A constant rigid correction of the grasps: prior_rad, prior_m."
    )
    gravity: AnglePrior | None = Field(
        None, description="A tilt of the direction of gravity: prior_rad."
    )


def _grasp_form(value: Any) -> str:
    return "<several>" if isinstance(value, list) else "<one>"


Grasps = Annotated[
    Annotated[GraspSection, Tag("<one>")] | Annotated[list[GraspSection], Tag("<several>")],
    Discriminator(_grasp_form),
]


class ExperimentSection(Section):
    """One recording."""

    name: Annotated[str, AfterValidator(_file_name)]
    grasp: Grasps = Field(
        default_factory=list, description="A table of nodes and poses, or a list of them."
    )
    markers: MarkersSection
    start: Literal["equilibrium", "undeformed"] = "equilibrium"
    start_rule: Literal["standard", "paper"] = "standard"
    gravity_m_s2: Vector = Field(
        (0.0, 0.0, -9.81), description="Acceleration of gravity [x, y, z]."
    )
    window_s: tuple[Boundless, Boundless] | None = Field(
        None, description="First and last time to use [start, end]."
    )
    resample_hz: Positive | None = Field(None, description="Put poses and markers on this rate.")
    every: Annotated[int, Field(strict=True, ge=1)] = Field(
        1, description="Use every so-manieth sample of the markers."
    )
    mass: list[MassSection] = Field(
        default_factory=list,
        description="[[experiment.mass]] tables: point masses tied to the body.",
    )
    force: list[ForceSection] = Field(
        default_factory=list, description="[[experiment.force]] tables: forces besides gravity."
    )
    estimate: EstimateSection | None = Field(
        None, description="What is estimated of this recording alone."
    )
    validation: Flag = Field(False, description="Not fitted, only predicted.")

    @property
    def grasps(self) -> list[GraspSection]:
        """The grasps, however they are written."""
        return self.grasp if isinstance(self.grasp, list) else [self.grasp]

    @model_validator(mode="after")
    def _window(self) -> ExperimentSection:
        if self.window_s is not None and not self.window_s[0] < self.window_s[1]:
            raise ValueError(
                f"found window_s = {list(self.window_s)}; expected [start, end] with start < end"
            )
        return self


class TranscriptionSection(Section):
    """How the equations of motion become constraints."""

    scheme: SchemeName = "midpoint"
    substeps: Whole = Field(default=1, ge=1, description="Grid steps between samples.")
    explicit_grasps: Flag = Field(
        default=False,
        description="Grasped nodes as constraint rows (the paper's c^g) instead of bounds.",
    )


def _ipopt_value(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(
            f"found {str(value).lower()}; expected text or a number, as IPOPT's manual has it: its "
            'switches are "yes" and "no"'
        )
    return value


class SolverSection(Section):
    """The method and its options."""

    method: MethodName = "reduced-space"
    hessian: Literal["exact", "gauss-newton", "limited-memory"] = "exact"
    warm_up: float = Field(
        default=0.1,
        ge=0,
        description="Gauss–Newton while a step changes a parameter by more than this.",
    )
    proximal: float = Field(
        default=1e-5, ge=0, description="Added to the Hessian at the positions."
    )
    linear_solver: Text = Field(default="mumps", description="IPOPT's linear solver.")
    huber: Positive | None = Field(
        default=None,
        description="Samples farther off than this many sigmas count linearly, not squared.",
    )
    factorisation: Literal["auto", "band", "sparse"] = Field(
        default="auto", description="How reduced-space factorises a timestep's equations."
    )
    inner: Literal["cg-descent", "scipy-cg", "l-bfgs-b", "levenberg-marquardt"] = Field(
        default="cg-descent",
        description="What minimises the merit function of penalty and augmented-lagrangian; "
        "the latter's default is levenberg-marquardt.",
    )
    schedule: Literal["geometric", "progress", "constant"] = Field(
        default="geometric",
        description="How rho rises: after every stage, where slack is left, or never.",
    )
    rho: Positive = Field(
        default=1e2,
        description="First weight of the dynamics; augmented-lagrangian's default is 1e5.",
    )
    rho_max: Positive = Field(
        default=1e8, description="Its last; augmented-lagrangian's default is 1e9."
    )
    rho_factor: Annotated[float, Field(gt=1)] = Field(
        default=10.0, description="Factor above 1 between the weights of two stages."
    )
    inner_iterations: Annotated[Whole, Field(gt=0)] = Field(
        default=1000, description="Most iterations of a stage."
    )
    violation: Positive = Field(
        default=1e-3,
        description="Slack left in the dynamics, over the largest force; "
        "augmented-lagrangian's default is 1e-7.",
    )
    gradient: Literal["forward", "adjoint"] = Field(
        default="forward", description="How shooting finds the slope of its loss."
    )
    shares: list[Positive] = Field(
        default=[0.25, 0.5, 1.0],
        description="List of the shares of the samples that continuation solves one after another; "
        "the last is 1.",
    )
    stage: SolverSection | None = Field(
        default=None, description="A method and its options, for each share of continuation."
    )
    casadi: dict[str, Any] = Field(
        default_factory=dict, description="Further options of a casadi: solver by name."
    )
    tolerance: Positive = 1e-8
    max_iterations: Whole = Field(default=200, ge=0)
    max_time_s: Positive = 1e6
    ipopt: dict[str, Annotated[str | int | float, BeforeValidator(_ipopt_value)]] = Field(
        default_factory=dict, description="Further IPOPT options by name."
    )


class UncertaintySection(Section):
    """How the error bars are found."""

    noise: Literal["given", "estimated"] = Field(
        default="given", description="Trust sigma_m, or scale it by the residuals."
    )
    errors: Literal["auto", "independent", "autocorrelated"] = Field(
        default="auto", description="What to assume of the errors; auto tests the residuals."
    )
    profile: list[Text] = Field(
        default_factory=list,
        description="List of the parameters whose profile likelihood is wanted.",
    )


class RolloutSection(Section):
    """The forward simulation that checks the answer."""

    integrator: Literal["newmark", "scheme"] = "newmark"
    timestep_s: Positive | None = Field(
        default=None, description="Newmark's step; a quarter of the sample interval by default."
    )


class ProblemFile(Section):
    """A problem file (TOML)."""

    title: str = ""
    object: ObjectSection
    parameters: ParametersSection
    experiment: list[ExperimentSection] = Field(
        min_length=1, description="At least one [[experiment]] table, one for each recording."
    )
    transcription: TranscriptionSection = TranscriptionSection()
    solver: SolverSection = SolverSection()
    rollout: RolloutSection = RolloutSection()
    uncertainty: UncertaintySection = UncertaintySection()

    @model_validator(mode="after")
    def _names_differ(self) -> ProblemFile:
        names = [experiment.name for experiment in self.experiment]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"two experiments are named {repeated[0]!r}; names must differ")
        return self

    @model_validator(mode="after")
    def _profiles_are_of_estimated_parameters(self) -> ProblemFile:
        given = {
            name: getattr(self.parameters, name) for name in type(self.parameters).model_fields
        }
        free = [name for name, section in given.items() if section and section.fixed is None]
        for name in self.uncertainty.profile:
            if name not in free:
                raise ValueError(
                    f"uncertainty.profile names {name!r}; expected estimated parameters, "
                    f"{', '.join(free)}"
                )
        return self

    @model_validator(mode="after")
    def _paper_rule_has_its_scheme(self) -> ProblemFile:
        scheme = self.transcription.scheme
        for experiment in self.experiment:
            if experiment.start_rule == "paper" and scheme != "backward-euler":
                raise ValueError(
                    f"experiment {experiment.name!r} has start_rule = 'paper' and the scheme is "
                    f"{scheme!r}; that rule expects transcription.scheme = 'backward-euler'"
                )
        return self


def _given(section: Section, *names: str) -> list[str]:
    return [name for name in names if getattr(section, name) is not None]


def _at_least_three(places: dict[str, Any], key: str) -> None:
    if len(places) < 3:
        raise ValueError(
            f"found {len(places)} in {key}; expected at least three, to fix a rotation"
        )


def _all_among(given: dict[str, Any], names: dict[str, Any], key: str) -> None:
    for name in given:
        if name not in names:
            raise ValueError(f"found {name!r} in {key}; expected names among {', '.join(names)}")


def _exactly_one(section: Section, *names: str) -> None:
    given = _given(section, *names)
    if len(given) != 1:
        found = " and ".join(given) or f"no {' or '.join(names)}"
        raise ValueError(f"found {found}; expected exactly one of {', '.join(names)}")
