"""One recording of a body: its grasps, loads and measurements, and the state it starts from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.array_types import Array, Index
from ..common.checked_arrays import float_array, float_converter, read_only_floats
from ..common.declarations import declaration, key
from ..common.schema_tables import ByForm, Vector
from ..common.validated_types import FileName, Finite, Flag, NotNegative
from ..errors import InputError, listed
from ..fem.node_force import AIR_KG_M3
from .actuator import Actuator
from .custom_sensor import CustomSensor
from .depth_camera import Depth
from .deviation import Deviation
from .grasp import Grasp, free_rigid_motions, prescribed_dofs
from .homogeneous_deformation import HomogeneousDeformation
from .loads import Force, LoadTime, PointMass, smooth_ramp
from .markers import Markers
from .measured_wrench import Wrench
from .measurement import Measurement
from .nuisance import Nuisance
from .obstacle import Obstacle, with_obstacle_frames
from .placement import require_body
from .pressure import Pressure
from .sample_times import STEP_TOLERANCE, TIME_TOLERANCE_S, first_unordered_time, sample_interval_s
from .tendon import Tendon
from .time_tables import is_within_experiment

if TYPE_CHECKING:
    from ..fem.body import Body
    from ..fem.pattern import JointPattern, SymmetricPattern

Kind = Literal["dynamic", "static"]
Start = Literal["equilibrium", "moving", "undeformed", "given"]
StartRule = Literal["standard", "paper"]

# Relative tolerance of the flatness of a face, and of a node that lies in a plane: rounding of mesh
# files in single precision, over the longest extent of the body.
FLATNESS = 1e-4
# Default gravity [m/s²], with z upwards.
EARTH_M_S2 = (0.0, 0.0, -9.81)
DEFAULT_NUISANCE = Nuisance()


def require_no_surface(found: Sequence[str]) -> None:
    """Raise an `InputError` if anything was found that only a solid body can have."""
    if found:
        raise InputError(
            f"found {listed(found)} of a rod; expected a solid body, because a rod has no surface: "
            "leave out obstacles, tendons, pressures, depth images and outlines"
        )


def _state(name: str) -> Callable[[ArrayLike], Array]:
    """Return a converter of (k, 3) to read-only floats for ``start_<name>``, checked."""
    return float_converter((None, 3), f"start_{name}")


Temperature = Annotated[list[tuple[Finite, Finite]] | Finite, ByForm(list)]


def _temperature(value: ArrayLike) -> Array:
    """Return times [s] and temperature differences [K] as (k, 2), from a table or one number."""
    name = "temperature_difference_k"
    given = float_array(value, name)
    return read_only_floats(given if given.ndim else [[0.0, given]], (None, 2), name)


VACUUM = "none"
# Density of the air around experiments that state none [kg/m³].
USUAL_KG_M3: float = AIR_KG_M3


def usual_air_density() -> float:
    """Return `USUAL_KG_M3`, the density of the air around experiments that state none [kg/m³], as
    it is at the time of the call.
    """
    return USUAL_KG_M3


def air_density(value: float | Literal["none"]) -> float:
    """Return a stated density of the air [kg/m³]; zero for "none", a vacuum.

    Raises
    ------
    InputError
        If it is neither "none" nor a finite number of at least zero; booleans and numbers as text
        are refused.
    """
    if isinstance(value, str) and value == VACUUM:
        return 0.0
    is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    density_kg_m3 = float(value) if is_number else np.nan
    if not 0 <= density_kg_m3 < np.inf:
        raise InputError(
            f"air_density_kg_m3 is {value!r}; expected a density in kg/m³ such as {AIR_KG_M3}, or "
            f'"{VACUUM}" for a vacuum or a recording simulated without air'
        )
    return density_kg_m3


@declaration
class Experiment:
    """One recording of a body: a motion or a series of equilibria, with loads and measurements.

    Parameters
    ----------
    body : Body
        Provides `nodes_m`, `cells` and `element`.
    t_s : (T,) array
        At least three evenly spaced times; of a static experiment one or more, ascending.
    grasps : sequence of Grasp
        Grasps, then any `Obstacle`. Two grasps must not hold a node along the same axis at the same
        time. Selections are looked up on the body, and poses given as matrices are those at `t_s`.
    markers : Markers, optional
        Tracks at the times `t_s`, at least one sample present. Markers given by their places are
        put on the body, see `place_markers`. Not needed if wrenches, depth or `readings` are
        measured.
    gravity_m_s2 : (3,) array
        Acceleration of gravity [x, y, z].
    name : str
        For messages and reports; experiments of one problem have different names.
    kind : {"dynamic", "static"}
        "dynamic": a motion. "static": each sample is an equilibrium, and a material with memory
        relaxes between the samples.
    start : {"equilibrium", "moving", "undeformed", "given"}
        State at the first time: at rest under its loads; displaced from there and moving, as nuisance
        parameters describe; undeformed, at rest or with `start_velocity_m_s` and `start_spin_rad_s`;
        or as given.
    start_rule : {"standard", "paper"}
        Inertia in the first time step. "standard": from the initial velocity. "paper": zero
        acceleration.
    start_positions_m, start_velocities_m_s : (n, 3) arrays, optional
        The state for "given"; at rest if the velocities are left out.
    start_velocity_m_s : (3,) array, optional
        Velocity [x, y, z] of the centre of mass at the first time, of a body that starts
        "undeformed"; at rest by default.
    start_spin_rad_s : (3,) array, optional
        Angular velocity [x, y, z] of such a body about its centre of mass; zero by default.
    start_motion : (12,) array, optional
        Known part of the motion of a body that starts "moving", see `start_motion.start_forces_n`: six
        accelerations [m/s²] and six velocities [m/s]; zero by default.
    loaded_since_s : float
        How long a body with memory has been in the shape of its initial equilibrium [s]; by default
        the material is completely relaxed.
    validation : bool
        Whether the recording is only predicted, not fitted.
    frames_fault : str
        Contradiction between the coordinate frames that the files of poses and markers state, with
        the remedy; "" if there is none, or files state no frames.
    masses : sequence of PointMass
        Point masses tied to the body.
    forces : sequence of Force
        Forces besides gravity.
    tendons : sequence of Tendon
        Tendons in the body.
    pressures : sequence of Pressure
        Pressures in cavities, or on patches whose rim is held.
    readings : sequence of CustomSensor
        Custom sensors, such as `Gauge`.
    depths : sequence of Depth
        Depth cameras and scanners.
    air_density_kg_m3 : float or "none"
        Density of the air around the body, which gives buoyancy, added mass and drag; "none",
        stored as zero, in a vacuum and for a recording simulated without air.
    nuisance : Nuisance
        Standard deviations of the unknowns of this recording alone, which are estimated too: by
        default those of a careful laboratory; `Nuisance.none` for ideal data.
    temperature_difference_k : float or (k, 2) array, optional
        Temperature of the body less that at which its constants are reported [K]: a number, or
        times [s] and differences, between which it is linear. None if it is not known.
    known_deviations : mapping of str to float
        Known values of deviations that change the stiffness, by name, such as
        ``{"stiffness_per_kelvin": -0.01}``.
    specimen : HomogeneousDeformation, optional
        Homogeneous deformation of a material test without a mesh, see `Specimen`; None for a body
        with a mesh.

    Raises
    ------
    InputError
        If any of this does not hold, naming the experiment.
    """

    body: Body = key(converter=require_body)
    t_s: Array = key(converter=float_converter((None,), "t_s"))
    grasps: tuple[Grasp, ...] = key(converter=tuple[Grasp, ...])
    markers: Markers = key(default=None)
    gravity_m_s2: Array = key(
        Vector, converter=float_converter((3,), "gravity_m_s2"), default=EARTH_M_S2
    )
    name: str = key(accepted=FileName, default="experiment")
    _: KW_ONLY
    kind: Kind = key(Kind, default="dynamic")
    start: Start = key(Start, default="equilibrium")
    start_rule: StartRule = key(StartRule, default="standard")
    start_positions_m: Array | None = key(converter=_state("positions_m"), default=None)
    start_velocities_m_s: Array | None = key(converter=_state("velocities_m_s"), default=None)
    start_velocity_m_s: Array | None = key(
        Vector | None, converter=float_converter((3,), "start_velocity_m_s"), default=None
    )
    start_spin_rad_s: Array | None = key(
        Vector | None, converter=float_converter((3,), "start_spin_rad_s"), default=None
    )
    start_motion: Array | None = key(converter=float_converter((12,), "start_motion"), default=None)
    loaded_since_s: float = key(NotNegative | None, default=np.inf)
    validation: bool = key(Flag, default=False)
    frames_fault: str = ""
    masses: tuple[PointMass, ...] = key(converter=tuple[PointMass, ...], default=())
    forces: tuple[Force, ...] = key(converter=tuple[Force, ...], default=())
    tendons: tuple[Tendon, ...] = key(converter=tuple[Tendon, ...], default=())
    pressures: tuple[Pressure, ...] = key(converter=tuple[Pressure, ...], default=())
    readings: tuple[CustomSensor, ...] = key(converter=tuple[CustomSensor, ...], default=())
    depths: tuple[Depth, ...] = key(converter=tuple[Depth, ...], default=())
    nuisance: Nuisance = DEFAULT_NUISANCE
    air_density_kg_m3: float = key(converter=air_density, default_factory=usual_air_density)
    temperature_difference_k: Array | None = key(
        Temperature | None, converter=_temperature, default=None
    )
    known_deviations: Mapping[str, float] = key(dict[str, Finite], default_factory=dict)
    specimen: HomogeneousDeformation | None = None

    def __post_init__(self) -> None:
        """Append the frames of the obstacles to the body, put obstacles last, and resolve nodes."""
        loads = ("masses", "forces", "tendons", "pressures")
        if not self.body.is_solid:
            self._require_no_surface()
        if self.obstacles or len(self.body.frames):
            vars(self)["body"] = with_obstacle_frames(
                self.body, self.obstacles, is_static=self.is_static
            )
        framed = zip(self.obstacles, self.body.frames, strict=True)
        vars(self).update(
            grasps=(
                *(grasp.on_body(self.body, self.t_s) for grasp in self.body_grasps),
                *(obstacle.with_frame_nodes(frame, self.t_s) for obstacle, frame in framed),
            ),
            markers=Markers.none(self.t_s) if self.markers is None else self.markers,
            **{
                name: tuple(load.on_body(self.body) for load in getattr(self, name))
                for name in loads
            },
        )
        self._check_kind()
        self._check_time()
        vars(self)["markers"] = self.markers.on_body(self.body, self._undeformed_places)
        self._check_nodes()
        self._check_order_of_grasps()
        vars(self)["grasps"] = tuple(self._without_symmetric_loads(each) for each in self.grasps)
        self._check_start()
        self._check_actuators()
        self._check_obstacles()
        self._check_air()
        self._check_stiffness_deviations()

    @property
    def description(self) -> str:
        """Name of the experiment with the word "experiment" in front, for messages."""
        return f"experiment '{self.name}'"

    def __repr__(self) -> str:
        static = "static, " if self.is_static else ""
        validation = ", validation" if self.validation else ""
        return (
            f"Experiment({self.name!r}: {static}{len(self.t_s)} samples over "
            f"{self.duration_s:.4g} s, grasps: {len(self.grasps)}, {self.markers!r}{validation})"
        )

    @property
    def body_grasps(self) -> tuple[Grasp, ...]:
        """Grasps that hold nodes of the body: all `grasps` but the obstacles."""
        return tuple(grasp for grasp in self.grasps if not isinstance(grasp, Obstacle))

    @property
    def wrenches(self) -> tuple[Wrench, ...]:
        """Measured wrenches of the grasps that have a sensor, obstacles included, in the order of
        `grasps`.
        """
        return tuple(self.sensors_by_grasp.values())

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """All measurements: markers if there are any, wrenches, custom sensors and depth cameras."""
        return (*(self.markers,) * bool(self.markers.names), *self.wrenches, *self.separate_sensors)

    def with_measurements(
        self, measurements: Iterable[Measurement | None], **changes: Any
    ) -> Experiment:
        """Return a copy of the experiment with other measurements.

        Parameters
        ----------
        measurements : iterable of Measurement or None
            Each in the place of one of `Experiment.measurements`, in their order; None leaves it
            out.
        **changes
            Other fields that are replaced; `grasps` then have the same sensors.

        Raises
        ------
        ValueError
            If their number is another one.
        """
        others = iter([each for _, each in zip(self.measurements, measurements, strict=True)])
        markers = next(others) if self.markers.names else None
        grasps = [
            grasp if grasp.wrench is None else replace(grasp, wrench=next(others))
            for grasp in changes.pop("grasps", self.grasps)
        ]
        sensors = {
            name: [other for _ in getattr(self, name) if (other := next(others)) is not None]
            for name in ("readings", "depths")
        }
        return replace(self, markers=markers, grasps=grasps, **sensors, **changes)

    @property
    def separate_sensors(self) -> list[CustomSensor | Depth]:
        """Sensors with times of their own, besides markers and those of grasps."""
        return [*self.readings, *self.depths]

    @property
    def camera_names(self) -> list[str]:
        """Names of the depth cameras, in their order."""
        return [camera.name for camera in self.depths]

    @property
    def sensors_by_grasp(self) -> dict[int, Wrench]:
        """Measurements of the force–torque sensors by the number of their grasp or obstacle, from 1
        on, in the order of `grasps`.
        """
        return {
            number: grasp.wrench
            for number, grasp in enumerate(self.grasps, 1)
            if grasp.wrench is not None
        }

    @cached_property
    def planes_of_symmetry(self) -> list[tuple[int, Index]]:
        """Normal axis, 0 to 2, and nodes of the body in each plane of symmetry: the plane in which
        the nodes of a grasp lie that holds them along its normal alone.
        """
        nodes_m = self.body.nodes.points_m
        tolerance_m = FLATNESS * float(np.ptp(nodes_m, axis=0).max())
        planes = []
        for grasp in self.body_grasps:
            if len(grasp.axes) > 1:
                continue
            normal = int(grasp.axis_indices[0])
            heights_m = nodes_m[grasp.nodes, normal]
            if np.ptp(heights_m) <= tolerance_m:
                is_in_plane = np.abs(nodes_m[:, normal] - heights_m.mean()) <= tolerance_m
                planes.append((normal, np.flatnonzero(is_in_plane)))
        return planes

    def _without_symmetric_loads(self, grasp: Grasp) -> Grasp:
        """Drop components that vanish on the complete specimen by symmetry."""
        wrench = grasp.wrench
        if wrench is None or wrench.symmetry == 1 or isinstance(grasp, Obstacle):
            return grasp
        vanishes = np.zeros(6, dtype=bool)
        for normal, nodes in self.planes_of_symmetry:
            is_own = len(grasp.axes) == 1 and grasp.axis_indices[0] == normal
            if not is_own and np.isin(grasp.nodes, nodes).any():
                vanishes[normal] = True
                vanishes[3:] |= np.arange(3) != normal
        if not (vanishes & wrench.measured_components).any():
            return grasp
        if not (wrench.measured_components & ~vanishes).any():
            names = listed(wrench.component_names)
            raise InputError(
                f"{names} of the complete specimen vanish by symmetry across the planes in which "
                "grasps hold the body; expected the measured force along the load"
            )
        return replace(
            grasp, wrench=replace(wrench, values=np.where(vanishes, np.nan, wrench.values))
        )

    @property
    def symmetry(self) -> int:
        """Ratio of the specimen's loads to those of the modelled part: that of the
        wrenches; 1 if there are no wrenches, or they state different ratios.
        """
        symmetries = {wrench.symmetry for wrench in self.wrenches}
        return symmetries.pop() if len(symmetries) == 1 else 1

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Rigid obstacles that the body may touch; they come last in `grasps`."""
        return tuple(grasp for grasp in self.grasps if isinstance(grasp, Obstacle))

    def with_obstacles(self, obstacles: Iterable[Obstacle]) -> Experiment:
        """Return a copy of the experiment with these obstacles in place of its own; all checks are
        repeated.
        """
        return replace(self, grasps=(*self.body_grasps, *obstacles))

    @property
    def is_static(self) -> bool:
        """Whether every sample is an equilibrium of its own."""
        return self.kind == "static"

    @property
    def timestep_s(self) -> float:
        """Mean time between samples [s]; 1 s if there is only one sample."""
        return self.duration_s / (len(self.t_s) - 1) if len(self.t_s) > 1 else 1.0

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample."""
        return float(self.t_s[-1] - self.t_s[0])

    @cached_property
    def prescribed_dofs(self) -> Index:
        """Sorted dofs (3 · node + axis) with prescribed displacements at every sample time, those
        of the obstacles' frames included.
        """
        is_prescribed = self.is_prescribed(self.t_s)
        return np.flatnonzero(is_prescribed.all(axis=0))

    @cached_property
    def free_dofs(self) -> Index:
        """Sorted dofs that are not in `prescribed_dofs`; grasps with a time window may hold some of
        them for a while.
        """
        return np.setdiff1d(np.arange(self.body.nodes_m.size), self.prescribed_dofs)

    def prescribed_displacements(self, t_s: ArrayLike) -> tuple[NDArray[np.bool_], Array]:
        """Return which nodal coordinates are prescribed at the times `t_s` (T,), and their values.

        The n nodes include those of the obstacles' frames.

        Returns
        -------
        is_prescribed : (T, n, 3) bool
            Whether a grasp prescribes the coordinate.
        positions_m : (T, n, 3)
            Prescribed coordinates [m]; NaN where a coordinate is free.

        Raises
        ------
        InputError
            If a grasp is active at a time that its poses do not cover, see `PoseSequence.at`.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        is_prescribed = self.is_prescribed(times)
        positions = np.full(is_prescribed.shape, np.nan)
        for grasp in self.grasps:
            holding = np.flatnonzero(grasp.is_active(times))
            moved_m = grasp.positions_at(self.body.nodes_m, times[holding])
            positions[np.ix_(holding, grasp.nodes, grasp.axis_indices)] = moved_m[
                ..., grasp.axis_indices
            ]
        return is_prescribed, positions

    def is_prescribed(self, t_s: ArrayLike) -> NDArray[np.bool_]:
        """Return whether a grasp prescribes each nodal coordinate at the times `t_s` (T,), as (T,
        n, 3) bool; the nodes include those of the obstacles' frames.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        is_prescribed = np.zeros((len(times), *self.body.nodes_m.shape), dtype=bool)
        for grasp in self.grasps:
            holding = np.flatnonzero(grasp.is_active(times))
            is_prescribed[np.ix_(holding, grasp.nodes, grasp.axis_indices)] = True
        return is_prescribed

    def moving_node_mass_kg(self, t_s: ArrayLike) -> Array:
        """Return the mass that moves with each node at the times `t_s` (T,), as (T, n) [kg].

        It is the sum of the body's mass at its stated densities and of the point masses; added mass
        of the air is not included.
        """
        return self.body.node_mass + self.point_mass_at_nodes_kg(t_s)

    def point_mass_at_nodes_kg(self, t_s: ArrayLike) -> Array:
        """Return the mass of all point masses at each node at times `t_s` (T,), as (T, n) [kg],
        with the share that acts then, see `share`.
        """
        n = len(self.body.nodes_m)
        times = np.atleast_1d(t_s)
        mass = np.broadcast_to(0.0, (len(times), n))
        for point in self.masses:
            mass = mass + np.outer(self.share(point, times), point.node_mass_kg(n))
        return mass

    def share(self, load: PointMass | Force, t_s: ArrayLike) -> Array:
        """Return the share of a load that acts at the times `t_s` (T,), from 0 to 1.

        In a motion the share rises, or falls, from one sample before to one sample after `from_s`
        or `until_s`, see `loads.smooth_ramp`; a load that joins at or before the first sample acts
        fully from the start. In a static experiment the share jumps at these times.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        first_share, last_share = (
            self._share_since(load, change, times=times) for change in get_args(LoadTime)
        )
        return first_share - last_share

    def _share_since(self, load: PointMass | Force, change: LoadTime, times: Array) -> Array:
        """Return the share (T,) of a load whose "from_s" or "until_s" has passed, see `share`."""
        # In a motion it is 0 or 1 throughout unless that time is strictly within the recording.
        at_s = getattr(load, change)
        if self.is_static:
            return (times >= at_s - TIME_TOLERANCE_S).astype(np.float64)
        if self.changes_within(load, change):
            return smooth_ramp((times - at_s) / self.timestep_s)
        return np.full(len(times), float(at_s <= self.t_s[0]))

    def changes_within(self, load: PointMass | Force, change: LoadTime) -> bool:
        """Return whether the time `change` ("from_s" or "until_s") of a load is after the first and
        before the last sample of a motion; false if the experiment is static.
        """
        within = self.t_s[0] < getattr(load, change) < self.t_s[-1]
        return bool(within) and not self.is_static

    def declared_node_forces_n(self, t_s: ArrayLike) -> Array:
        """Return the stated forces on each node, without gravity and actuators, at times `t_s`
        (T,), as (T, n, 3) [N], with the share that acts then, see `share`.
        """
        n = len(self.body.nodes_m)
        times = np.atleast_1d(t_s)
        total = np.broadcast_to(np.zeros(3), (len(times), n, 3))
        for force in self.forces:
            total = total + self.share(force, times)[:, None, None] * force.node_forces_n(times, n)
        return total

    @property
    def instrumented_grasps(self) -> tuple[int, ...]:
        """Indices in `grasps`, counted from 0, of the grasps and obstacles whose force
        or torque is measured by a wrench or a custom sensor.
        """
        grasps_of_gauges = {gauge.grasp - 1 for gauge in self.readings if gauge.grasp is not None}
        sensed = (
            k for k, g in enumerate(self.grasps) if g.wrench is not None or k in grasps_of_gauges
        )
        return tuple(sensed)

    def has_known_force(self) -> bool:
        """Return whether a stated or measured force sets the scale of all forces.

        True if a force is measured at a grasp or obstacle, the amplitude of an actuator differs
        from zero at a sample, or a point mass or stated force acts on a free dof at a sample. The
        weight of the body itself does not count.
        """
        if self.instrumented_grasps:
            return True
        if any(actuator.energy_amplitude_at(self.t_s).any() for actuator in self.actuators):
            return True
        tied = np.repeat(self.point_mass_at_nodes_kg(self.t_s), 3, axis=1)
        forces = self.declared_node_forces_n(self.t_s).reshape(tied.shape)
        return bool((tied != 0)[:, self.free_dofs].any() or forces[:, self.free_dofs].any())

    def temperature_difference_at(self, t_s: Array) -> Array:
        """Return the temperature (T,) at times (T,), less that of the constants of the body [K]."""
        assert self.temperature_difference_k is not None
        return np.interp(t_s, *self.temperature_difference_k.T)

    @property
    def stiffness_deviations(self) -> list[Deviation]:
        """Deviations that change the stiffness in this experiment: those that are known,
        or estimated.
        """
        return [
            row
            for row in self.nuisance.kinds
            if row.stiffness is not None
            and row.applies(self)
            and (self.nuisance.sigma(row) or row.name in self.known_deviations)
        ]

    def known_stiffness_change(self, t_s: Array) -> Array:
        """Return the relative change (T,) of the stiffness by known deviations at times (T,)."""
        change = np.zeros(len(t_s))
        for row in self.stiffness_deviations:
            assert row.stiffness is not None
            change += self.known_deviations.get(row.name, 0.0) * row.stiffness(self, t_s)
        return change

    @property
    def has_air_drag(self) -> bool:
        """Whether air drag acts: false in a vacuum and in static experiments."""
        return self.air_density_kg_m3 > 0 and not self.is_static

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Tendons of the experiment, then its pressures."""
        return (*self.tendons, *self.pressures)

    def build_coupled_graph(self) -> JointPattern:
        """Return the mesh graph of the body with the couplings of its actuators, obstacles and,
        where it acts, air drag; computed anew at each access.
        """
        couplings = [each.require_measure().couplings for each in self.actuators]
        couplings += [each.couplings_with(self.body) for each in self.obstacles]
        if self.has_air_drag:
            couplings.append(self.body.unit_air_drag.points.couplings)
        couplings += [self.body.pattern] * bool(self.stiffness_deviations)
        return self.body.joint_pattern_with(couplings)

    @property
    def sparsity(self) -> SymmetricPattern:
        """Sparsity pattern of the derivatives of the forces on the body, which is that of
        `build_coupled_graph`.
        """
        return self.build_coupled_graph().pattern

    def rigid_positions(self, t_s: ArrayLike) -> Array:
        """Return the node positions (T, n, 3) [m] at times `t_s` (T,) if a grasp carried the
        undeformed body rigidly.

        The first grasp that holds all axes at every sample is used; without one, the first that
        holds some axes at every sample, else the first. Without a grasp the body stays in its
        undeformed place. The frames of obstacles follow their own poses.

        Raises
        ------
        InputError
            If poses do not cover a time, see `PoseSequence.at`; those of a grasp that is not active
            at every sample are repeated beyond their ends instead.
        """
        rotations, translations = self.rigid_motion(t_s)
        places = np.einsum("tij,kj->tki", rotations, self.body.nodes_m) + translations[:, None]
        for obstacle in self.obstacles:
            places[:, obstacle.nodes] = obstacle.positions_at(self.body.nodes_m, np.atleast_1d(t_s))
        return places

    @property
    def upward_direction(self) -> Array:
        """Unit vector (3,) against gravity; the z axis if there is no gravity."""
        pull = np.linalg.norm(self.gravity_m_s2)
        return -self.gravity_m_s2 / pull if pull > 0 else np.array([0.0, 0.0, 1.0])

    def rigid_motion(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """Return rotations R (T, 3, 3) and translations p (T, 3) [m] of `rigid_positions`, x = R X
        + p, with the same choice of the grasp and the same errors; identities without a grasp.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if not self.body_grasps:
            return np.tile(np.eye(3), (len(times), 1, 1)), np.zeros((len(times), 3))
        throughout = [grasp for grasp in self.body_grasps if grasp.is_active(self.t_s).all()]
        throughout.sort(key=lambda grasp: grasp.axes != "xyz")
        poses = (throughout or self.body_grasps)[0].poses
        if len(poses.t_s) > 1 and not throughout:
            times = np.clip(times, poses.t_s[0], poses.t_s[-1])
        return poses.at(times)

    def _undeformed_places(self, points_m: Array, t_s: Array) -> Array:
        """Places (M, 3) of points measured at `t_s` (M,) on a rigidly moved body [m]."""
        rotations, translations = self.rigid_motion(t_s)
        return np.einsum("mji,mj->mi", rotations, points_m - translations)

    @property
    def place_sigma_m(self) -> Array:
        """Prior standard deviation (M,) of each marker's place [m].

        It is that of the marker where `markers.places_sigma_m` has a finite one, and else the
        `marker_offset_m` of the nuisance parameters; zero where the place is exact. Where no place
        is given it is the diagonal of the bounding box of the body's nodes.
        """
        markers = self.markers
        usual = self.nuisance.marker_offset_m or 0.0
        sigma_m = np.full(len(markers.names), usual)
        if markers.places_sigma_m is not None:
            own = markers.places_sigma_m
            sigma_m = np.where(np.isfinite(own), own, usual)
        body_m = float(np.linalg.norm(np.ptp(self.body.nodes_m, axis=0)))
        return np.where(markers.located, sigma_m, body_m)

    def _check_kind(self) -> None:
        """Refuse another `start` or `start_rule` than the default in a static experiment."""
        if not self.is_static:
            return
        for name, usual in (("start", "equilibrium"), ("start_rule", "standard")):
            if getattr(self, name) != usual:
                raise InputError(
                    f"{name} is {getattr(self, name)!r}, but the experiment is static: each sample "
                    f"is an equilibrium, and nothing moves; expected no {name}"
                )

    def _check_air(self) -> None:
        """Refuse air that is not lighter than each region at its stated density."""
        lightest = min(self.body.parts, key=lambda part: part.density_kg_m3)
        if self.air_density_kg_m3 < lightest.density_kg_m3:
            return
        whose = f"region {lightest.name!r}" if lightest.name else "the body"
        raise InputError(
            f"the air has a density of {self.air_density_kg_m3:g} kg/m³, and {whose} of "
            f"{lightest.density_kg_m3:.4g} kg/m³; expected air that is lighter, 1.2 kg/m³ in a "
            "laboratory: check air_density_kg_m3, and mass or density of the body",
            where="air_density_kg_m3",
        )

    def _check_stiffness_deviations(self) -> None:
        """Refuse known deviations without effect here, and custom ones of a body with memory."""
        for row in self.nuisance.own:
            if row.stiffness is not None and self.body.has_memory:
                raise InputError(
                    f"the deviation {row.name!r} changes the stiffness, and the body has memory; "
                    "expected a body without memory"
                )
        listed_names = [row.name for row in self.stiffness_deviations]
        for name in self.known_deviations:
            if name not in listed_names:
                raise InputError(
                    f"found a value of {name!r}, which does not change the stiffness here; expected "
                    "stiffness_per_kelvin of a body without memory, beside temperature_difference_k, "
                    "or a deviation of your own with a function stiffness",
                    where="known_deviations",
                )

    def _check_time(self) -> None:
        fewest = 1 if self.is_static else 3
        if len(self.t_s) < fewest:
            raise InputError(
                f"found {len(self.t_s)} sample times; expected at least {fewest}: check window_s and "
                "the marker file"
            )
        if not self.is_static:
            step_s = sample_interval_s(self.t_s, f"t_s of experiment '{self.name}'")
        elif fault := first_unordered_time(self.t_s):
            raise InputError(f"t_s: {fault[1]}", where=f"row {fault[0] + 1}")
        else:
            step_s = float(np.diff(self.t_s).min(initial=self.timestep_s))
        measured = self.markers.t_s
        if len(measured) != len(self.t_s) or (
            np.abs(measured - self.t_s).max() > STEP_TOLERANCE * step_s
        ):
            raise InputError(
                "the sample times of the markers differ from t_s of the experiment; expected the same "
                "times: cs.align brings poses and markers to common times"
            )
        if self.markers.sample_count == 0:
            self._require_measurements()
        self._check_grasp_times()
        self._check_separate_sensors()

    def _check_grasp_times(self) -> None:
        """Refuse poses that do not cover their samples, and wrenches with too few."""
        for grasp in self.grasps:
            grasp.poses.at(self.t_s[grasp.is_active(self.t_s)])
            if grasp.wrench is not None:
                is_within_experiment(
                    grasp.wrench.t_s,
                    self.t_s,
                    name="the wrench of a grasp",
                    is_static=self.is_static,
                )

    def _check_separate_sensors(self) -> None:
        named = Counter((each.description_name, each.name) for each in self.separate_sensors)
        for sensor in self.separate_sensors:
            kind, name = sensor.description_name, sensor.name
            what = f"the {kind} '{name}'"
            if named[kind, name] > 1:
                raise InputError(f"two {kind}s are called {name!r}; expected different names")
            at_s = sensor.sample_times_s
            is_within_experiment(at_s, self.t_s, name=what, is_static=self.is_static)
            if isinstance(sensor, CustomSensor):
                if sensor.grasp is not None and not 1 <= sensor.grasp <= len(self.grasps):
                    raise InputError(
                        f"{what} refers to grasp {sensor.grasp}; expected the number of a grasp, 1 "
                        f"to {len(self.grasps)}"
                    )
            elif self.is_static:
                distance_s = np.abs(at_s[:, None] - self.t_s).min(axis=1)
                if distance_s.max() > TIME_TOLERANCE_S:
                    raise InputError(
                        f"{what} has an image at {at_s[distance_s.argmax()]:g} s, but the static "
                        "experiment has no sample then; expected times of its samples"
                    )

    def _require_measurements(self) -> None:
        if self.separate_sensors or self.instrumented_grasps:
            return
        if not self.markers.names:
            message = (
                "nothing is measured: there are no markers, no measured wrench, no reading of a "
                "sensor and no depth camera"
            )
            raise InputError(f"{message}; expected at least one of them")
        raise InputError("there is no marker sample; check the marker file and window_s")

    def require_measured_values(self) -> None:
        """Raise an `InputError` if a custom sensor has no measured values, as before a simulation."""
        for gauge in self.readings:
            if gauge.values is None:
                raise InputError(
                    f"the reading '{gauge.name}' of experiment '{self.name}' has no values; "
                    "expected measured ones, or simulated ones: with_readings(experiment, values)"
                )

    def _check_nodes(self) -> None:
        """Refuse nodes that the body does not have, and dofs held twice at a time."""
        n = len(self.body.nodes_m)
        grasped = prescribed_dofs(self.grasps)
        if grasped.size and grasped[-1] >= 3 * n:
            raise InputError(
                f"a grasp holds node {grasped[-1] // 3}; expected node indices from 0 to {n - 1}: the "
                f"body has {n} nodes"
            )
        for what, loads in (
            ("point mass is attached to", self.masses),
            ("force acts on", self.forces),
        ):
            beyond = [load.nodes[-1] for load in loads if load.nodes[-1] >= n]
            if beyond:
                raise InputError(
                    f"a {what} node {beyond[0]}; expected node indices from 0 to {n - 1}: the body has {n} "
                    "nodes"
                )
        placed = self.markers.placement.node_count
        own = len(self.body.nodes.points_m)
        if placed not in (own, n):
            raise InputError(
                f"the markers were associated with a body of {placed} nodes, but this body has "
                f"{own}; expected an association with this body"
            )

    def _check_order_of_grasps(self) -> None:
        """Refuse platens that pass each other in an equilibrium; slender ends may do so, and the
        stretches of a homogeneous specimen are positive.
        """
        if not self.is_static or self.specimen is not None:
            return
        nodes_m = self.body.nodes_m
        grasps = self.body_grasps
        for (i, first), (k, second) in combinations(enumerate(grasps, 1), 2):
            for axis in set(first.axis_indices.tolist()) & set(second.axis_indices.tolist()):
                least = min(
                    float(np.ptp(np.delete(nodes_m[g.nodes], axis, axis=1), axis=0).min())
                    for g in (first, second)
                )
                a, b = (g.positions_at(nodes_m, self.t_s)[..., axis] for g in (first, second))
                side = np.sign(
                    nodes_m[first.nodes, axis].mean() - nodes_m[second.nodes, axis].mean()
                )
                low, high = (a, b) if side < 0 else (b, a)
                own, other = (first, second) if side < 0 else (second, first)
                apart_m = nodes_m[other.nodes, axis].min() - nodes_m[own.nodes, axis].max()
                passed = np.flatnonzero(high.max(axis=1) <= low.min(axis=1))
                if not 0 < apart_m < 4 * least or not passed.size:
                    continue
                nearer_m = apart_m - (high[passed[0]].min() - low[passed[0]].max())
                raise InputError(
                    f"{self.description}: at {self.t_s[passed[0]]:.4g} s grasps {i} and {k} are "
                    f"{1e3 * nearer_m:.4g} mm nearer along {'xyz'[axis]} than in the undeformed body, "
                    f"where {1e3 * apart_m:.4g} mm are between them; expected less: check the unit, the "
                    "sign and the scale of the displacement"
                )

    def _require_no_surface(self) -> None:
        found = {"obstacle": self.obstacles, "tendon": self.tendons, "pressure": self.pressures}
        surfaces = [each for each in self.separate_sensors if each.needs_surface]
        require_no_surface([*filter(found.get, found), *(each.title for each in surfaces)])

    def _check_obstacles(self) -> None:
        names = [obstacle.name for obstacle in self.obstacles]
        if twice := [name for k, name in enumerate(names) if name in names[:k]]:
            raise InputError(f"two obstacles are called {twice[0]!r}; expected different names")
        if self.start == "given" or not names:
            return
        first_s = self.t_s[:1]
        (turn,), (shift_m,) = self.rigid_motion(first_s)
        points_m = self.body.nodes.points_m @ turn.T + shift_m
        for obstacle in self.obstacles:
            if not obstacle.is_active(first_s)[0]:
                continue
            (turn,), (shift_m,) = obstacle.poses.at(first_s)
            gaps_m = obstacle.shape.signed_distances_m((points_m - shift_m) @ turn)
            if gaps_m.max() < -FLATNESS * gaps_m.min():
                raise InputError(
                    f"the undeformed body lies inside {obstacle.name!r}, by up to "
                    f"{-1e3 * gaps_m.min():.3g} mm; expected it outside: the normal of a plane points out "
                    "of the solid, towards the body; check unit and place of the solid, too"
                )

    def _check_actuators(self) -> None:
        """Check names and times of the actuators, and fix the rims of the pressures, in place."""
        names = [actuator.name for actuator in self.actuators]
        if twice := [name for k, name in enumerate(names) if name in names[:k]]:
            raise InputError(
                f"two tendons or pressures are called {twice[0]!r}; expected different names"
            )
        for actuator in self.actuators:
            actuator.declared_values.require_covered(self.t_s, actuator.name)
        if not self.pressures:
            return
        is_prescribed, places_m = self.prescribed_displacements(self.t_s)
        throughout = np.asarray(is_prescribed.all(axis=0))
        bounded = tuple(
            pressure.with_fixed_rim(throughout, places_m) for pressure in self.pressures
        )
        vars(self)["pressures"] = bounded

    def _check_start(self) -> None:
        """Complete a given start in place: zero velocities, and the frames of the obstacles."""
        if np.isfinite(self.loaded_since_s) and not self.is_balanced_at_start:
            raise InputError(
                f"loaded_since_s is given, but start is '{self.start}'; loaded_since_s is the "
                "time for which a body that starts in equilibrium has been loaded"
            )
        has_initial_state = (
            self.start_positions_m is not None or self.start_velocities_m_s is not None
        )
        if self.start == "given":
            if self.start_positions_m is None:
                raise InputError("start = 'given' needs start_positions_m")
            if self.start_velocities_m_s is None:
                vars(self)["start_velocities_m_s"] = np.zeros_like(self.start_positions_m)
            self._append_obstacle_frames(len(self.start_positions_m))
            for name in ("start_positions_m", "start_velocities_m_s"):
                read_only_floats(getattr(self, name), self.body.nodes_m.shape, name=name)
        elif has_initial_state:
            raise InputError(
                f"start_positions_m or start_velocities_m_s is given, but start is '{self.start}'; "
                "expected start = 'given', or neither of them"
            )
        for name in ("start_velocity_m_s", "start_spin_rad_s"):
            if self.start != "undeformed" and getattr(self, name) is not None:
                raise InputError(
                    f"{name} is given, but start is '{self.start}'; expected start = 'undeformed', "
                    f"or no {name}",
                    where=name,
                )
        if self.is_balanced_at_start:
            self._require_unique_equilibrium()
        if self.start == "moving" and not self.body_grasps:
            raise InputError(
                "start = 'moving' needs a grasp; expected another start", where="start"
            )

    @property
    def is_balanced_at_start(self) -> bool:
        """Whether the forces at the first time are in equilibrium, also those that hold a body which
        moves then.
        """
        return self.start in ("equilibrium", "moving")

    @property
    def initial_velocities_m_s(self) -> Array | None:
        """Velocities (n, 3) at the first time [m/s]: given ones, or those of a rigid motion with
        `start_velocity_m_s` and `start_spin_rad_s`; None for a body at rest. Frames of obstacles
        follow their own poses.
        """
        if self.start_velocity_m_s is None and self.start_spin_rad_s is None:
            return self.start_velocities_m_s
        x_m = self.rigid_positions(self.t_s[:1])[0]
        mass_kg = self.moving_node_mass_kg(self.t_s[:1])[0]
        arms_m = x_m - mass_kg @ x_m / mass_kg.sum()
        spin = np.zeros(3) if self.start_spin_rad_s is None else self.start_spin_rad_s
        velocities: Array = np.asarray(np.cross(spin, arms_m), dtype=np.float64)
        velocities += 0.0 if self.start_velocity_m_s is None else self.start_velocity_m_s
        frames = self.body.frames.ravel()
        velocities[frames] = self._frame_motion()[1]
        return velocities

    def _append_obstacle_frames(self, node_count: int) -> None:
        if node_count == len(self.body.nodes_m):
            return
        state = ("start_positions_m", "start_velocities_m_s")
        for name, own in zip(state, self._frame_motion(), strict=True):
            vars(self)[name] = np.vstack([getattr(self, name), own])

    def _frame_motion(self) -> tuple[Array, Array]:
        """Positions and velocities of the obstacles' frames, over a thousandth of a step."""
        at_s = self.t_s[0] + np.array([0.0, 1e-3 * self.timestep_s])
        places = self.rigid_positions(at_s)[:, self.body.frames.ravel()]
        return places[0], np.diff(places, axis=0)[0] / np.diff(at_s)

    def _require_unique_equilibrium(self) -> None:
        """Refuse grasps that leave a rigid motion, unless obstacles may hold it."""
        if self.obstacles:
            return  # these may carry it: the rest state is looked for
        is_prescribed = self.is_prescribed(self.t_s[:1])[0]
        motions = free_rigid_motions(self.body.nodes_m, is_prescribed)
        if motions:
            raise InputError(
                "start = 'equilibrium' needs grasps that leave the body no rigid motion, but it "
                f"can {' and '.join(motions)}, so that its rest state is not unique; "
                f"{int(is_prescribed.any(axis=1).sum())} nodes are held at the start. Grasp at "
                "least 3 nodes that are not on one line, hold more axes, or use start = "
                "'undeformed'"
            )
