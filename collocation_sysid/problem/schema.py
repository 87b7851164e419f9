"""The problem file's keys: SI units, the unit in the key; unknown keys are refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from ..checked import Flag, NotNegative, Positive, Text, Whole
from ..fem.elements import ELEMENTS
from ..fem.materials import MATERIALS
from ..nlp.schemes import SCHEMES
from .recording_schema import ExperimentSection
from .section import Section, Unit, given_keys, require_one
from .solver_schema import SolverSection

if TYPE_CHECKING:
    MaterialName = ElementName = SchemeName = str
else:
    MaterialName = Literal[tuple(MATERIALS)]
    ElementName = Literal[tuple(ELEMENTS)]
    SchemeName = Literal[tuple(SCHEMES)]


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
        require_one(self, "mesh", "surface")
        if (self.surface is None) != (self.edge_length_m is None):
            raise ValueError("edge_length_m belongs to surface; expected both or neither")
        require_one(self, "mass_kg", "density_kg_m3")
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
        require_one(self, "guess", "fixed")
        useless = given_keys(self, "lower", "upper", "prior")
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
        given = given_keys(self, "lambda_pa", "mu_pa", "young_pa", "poisson")
        if given not in (["lambda_pa", "mu_pa"], ["young_pa", "poisson"]):
            raise ValueError(
                f"the elastic parameters are {', '.join(given) or 'missing'}; "
                "expected lambda_pa and mu_pa, or young_pa and poisson"
            )
        for name in ("mu_pa", "young_pa"):
            if name in given and getattr(self, name).fixed == 0:
                raise ValueError(f"found {name} = {{ fixed = 0 }}; expected a stiffness above 0")
        return self


class TranscriptionSection(Section):
    """How the equations of motion become constraints."""

    scheme: SchemeName = "midpoint"
    substeps: Whole = Field(default=1, ge=1, description="Grid steps between samples.")
    explicit_grasps: Flag = Field(
        default=False,
        description="Grasped nodes as constraint rows (the paper's c^g) instead of bounds.",
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
    solver: SolverSection = Field(default_factory=SolverSection)
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
