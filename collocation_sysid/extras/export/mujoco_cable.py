"""MuJoCo: a slender body as a chain of links, with three hinges at each cross-section.

A link is the part between two cross-sections. At each section, hinges about the tangent and the two
directors have springs of GJ, EI₁ and EI₂ over the distance of the middles of the links, with dampers
γ_r times as strong. The first section after the clamp is half a link from the clamp.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...errors import InputError
from ...kinds.rod.element import RodMaterial, RodMesh, frames_of_sections
from .identified import IdentifiedBody
from .target import values_as_text

# Timestep over the period of the fastest hinge.
STEP_SHARE = 0.02
# Directions of the hinges of a section in its frame: tangent, d₁, d₂.
AXES = ("1 0 0", "0 1 0", "0 0 1")


@dataclass(frozen=True, eq=False)
class Chain:
    """Links of a cable from its clamp to its free end; arrays have one row for each link."""

    lengths_m: Array  # (k,)
    masses_kg: Array  # (k,)
    inertias_kg_m2: Array  # (k, 3): about tangent, d₁ and d₂, through the middle of a link
    stiffness_nm: Array  # (k, 3): of the hinges at the beginning of a link, per radian
    rest_rad: Array  # (k, 3): angles of the hinges without stress
    gamma_r_s: float
    gamma_m_1_s: float
    # Places of the sections at the beginning of the links and at the free end, in a configuration.
    sections: Index

    @classmethod
    def from_body(cls, body: IdentifiedBody) -> Chain:
        """Return the chain of an identified rod.

        Raises
        ------
        InputError
            Unless one gripper holds one end of the rod, and all of it has the same constants.
        """
        mesh = body.body.mesh
        assert isinstance(mesh, RodMesh)
        held = np.flatnonzero(body.is_node_prescribed.reshape(-1, 3).all(axis=1))
        count = len(mesh.s_m)
        is_first = held.size and np.array_equal(held, np.arange(len(held)))
        if len(body.experiment.grasps) != 1 or not is_first or len(held) == count:
            raise InputError(
                "a chain of MuJoCo hangs from one gripper that holds the beginning of the cable; "
                "expected such a recording: export it, or to json"
            )
        if len(body.body.parts) > 1 or body.point_masses_kg.any():
            raise InputError(
                "a cable with regions or point masses is not exported to mujoco; expected --to json"
            )
        region, part = body.regions[0], next(iter(body.body.parts))
        law = part.material
        assert isinstance(law, RodMaterial)
        first = len(held) - 1
        lengths = np.diff(mesh.s_m)[first:]
        between = np.concatenate([lengths[:1] / 2, (lengths[1:] + lengths[:-1]) / 2])
        values = [region.constants[constant.name] for constant in law.constants]
        stiffness = law.stiffness(values)[[5, 3, 4]]
        density_kg_m = body.node_mass_kg.sum() / mesh.s_m[-1]
        own = np.array([sum(law.section.moments_m4), *law.section.moments_m4])
        masses = density_kg_m * lengths
        inertias = masses[:, None] * (own / law.section.area_m2)
        inertias[:, 1:] += (masses * lengths**2 / 12)[:, None]
        sections = np.arange(first, count)
        rest = np.zeros((len(lengths), 3))
        if not mesh.is_straight_at_rest:
            rest = hinge_angles(body.body.nodes_m, sections)
        if law.natural_curvature:
            shares = mesh.s_m[sections[:-1], None] / mesh.s_m[-1]
            natural = law.natural_strains(np.array(values), shares)
            rest = rest + between[:, None] * natural[:, [2, 0, 1]]
        return cls(
            lengths,
            masses,
            inertias,
            stiffness_nm=stiffness / between[:, None],
            rest_rad=rest,
            gamma_r_s=region.gamma_r_s,
            gamma_m_1_s=region.gamma_m_1_s,
            sections=sections,
        )

    @property
    def stable_step_s(self) -> float:
        """Timestep [s] that resolves the fastest hinge."""
        return float(
            STEP_SHARE * 2 * np.pi * np.sqrt((self.inertias_kg_m2 / self.stiffness_nm).min())
        )

    @property
    def viscosity(self) -> float:
        """Viscosity of a medium in which the drag on the links is γ_m times their mass [Pa s]."""
        x, y, z = self.inertias_kg_m2.T
        sizes = np.sqrt(6 * np.stack([y + z - x, x + z - y, x + y - z]) / self.masses_kg)
        return float(
            self.gamma_m_1_s * self.masses_kg.sum() / (3 * np.pi * sizes.mean(axis=0).sum())
        )

    def xml(self, clamp: tuple[Array, Array]) -> str:
        """Return nested bodies, the first at position (3,) and quaternion (w, x, y, z) `clamp` in
        the frame of the gripper.
        """
        lines = ""
        for k, length in enumerate(self.lengths_m.tolist()):
            place, turn = (
                clamp if k == 0 else (np.array([self.lengths_m[k - 1], 0, 0]), [1, 0, 0, 0])
            )
            lines += f'<body name="link{k}" pos="{values_as_text(place)}" '
            lines += f'quat="{values_as_text(turn)}">'
            lines += f'<inertial pos="{length / 2!r} 0 0" mass="{float(self.masses_kg[k])!r}" '
            lines += f'diaginertia="{values_as_text(self.inertias_kg_m2[k])}"/>\n'
            for axis, name in enumerate(AXES):
                stiffness = float(self.stiffness_nm[k, axis])
                lines += (
                    f'<joint type="hinge" axis="{name}" stiffness="{stiffness!r}" '
                    f'springref="{float(np.degrees(self.rest_rad[k, axis]))!r}" '
                    f'damping="{self.gamma_r_s * stiffness!r}"/>'
                )
            lines += "\n"
        end = f'<site name="tip" pos="{float(self.lengths_m[-1])!r} 0 0"/>\n'
        return lines + end + "</body>\n" * len(self.lengths_m)


def hinge_angles(nodes_m: Array, sections: Index) -> Array:
    """Return the angles (k, 3) of the hinges at all given sections but the last, from positions of
    nodes (n, 3): from the clamped section to the first link, then between links.
    """
    centres, frames = frames_of_sections(nodes_m)
    centres, frames = centres[sections], frames[sections]
    turns = [Rotation.from_matrix(frames[0])]
    for k in range(len(sections) - 1):
        way = centres[k + 1] - centres[k]
        x = way / np.linalg.norm(way)
        y = frames[k, :, 1] + frames[k + 1, :, 1]
        y = y - (y @ x) * x
        y /= np.linalg.norm(y)
        turns.append(Rotation.from_matrix(np.column_stack([x, y, np.cross(x, y)])))
    relative = [a.inv() * b for a, b in pairwise(turns)]
    return np.array([each.as_euler("XYZ") for each in relative])


def clamp_in_gripper(body: IdentifiedBody, section: int) -> tuple[Array, Array]:
    """Return position (3,) [m] and quaternion (w, x, y, z) of the clamped section in the frame of
    the gripper.
    """
    centres, frames = frames_of_sections(body.body.nodes_m)
    return centres[section], np.roll(Rotation.from_matrix(frames[section]).as_quat(), 1)
