"""Tables of measured displacements of the nodes of a grasp, as of image or volume correlation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from .poses import FaceDeformation, PoseSequence
from .rigid_fit import fit_poses
from .sources.source import read_table
from .sources.text import names_file_in_errors, numeric_cells

PLACE = ("x_m", "y_m", "z_m")


@names_file_in_errors
def read_face(path: str | Path, nodes_m: Array, axes: str = "xyz") -> PoseSequence:
    """Read displacements of places on the undeformed body over time: t_s, x_m, y_m, z_m or node,
    ux_m, uy_m, uz_m, with one row for each place at each time, in any order.

    Parameters
    ----------
    nodes_m : (n, 3) array
        Nodes of the undeformed body.
    axes : str
        Axes whose displacements the table must have; others that are missing are zero.

    Returns
    -------
    PoseSequence
        Rigid motion that fits the displacements best, and the rest as its `deformation`.

    Raises
    ------
    InputError
        If a column or row is missing or repeated, a cell is not a number, or the places lie on one
        line.
    """
    grid = read_table(path)
    place = ("node",) if "node" in grid.columns else PLACE
    moved = [axis for axis in "xyz" if axis in axes or f"u{axis}_m" in grid.columns]
    names = ["t_s", *place, *(f"u{axis}_m" for axis in moved)]
    if any(grid.columns.count(name) != 1 for name in names):
        raise grid.error_at(
            f"found the columns {', '.join(grid.columns)}; expected each of {', '.join(names)} once"
        )
    columns = [grid.columns.index(name) for name in names]
    values = numeric_cells(grid, columns, blank_allowed=False)
    places_m = values[:, 1:4]
    if len(place) == 1:
        for row in (~np.isin(values[:, 1], np.arange(len(nodes_m)))).nonzero()[0]:
            raise grid.error_at(
                f"node is {values[row, 1]:g}; expected an index from 0 to {len(nodes_m) - 1}",
                int(row),
            )
        places_m = nodes_m[values[:, 1].astype(int)]
    moved_m = np.zeros((len(values), 3))
    moved_m[:, ["xyz".index(axis) for axis in moved]] = values[:, 1 + len(place) :]
    rows, order = np.unique(np.column_stack([values[:, 0], places_m]), axis=0, return_index=True)
    t_s = np.unique(values[:, 0])
    shape = (len(t_s), len(rows) // len(t_s), -1)
    own_m = rows[: shape[1], 1:]
    if len(order) < len(values) or not np.array_equal(rows[:, 1:], np.tile(own_m, (len(t_s), 1))):
        raise grid.error_at(
            f"found {len(values)} rows of {len(np.unique(places_m, axis=0))} places at {len(t_s)} "
            "times; expected each place once at each time: leave out places that were lost"
        )
    positions_m = own_m + moved_m[order].reshape(shape)
    fit = fit_poses(own_m, positions_m)
    rigid = PoseSequence(t_s, fit.positions_m, quaternions_xyzw=fit.quaternions_xyzw)
    rest_m = positions_m - rigid.moved_positions(own_m, t_s)
    return PoseSequence(
        t_s,
        fit.positions_m,
        quaternions_xyzw=fit.quaternions_xyzw,
        deformation=FaceDeformation(t_s, own_m, rest_m),
    )


def face_note(poses: PoseSequence) -> str:
    """Return the largest rigid displacement and rotation of a measured face, and the rest of its
    motion, as text.
    """
    face = poses.deformation
    assert face is not None
    rotations, shifts_m = poses.at(face.t_s)
    middle_m = face.places_m.mean(axis=0)
    moved_m = np.linalg.norm(rotations @ middle_m + shifts_m - middle_m, axis=1).max()
    turned = np.degrees(Rotation.from_matrix(rotations).magnitude().max())
    rest_m = np.sqrt((face.displacements_m**2).sum(axis=2).mean(axis=1)).max()
    return (
        f"{len(face.places_m)} places move rigidly by up to {1e3 * moved_m:.3g} mm and {turned:.2g}°; "
        f"the rest of their motion is up to {1e3 * rest_m:.3g} mm RMS"
    )


def face_columns(poses: PoseSequence) -> dict[str, Array]:
    """Return the columns of the table of a measured face, as `read_face` reads them."""
    face = poses.deformation
    assert face is not None
    moved_m = poses.moved_positions(face.places_m, face.t_s) - face.places_m
    columns = {"t_s": np.repeat(face.t_s, len(face.places_m))}
    for k, name in enumerate(PLACE):
        columns[name] = np.tile(face.places_m[:, k], len(face.t_s))
    return columns | {f"u{axis}_m": moved_m[..., k].ravel() for k, axis in enumerate("xyz")}
