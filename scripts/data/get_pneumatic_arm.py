"""Get the measured arm of problems/pneumatic_arm: its recordings, and its mesh.

The recordings are public data (MIT licence) of the Soft Robotics Lab, ETH Zurich: repository
srl-ethz/diffPD_sim2real on GitHub, folder python/1segment_arm, from Dubied et al. 2022,
"Sim-to-Real for Soft Robots using Differentiable FEM: Recipes for Meshing, Damping, and Actuation",
arXiv 2201.12560. Reading them needs the extra: pip install 'collocation-sysid[c3d]'. Of each
recording the motion of the tip markers from their rest is written in the frame of the mesh, and the
step of the pressure as the problem assumes it.

    python scripts get_pneumatic_arm                  # downloads
    python scripts get_pneumatic_arm --from FOLDER    # or reads a folder that has the files
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from script_arguments import fetched_files

from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.recording.marker_files import read_markers

FOLDER = Path(__file__).parents[2] / "problems" / "pneumatic_arm"
COMMIT = "5010a6983e4e4baf82e810ed16ddc4013e0106cb"
SOURCE = (
    f"https://raw.githubusercontent.com/srl-ethz/diffPD_sim2real/{COMMIT}"
    "/python/1segment_arm/Measurement_data"
)
PRESSURES_MBAR = (100, 150, 200, 300, 350, 450)
# Positions of the base markers in the frame of the mesh [m], as the authors state them.
BASE_M = np.array(
    [
        [-0.0505, -0.0205, 0.102],
        [-0.0305, -0.0505, 0.102],
        [-0.0105, 0.0505, 0.102],
        [-0.0505, 0.0235, 0.102],
    ]
)
# Positions of the tip markers in the frame of the mesh [m], as the authors state them.
TIP_M = np.array([[-0.009645, -0.0265, 0.0], [-0.009645, 0.0265, 0.0], [-0.0282, 0.0, 0.0]])
# The model is the half y > 0 of the arm: the marker at y < 0 is written as its mirror image.
MIRRORED = "Tip - 1"
# Written samples before the tip begins to move, and from there on; the sampling rate is 100 Hz.
SAMPLES_BEFORE = 20
SAMPLES_AFTER = 200
# Samples after the start in which the tip is at rest; in the first ones the cameras drift.
REST = slice(10, 35)
# Distance from its position at rest at which the tip counts as moving [m]: ten times the noise.
ONSET_M = 5e-4
# Stated time of the step [s]: two samples before the tip counts as moving, and its duration [s].
STEP_S = (SAMPLES_BEFORE - 2) / 100
RAMP_S = 1e-3


@dataclass(frozen=True)
class ArmShape:
    """Dimensions of the arm [m]; those without a source are assumptions."""

    # Radius and length of the arm and thickness of the cross between its four chambers, from the
    # simplified geometries of the authors.
    radius_m: float = 0.0222
    length_m: float = 0.100
    cross_m: float = 0.0044
    # Thickness of the outer wall, not documented; chosen such that the static travels at all six
    # pressures are about those measured.
    wall_m: float = 0.0037
    cap_m: float = 0.006  # thickness of the closed end at the tip, not documented
    layers: int = 3  # layers of elements along the chambers


def main() -> None:
    names = {f"{pressure}mbar_V3.c3d": pressure for pressure in PRESSURES_MBAR}
    for file in fetched_files(__doc__, {name: f"{SOURCE}/{name}" for name in names}):
        pressure = names[file.name]
        written = FOLDER / f"{pressure}mbar.csv"
        written.write_text(table_of_tip(file))
        print(written)
        (FOLDER / f"{pressure}mbar_step.csv").write_text(table_of_step(1e2 * pressure))
    arm_mesh(ArmShape()).write(FOLDER / "arm.vtu")


# Recordings -------------------------------------------------------------------------------------


def table_of_tip(file: Path) -> str:
    """Return a table of the tip markers in the frame of the mesh, from the onset of motion on.

    Time is zero SAMPLES_BEFORE samples before the tip moves.
    """
    t_s, tip_m, labels = tip_in_mesh_frame(file)
    start = onset(tip_m) - SAMPLES_BEFORE
    rows = slice(start, start + SAMPLES_BEFORE + SAMPLES_AFTER + 1)
    names = [label.lower().replace(" - ", "_") for label in labels]
    columns = ["t_s", *(f"{name}_{axis}" for name in names for axis in "xyz")]
    values = np.column_stack([t_s[rows] - t_s[start], tip_m[rows].reshape(-1, 3 * len(labels))])
    lines = [",".join([f"{row[0]:.2f}", *(f"{v:.5f}" for v in row[1:])]) for row in values]
    return "\n".join([",".join(columns), *lines]) + "\n"


def table_of_step(pressure_pa: float) -> str:
    """Return a table of a pressure that rises from zero at STEP_S."""
    end_s = (SAMPLES_BEFORE + SAMPLES_AFTER) / 100 + 1.0
    rows = [(0.0, 0.0), (STEP_S, 0.0), (STEP_S + RAMP_S, pressure_pa), (end_s, pressure_pa)]
    return "t_s,pressure_pa\n" + "".join(f"{t_s:g},{value:g}\n" for t_s, value in rows)


def tip_in_mesh_frame(file: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], list[str]]:
    """Return the times (T,) [s], the tip markers (T, 3, 3) [m] in the frame of the mesh, and their
    labels.

    At rest the markers are at TIP_M; where they were measured, up to 4 mm from there, contains the
    errors of the stated positions. The marker at y < 0 is mirrored at y = 0.
    """
    tracks = read_markers(file)
    labels = list(tracks.names)
    base = [k for k, label in enumerate(labels) if label.startswith("Base")]
    tip = [k for k, label in enumerate(labels) if label.startswith("Tip")]
    positions_m = tracks.positions_m
    rotation, shift_m = rigid_transform(positions_m[:, base].mean(axis=0), BASE_M)
    tip_m = positions_m[:, tip] @ rotation.T + shift_m
    tip_m += TIP_M - tip_m[REST].mean(axis=0)
    tip_labels = [labels[k] for k in tip]
    tip_m[:, tip_labels.index(MIRRORED), 1] *= -1
    return tracks.t_s, tip_m, tip_labels


def rigid_transform(
    from_m: NDArray[np.float64], to_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation (3, 3) and shift (3,) that map points (n, 3) to others with least squares."""
    from_centre_m = from_m.mean(axis=0)
    to_centre_m = to_m.mean(axis=0)
    u, _, vt = np.linalg.svd((to_m - to_centre_m).T @ (from_m - from_centre_m))
    handedness = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ handedness @ vt
    return rotation, to_centre_m - rotation @ from_centre_m


def onset(tip_m: NDArray[np.float64]) -> int:
    """Return the index of the first sample at which the middle of the tip has moved."""
    centre_m = tip_m.mean(axis=1)
    distance_m = np.linalg.norm(centre_m - centre_m[REST].mean(axis=0), axis=1)
    return int(np.flatnonzero(distance_m > ONSET_M)[0])


# Mesh -------------------------------------------------------------------------------------------


def arm_mesh(shape: ArmShape) -> TetMesh:
    """Return the half y > 0 of the arm, with the tip at z = 0 and a chamber around the x axis.

    The point array `chamber` is 1 on the wall of the chamber at x > 0 and on its end at the tip.
    The cell arrays `ring_1` to `ring_7` are 1 in sectors of the outer wall between `ring_angles`,
    without the end. The chambers are open at the base, where the nodes are clamped.
    """
    section_m, wall_triangles, chamber_triangles, chamber_corners = cross_section(shape)
    heights_m = np.append(0.0, np.linspace(shape.cap_m, shape.length_m, shape.layers + 1))
    points_m = np.vstack(
        [np.column_stack([section_m, np.full(len(section_m), z)]) for z in heights_m]
    )
    tetrahedra = []
    for layer in range(len(heights_m) - 1):
        triangles = wall_triangles + chamber_triangles * (layer == 0)
        offset = layer * len(section_m)
        for triangle in triangles:
            tetrahedra += prism_tetrahedra([offset + k for k in triangle], len(section_m))
    on_wall = np.zeros((len(heights_m), len(section_m)), dtype=bool)
    on_wall[1:, chamber_corners] = True
    mesh = TetMesh(points_m, tetrahedra)
    x, y, z = mesh.centres_m.T
    # Chords of the arcs are closer to the axis than their ends; the arms of the cross end before.
    in_ring = (np.hypot(x, y) > 0.9 * (shape.radius_m - shape.wall_m)) & (z > shape.cap_m)
    sectors = np.searchsorted(ring_angles(shape), np.arctan2(y, x))
    rings = {f"ring_{k}": (in_ring & (sectors == k)).astype(float) for k in range(1, 8)}
    chamber = {"chamber": on_wall.ravel().astype(float)}
    return TetMesh(points_m, mesh.tetrahedra, point_arrays=chamber, cell_arrays=rings)


def prism_tetrahedra(corners: list[int], count: int) -> list[list[int]]:
    """Return the three tetrahedra of the prism over a triangle, up to the nodes `count` higher.

    Corners in ascending order give neighbouring prisms the same diagonals.
    """
    a, b, c = sorted(corners)
    return [
        [a, b, c, c + count],
        [a, b, b + count, c + count],
        [a, a + count, b + count, c + count],
    ]


def cross_section(
    shape: ArmShape,
) -> tuple[NDArray[np.float64], list[list[int]], list[list[int]], list[int]]:
    """Return the half section: points (n, 2) [m], triangles of walls and of chambers, and the
    indices of the points on the wall of the chamber at x > 0.

    Points are the core of the cross (0 to 2), the inside of the outer wall (3 to 10) and its
    outside (11 to 18).
    """
    core_m = shape.cross_m / np.sqrt(2) * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    angles = ring_angles(shape)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    directions[-1] = (-1.0, 0.0)
    inner_m = shape.radius_m - shape.wall_m
    points_m = np.vstack([core_m, inner_m * directions, shape.radius_m * directions])
    inside = list(range(3, 11))
    outside = list(range(11, 19))
    quads = [(0, inside[2], inside[3], 1), (1, inside[5], inside[6], 2)]
    quads += [(inside[k], outside[k], outside[k + 1], inside[k + 1]) for k in range(7)]
    walls = [[0, 1, 2]]
    for a, b, c, d in quads:
        walls += [[a, b, c], [a, c, d]]
    chambers = [[inside[0], inside[1], 0], [inside[1], inside[2], 0]]
    chambers += [[inside[3], inside[4], 1], [inside[4], inside[5], 1], [inside[6], inside[7], 2]]
    return points_m, walls, chambers, [0, *inside[:3]]


def ring_angles(shape: ArmShape) -> NDArray[np.float64]:
    """Return the polar angles (8,) of the points of the outer wall [rad], in ascending order.

    The arms of the cross are at 45° and 135°.
    """
    half = np.arcsin(shape.cross_m / 2 / (shape.radius_m - shape.wall_m))
    quarter = np.pi / 4
    side = np.array([quarter - half, quarter + half])
    return np.array([0.0, side[0] / 2, *side, np.pi / 2, *(np.pi - side[::-1]), np.pi])


def fibre_angles(shape: ArmShape) -> NDArray[np.float64]:
    """Return the angles (7,) from the x axis to the threads around the arm, in each sector of the
    outer wall [rad].
    """
    angles = ring_angles(shape)
    return (angles[1:] + angles[:-1]) / 2 + np.pi / 2


if __name__ == "__main__":
    main()
