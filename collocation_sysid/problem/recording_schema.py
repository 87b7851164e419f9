"""Keys of [[experiment]]: grasps, obstacles, loads, measurements and nuisance parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from ..common.schema_tables import ByForm, Section, Unit, Vector, used_keys
from ..common.validated_types import (
    AtLeastOne,
    Boundless,
    Finite,
    Flag,
    NotNegative,
    Positive,
    Text,
)
from ..recording.depth_camera import Background, PoseMatrix
from ..recording.experiment import EARTH_M_S2, Kind, StartRule
from ..recording.grasp import Axes
from ..recording.markers import Places
from ..recording.node_selection import Nodes
from ..recording.placement import AttachmentRule
from ..recording.poses import Frame
from ..recording.solid_sections import SolidSection
from .load_schema import (
    ForceSection,
    PointMassSection,
    PressureSection,
    TendonSection,
)
from .nuisance_schema import NuisanceOrNone, NuisanceSection


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
    quaternion_xyzw: tuple[Finite, Finite, Finite, Finite] = (
        0.0,
        0.0,
        0.0,
        1.0,
    )

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
        A table of columns with units; the experiment's file by default.
    columns : mapping of name to str
        Column of the file for each quantity whose column is not recognised by its name. A unit that
        the file does not state is added to the name, as in "Load (N)".
    axis : {"x", "y", "z"}
        Axis of the world along which a machine measures.
    sign : {1, -1}
        1, or -1 if positive values in the file point against the axis, as those of a compression.
    """

    file: Text | None = None
    columns: dict[str, Text] = Field(default_factory=dict)
    axis: Literal["x", "y", "z"] = "z"
    sign: Literal[1, -1] = 1

    def dump_layout(self) -> dict[str, Any]:
        """Return the arguments with which the columns are read, by name: `columns`, `axis`, `sign`,
        and `scale`, `length_m` or `area_m2` where the section has them.
        """
        return self.model_dump(
            include={"columns", "axis", "sign", "scale", "length_m", "area_m2"}
        )


class DisplacementSection(TableSection):
    """Translations without rotations from the undeformed position, as of a test bench's crosshead.

    Columns t_s and any of x_m, y_m, z_m, in these or other units; or a machine's displacement, or
    engineering strain with a length.

    Attributes
    ----------
    length_m : float or "body", optional
        Undeformed length by which an engineering strain is multiplied [m]; "body" is the length of
        the body along the axis.
    scale : float
        Factor, above 0, on the displacements of the file: 0.5 for a model of half the height of the
        specimen, with a plane of symmetry across the loading axis, of which each half takes half of
        the displacement.
    """

    length_m: Annotated[Literal["body"] | Positive, ByForm(str)] | None = None
    scale: Positive = 1.0

    @model_validator(mode="after")
    def _require_one_size(self) -> DisplacementSection:
        """Return the section itself, or raise `ValueError` for a scale of strains of the body."""
        if self.length_m == "body" and self.scale != 1.0:
            raise ValueError(
                f'found scale = {self.scale:g} with length_m = "body"; expected one of them: the '
                "strain of the specimen is also that of the modelled part"
            )
        return self


class ForceSensorSection(TableSection):
    """The measured force and torque that the grasp or the obstacle exerts on the body.

    The table has the column t_s and any of fx_n, fy_n, fz_n, tx_nm, ty_nm, tz_nm, in these or
    other units; its rate may differ from that of the poses and markers. Or it has the force of a
    testing machine, or an engineering stress, with area_m2. Blank cells are missing. For a sensor
    that reports the reaction, the wrench of the body on the grasp or obstacle, set sign = -1.

    Attributes
    ----------
    sigma_n : float
        Standard deviation of the noise of each force [N].
    sigma_nm : float, optional
        Standard deviation of the noise of each torque [N m]; needed if torques are measured.
    frame : {"world", "grasp"}
        Axes of the components: those of the poses' world, or "grasp" for those of the undeformed
        body as the grasp carries it.
    point_m : list
        Point [x, y, z] of the torque: fixed in the world, or, in the frame "grasp", on the
        undeformed body and carried by the grasp.
    sensor_frame : str, optional
        Frame of the log in which the sensor measures, instead of frame and point_m: the log's
        static transforms rotate the components to the body, or to the world, and give the point. By
        default the frame of the messages, if frame and point_m are not stated either.
    area_m2 : float, optional
        Undeformed area by which an engineering stress is multiplied [m²].
    symmetry : int
        Number of equal parts of the measured specimen of which the mesh is one, such as 4 for a
        quarter: forces and sigmas are divided by this number, and results are reported for the
        whole specimen.
    """

    sigma_n: Positive
    sigma_nm: Positive | None = None
    frame: Frame = "world"
    point_m: Vector = (0.0, 0.0, 0.0)
    sensor_frame: Text | None = None
    symmetry: AtLeastOne = 1
    area_m2: Positive | None = None

    @property
    def states_axes(self) -> bool:
        """Whether the table states the axes of the components or the point of the torque."""
        return bool({"frame", "point_m"} & self.model_fields_set)

    @model_validator(mode="after")
    def _require_one_frame(self) -> ForceSensorSection:
        """Return the section itself; raise `ValueError` for sensor_frame with frame or point_m."""
        if self.sensor_frame is not None and self.states_axes:
            raise ValueError(
                "found sensor_frame together with frame or point_m; expected either sensor_frame, "
                "from which the log's transforms give both, or frame and point_m"
            )
        return self


def _as_table(value: str | DisplacementSection) -> DisplacementSection:
    """Return a displacement as a table: text is the name of its file, a table is returned
    as it is.
    """
    return (
        DisplacementSection.model_validate({"file": value})
        if isinstance(value, str)
        else value
    )


if TYPE_CHECKING:
    Displacement = DisplacementSection
else:
    Displacement = Annotated[
        Annotated[Text, AfterValidator(_as_table)] | DisplacementSection,
        ByForm(str),
    ]


class MovedSection(Section):
    """Grasp or obstacle that moves on a path of its own.

    Attributes
    ----------
    poses : str, optional
        File of poses (CSV or .npz). Without poses, displacement and markers there is no motion.
    displacement : Displacement, optional
        Translations from the undeformed position, as of a crosshead, instead of poses: a file with
        t_s and any of x_m, y_m, z_m, or a table of file, columns, axis and sign.
    quaternion : {"xyzw", "wxyz"}, optional
        Order of the quaternion's components, if the columns of the poses do not name them.
    length_unit : {"m", "cm", "mm", "in"}, optional
        Unit of the positions, if the file of poses does not state it.
    markers : mapping of name to (3,) array, optional
        Position [x, y, z] in the frame of the undeformed body of each marker on the gripper or
        obstacle, by name; the poses are fitted to the tracks of these markers.
    weights : mapping of name to float
        Weight of each of these markers in the fit of the poses, by name; 1 by default.
    max_residual_m : float, optional
        Residual of the fit of the poses above which a frame is reported [m].
    gripper_to_body : TransformSection, optional
        Pose G of the undeformed body in the frame whose poses U(t) were measured, x = U(t) G X:
        position_m, quaternion_xyzw.
    interpolation : {"smooth", "linear", "hold"}
        Motion between the samples of poses.
    """

    poses: Text | None = None
    displacement: Displacement | None = None
    quaternion: Literal["xyzw", "wxyz"] | None = None
    length_unit: Unit | None = None
    markers: dict[str, Vector] | None = None
    weights: dict[str, NotNegative] = Field(default_factory=dict)
    max_residual_m: Positive | None = None
    gripper_to_body: TransformSection | None = None
    interpolation: Literal["smooth", "linear", "hold"] = "smooth"

    @model_validator(mode="after")
    def _require_one_source(self) -> MovedSection:
        """Return the section itself, or raise `ValueError`.

        The error is raised if more than one of poses, displacement and markers is given,
        `gripper_to_body` with markers, a key without the source that it belongs to, fewer than
        three markers, or a weight of an unknown marker.
        """
        sources = used_keys(self, "poses", "displacement", "markers")
        if len(sources) > 1:
            raise ValueError(
                f"found {' and '.join(sources)}; expected one of them"
            )
        if self.gripper_to_body is not None and self.markers is not None:
            raise ValueError(
                "found gripper_to_body and markers; expected no gripper_to_body, because the "
                "positions in markers already refer to the undeformed body"
            )
        for section, keys in (
            ("poses", ("quaternion", "length_unit", "gripper_to_body")),
            ("markers", ("max_residual_m", "weights")),
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


class GraspSection(MovedSection):
    """Nodes held by a gripper or a test bench, and how it moves.

    Attributes
    ----------
    nodes : Nodes
        Selection: a table of box_m, ball_m, face or indices, or the name of a point array or
        physical group.
    from_s : float, optional
        First time [s] at which the grasp or obstacle acts; the start of the recording by default.
    until_s : float, optional
        Last time [s] at which the grasp or obstacle acts; the end of the recording by default. If a
        grasp ends at the first sample, the body is released from its equilibrium in this grasp.
    sigma_m : float, optional
        Standard deviation of the noise in each position of the poses [m]; estimated from their
        roughness by default.
    sigma_rad : float, optional
        Standard deviation of the noise in each rotation, about each axis [rad]; estimated from the
        roughness of the poses by default.
    axes : {"x", "y", "z", "xy", "xz", "yz", "xyz"}
        Axes of the world along which the nodes are prescribed; they slide along the others.
    wrench : ForceSensorSection, optional
        Measured force and torque on the body: file, sigma_n, sigma_nm, …
    """

    nodes: Nodes
    from_s: Finite | None = None
    until_s: Finite | None = None
    sigma_m: NotNegative | None = None
    sigma_rad: NotNegative | None = None
    axes: Axes = "xyz"
    wrench: ForceSensorSection | None = None

    @property
    def sensor(self) -> ForceSensorSection | None:
        """Table of the measured force and torque; None if they are not measured."""
        return self.wrench


class ObstacleSection(MovedSection):
    """A rigid solid that the body may touch, and how it moves.

    Attributes
    ----------
    from_s : float, optional
        First time [s] at which the grasp or obstacle acts; the start of the recording by default.
    until_s : float, optional
        Last time [s] at which the grasp or obstacle acts; the end of the recording by default. If a
        grasp ends at the first sample, the body is released from its equilibrium in this grasp.
    sigma_m : float, optional
        Standard deviation of the noise in each position of the poses [m]; estimated from their
        roughness by default.
    sigma_rad : float, optional
        Standard deviation of the noise in each rotation, about each axis [rad]; estimated from the
        roughness of the poses by default.
    axes : {"x", "y", "z", "xy", "xz", "yz", "xyz"}
        Axes of the world along which the nodes are prescribed; they slide along the others.
    shape : SolidSection
        Plane, Sphere, Cylinder, Capsule or Cuboid.
    name : str, optional
        Name in messages and pictures.
    friction : float or str
        Coefficient of friction; or the name of a parameter, whose bounds are 0 and 2.
    faces : Nodes, optional
        Faces of the body that may touch the obstacle: those whose corners are all selected. All by
        default.
    stiffness_pa_m : float, optional
        Contact stiffness κ [Pa/m] in the pressure κ (⟨δ − g⟩² − ⟨−g⟩²)/δ at the gap g; by default
        100 times Young's modulus at the current parameters over the mean edge of the face at each
        point.
    width_m : float, optional
        Gap δ at which the pressure begins [m]; by default the mean edge of the face over 5000, or
        over 500 with friction.
    slip : float, optional
        Sliding speed [m/s], or slip from sample to sample [m] of a static experiment, at which
        friction is 0.7 of its limit.
    force : ForceSensorSection, optional
        Measured force on the body: file, sigma_n, …
    """

    from_s: Finite | None = None
    until_s: Finite | None = None
    sigma_m: NotNegative | None = None
    sigma_rad: NotNegative | None = None
    axes: Axes = "xyz"
    shape: SolidSection
    name: Text | None = None
    friction: NotNegative | Text = 0.0
    faces: Nodes | None = None
    stiffness_pa_m: Positive | None = None
    width_m: Positive | None = None
    slip: Positive | None = None
    force: ForceSensorSection | None = None

    @property
    def sensor(self) -> ForceSensorSection | None:
        """Table of the measured force; None if it is not measured."""
        return self.force


# For each marker by name, or for all.
Sigma = Annotated[dict[str, Positive] | Positive, ByForm(dict)]
ReferenceSigma = Annotated[dict[str, NotNegative] | NotNegative, ByForm(dict)]


class MarkersSection(Section):
    """Tracked points.

    Attributes
    ----------
    places : {"free", "surface"}
        Estimated positions on the undeformed body: anywhere in it, or on its surface.
    attach : {"auto", "vertex", "embedded"}
        Nodes that carry a marker. "vertex": the nearest node. "embedded": the nodes of the
        tetrahedron that contains the marker or is nearest to it. "auto": the nearest node if it
        lies within 5 % of the mean edge length, otherwise "embedded".
    max_distance_m : float, optional
        Largest distance of a marker from the body; the mean edge length by default.
    file : str, optional
        Marker tracks: C3D, TRC, Qualisys TSV, Motive CSV or plain CSV; only `simulate` can do
        without.
    sigma_m : Sigma
        Standard deviation of the noise of each coordinate [m], for all markers or by marker name.
    names : list of str, optional
        List of the names of markers to use; all by default.
    labels : mapping of name to str
        Marker name for each label in the file, by label.
    weights : mapping of name to float
        Weight in the loss by marker name, 1 by default; 0 leaves the marker out.
    length_unit : {"m", "cm", "mm", "in"}, optional
        Unit of the coordinates, if the file does not state it.
    rate_hz : float, optional
        Frame rate [Hz], if the file states neither it nor times.
    template_m : mapping of name to (3,) array, optional
        Position [x, y, z] in the body's frame of at least three markers, by name; all tracks are
        moved by the rigid motion that fits these markers to their positions.
    template_window_s : list, optional
        First and last time [start, end] to average for the template.
    max_template_residual_m : float, optional
        Largest allowed distance of a marker from its position in the template [m].
    reference_m : mapping of name to (3,) array
        Position [x, y, z] of each marker on the undeformed body, by name; those of other markers
        are estimated.
    reference_sigma_m : ReferenceSigma, optional
        Standard deviation of the positions in reference_m, for all or by marker name; 0 for exact
        positions. That of nuisance.marker_offsets by default.
    """

    places: Places = "free"
    attach: AttachmentRule = "auto"
    max_distance_m: Positive | None = None
    file: Text | None = None
    sigma_m: Sigma = 0.001
    names: list[str] | None = None
    labels: dict[str, Text] = Field(default_factory=dict)
    weights: dict[str, NotNegative] = Field(default_factory=dict)
    length_unit: Unit | None = None
    rate_hz: Positive | None = None
    template_m: dict[str, Vector] | None = None
    template_window_s: tuple[Finite, Finite] | None = None
    max_template_residual_m: Positive | None = None
    reference_m: dict[str, Vector] = Field(default_factory=dict)
    reference_sigma_m: ReferenceSigma | None = None

    @model_validator(mode="after")
    def _require_template(self) -> MarkersSection:
        """Return the section itself; raise `ValueError` unless `template_m` and `template_window_s`
        are given together or not at all, with at least three positions and a window that does
        not end before it starts.
        """
        present = used_keys(
            self, "template_m", "template_window_s", "max_template_residual_m"
        )
        if present and not {"template_m", "template_window_s"} <= set(present):
            raise ValueError(
                f"found {', '.join(present)}; expected template_m and template_window_s, both "
                "or neither"
            )
        _require_three(self.template_m, "template_m")
        if (window := self.template_window_s) is not None and not window[
            0
        ] <= window[1]:
            raise ValueError(
                f"found template_window_s = {list(window)}; expected [start, end] with start <= end"
            )
        return self


def _require_file_name(name: str) -> str:
    r"""Return a name unchanged if it can be part of a file name on every platform: printable, not
    empty, no leading dot, and none of / \ : * ? " < > |; raise `ValueError` otherwise.
    """
    if (
        not name.isprintable()
        or name[:1] in ("", ".")
        or any(mark in name for mark in '/\\:*?"<>|')
    ):
        raise ValueError(
            f"found {name!r}; expected a valid file name: not empty, no leading dot, none of / \\ "
            ': * ? " < > |'
        )
    return name


Grasps = Annotated[list[GraspSection] | GraspSection, ByForm(list)]


class NamedSection(Section):
    """Table with a name that is also part of file names."""

    name: Annotated[str, AfterValidator(_require_file_name)]


class ReadingSection(NamedSection):
    """A custom sensor: a Python function of positions or forces and of its own unknowns.

    Attributes
    ----------
    name : str
        Name in error bars, and of the file that `simulate` writes.
    sigma : float
        Standard deviation of the noise of each number, in its unit.
    points_m : list
        Places [x, y, z] on the undeformed body whose motion the sensor measures.
    unknowns : mapping of name to float
        Prior standard deviation of each unknown of the sensor, about zero, by the argument's name;
        none by default. Write an unknown factor as ``1 + gain``. In a simulation unknowns are zero.
    grasp : int, optional
        Instead of points: the number of the grasp, from 1, whose force and torque the sensor
        measures.
    frame : {"world", "grasp"}
        Axes and origin of force and torque: those of the undeformed body as the grasp carries it,
        or the poses' world.
    columns : list of str
        Columns of the numbers in the file, in their order; all besides t_s by default.
    unit : str
        Unit of the numbers, for the terminal, reports and figures.
    code : str
        Python file; it is run, which needs --allow-code.
    function : str
        Name of the function in it.
    file : str, optional
        Measured values: a column t_s, and one for each number; only `simulate` can do without.
    """

    sigma: Positive
    points_m: list[Vector] = Field([])
    unknowns: dict[str, Positive] = Field({})
    grasp: AtLeastOne | None = None
    frame: Frame = "grasp"
    columns: list[Text] = Field([])
    unit: str = ""
    code: Text
    function: Text
    file: Text | None = None


class DepthCameraSection(Section):
    """A depth camera, or the frame of a scanner; keys that an .npz or a log contains may be left
    out.

    Attributes
    ----------
    matrix : list, optional
        Pinhole camera: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels. A cloud needs none; with it
        a bias and a scale of the depth are estimated, and surfaces that face away are left out.
    distortion : list
        k1, k2, p1, p2, k3 of the model of Brown and Conrady.
    pose : list, optional
        From the camera's frame to the world, or, with `poses`, to the frame that these move
        (hand–eye transform).
    poses : str, optional
        File of poses of the body that carries the camera; it is at rest by default.
    """

    matrix: tuple[Vector, Vector, Vector] | None = None
    distortion: list[Finite] = Field([])
    pose: PoseMatrix | None = None
    poses: Text | None = None


class DepthSection(NamedSection):
    """Depth images or point clouds of the body from a camera or a scanner, without labels.

    Attributes
    ----------
    name : str
        Name in messages, error bars and pictures.
    sigma_m : float
        Standard deviation of the noise along the normal of the surface.
    spacing_m : float
        Points are thinned to about this distance, as the noise of neighbouring pixels is
        correlated.
    gate_m : float
        Points farther than this from the surface are taken to belong to something else and are left
        out.
    faces : Nodes, optional
        Faces that may be visible: those whose corners are all selected. All by default.
    background : {"auto", "empty", "unknown"}
        Meaning of a pixel without a depth. "empty": nothing is there, so that the body cannot be
        there. "unknown": anything may be there, as where the sensor gets no echo from dark or steep
        surfaces. "auto": "empty" in images where hardly any pixel shows something far behind the
        body, otherwise "unknown". A measured depth well behind the body shows in either case that
        the body is not there.
    outline_sigma_px : float
        Standard deviation [pixels] of the distance between the body's outline and the edge of its
        silhouette in an image, at points of the outline that are `spacing_m` apart. Rounding to
        pixels alone gives 0.3.
    file : str
        Depth images (.npz, .png of 16 bits, .exr) or clouds of points (.ply, .pcd, .npy, .xyz), or
        a folder of these in the order of their names, with times.csv or t_s; or a topic of a log,
        ``run.mcap#/camera/depth/image_rect_raw``.
    camera : DepthCameraSection
        Pose and projection of the camera.
    t_s : list of float, optional
        Times [s], if the file does not contain them; a single image is assigned to the first sample
        by default.
    count_m : float, optional
        Depth of one count of an image, 0.001 by default.
    length_unit : {"m", "cm", "mm", "in"}
        Unit of clouds.
    """

    name: Annotated[str, AfterValidator(_require_file_name)] = "depth"
    sigma_m: Positive
    spacing_m: Positive = 0.004
    gate_m: Positive = 0.01
    faces: Nodes | None = None
    background: Background = "auto"
    outline_sigma_px: Positive = 0.5
    file: Text
    camera: DepthCameraSection = Field(
        default_factory=lambda: DepthCameraSection.model_construct()
    )
    t_s: list[Finite] | None = None
    count_m: Positive | None = None
    length_unit: Unit = "m"


class ExperimentSection(NamedSection):
    """One recording.

    Attributes
    ----------
    gravity_m_s2 : list
        Acceleration of gravity [x, y, z].
    gravity_frame : str, optional
        Frame of the log in whose axes gravity_m_s2 is stated, such as "base_link"; it must be fixed
        in the frame of the poses by static transforms. The frame of the poses by default.
    kind : {"dynamic", "static"}
        A motion ("dynamic"); or samples each of which is an equilibrium of its own ("static"), at
        any times (with memory, quasi-static in time).
    start : {"equilibrium", "undeformed"}
        State at the first time: at rest under its loads; or undeformed and at rest.
    start_rule : {"standard", "paper"}
        Inertia of the first step: from the starting velocity, or zero acceleration.
    loaded_since_s : float, optional
        How long a body with memory has been in the shape of its equilibrium; by default it has
        relaxed completely.
    validation : bool
        Whether the recording is only predicted, not fitted.
    mass : list of PointMassSection
        [[experiment.mass]] tables: point masses tied to the body.
    force : list of ForceSection
        [[experiment.force]] tables: forces besides gravity.
    tendon : list of TendonSection
        [[experiment.tendon]] tables: tendons in the body.
    pressure : list of PressureSection
        [[experiment.pressure]] tables: pressures in cavities, or on patches whose rim is held.
    file : str, optional
        Table of displacements and wrenches that name no file of their own: CSV as a test bench
        writes it.
    grasp : Grasps
        A table of nodes and poses, or a list of them.
    obstacle : list of ObstacleSection
        [[experiment.obstacle]] tables: rigid solids that the body may touch.
    markers : MarkersSection
        Tracked points; none are needed where the wrench of a grasp is measured.
    window_s : list, optional
        First and last time to use [start, end].
    resample_hz : float, optional
        Interpolate the markers linearly to this rate [Hz]. By default samples have the frame rate,
        lost frames are missing samples, and the model is evaluated at the time of each frame.
    every : int
        Use every n-th sample of the markers.
    reading : list of ReadingSection
        [[experiment.reading]] tables: custom sensors.
    depth : list of DepthSection
        [[experiment.depth]] tables: depth cameras and scanners.
    nuisance : NuisanceOrNone
        What is estimated of this recording alone, as a table; or "none".
    """

    gravity_m_s2: Vector = EARTH_M_S2
    gravity_frame: Text | None = None
    kind: Kind = "dynamic"
    start: Literal["equilibrium", "undeformed"] = "equilibrium"
    start_rule: StartRule = "standard"
    loaded_since_s: NotNegative | None = None
    validation: Flag = False
    mass: list[PointMassSection] = Field([])
    force: list[ForceSection] = Field([])
    tendon: list[TendonSection] = Field([])
    pressure: list[PressureSection] = Field([])
    file: Text | None = None
    grasp: Grasps = Field(default_factory=list)
    obstacle: list[ObstacleSection] = Field(default_factory=list)
    markers: MarkersSection = Field(
        default_factory=lambda: MarkersSection.model_construct()
    )
    window_s: tuple[Boundless, Boundless] | None = None
    resample_hz: Positive | None = None
    every: AtLeastOne = 1
    reading: list[ReadingSection] = Field(default_factory=list)
    depth: list[DepthSection] = Field(default_factory=list)
    nuisance: NuisanceOrNone = Field(
        default_factory=lambda: NuisanceSection.model_construct()
    )

    @property
    def has_markers(self) -> bool:
        """Whether the problem file states a table of markers, also an empty one."""
        return "markers" in self.model_fields_set

    def file_of(self, table: TableSection | None) -> str | None:
        """Return the file of a table, else that of the experiment; None if there is no table
        (None), or neither names one.
        """
        return table and (table.file or self.file)

    def list_measurement_files(self) -> list[str | None]:
        """Return the files of markers, custom sensors, depth cameras, grasps and obstacles; None
        for those that are not named.
        """
        names = [
            self.markers.file,
            *(each.file for each in (*self.reading, *self.depth)),
        ]
        for grasp in self.moved_sections:
            names += [
                grasp.poses or self.file_of(grasp.displacement),
                self.file_of(grasp.sensor),
            ]
        return names

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
        """Return the section itself; raise `ValueError` unless the window is missing or begins
        before it ends.
        """
        if (
            self.window_s is not None
            and not self.window_s[0] < self.window_s[1]
        ):
            raise ValueError(
                f"found window_s = {list(self.window_s)}; expected [start, end] with start < end"
            )
        return self

    @model_validator(mode="after")
    def _require_static_keys(self) -> ExperimentSection:
        """Return the section itself; raise `ValueError` if a series of equilibria has a key of
        motions.

        These are another `start` than "equilibrium", another `start_rule` than "standard",
        `resample_hz`, and a table `nuisance.time_shift`.
        """
        if self.kind == "dynamic":
            return self
        usual = {
            "start": "equilibrium",
            "start_rule": "standard",
            "resample_hz": None,
        }
        moving = [
            key for key, value in usual.items() if getattr(self, key) != value
        ]
        if isinstance(getattr(self.nuisance, "time_shift", None), Section):
            moving.append("nuisance.time_shift")
        if moving:
            raise ValueError(
                f'found {moving[0]} together with kind = "static"; expected none, because each '
                "sample is a separate equilibrium"
            )
        return self


def _require_three(places: dict[str, Any] | None, key: str) -> None:
    """Raise `ValueError` for fewer than three positions, which do not determine a rotation; None
    passes. `key` is for the message.
    """
    if places is not None and len(places) < 3:
        raise ValueError(
            f"found {len(places)} in {key}; expected at least three, to determine a rotation"
        )
