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
if TYPE_CHECKING:
    MaterialName = ElementName = SchemeName = MethodName = str
else:
    MaterialName = Literal[tuple(MATERIALS)]
    ElementName = Literal[tuple(ELEMENTS)]
    SchemeName = Literal[tuple(SCHEMES)]
    MethodName = Literal[tuple(METHODS)]


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
    poses: Text | None = Field(None, description="Poses CSV; held where they are without it.")
    interpolation: Literal["linear", "hold"] = "linear"


def _sigma_form(value: Any) -> str:
    return "<by marker>" if isinstance(value, dict) else "<for all>"


Sigma = Annotated[
    Annotated[Positive, Tag("<for all>")] | Annotated[dict[str, Positive], Tag("<by marker>")],
    Discriminator(_sigma_form),
]


class MarkersSection(Section):
    """Tracked points."""

    file: Text | None = Field(None, description="Markers CSV; only `simulate` can do without.")
    sigma_m: Sigma = Field(
        1e-3, description="Standard deviation of a coordinate, for all or by marker name."
    )
    names: list[str] | None = Field(
        None, description="List of the names of markers to use; all by default."
    )
    length_unit: Unit = Field("m", description="Unit of the coordinates in the file.")
    reference_m: dict[str, Vector] = Field(
        default_factory=dict,
        description="Place [x, y, z] on the undeformed body for each marker, by name.",
    )
    attach: Literal["auto", "vertex", "embedded"] = "auto"
    max_distance_m: Positive | None = Field(
        None, description="Farthest a marker may be from the body; the mean edge length by default."
    )


def _file_name(name: str) -> str:
    if not name or name.startswith(".") or any(mark in name for mark in '/\\:*?"<>|\n'):
        raise ValueError(
            f"found {name!r}; expected a name that files can have: not empty, no dot in front, "
            'none of / \\ : * ? " < > |'
        )
    return name


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
        default=None, description="Threshold of Huber's loss in sigmas, for reduced-space."
    )
    factorisation: Literal["auto", "band", "sparse"] = Field(
        default="auto", description="How reduced-space factorises a timestep's equations."
    )
    tolerance: Positive = 1e-8
    max_iterations: Whole = Field(default=200, ge=0)
    max_time_s: Positive = 1e6
    ipopt: dict[str, Annotated[str | int | float, BeforeValidator(_ipopt_value)]] = Field(
        default_factory=dict, description="Further IPOPT options by name."
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

    @model_validator(mode="after")
    def _names_differ(self) -> ProblemFile:
        names = [experiment.name for experiment in self.experiment]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"two experiments are named {repeated[0]!r}; names must differ")
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


def _exactly_one(section: Section, *names: str) -> None:
    given = _given(section, *names)
    if len(given) != 1:
        found = " and ".join(given) or f"no {' or '.join(names)}"
        raise ValueError(f"found {found}; expected exactly one of {', '.join(names)}")
