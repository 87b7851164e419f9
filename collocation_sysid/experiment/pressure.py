"""A pressure: the energy −p(t) V(x) of a pressure p and the volume V that faces enclose."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Array, Index
from ..errors import InputError
from ..fem.selection import Selection
from ..fem.volume import Volume
from .course import Course

if TYPE_CHECKING:
    from ..fem.body import Body


@dataclass(frozen=True, eq=False)
class Pressure:
    """A pressure on faces of a body's boundary, above that on the rest of it.

    Its force follows the faces as they move. It has an energy, and a symmetric stiffness, where
    the faces are closed, as a cavity's wall is, or where their rim is held.

    Parameters
    ----------
    faces : Selection or (F, 3) array
        Triangles of the boundary, in any orientation. A selection takes those in a face set of the
        mesh, or those whose corners it holds.
    pressure_pa : float or (m,) array
        Constant, or linear between the rows of a table; negative where it sucks.
    t_s : (m,) array, optional
        Times of the rows, which must reach over the recording.
    name : str
    factor, offset_pa : float
        How the pressure in the body differs: factor · pressure + offset.

    Attributes
    ----------
    measure : Volume or None
        Of what is enclosed, once it is on a body.
    """

    faces: Selection | Index
    pressure_pa: Array
    t_s: Array | None
    name: str
    factor: float
    offset_pa: float
    measure: Volume | None
    course: Course = field(init=False, repr=False)

    def __init__(
        self,
        faces: Selection | ArrayLike,
        pressure_pa: ArrayLike,
        t_s: ArrayLike | None = None,
        name: str = "pressure",
        *,
        factor: float = 1.0,
        offset_pa: float = 0.0,
        measure: Volume | None = None,
    ) -> None:
        pressure = Course(pressure_pa, t_s, f"pressure_pa of {name}")
        if not isinstance(faces, Selection):
            faces = np.array(faces)
            if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
                raise InputError(
                    f"{name}: faces are {faces.dtype} {faces.shape}; expected a selection or a "
                    "(F, 3) array of node numbers"
                )
        vars(self).update(
            faces=faces,
            pressure_pa=pressure.values,
            t_s=pressure.t_s,
            course=pressure,
            name=name,
            factor=factor,
            offset_pa=offset_pa,
            measure=measure,
        )

    def on(self, body: Body) -> Pressure:
        """The same on the faces of a body.

        Raises
        ------
        InputError
            If they are not on its boundary, or enclose the body instead of a cavity.
        """
        mesh = body.mesh
        if isinstance(self.faces, Selection):
            rows = self.faces.resolve_faces(mesh)
        else:
            rows = _rows_of(self.faces, mesh.surface, self.name)
        # Seen from the cavity, the outside of the material is the inside.
        wall = body.nodes.on_faces(mesh.surface[rows][:, ::-1])
        volume = Volume(wall, len(body.nodes_m))
        if not volume.rim.size and volume.value(body.nodes_m.reshape(1, -1))[0] <= 0:
            raise InputError(
                f"{self.name}: the faces surround the body from outside; expected the wall of a "
                "cavity in it, or an open patch whose rim is held"
            )
        return replace(self, measure=volume)

    def amplitude(self, t_s: Array) -> Array:
        """The negative of the pressure at the times `t_s` (T,) [Pa]."""
        return -(self.factor * self.course.at(t_s) + self.offset_pa)

    def slopes(self, t_s: Array) -> Array:
        """Its derivatives (T, 2) by factor and offset_pa."""
        stated = self.course.at(t_s)
        return -np.column_stack([stated, np.ones(len(stated))])

    def refuse_free_rim(self, held: NDArray[np.bool_]) -> None:
        """Refuse an open patch whose rim moves freely; `held` (n,) are nodes held throughout.

        Raises
        ------
        InputError
            Naming the pressure.
        """
        rim = self.measure.rim if self.measure else ()
        free = int((~held[rim]).sum())
        if free:
            raise InputError(
                f"{self.name}: the faces are not closed, and {free} of the {len(rim)} nodes on "
                "their rim are free; expected the whole wall of a cavity, or a rim that is held: "
                "the force on other patches has no energy"
            )


def _rows_of(faces: Index, surface: Index, name: str) -> Index:
    """Rows of the surface (F, 3) that faces (k, 3) are."""
    there = {tuple(face): row for row, face in enumerate(np.sort(surface, axis=1).tolist())}
    rows = {there.get(tuple(face), -1) for face in np.sort(faces, axis=1).tolist()}
    if -1 in rows or not rows:
        raise InputError(f"{name}: not all faces are triangles of the body's boundary")
    return np.array(sorted(rows), dtype=np.int64)
