"""Keys of the problem file: SI units, with the unit in the key; unknown keys are errors."""

# ruff: noqa: D101 (the table of a class has the summary of that class)
from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from ..common.schema_tables import (
    Among,
    ByForm,
    Declared,
    Section,
    Unit,
    Vector,
    require_one,
    used_keys,
)
from ..common.validated_types import Count, Finite, Flag, NotNegative, Positive, Text
from ..errors import InputError
from ..fem.body import Made, MeshOrigin
from ..fem.elements import ELEMENTS
from ..fem.laws.fibres import Fibres
from ..fem.laws.materials import DAMPINGS, MATERIALS
from ..fem.schemes import MOST_STEPS, SCHEMES
from ..fem.spatial_field import Field as SpatialField
from ..kinds.rod.element import LAWS as ROD_LAWS
from ..model.parameters import Unknown
from ..recording.experiment import usual_air_density
from ..recording.node_selection import Nodes
from ..statistics.budget.systematic_effects import Assumptions, ExactIfNone
from .options import RolloutOptions, UncertaintyOptions
from .recording_schema import ExperimentSection
from .solver_schema import SolverSection
from .specimen_schema import SpecimenSection

MaterialName = Annotated[str, Among((*MATERIALS, *ROD_LAWS))]
DampingName = Annotated[str, Among(tuple(DAMPINGS))]
ElementName = Annotated[str, Among(tuple(ELEMENTS))]
SchemeName = Annotated[str, Among(tuple(SCHEMES))]


class CodeSection(Section):
    """A custom material: a Python function of F and named constants.

    Attributes
    ----------
    file : str
        Python file; it is executed, for which commands need the option --allow-code.
    function : str
        Name of the energy function in the file.
    """

    file: Text
    function: Text


class NodeForceSection(CodeSection):
    """A custom force: a Python function of x, v, at and named constants.

    Attributes
    ----------
    function : str
        Name of the force function in the file.
    nodes : ElementNodes, optional
        Selection of nodes; all by default.
    on : str
        "nodes": the force acts on the selected nodes. "faces": it acts on the faces of the surface
        all of whose nodes are selected.
    carries : int
        Number of internal variables of each node or face. The function gets their previous values
        as the argument after v, and returns the force and their new values.
    """

    nodes: Nodes | None = None
    on: Literal["nodes", "faces"] = "nodes"
    carries: Count = 0


class FieldSection(Section, of=SpatialField): ...


class FibresSection(Section, of=Fibres): ...


Material = Annotated[MaterialName | CodeSection, ByForm(str)]


class RegionSection(Section):
    """A part of the body with other properties. The names of its parameters begin with its name.

    Attributes
    ----------
    name : str
        Name, made of letters, digits, - and _.
    cells : ElementNodes
        Elements of the region, selected by their centres: a table of box_m, ball_m or indices, or
        s_m along a rod, or the name of a cell array or of a physical group.
    material : Material, optional
        Material of the region; by default that of the object.
    damping : DampingName, optional
        Damping law of the region; by default that of the object.
    density_kg_m3 : float, optional
        Density of the region [kg/m³]; by default that of the object.
    field : FieldSection, optional
        A constant that varies in space within the region.
    fibres : FibresSection, optional
        Fibres of the region beside its material.
    """

    name: Annotated[str, Field(pattern="^[A-Za-z0-9_-]+$")]
    cells: Nodes
    material: Material | None = None
    damping: DampingName | None = None
    density_kg_m3: Positive | None = None
    field: FieldSection | None = None
    fibres: FibresSection | None = None


class PronySection(Section):
    """A branch of the material's memory. The parameters of a branch with the name prony_1 are
    prony_1.share and prony_1.tau_s.

    Attributes
    ----------
    name : str
        Name, made of letters, digits, - and _.
    region : str, optional
        Region with this branch; by default all regions that have no branches of their own.
    """

    name: Annotated[str, Field(pattern="^[A-Za-z0-9_-]+$")]
    region: Text | None = None


class CylinderSection(Section):
    """An upright cylinder, whose base is in the plane z = 0 with its centre at the origin.

    Attributes
    ----------
    quarter : bool
        Whether to mesh only the quarter x ≥ 0, y ≥ 0 between planes of symmetry.
    """

    diameter_m: Positive
    height_m: Positive
    quarter: Flag = False


class ScanSection(Section):
    """Gravity and held nodes while the mesh was scanned, with rest_shape = "under_gravity".

    Attributes
    ----------
    nodes : ElementNodes
        Selection of the nodes that were held: those in a clamp or on a table.
    gravity_m_s2 : list
        Gravity during the scan, along the axes of the mesh; its direction states the orientation in
        which the object was scanned.
    """

    nodes: Nodes
    gravity_m_s2: Vector = (0.0, 0.0, -9.81)


class RodSection(Section):
    """The cross-section of a rod: a circle, a ring, or a rectangle.

    Attributes
    ----------
    diameter_m : float, optional
        Outer diameter [m].
    inner_m : float
        Inner diameter [m], with diameter_m.
    width_m, height_m : float, optional
        Lengths of the sides [m]; the width is along first_director.
    """

    diameter_m: Positive | None = None
    inner_m: NotNegative = 0.0
    width_m: Positive | None = None
    height_m: Positive | None = None

    @model_validator(mode="after")
    def _require_one_form(self) -> RodSection:
        if sorted(used_keys(self, "diameter_m", "width_m", "height_m")) not in (
            ["diameter_m"],
            ["height_m", "width_m"],
        ):
            raise ValueError("expected diameter_m, or width_m and height_m")
        return self


# Keys of the object that state its shape.
SHAPES = ("mesh", "surface", "cylinder", "box_m", "centreline", "length_m")
# Keys that belong to a rod.
ROD_KEYS = ("section", "sections", "mass_per_length_kg_m", "first_director")


class ObjectSection(Section):
    """The soft object: its mesh, surface or shape, mass and material.

    Attributes
    ----------
    mesh : str, optional
        Tetrahedral mesh in any meshio format.
    surface : str, optional
        Closed surface to fill with tetrahedra.
    cylinder : CylinderSection, optional
        A cylinder to mesh: diameter_m, height_m, quarter.
    box_m : list, optional
        Lengths [x, y, z] of a box to mesh, with a corner at the origin.
    centreline : str, optional
        Table of points x_m, y_m, z_m along the centreline of a rod, cable or hose.
    length_m : float, optional
        Length of a rod that is straight, from the origin along x [m].
    section : RodSection, optional
        Cross-section of a rod: diameter_m and inner_m, or width_m and height_m.
    sections : int
        Number of cross-sections of a rod, at which it has nodes.
    mass_per_length_kg_m : float, optional
        Mass per length of a rod [kg/m], instead of the mass.
    first_director : list, optional
        Direction [x, y, z] of the section's width at the beginning of a rod.
    edge_length_m : float, optional
        Target edge length of the mesh of a surface, cylinder or box [m].
    length_unit : {"m", "cm", "mm", "in"}
        Unit of the coordinates in the file.
    mass_kg : float, optional
        Weighed mass of the complete object [kg]. Omit it if density_kg_m3 is stated here or is a
        parameter.
    density_kg_m3 : float, optional
        Uniform density [kg/m³], instead of the mass.
    material_density_kg_m3 : float, optional
        Known density of the material [kg/m³], beside mass_kg: with it the mass over the volume of
        the mesh is compared, which shows a mesh of another section or size.
    material : Material
        Name of a built-in material, or a table with the file and the function of a custom one.
    damping : DampingName
        Damping law, whose constant is γ_r. "kelvin-voigt": viscous stress proportional to the rate
        of deformation. "material": viscous stress proportional to the rate of the Green strain, as
        in MuJoCo. "rayleigh": the law of the paper, which also damps rigid rotation.
    element : {"tet4", "tet10", "tet10-p0"}
        Finite element: linear tetrahedra ("tet4"), quadratic tetrahedra ("tet10"), or quadratic
        tetrahedra with one pressure each, for nearly incompressible materials ("tet10-p0").
    region : list of RegionSection
        [[object.region]] tables: parts of the body with other properties.
    prony : list of PronySection
        [[object.prony]] tables: a material with memory, branch by branch.
    force : list of NodeForceSection
        [[object.force]] tables: custom forces on the nodes.
    field : FieldSection, optional
        A constant that varies in space: parameter, length_m, modes, amplitude.
    fibres : FibresSection, optional
        Fibres beside the material, outside all regions: direction or axis, families, law. Of a
        specimen without a mesh the direction is in the plane of its axes z (of the first strain)
        and x, see cut_angle_deg.
    rest_shape : {"stress_free", "under_gravity", "straight"}, optional
        "stress_free": the mesh has the shape without stress. "under_gravity": the mesh has the
        shape in which the object hung or stood under its own weight while it was scanned.
        "straight": the centreline of a rod is a shape under load, and the rod is straight without
        stress. By default the mesh counts as stress-free, and the result states how much the estimates would
        change if it is not; natural curvatures and twist of a rod are then estimated.
    made : Made, optional
        How the object was made, which selects default deviations of [uncertainty.assumptions] and
        the plausible densities: "cast" in a mould, cut from or moulded as "foam", "printed", or
        grown ("tissue").
    mesh_from : MeshOrigin, optional
        Origin of the mesh: the drawing from which the object was made ("cad"), or a "scan" of the
        object. A scan without rest_shape counts as made in an unknown orientation to gravity.
    scan : ScanSection, optional
        Gravity and held nodes during the scan: gravity_m_s2, nodes.
    """

    mesh: Text | None = None
    surface: Text | None = None
    cylinder: CylinderSection | None = None
    box_m: tuple[Positive, Positive, Positive] | None = None
    centreline: Text | None = None
    length_m: Positive | None = None
    section: RodSection | None = None
    sections: Count = 31
    mass_per_length_kg_m: Positive | None = None
    first_director: Vector | None = None
    edge_length_m: Positive | None = None
    length_unit: Unit = "m"
    mass_kg: Positive | None = None
    density_kg_m3: Positive | None = None
    material_density_kg_m3: Positive | None = None
    material: Material = "neo-hookean"
    damping: DampingName = "kelvin-voigt"
    element: ElementName = "tet4"
    region: list[RegionSection] = Field(default_factory=list)
    prony: list[PronySection] = Field(default_factory=list)
    force: list[NodeForceSection] = Field(default_factory=list)
    field: FieldSection | None = None
    fibres: FibresSection | None = None
    rest_shape: Literal["stress_free", "under_gravity", "straight"] | None = None
    made: Made | None = None
    mesh_from: MeshOrigin | None = None
    scan: ScanSection | None = None

    @property
    def has_shape(self) -> bool:
        """Whether the table states a mesh, a surface, a cylinder, a box, or an edge length."""
        return bool(used_keys(self, *SHAPES)) or self.edge_length_m is not None

    @property
    def is_rod(self) -> bool:
        """Whether the table describes a slender body."""
        return bool(used_keys(self, "centreline", "length_m"))

    def _require_rod_keys(self) -> None:
        rod_only = [key for key in ROD_KEYS if key in self.model_fields_set]
        if not self.is_rod:
            if rod_only or self.rest_shape == "straight":
                key = rod_only[0] if rod_only else 'rest_shape = "straight"'
                raise ValueError(
                    f"found {key} without centreline or length_m; expected one of them"
                )
            return
        if self.section is None:
            raise ValueError(
                "section is missing; expected the cross-section of the rod, such as "
                "section = { diameter_m = 0.006 }"
            )
        if "material" in self.model_fields_set and self.material not in ROD_LAWS:
            raise ValueError(
                f"found material = {self.material!r} for a rod; expected 'rod' (E and ν) or 'cable'"
            )
        if len(used_keys(self, "mass_kg", "density_kg_m3", "mass_per_length_kg_m")) > 1:
            require_one(self, "mass_kg", "density_kg_m3", "mass_per_length_kg_m")
        if solid := [
            key for key in ("edge_length_m", "scan", "element") if key in self.model_fields_set
        ]:
            raise ValueError(f"found {solid[0]} for a rod; expected none")

    @model_validator(mode="after")
    def _require_consistent(self) -> ObjectSection:
        if self.has_shape:
            require_one(self, *SHAPES)
        self._require_rod_keys()
        if self.is_rod:
            return self
        if self.has_shape and self.mesh is None and self.edge_length_m is None:
            raise ValueError(
                "edge_length_m is missing; expected the length of the elements' edges "
                "together with surface, cylinder or box_m"
            )
        if self.mesh is not None and self.edge_length_m is not None:
            raise ValueError(
                "edge_length_m is used only with surface, cylinder or box_m; expected one of "
                "these, or no edge_length_m"
            )
        if len(used_keys(self, "mass_kg", "density_kg_m3")) > 1:
            require_one(self, "mass_kg", "density_kg_m3")
        if (self.rest_shape == "under_gravity") != (self.scan is not None):
            raise ValueError(
                'rest_shape = "under_gravity" and [object.scan] belong together; expected both, '
                "or neither"
            )
        regions = [region.name for region in self.region]
        for branch in self.prony:
            if branch.region is not None and branch.region not in regions:
                one = (
                    f"one of {', '.join(regions)}"
                    if regions
                    else ("no region, because the object has none")
                )
                finding = f"prony '{branch.name}' belongs to the region {branch.region!r}"
                raise ValueError(f"{finding}; expected {one}")
        return self


class PriorSection(Section):
    """A normal prior, of the logarithm of a positive parameter or of the value of a linear one.

    Attributes
    ----------
    relative : float, optional
        Relative standard deviation, such as 0.2 for 20 %.
    deviation : float, optional
        Standard deviation of a parameter with scale = "linear", in the unit of the parameter.
    """

    mean: Finite
    relative: Positive | None = None
    deviation: Positive | None = None

    @model_validator(mode="after")
    def _require_one_deviation(self) -> PriorSection:
        require_one(self, "relative", "deviation")
        return self


class ParameterSection(Section, of=Unknown):
    """One parameter: estimated within bounds, fixed, or tied to another; {} is estimated.

    Attributes
    ----------
    fixed : float, optional
        Value that is not estimated.
    tied_to : str, optional
        Name of the parameter of which this one is a multiple.
    ratio : float, optional
        Ratio of this parameter to the parameter in `tied_to`, 1 by default.
    """

    guess: Declared
    lower: Declared
    upper: Declared
    prior: PriorSection | None = None
    scale: Declared
    typical: Declared
    fixed: Finite | None = None
    tied_to: Text | None = None
    ratio: Finite | None = None

    @model_validator(mode="after")
    def _require_one_kind(self) -> ParameterSection:
        if len(used_kinds := used_keys(self, "guess", "fixed", "tied_to")) > 1:
            raise ValueError(f"found {' and '.join(used_kinds)}; expected one of them, or none")
        of_kind = {
            "guess": ("lower", "upper", "prior", "scale", "typical"),
            "fixed": (),
            "tied_to": ("ratio",),
        }
        kind = next((key for key in of_kind if getattr(self, key) is not None), "guess")
        others = {key for keys in of_kind.values() for key in keys} - set(of_kind[kind])
        if useless := used_keys(self, *(n for n in type(self).model_fields if n in others)):
            alternative = "guess instead, or nothing, to estimate the parameter"
            raise ValueError(
                f"found {kind} together with {', '.join(useless)}; expected {kind} alone, or "
                f"{alternative}"
            )
        return self


def _flatten_parameters(tables: Any, *, prefix: str = "") -> Any:
    """Return parameters by full names; a table with a key of `ParameterSection` is a parameter."""
    if not isinstance(tables, dict):
        return tables
    flattened: dict[str, Any] = {}
    for name, value in tables.items():
        nested = isinstance(value, dict) and not set(value) & set(ParameterSection.model_fields)
        full_name = f"{prefix}{name}"
        inner = (
            _flatten_parameters(value, prefix=f"{full_name}.")
            if nested and value
            else {full_name: value}
        )
        if twice := [key for key in inner if key in flattened]:
            raise ValueError(f"{twice[0]!r} is given twice; expected one value")
        flattened.update(inner)
    return flattened


OneParameter = Annotated[ParameterSection | Finite, ByForm((dict, ParameterSection))]
Parameters = Annotated[dict[str, OneParameter], BeforeValidator(_flatten_parameters)]
Substeps = Annotated[int, Field(strict=True, ge=1, le=MOST_STEPS)]


class TranscriptionSection(Section):
    """Discretisation of the equations of motion.

    Attributes
    ----------
    scheme : {"midpoint", "bdf2", "backward-euler"}
        Time discretisation: midpoint rule, second-order backward differences, or backward Euler.
    substeps : str
        Number of time steps between samples. "auto": one, or more (up to 8) if one step would
        change a parameter by more than half a standard error; in motions with obstacles as many
        (up to 16) that the body moves in a step by at most the noise of its markers.
    explicit_grasps : bool
        Whether the positions of grasped nodes are constraints of the program (c^g in the paper)
        instead of bounds.
    """

    scheme: SchemeName = "midpoint"
    substeps: Annotated[Literal["auto"] | Substeps, ByForm(str)] = "auto"
    explicit_grasps: Flag = False


AirDensity = Annotated[Literal["none"] | NotNegative, ByForm(str)]


class EnvironmentSection(Section):
    """Surroundings of the object.

    Attributes
    ----------
    air_density_kg_m3 : float or "none"
        Density of the air, which causes buoyancy, added mass and drag, 1.2 by default; "none" in a
        vacuum, and for recordings that were simulated without air.
    """

    air_density_kg_m3: AirDensity = Field(default_factory=usual_air_density)


class RolloutSection(Section, of=RolloutOptions): ...


class AssumptionsSection(Section, of=Assumptions): ...


class UncertaintySection(Section, of=UncertaintyOptions):
    """Intervals of the estimates.

    Attributes
    ----------
    assumptions : Assumptions
        Standard deviations of systematic effects, by name; "none" if all are exact, as for a
        simulated recording.
    """

    assumptions: Annotated[AssumptionsSection, ExactIfNone()] = AssumptionsSection()


def _kind_tag(value: Any) -> str:
    """Return the tag of an experiment, which messages omit."""
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    return SPECIMEN_TAG if kind == "specimen" else "<recording>"


# Tag of the tables of specimens in the locations of validation errors.
SPECIMEN_TAG = "<specimen>"
if TYPE_CHECKING:
    AnyExperimentSection = ExperimentSection | SpecimenSection
else:
    AnyExperimentSection = Annotated[
        Annotated[ExperimentSection, Tag("<recording>")]
        | Annotated[SpecimenSection, Tag(SPECIMEN_TAG)],
        Discriminator(_kind_tag),
    ]


class ProblemFile(Section):
    """A problem file (TOML).

    Attributes
    ----------
    title : str
        Title of the problem in reports.
    parameters : Parameters
        Constants of the model by name: {} or a guess for a constant to estimate, a number for a
        known one, or a tie to another constant.
    experiment_defaults : mapping of name to object
        Default keys of every [[experiment]] table; specimens get only the keys that they have.
    experiment : list of ExperimentSection or SpecimenSection
        At least one [[experiment]] table, one for each recording or specimen.
    """

    title: str = ""
    object: ObjectSection
    parameters: Parameters
    experiment_defaults: dict[str, object] = Field(default_factory=dict)
    experiment: list[AnyExperimentSection] = Field(min_length=1)
    environment: EnvironmentSection = Field(default_factory=EnvironmentSection)
    transcription: TranscriptionSection = TranscriptionSection()
    solver: SolverSection = Field(default_factory=SolverSection)
    rollout: RolloutSection = RolloutSection()
    uncertainty: UncertaintySection = UncertaintySection.model_construct()

    @model_validator(mode="before")
    @classmethod
    def _merge_defaults(cls, content: Any) -> Any:
        """Insert [experiment_defaults] before the file is validated."""
        return with_experiment_defaults(content)

    @model_validator(mode="after")
    def _require_shape(self) -> ProblemFile:
        if self.object.has_shape:
            return self
        if self.recordings:
            raise InputError(
                f"found no {' or '.join(SHAPES)}; expected exactly one of {', '.join(SHAPES)}",
                where="object",
            )
        for key in ("region", "field", "force", "scan"):
            if getattr(self.object, key):
                raise InputError(
                    f"found {key} in a problem of specimens without a mesh, which are homogeneous; "
                    f"expected no {key}, or a mesh and a recording of it",
                    where=f"object.{key}",
                )
        return self

    @property
    def recordings(self) -> list[ExperimentSection]:
        """Experiments with the object's mesh, in the order of the file."""
        return [each for each in self.experiment if isinstance(each, ExperimentSection)]

    @property
    def specimens(self) -> list[SpecimenSection]:
        """Material tests without a mesh, in the order of the file."""
        return [each for each in self.experiment if isinstance(each, SpecimenSection)]


def with_experiment_defaults(content: Any) -> Any:
    """Return the content of a problem file with the keys of [experiment_defaults] in each
    experiment that does not state them.

    Only complete keys are taken over: a table in the experiment replaces that of the defaults. The
    content itself is not modified, and is returned if there is nothing to insert. Content that is
    not as the schema expects is passed on.
    """
    shared = content.get("experiment_defaults") if isinstance(content, dict) else None
    experiments = content.get("experiment") if isinstance(content, dict) else None
    if not (isinstance(shared, dict) and isinstance(experiments, list)):
        return content
    completed_tables = [
        _known_defaults(shared, table) | table if isinstance(table, dict) else table
        for table in experiments
    ]
    return content | {"experiment": completed_tables}


def _known_defaults(shared: dict[str, Any], table: dict[str, Any]) -> dict[str, Any]:
    """Return the defaults; those of recordings too leave out keys that specimens do not know."""
    if table.get("kind") != "specimen" or shared.get("kind") == "specimen":
        return shared
    return {key: value for key, value in shared.items() if key in SpecimenSection.model_fields}
