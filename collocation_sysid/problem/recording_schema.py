"""Keys of [[experiment]]: grasps, obstacles, loads, measurements and nuisance parameters."""

# ruff: noqa: D101 (the table of a class has the summary of that class)
from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, GetJsonSchemaHandler, TypeAdapter, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from ..common.schema_tables import ByForm, Declared, Section, Unit, Vector, used_keys
from ..common.validated_types import AtLeastOne, Boundless, Finite, NotNegative, Positive, Text
from ..recording import (
    Experiment,
    Force,
    Gauge,
    Grasp,
    Markers,
    Obstacle,
    PointMass,
    Pressure,
    Tendon,
    Wrench,
)
from ..recording.markers import Places
from .camera_section import DepthSection
from .measurement_section import MeasurementSection, NamedSection, own_tables, registered_tables
from .nuisance_schema import NuisanceOrNone, NuisanceSection

# Fields of `Experiment` by the key of the tables that read themselves.
MEASUREMENT_TABLES = {"depth": "depths"}


# Fields of `Experiment` and the keys of the tables that state their entries.
LOADS = {"masses": "mass", "forces": "force", "tendons": "tendon", "pressures": "pressure"}


class PointMassSection(Section, of=PointMass): ...


class ForceSection(Section, of=Force): ...


class TendonSection(Section, of=Tendon): ...


class PressureSection(Section, of=Pressure): ...


class TransformSection(Section):
    """A constant rigid motion.

    Attributes
    ----------
    position_m : (3,) array
        Translation [x, y, z].
    quaternion_xyzw : list
        Rotation before the translation [x, y, z, w].
    """

    position_m: Vector = (0.0, 0.0, 0.0)
    quaternion_xyzw: tuple[Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 1.0)

    def to_matrix(self) -> Array:
        """Return (4, 4) matrix of the motion."""
        matrix = np.eye(4)
        rotation = Rotation.from_quat(self.quaternion_xyzw)
        matrix[:3, :3] = rotation.as_matrix()
        matrix[:3, 3] = self.position_m
        return matrix


class TableSection(Section):
    """Columns of a file, with units in their names.

    Attributes
    ----------
    file : str, optional
        Table whose columns have units; by default the file of the experiment.
    columns : mapping of name to str
        Column of the file for each quantity whose column is not recognised by its name. A unit that
        the file does not state is added to the name, as in "Load (N)".
    header_line : int, optional
        Line of the column names in the file, if it is not the one above the longest table.
    axis : {"x", "y", "z"}
        Axis of the world along which a machine measures.
    sign : {1, -1}
        1; or -1 if positive values in the file point against the axis, such as those of a
        compression from above.
    """

    file: Text | None = None
    columns: dict[str, Text] = Field(default_factory=dict)
    header_line: AtLeastOne | None = None
    axis: Literal["x", "y", "z"] = "z"
    sign: Literal[1, -1] = 1

    def dump_layout(self) -> dict[str, Any]:
        """Return the arguments with which the columns are read, by name: `columns`, `header_line`,
        `axis`, `sign`, and `scale`, `length_m` or `area_m2` where the section has them.
        """
        names = {"columns", "header_line", "axis", "sign", "scale", "length_m", "area_m2"}
        return self.model_dump(include=names)


class DisplacementSection(TableSection):
    """Translations from the undeformed position, such as those of a crosshead, or a rotation.

    The file has the column t_s and any of x_m, y_m, z_m, in these or other units; or the
    displacement of a testing machine; or its angle, with point_m; or an engineering strain, with
    length_m.

    Attributes
    ----------
    point_m : (3,) array, optional
        Point [x, y, z] of the axis of rotation, whose direction is axis, if the file has an angle.
    length_m : float or "body", optional
        Undeformed length by which an engineering strain is multiplied [m]; "body" is the length of
        the body along the axis.
    scale : float
        Positive factor by which the displacements of the file are multiplied: 0.5 if half the
        height of the specimen is modelled, with a plane of symmetry across the loading axis,
        because each half takes half of the displacement.
    """

    point_m: Vector | None = None
    length_m: Annotated[Literal["body"] | Positive, ByForm(str)] | None = None
    scale: Positive = 1.0

    @model_validator(mode="after")
    def _require_one_size(self) -> DisplacementSection:
        if self.length_m == "body" and self.scale != 1.0:
            raise ValueError(
                f'found scale = {self.scale:g} with length_m = "body"; expected one of them: the '
                "strain of the specimen is also that of the modelled part"
            )
        return self


class ForceSensorSection(TableSection, of=Wrench):
    """The measured force and torque that the grasp or the obstacle exerts on the body.

    The table has the column t_s and any of fx_n, fy_n, fz_n, tx_nm, ty_nm, tz_nm, in these or other
    units; its rate may differ from that of the poses and markers. Or it has the force of a testing
    machine, or an engineering stress, with area_m2. Blank cells are missing values. If the sensor
    reports the wrench that the body exerts on the grasp or obstacle, set sign = -1.

    Attributes
    ----------
    sensor_frame : str, optional
        Frame of the log in which the sensor measures, instead of frame and point_m. The static
        transforms of the log rotate the components to the axes of the body or of the world, and
        give the point. If neither sensor_frame nor frame nor point_m is stated, the frame of the
        messages is used.
    area_m2 : float, optional
        Undeformed area by which an engineering stress is multiplied [m²].
    symmetry : int
        Number of equal parts into which symmetry divides the measured specimen, if the mesh is one
        of these parts, such as 4 for a quarter. Forces and sigmas are divided by this number, and
        results are reported for the complete specimen.
    """

    frame: Declared
    point_m: Declared
    sensor_frame: Text | None = None
    symmetry: AtLeastOne = 1
    area_m2: Positive | None = None

    @property
    def noise_columns(self) -> dict[str, str]:
        """Columns of standard deviations by the keys that name them."""
        stated = {key: getattr(self, key) for key in ("sigma_n", "sigma_nm")}
        return {key: value for key, value in stated.items() if isinstance(value, str)}

    @property
    def states_axes(self) -> bool:
        """Whether the table states the axes of the components or the point of the torque."""
        return bool({"frame", "point_m"} & self.model_fields_set)

    @model_validator(mode="after")
    def _require_noise(self) -> ForceSensorSection:
        if all(getattr(self, key) is None for key in ("sigma_n", "sigma_nm")):
            raise ValueError(
                "found no sigma_n; expected sigma_n, the standard deviation of the noise of the "
                "forces [N], or sigma_nm, that of the torques [N m]"
            )
        return self

    @model_validator(mode="after")
    def _require_one_frame(self) -> ForceSensorSection:
        if self.sensor_frame is not None and self.states_axes:
            raise ValueError(
                "found sensor_frame together with frame or point_m; expected either sensor_frame, "
                "from which the log's transforms give both, or frame and point_m"
            )
        return self


def _as_table(value: str | DisplacementSection) -> DisplacementSection:
    return DisplacementSection.model_validate({"file": value}) if isinstance(value, str) else value


if TYPE_CHECKING:
    Displacement = DisplacementSection
else:
    Displacement = Annotated[
        Annotated[Text, AfterValidator(_as_table)] | DisplacementSection, ByForm(str)
    ]


class MovedSection(Section):
    """Grasp or obstacle that moves on a path of its own.

    Attributes
    ----------
    poses : str, optional
        File of poses (CSV or .npz). If neither poses nor displacement nor markers are given, there
        is no motion.
    displacement : Displacement, optional
        Translations from the undeformed position, such as those of a crosshead, instead of poses: a
        file with t_s and any of x_m, y_m, z_m, or a table of file, columns, axis and sign.
    quaternion : {"xyzw", "wxyz"}, optional
        Order of the quaternion's components, if the columns of the poses do not name them.
    length_unit : {"m", "cm", "mm", "in"}, optional
        Unit of the positions, if the file of poses does not state it.
    markers : mapping of name to (3,) array, optional
        Position [x, y, z] in the frame of the undeformed body of each marker on the gripper or
        obstacle, by name; the poses are fitted to the tracks of these markers.
    two_points : mapping of name to (3,) array, optional
        The same of two markers alone: the rotation about their line is that of least twist.
    weights : mapping of name to float
        Weight of each marker in `markers` in the fit of the poses, by name; 1 by default.
    gripper_to_body : TransformSection, optional
        Pose G of the undeformed body in the frame whose poses U(t) were measured, x = U(t) G X:
        position_m, quaternion_xyzw.
    interpolation : {"smooth", "linear", "hold"}
        Motion between the samples of poses: cubic splines ("smooth"), straight lines ("linear"), or
        the latest pose ("hold").
    """

    poses: Text | None = None
    displacement: Displacement | None = None
    quaternion: Literal["xyzw", "wxyz"] | None = None
    length_unit: Unit | None = None
    markers: dict[str, Vector] | None = None
    two_points: dict[str, Vector] | None = None
    weights: dict[str, NotNegative] = Field(default_factory=dict)
    gripper_to_body: TransformSection | None = None
    interpolation: Literal["smooth", "linear", "hold"] = "smooth"

    @model_validator(mode="after")
    def _require_one_source(self) -> MovedSection:
        sources = used_keys(self, "poses", "displacement", "markers", "two_points")
        if len(sources) > 1:
            raise ValueError(f"found {' and '.join(sources)}; expected one of them")
        if self.gripper_to_body is not None and self.cluster:
            raise ValueError(
                f"found gripper_to_body and {sources[0]}; expected no gripper_to_body, because the "
                f"positions in {sources[0]} already refer to the undeformed body"
            )
        if self.two_points is not None and len(self.two_points) != 2:
            raise ValueError(f"found {len(self.two_points)} in two_points; expected two")
        for section, keys in (
            ("poses", ("quaternion", "length_unit", "gripper_to_body")),
            ("markers", ("weights",)),
        ):
            present = [key for key in keys if getattr(self, key)]
            if present and getattr(self, section) is None:
                raise ValueError(
                    f"found {present[0]} without {section}; it is only used together with {section}"
                )
        _require_three(self.markers, "markers")
        for name in self.weights:
            if name not in (names := self.markers or ()):
                raise ValueError(
                    f"found {name!r} in weights; expected names among {', '.join(names)}"
                )
        return self

    @property
    def cluster(self) -> dict[str, Vector]:
        """Markers on the gripper or obstacle, with their places."""
        return self.markers or self.two_points or {}


class GraspSection(MovedSection, of=Grasp):
    """Nodes held by a gripper or a test bench, and how it moves.

    Attributes
    ----------
    displacements : str, optional
        Table of measured displacements that the nodes follow, as of image correlation, instead of
        poses: for each time and place a row of t_s, x_m, y_m, z_m (place on the undeformed body) or
        node (index, from 0), and ux_m, uy_m, uz_m, the displacement from the undeformed body.
    wrench : ForceSensorSection, optional
        Measured force and torque on the body: file, sigma_n, sigma_nm, …
    """

    axes: Declared
    sigma_m: Declared
    displacements: Text | None = None
    wrench: ForceSensorSection | None = None

    @model_validator(mode="after")
    def _require_deviation(self) -> GraspSection:
        others = used_keys(self, "poses", "displacement", "markers", "two_points")
        if self.displacements is not None and (others or self.sigma_m is None):
            found = f"together with {others[0]}" if others else "without sigma_m"
            raise ValueError(
                f"found displacements {found}; expected displacements and sigma_m, the standard "
                "deviation of the measured displacements [m], and no other motion"
            )
        return self

    @property
    def sensor(self) -> ForceSensorSection | None:
        """Table of the measured force and torque; None if they are not measured."""
        return self.wrench


class ObstacleSection(MovedSection, of=Obstacle):
    """A rigid solid that the body may touch, and how it moves.

    Attributes
    ----------
    force : ForceSensorSection, optional
        Measured force on the body: file, sigma_n, …
    """

    friction: Declared
    faces: Declared
    stiffness_pa_m: Declared
    width_m: Declared
    slip: Declared
    force: ForceSensorSection | None = None

    @property
    def sensor(self) -> ForceSensorSection | None:
        """Table of the measured force; None if it is not measured."""
        return self.force


# For each marker by name, or for all.
Sigma = Annotated[dict[str, Positive] | Positive, ByForm(dict)]
ReferenceSigma = Annotated[dict[str, NotNegative] | NotNegative, ByForm(dict)]


class MarkersSection(Section, of=Markers):
    """Tracked points.

    Attributes
    ----------
    places : {"free", "surface"}
        Where the estimated positions of markers may be: anywhere in the undeformed body ("free"),
        or on its surface ("surface").
    file : str, optional
        Marker tracks: C3D, TRC, Qualisys TSV, Motive, Vicon or plain CSV; not needed for `simulate`.
    sigma_m : Sigma
        Standard deviation of the noise of each coordinate [m], for all markers or by marker name.
    names : list of str, optional
        List of the names of markers to use; all by default.
    labels : mapping of name to str
        Marker name for each label in the file, by label.
    weights : mapping of name to float
        Weight of each marker in the loss, by name, 1 by default; 0 excludes the marker.
    length_unit : {"m", "cm", "mm", "in"}, optional
        Unit of the coordinates, if the file does not state it.
    rate_hz : float, optional
        Frame rate [Hz], if the file states neither it nor times.
    template_m : mapping of name to (3,) array, optional
        Position [x, y, z] in the body's frame of at least three markers, by name; all tracks are
        moved by the rigid motion that fits these markers to their positions.
    template_window_s : list, optional
        First and last time [start, end] of the window in which the markers are at the positions in
        template_m; their tracks are averaged over it.
    s_m : mapping of name to float
        Arc length of each marker on the centreline of a rod [m], by name, in place of reference_m.
    reference_m : mapping of name to (3,) array
        Position [x, y, z] of each marker on the undeformed body, by name; the positions of other
        markers are estimated.
    reference_sigma_m : ReferenceSigma, optional
        Standard deviation of the positions in reference_m, for all markers or by marker name; 0 for
        exact positions. By default it is the prior of nuisance.marker_offsets.
    """

    places: Places = "free"
    attach: Declared
    max_distance_m: Declared
    file: Text | None = None
    sigma_m: Sigma = 0.001
    names: list[str] | None = None
    labels: dict[str, Text] = Field(default_factory=dict)
    weights: dict[str, NotNegative] = Field(default_factory=dict)
    length_unit: Unit | None = None
    rate_hz: Positive | None = None
    template_m: dict[str, Vector] | None = None
    template_window_s: tuple[Finite, Finite] | None = None
    s_m: dict[str, NotNegative] = Field(default_factory=dict)
    reference_m: dict[str, Vector] = Field(default_factory=dict)
    reference_sigma_m: ReferenceSigma | None = None

    @model_validator(mode="after")
    def _require_template(self) -> MarkersSection:
        present = used_keys(self, "template_m", "template_window_s")
        if len(present) == 1:
            raise ValueError(
                f"found {', '.join(present)}; expected template_m and template_window_s, both "
                "or neither"
            )
        _require_three(self.template_m, "template_m")
        if (window := self.template_window_s) is not None and not window[0] <= window[1]:
            raise ValueError(
                f"found template_window_s = {list(window)}; expected [start, end] with start <= end"
            )
        return self


Grasps = Annotated[list[GraspSection] | GraspSection, ByForm(list)]


class ReadingSection(NamedSection, of=Gauge):
    """A custom sensor: a Python function of positions or forces and of its own unknowns.

    Attributes
    ----------
    name : str
        Name of the sensor in results, and of the file that `simulate` writes.
    grasp : int, optional
        Instead of points: the number of the grasp, from 1, whose force and torque the sensor
        measures.
    code : str
        Python file; it is executed, for which commands need the option --allow-code.
    function : str
        Name of the function in the Python file.
    file : str, optional
        Table of the measured values with a column t_s, and one column for each number; not needed
        for `simulate`.
    """

    grasp: Declared
    frame: Declared
    columns: Declared
    unit: Declared
    sigma: Declared
    code: Text
    function: Text
    file: Text | None = None


class ExperimentSection(NamedSection, of=Experiment):
    """One recording.

    Attributes
    ----------
    gravity_frame : str, optional
        Frame of the log in whose axes gravity_m_s2 is stated, such as "base_link"; it must be fixed
        in the frame of the poses by static transforms. The frame of the poses by default.
    start : {"equilibrium", "moving", "undeformed"}
        State of the body at the first time. "equilibrium": at rest under its loads. "moving": it still
        swings; its displacement and velocity are nuisance parameters. "undeformed": undeformed, and
        at rest unless `start_velocity_m_s` or `start_spin_rad_s` is stated.
    mass : list of PointMassSection
        [[experiment.mass]] tables: point masses tied to the body.
    force : list of ForceSection
        [[experiment.force]] tables: forces besides gravity.
    tendon : list of TendonSection
        [[experiment.tendon]] tables: tendons in the body.
    pressure : list of PressureSection
        [[experiment.pressure]] tables: pressures in cavities, or on patches whose rim is held.
    file : str, optional
        Table of the measurements of all displacements and wrenches that do not name a file of their
        own: CSV as a test bench writes it.
    grasp : Grasps
        A table of nodes and poses, or a list of them.
    obstacle : list of ObstacleSection
        [[experiment.obstacle]] tables: rigid solids that the body may touch.
    markers : MarkersSection
        Tracked points; not needed if the wrench of a grasp is measured.
    window_s : list, optional
        First and last time to use [start, end].
    resample_hz : float, optional
        Rate to which the markers are interpolated linearly [Hz]. By default the samples have the
        frame rate, lost frames are missing samples, and the model is evaluated at the time of each
        frame.
    every : int
        Use every n-th sample of the markers.
    reading : list of ReadingSection
        [[experiment.reading]] tables: custom sensors.
    depth : list of DepthSection
        [[experiment.depth]] tables: depth cameras and scanners.
    nuisance : NuisanceOrNone
        Table of the nuisance parameters of this recording with their priors; or "none" to estimate
        no nuisance parameters.
    """

    gravity_m_s2: Declared
    gravity_frame: Text | None = None
    kind: Declared
    start: Literal["equilibrium", "moving", "undeformed"] = "equilibrium"
    start_velocity_m_s: Declared
    start_spin_rad_s: Declared
    start_rule: Declared
    loaded_since_s: Declared
    validation: Declared
    mass: list[PointMassSection] = Field([])
    force: list[ForceSection] = Field([])
    tendon: list[TendonSection] = Field([])
    pressure: list[PressureSection] = Field([])
    file: Text | None = None
    grasp: Grasps = Field(default_factory=list)
    obstacle: list[ObstacleSection] = Field(default_factory=list)
    markers: MarkersSection = Field(default_factory=lambda: MarkersSection.model_construct())
    window_s: tuple[Boundless, Boundless] | None = None
    resample_hz: Positive | None = None
    every: AtLeastOne = 1
    reading: list[ReadingSection] = Field(default_factory=list)
    depth: list[DepthSection] = Field(default_factory=list)
    nuisance: NuisanceOrNone = Field(default_factory=lambda: NuisanceSection.model_construct())

    @property
    def has_markers(self) -> bool:
        """Whether the problem file states a table of markers, also an empty one."""
        return "markers" in self.model_fields_set

    def file_of(self, table: TableSection | None) -> str | None:
        """Return the file of a table, else that of the experiment; None if there is no table
        (None), or neither names one.
        """
        return table and (table.file or self.file)

    def noise_columns_of(self, table: TableSection) -> list[str]:
        """Return the columns of the table's file that hold the noise of sensors."""
        sensors = [each.sensor for each in self.moved_sections if each.sensor is not None]
        here = [each for each in sensors if self.file_of(each) == self.file_of(table)]
        return [name for each in here for name in each.noise_columns.values()]

    def list_measurement_files(self) -> list[str | None]:
        """Return the files of markers, sensors, grasps and obstacles; None for those that are not
        named.
        """
        names = [
            self.markers.file,
            *(each.file for each in self.reading),
            *(
                getattr(each, "file", None)
                for tables in self.measurement_tables.values()
                for each in tables
            ),
        ]
        for grasp in self.moved_sections:
            names += [self.motion_file(grasp), self.file_of(grasp.sensor)]
        return names

    def motion_file(self, moved: MovedSection) -> str | None:
        """Return the file of the motion of a grasp or an obstacle; None without a file."""
        measured = moved.displacements if isinstance(moved, GraspSection) else None
        return moved.poses or measured or self.file_of(moved.displacement)

    @property
    def measurement_tables(self) -> dict[str, list[MeasurementSection]]:
        """Tables that read themselves by their key, of those keys that have any."""
        tables = {key: getattr(self, key) for key in MEASUREMENT_TABLES}
        if self._registered is not None:
            tables |= dict(self._registered)
        return {key: listed for key, listed in tables.items() if listed}

    # Tables of features and of other packages.
    _registered: Section | None = None

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        schema = handler(core_schema)
        properties = handler.resolve_ref_schema(schema)["properties"]
        for key, table in own_tables().items():
            summary = (table.__doc__ or "").partition("\n")[0]
            properties[key] = {
                "default": [],
                "description": f"[[experiment.{key}]] tables: {summary[:1].lower()}{summary[1:]}",
                "items": handler(TypeAdapter(table).core_schema),
                "type": "array",
            }
        return schema

    @model_validator(mode="wrap")
    @classmethod
    def _with_registered_tables(cls, table: Any, validated: Any) -> Any:
        """Tables of features and of other packages are validated by their own classes."""
        registered = registered_tables()
        if not isinstance(table, dict):
            return validated(table)
        of_others = {key: table[key] for key in registered.model_fields.keys() & table.keys()}
        section = validated({k: each for k, each in table.items() if k not in of_others})
        section._registered = registered.model_validate(of_others)
        return section

    @property
    def grasp_list(self) -> list[GraspSection]:
        """Grasps as a list; a single table is a list of one, no grasp an empty one."""
        return self.grasp if isinstance(self.grasp, list) else [self.grasp]

    @property
    def moved_sections(self) -> list[GraspSection | ObstacleSection]:
        """Grasps, followed by the obstacles, in the order of the file; their indices from 0 are
        those of `Experiment.grasps`.
        """
        return [*self.grasp_list, *self.obstacle]

    @model_validator(mode="after")
    def _require_window(self) -> ExperimentSection:
        if self.window_s is not None and not self.window_s[0] < self.window_s[1]:
            raise ValueError(
                f"found window_s = {list(self.window_s)}; expected [start, end] with start < end"
            )
        return self

    @model_validator(mode="after")
    def _require_static_keys(self) -> ExperimentSection:
        """Equilibria have no keys of motions."""
        if self.kind == "dynamic":
            return self
        usual = {"start": "equilibrium", "start_rule": "standard", "resample_hz": None}
        moving = [key for key, value in usual.items() if getattr(self, key) != value]
        if isinstance(getattr(self.nuisance, "time_shift", None), Section):
            moving.append("nuisance.time_shift")
        if moving:
            raise ValueError(
                f'found {moving[0]} together with kind = "static"; expected none, because each '
                "sample is a separate equilibrium"
            )
        return self


def _require_three(places: dict[str, Any] | None, key: str) -> None:
    if places is not None and len(places) < 3:
        raise ValueError(
            f"found {len(places)} in {key}; expected at least three, to determine a rotation"
        )
