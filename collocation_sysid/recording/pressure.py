"""Pressures: energies −p(t) V(x) of a pressure p and the volume V behind faces of a body."""

from __future__ import annotations

from dataclasses import KW_ONLY, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.array_types import Array, Index
from ..common.checked_arrays import as_array
from ..common.declarations import Key, declaration, key
from ..common.validated_types import Finite, NotNegative, Text
from ..errors import InputError
from ..fem.meshes.refinement import split_faces_in_four
from ..fem.meshes.selection import Indices, Selection, rows_of_faces
from ..fem.shape import EnclosedVolume
from .actuator import Actuator, BodyMeasure
from .loads import TimeSeries
from .node_selection import Nodes, selection_from_section
from .time_tables import read_pressure

if TYPE_CHECKING:
    from ..fem.body import Body

# Largest distance of points of a plane from it, relative to the size of the body: rounding.
PLANE_TOLERANCE = 1e-9


def _checked_faces(faces: Selection | ArrayLike) -> Selection | Index:
    if isinstance(faces, Selection):
        return faces
    faces = np.array(as_array(faces, "faces of a pressure"))
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise InputError(
            f"faces of a pressure are {faces.dtype} {faces.shape}; expected a selection or a "
            "(F, 3) array of node indices from 0"
        )
    return faces.astype(np.int64)


_TABLE = Key(
    "pressure",
    Text | None,
    read=read_pressure,
    constant="pressure_pa",
    description="CSV with the columns t_s and pressure_pa, which covers the complete recording.",
)


@declaration
class Pressure(Actuator[EnclosedVolume]):
    """A pressure, relative to the surroundings, on faces of the boundary such as the wall of a
    cavity.

    Its force follows the faces as they move. It derives from an energy, and has a symmetric
    stiffness, if the faces are closed, as a cavity's wall is, or if their rim is held.

    Parameters
    ----------
    faces : Selection or (F, 3) array
        Faces whose corners are all in box_m, ball_m or indices; or the name of a physical group or
        cell array of triangles, or of a point array.
    pressure_pa : float or (m,) array
        Constant pressure; negative for suction.
    t_s : (m,) array, optional
        Times of the rows of `pressure_pa`, between which it is linear; they cover the whole
        recording.
    name : str
        Name; pressure_1, pressure_2 and so on by default.
    lag_s : float
        Time constant τ of the pressure p in the chamber behind valve and tube,
        τ dp/dt = stated pressure − p, beginning at the first stated pressure; zero for no lag.
    factor, loss_pa : float
        Pressure in the body: factor · stated pressure − loss_pa.
    """

    faces: Selection | Index = key(Nodes, converter=_checked_faces, read=selection_from_section)
    pressure_pa: Array = key(Finite | None, converter=as_array)
    t_s: Array | None = key(_TABLE, converter=as_array, default=None)
    name: str = key(Text | None, default="pressure")
    _: KW_ONLY
    lag_s: float = key(NotNegative, default=0.0)
    factor: float = 1.0
    loss_pa: float = 0.0
    body_measure: BodyMeasure[EnclosedVolume] | None = None

    unit: ClassVar[str] = "Pa"
    offset_field: ClassVar[str] = "loss_pa"

    def __post_init__(self) -> None:
        pressure = TimeSeries(self.pressure_pa, self.t_s, what=f"pressure_pa of {self.name}")
        vars(self).update(pressure_pa=pressure.values, t_s=pressure.t_s, declared_values=pressure)
        if self.lag_s and self.t_s is None:
            raise InputError(
                f"{self.name} is constant and has a lag_s of {self.lag_s:g} s; expected a table of "
                "pressures, which a lag delays, or no lag_s"
            )

    def _measure_on(self, body: Body) -> EnclosedVolume:
        """Return the volume on the pressure's side of faces, which may be an open patch."""
        mesh = body.mesh
        if isinstance(self.faces, Selection):
            rows = self.faces.resolve_faces(mesh)
        else:
            rows = np.unique(rows_of_faces(self.faces, mesh.surface))
            if rows[0] < 0:
                raise InputError(
                    f"{self.name}: not all faces are on the boundary of the body; expected faces "
                    "that have the material on one side only"
                )
        # Seen from the cavity, the outside of the material is the inside.
        wall = body.nodes.nodes_of_faces(mesh.surface[rows][:, ::-1])
        volume = EnclosedVolume(wall, len(body.nodes_m))
        if not volume.rim.size and volume.evaluate(body.nodes_m.reshape(1, -1))[0] <= 0:
            raise InputError(
                f"{self.name}: the faces are the outer surface of the body; expected the wall of "
                "a cavity in it, or an open patch whose rim is held"
            )
        return volume

    def on_refined_body(self, body: Body, finer: Body) -> Pressure:
        """Return the pressure on the body `finer`, whose mesh is that of `body` with every element
        split in eight; without `body_measure`, which an experiment sets.

        A selection by position or name stays as it is. Faces given as node indices, (F, 3) or as
        `Indices`, become the four triangles of each, (4F, 3) node indices of `finer`.

        Raises
        ------
        InputError
            If such faces do not fit `body`, see `_measure_on`.
        """
        if isinstance(self.faces, Selection) and not isinstance(self.faces, Indices):
            return replace(self, body_measure=None)
        corners = self.on_body(body).require_measure().faces[:, :3]
        return replace(self, faces=split_faces_in_four(corners, body.mesh), body_measure=None)

    def energy_amplitude(self, declared_value: Any, factor: Any, offset: Any) -> Any:
        """Return the amplitude of the energy, minus the pressure in the body: `offset` − `factor` ·
        `declared_value` [Pa].
        """
        return offset - factor * declared_value

    def with_calibration(self, factor: float, offset: float, log_lag_ratio: float) -> Self:
        """Return the pressure with another factor and offset [Pa], and its own lag times
        exp(`log_lag_ratio`).
        """
        lag_s = self.lag_s * float(np.exp(log_lag_ratio))
        return replace(self, factor=factor, loss_pa=offset, lag_s=lag_s)

    def input_data(self, t_s: Array) -> Array:
        """Return the times (1, T) [s] if the pressure lags, else the stated pressures (1, T) [Pa]
        at the times `t_s` (T,).
        """
        return t_s[None] if self.lag_s else super().input_data(t_s)

    def calibrated_amplitude(
        self, data: ca.SX, factor: Any, offset: Any, log_lag_ratio: Any
    ) -> ca.SX:
        if not self.lag_s:
            return self.energy_amplitude(data, factor, offset=offset)
        pressure_pa = self._lagging_pressure(data, self.lag_s * ca.exp(log_lag_ratio))
        return self.energy_amplitude(pressure_pa, factor, offset=offset)

    def energy_amplitude_at(self, t_s: Array) -> Array:
        if not self.lag_s:
            return super().energy_amplitude_at(t_s)
        pressure_pa = self._lagging_pressure(ca.DM(t_s), ca.DM(self.lag_s)).full().ravel()
        return self.energy_amplitude(pressure_pa, self.factor, offset=self.loss_pa)

    def _lagging_pressure(self, t_s: Any, lag_s: Any) -> Any:
        """Return the solution p [Pa] of τ dp/dt = stated pressure − p for τ = `lag_s`."""
        # The stated pressure is a sum of ramps, one for each change of its slope; the response to a
        # ramp that begins at zero is t − τ (1 − exp(−t/τ)).
        assert self.t_s is not None
        slopes = np.diff(self.pressure_pa) / np.diff(self.t_s)
        changes = np.diff(slopes, prepend=0.0, append=0.0)
        pressure_pa = ca.DM(self.pressure_pa[0])
        for begin_s, change in zip(self.t_s, changes, strict=True):
            if change:
                since_s = ca.fmax(t_s - begin_s, 0.0)
                response = since_s - lag_s * (1 - ca.exp(-since_s / lag_s))
                pressure_pa = pressure_pa + change * response
        return pressure_pa

    def with_fixed_rim(self, is_prescribed: NDArray[np.bool_], prescribed_m: Array) -> Pressure:
        """Return the pressure with a volume that does not depend on the motion of a held rim; self
        if the faces are closed.

        The volume of an open patch is that of the cones over its faces from an apex. The pressure
        does the work p dV if the rim is held, or slides in planes, such as planes of symmetry, that
        contain the apex.

        Parameters
        ----------
        is_prescribed : (n, 3) bool
            Whether each coordinate is prescribed throughout.
        prescribed_m : (T, n, 3)
            Prescribed coordinates, NaN elsewhere.

        Raises
        ------
        InputError
            If the rim moves otherwise, or the pressure is on no body yet.
        """
        placed = self.body_measure
        volume = self.require_measure()
        if placed is None or not volume.rim.size:
            return self
        moving_rim = volume.rim[~is_prescribed[volume.rim].all(axis=(1, 2))]
        is_sliding = np.asarray(np.logical_and.reduce(is_prescribed[moving_rim], axis=1))  # (k, 3)
        free = int((~is_sliding.any(axis=1)).sum())
        apex = np.zeros(3)
        size_m = np.nanmax(np.abs(prescribed_m), initial=0.0)
        for axis in range(3):
            plane = prescribed_m[:, moving_rim[is_sliding[:, axis]], axis]
            if plane.size and np.ptp(plane) > PLANE_TOLERANCE * size_m:
                free += plane.shape[1]
            elif plane.size:
                apex[axis] = plane.mean()
        if free:
            raise InputError(
                f"{self.name}: the faces are not closed, and {free} of the {len(volume.rim)} "
                "edges of their rim move; expected the complete wall of a cavity, or a rim that "
                "is held or slides in a plane perpendicular to an axis: the pressure on other "
                "patches has no potential energy"
            )
        return replace(self, body_measure=BodyMeasure(placed.body, volume.with_apex(apex)))
