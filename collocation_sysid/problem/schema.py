"""The problem file's keys: SI units, the unit in the key; unknown keys are refused."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from ..fem.elements import ELEMENTS
from ..fem.materials import MATERIALS
from ..nlp.schemes import SCHEMES

Vector = tuple[float, float, float]
Unit = Literal["m", "cm", "mm", "in"]
Material = Literal[tuple(MATERIALS)]  # type: ignore[valid-type]
ElementName = Literal[tuple(ELEMENTS)]  # type: ignore[valid-type]
SchemeName = Literal[tuple(SCHEMES)]  # type: ignore[valid-type]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Section(BaseModel):
    """A table of the problem file."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ObjectSection(Section):
    """The soft object: its mesh or surface, mass and material."""

    mesh: str | None = Field(None, description="Tetrahedral mesh in any meshio format.")
    surface: str | None = Field(None, description="Closed surface to fill with tetrahedra.")
    edge_length_m: Positive | None = Field(None, description="Wanted edge length of a surface.")
    length_unit: Unit = Field("m", description="Unit of the coordinates in the file.")
    mass_kg: Positive | None = Field(None, description="Weighed mass of the whole object.")
    density_kg_m3: Positive | None = Field(None, description="Uniform density instead of a mass.")
    material: Material = "neo-hookean"
    element: ElementName = "tet4"
    evaluator: Literal["auto", "simd", "casadi"] = Field(
        "auto", description="How element kernels are evaluated."
    )

    @model_validator(mode="after")
    def _one_of_each(self) -> ObjectSection:
        if (self.mesh is None) == (self.surface is None):
            raise ValueError("expected exactly one of mesh and surface")
        if (self.surface is None) != (self.edge_length_m is None):
            raise ValueError("edge_length_m belongs to surface: expected both or neither")
        if (self.mass_kg is None) == (self.density_kg_m3 is None):
            raise ValueError("expected exactly one of mass_kg and density_kg_m3")
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
    fixed: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = Field(
        None, description="Value that is not estimated."
    )
    prior: PriorSection | None = None

    @model_validator(mode="after")
    def _guess_or_fixed(self) -> ParameterSection:
        if (self.guess is None) == (self.fixed is None):
            raise ValueError("expected exactly one of guess and fixed")
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
        given = [name for name in ("lambda_pa", "mu_pa", "young_pa", "poisson")
                 if getattr(self, name) is not None]  # fmt: skip
        if given not in (["lambda_pa", "mu_pa"], ["young_pa", "poisson"]):
            raise ValueError(
                f"the elastic parameters are {', '.join(given) or 'missing'}; "
                "expected lambda_pa and mu_pa, or young_pa and poisson"
            )
        return self


class NodesSection(Section):
    """A selection of mesh nodes, by exactly one of these."""

    box_m: tuple[Vector, Vector] | None = Field(None, description="Lowest and highest corner.")
    ball_m: tuple[Vector, Positive] | None = Field(None, description="Centre and radius.")
    indices: list[int] | None = Field(None, description="Node numbers as in the mesh file.")
    name: str | None = Field(None, description="A point array of the mesh, nonzero where selected.")

    @model_validator(mode="after")
    def _one(self) -> NodesSection:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"found {', '.join(given) or 'nothing'}; expected exactly one of "
                "box_m, ball_m, indices, name"
            )
        return self


def _named_nodes(value: Any) -> Any:
    return {"name": value} if isinstance(value, str) else value


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, dict) else value


class GraspSection(Section):
    """Nodes held by a gripper, and how it moves."""

    nodes: Annotated[NodesSection, BeforeValidator(_named_nodes)]
    poses: str | None = Field(None, description="Poses CSV; held where they are without it.")
    interpolation: Literal["linear", "hold"] = "linear"


class MarkersSection(Section):
    """Tracked points."""

    file: str | None = Field(None, description="Markers CSV; only `simulate` can do without.")
    sigma_m: Positive | dict[str, Positive] = Field(
        1e-3, description="Standard deviation of a coordinate, for all or by marker name."
    )
    names: list[str] | None = Field(None, description="Which markers to use; all by default.")
    length_unit: Unit = "m"
    reference_m: dict[str, Vector] = Field(
        default_factory=dict, description="Places on the undeformed body, by marker name."
    )
    attach: Literal["auto", "vertex", "embedded"] = "auto"
    max_distance_m: Positive | None = Field(
        None, description="Farthest a marker may be from the body; the mean edge length by default."
    )


class ExperimentSection(Section):
    """One recording."""

    name: str = Field(min_length=1, pattern=r"^[^/\\]+$")
    grasp: Annotated[list[GraspSection], BeforeValidator(_as_list)] = Field(default_factory=list)
    markers: MarkersSection
    start: Literal["equilibrium", "undeformed"] = "equilibrium"
    start_rule: Literal["standard", "paper"] = "standard"
    gravity_m_s2: Vector = (0.0, 0.0, -9.81)
    window_s: tuple[float, float] | None = Field(None, description="Use only this span of time.")
    resample_hz: Positive | None = Field(None, description="Put poses and markers on this rate.")
    validation: bool = Field(False, description="Not fitted, only predicted.")

    @model_validator(mode="after")
    def _window(self) -> ExperimentSection:
        if self.window_s is not None and not self.window_s[0] < self.window_s[1]:
            raise ValueError(f"window_s = {list(self.window_s)}; expected [start, end], start < end")
        return self


class TranscriptionSection(Section):
    """How the equations of motion become constraints."""

    scheme: SchemeName = "midpoint"
    substeps: int = Field(1, ge=1, description="Grid steps between samples.")
    explicit_grasps: bool = Field(
        False, description="Grasped nodes as constraint rows (the paper's c^g) instead of bounds."
    )


class SolverSection(Section):
    """The method and its options."""

    method: Literal["interior-point"] = "interior-point"
    hessian: Literal["exact", "gauss-newton", "limited-memory"] = "exact"
    linear_solver: str = Field("mumps", description="IPOPT's linear solver.")
    tolerance: Positive = 1e-8
    max_iterations: int = Field(200, ge=0)
    max_time_s: Positive = 1e6
    ipopt: dict[str, str | int | float] = Field(
        default_factory=dict, description="Further IPOPT options by name."
    )


class RolloutSection(Section):
    """The forward simulation that checks the answer."""

    integrator: Literal["newmark", "scheme"] = "newmark"
    timestep_s: Positive | None = Field(
        None, description="Newmark's step; a quarter of the sample interval by default."
    )


class ProblemFile(Section):
    """A problem file (TOML)."""

    title: str = ""
    object: ObjectSection
    parameters: ParametersSection
    experiment: list[ExperimentSection] = Field(min_length=1)
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
