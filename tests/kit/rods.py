"""Slender bodies, and references for them: a plane rod by its equilibrium equations, and a discrete
elastic rod.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import OptimizeResult, brentq, minimize
from scipy.spatial.transform import Rotation

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.pattern import dofs_of
from collocation_sysid.kinds.rod.element import CrossSection, RodMesh, rod_mesh
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.modes.natural import Modes, natural_modes
from collocation_sysid.recording import Experiment, Force, Grasp, PoseSequence
from kit.forces import forces_alone
from kit.problems import IDEAL, point_markers

Array = NDArray[np.float64]

NO_GRAVITY = (0.0, 0.0, 0.0)
UNDAMPED = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
CABLE = {"bending_n_m2": 0.02, "torsion_n_m2": 0.013, "axial_n": 5e4}
DENSITY_KG_M3 = 1200.0
_ANGLES = 2 * np.pi / 3 * np.arange(3)


def straight(length_m: float, section: CrossSection, sections: int, along: ArrayLike = (1, 0, 0)):
    """A straight rod from the origin."""
    return rod_mesh(np.outer([0.0, length_m], along), section, sections)


def bent(sections: int = 8) -> RodMesh:
    """A rod in space with sections at uneven distances."""
    t = np.linspace(0, 2, 9)
    centreline_m = np.stack([0.3 * np.sin(t), 0.3 * np.cos(t), 0.05 * t**2], axis=1)
    section = CrossSection.rectangle(0.012, 0.007)
    return rod_mesh(centreline_m, section, sections, stations_m=[0.0333])


def cable(mesh: RodMesh, **options) -> Body:
    return Body(mesh, "cable", density_kg_m3=DENSITY_KG_M3, **options)


def ends(body: Body) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Nodes of the first and of the last section."""
    return np.arange(3), np.arange(len(body.nodes_m) - 3, len(body.nodes_m))


def free_dofs(body: Body, *held: NDArray[np.int64]) -> NDArray[np.int64]:
    return dofs_of(np.setdiff1d(np.arange(len(body.nodes_m)), np.concatenate([[-1], *held])))


def centres(x: Array) -> Array:
    """Centres of the sections (…, N, 3)."""
    return x.reshape(*x.shape[:-2], -1, 3, 3).mean(axis=-2)


def directors(mesh: RodMesh, x: Array) -> Array:
    """Directors d₁ and d₂ of each section (N, 2, 3)."""
    at_nodes = x.reshape(-1, 3, 3)
    parts = [
        2 / 3 * np.einsum("j,njc->nc", wave(_ANGLES), at_nodes) / radius
        for wave, radius in zip((np.cos, np.sin), mesh.section.node_radii_m, strict=True)
    ]
    return np.stack(parts, axis=1)


def placed(mesh: RodMesh, centres_m: Array, frames: Array) -> Array:
    """Nodes (3N, 3) of sections with these centres (N, 3) and directors d₁ and d₂ (N, 2, 3)."""
    first, second = mesh.section.node_radii_m
    across = first * np.cos(_ANGLES)[:, None] * frames[:, None, 0]
    across = across + second * np.sin(_ANGLES)[:, None] * frames[:, None, 1]
    return (centres_m[:, None] + across).reshape(-1, 3)


def wrench_on_section(points_m: Array, force_n: ArrayLike, moment_n_m: ArrayLike) -> Array:
    """Forces (3, 3) on the nodes of a section with a force at its centre and a moment.

    They are the smallest ones.
    """
    arms = points_m - points_m.mean(axis=0)
    cross = np.array([[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in arms])
    rows = np.vstack([np.hstack([np.eye(3)] * 3), np.hstack([*cross])])
    wrench = np.concatenate([force_n, moment_n_m])
    return np.linalg.lstsq(rows, wrench, rcond=None)[0].reshape(3, 3)


def small_displacement(body: Body, forces_n: Array, **constants: float) -> Array:
    """Displacement (n, 3) of a rod that is clamped at its first section, by its stiffness at rest."""
    free = free_dofs(body, ends(body)[0])
    stiffness = body.stiffness(body.nodes_m, **constants).toarray()[np.ix_(free, free)]
    moved = np.zeros(body.nodes_m.size)
    moved[free] = np.linalg.solve(stiffness, forces_n.ravel()[free])
    return moved.reshape(-1, 3)


def modes(
    body: Body, *held: NDArray[np.int64], count: int = 6, x: Array | None = None, **constants: float
) -> Modes:
    """Natural modes of a rod at rest, or in a shape x, with these nodes held."""
    theta = body.theta_from_values(constants | UNDAMPED)
    place = body.nodes_m if x is None else x
    return natural_modes(forces_alone(body, theta), place, free_dofs(body, *held), count)


def clamped(body: Body, *tip_force_n: float, **changes) -> Experiment:
    """A rod held at its first section, with a force at its other end."""
    t_s = changes.pop("t_s", np.arange(3.0))
    first, last = ends(body)
    settings = {"gravity_m_s2": NO_GRAVITY, "nuisance": IDEAL} | changes
    forces = (Force(last, np.array(tip_force_n)),) if tip_force_n else ()
    markers = point_markers(body, body.nodes_m[-1:], t_s)
    grasps = settings.pop("grasps", [Grasp(first, PoseSequence.fixed())])
    return Experiment(body, t_s, grasps, markers, forces=forces, **settings)


def rest_shape_under(experiment: Experiment, **constants: float) -> Array:
    """Equilibrium (n, 3)."""
    theta = experiment.body.theta_from_values(constants | UNDAMPED)
    return equilibrium(experiment, theta).reshape(-1, 3)


def relaxed(
    body: Body, x: Array, free: NDArray[np.int64], neutral_n_m: float = 0.0, **constants: float
) -> tuple[Array, Array]:
    """Equilibrium without loads (n, 3) near x, stable or not, and the eigenvalues of its stiffness.

    Directions with an eigenvalue up to `neutral_n_m` are left out of the steps.
    """
    place = x.ravel().copy()
    for _ in range(30):
        force = body.elastic_force(place.reshape(-1, 3), **constants).ravel()[free]
        stiffness = body.stiffness(place.reshape(-1, 3), **constants).toarray()[np.ix_(free, free)]
        values, vectors = np.linalg.eigh(stiffness)
        moving = np.abs(values) > neutral_n_m
        step = vectors[:, moving] @ ((vectors.T @ force)[moving] / values[moving])
        place[free] += step
        if np.abs(step).max() < 1e-9:
            return place.reshape(-1, 3), values
    raise AssertionError("Newton's method did not converge")


# A plane rod -----------------------------------------------------------------------------------


def plane_rod(
    length_m: float,
    bending_n_m2: float,
    angle_rad: float = 0.0,
    weight_n_m: float = 0.0,
    tip_force_n: tuple[float, float] = (0.0, 0.0),
    curvature_1_m: float = 0.0,
) -> Array:
    """Shape (100, 2) of an inextensible rod in a plane, clamped at the origin, under its weight along
    −y and a force at its end.

    θ is the angle of the tangent against x: EI (θ′ − κ₀)′ = f_x sin θ − f_y cos θ with the force f
    on the section from beyond it, θ(0) given and θ′(L) = κ₀. Shooting begins at the end where both
    unknowns are bounded: θ(L) is varied until θ(0) is met.
    """

    def rates(s: float, state: Array) -> list[float]:
        theta, slope, *_ = state
        along_y = tip_force_n[1] - weight_n_m * (length_m - s)
        bend = (tip_force_n[0] * np.sin(theta) - along_y * np.cos(theta)) / bending_n_m2
        return [slope, bend, np.cos(theta), np.sin(theta)]

    def shape(end_rad: float) -> OptimizeResult:
        return solve_ivp(
            rates,
            (length_m, 0.0),
            [end_rad, curvature_1_m, 0.0, 0.0],
            rtol=1e-10,
            atol=1e-12,
            t_eval=np.linspace(length_m, 0, 100),
        )

    # From the undeformed angle towards that of the resultant: the stable shape is the first one.
    free_rad = angle_rad + curvature_1_m * length_m
    tries = free_rad + np.linspace(0, np.pi, 60)[:, None] * np.array([-1, 1])
    errors = np.array([[shape(end).y[0, -1] - angle_rad for end in row] for row in tries])
    for k in range(len(tries) - 1):
        for side in range(2):
            if errors[k, side] * errors[k + 1, side] <= 0:
                end = brentq(
                    lambda at: shape(at).y[0, -1] - angle_rad, tries[k, side], tries[k + 1, side]
                )
                places = shape(end).y[2:, ::-1].T
                return places - places[0]
    raise AssertionError("no shape was found")


# A discrete elastic rod ------------------------------------------------------------------------


@dataclass(frozen=True)
class DiscreteRod:
    """Inextensible discrete elastic rod of Bergou, Wardetzky, Robinson, Audoly & Grinspun (2008).

    Edges of equal length carry material frames. The curvature of a vertex is its binormal
    2 t × t′/(1 + t·t′) in the mean of both frames, the twist is the angle that remains after parallel
    transport. The unknowns are the rotations from frame to frame; the first edge is half as long as
    the others and fixed.
    """

    length_m: float
    edges: int
    bending_n_m2: float
    torsion_n_m2: float
    weight_n_m: float
    natural_1_m: tuple[float, float, float]  # κ₁, κ₂ and τ
    first_frame: Array  # (3, 3): rows d₁, d₂ and d₃
    tip_force_n: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def lengths_m(self) -> Array:
        """Of each edge: vertices, where the rod bends, have equal parts of it."""
        lengths = np.full(self.edges + 1, self.length_m / self.edges)
        lengths[[0, -1]] /= 2
        return lengths

    def frames(self, turns: Array) -> Array:
        """Frames (edges + 1, …, 3, 3) after rotation vectors (…, 3 · edges) in the frame before."""
        vectors = turns.reshape(-1, self.edges, 3)
        relative = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
        relative = relative.reshape(*vectors.shape, 3)
        frames = [np.broadcast_to(self.first_frame, (len(vectors), 3, 3))]
        for k in range(self.edges):
            frames.append(relative[:, k].swapaxes(1, 2) @ frames[-1])
        return np.stack(frames)

    def vertices_m(self, turns: Array) -> Array:
        """Vertices (edges + 2, …, 3), from the clamp."""
        steps = self.lengths_m[:, None, None] * self.frames(turns)[:, :, 2]
        return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])

    def energy_j(self, turns: Array) -> Array:
        frames = self.frames(turns)
        before, after = frames[:-1], frames[1:]
        t, u = before[:, :, 2], after[:, :, 2]
        cosine = np.einsum("esc,esc->es", t, u)[..., None]
        binormal = 2 * np.cross(t, u) / (1 + cosine)
        # The first director of the frame before, carried along without twist.
        axis = np.cross(t, u)
        first = before[:, :, 0]
        along = np.einsum("esc,esc->es", axis, first)[..., None]
        carried = first * cosine + np.cross(axis, first) + axis * along / (1 + cosine)
        other = np.cross(u, carried)
        own = after[:, :, 0]
        twist = np.arctan2(
            np.einsum("esc,esc->es", own, other), np.einsum("esc,esc->es", own, carried)
        )
        mean = (before[:, :, :2] + after[:, :, :2]) / 2
        bends = np.einsum("esc,eskc->esk", binormal, mean)
        length = self.length_m / self.edges
        natural = length * np.array(self.natural_1_m)
        energy = self.bending_n_m2 * ((bends - natural[:2]) ** 2).sum(axis=(0, 2))
        energy += self.torsion_n_m2 * ((twist - natural[2]) ** 2).sum(axis=0)
        places = self.vertices_m(turns)
        middles = (places[1:] + places[:-1]) / 2
        height = np.einsum("e,es->s", self.lengths_m, middles[:, :, 2])
        work = places[-1] @ np.array(self.tip_force_n)
        return energy / (2 * length) + self.weight_n_m * height - work

    def solve(self) -> Array:
        """Middles of the edges and both ends (edges + 3, 3) of the shape of least energy."""
        size = 3 * self.edges
        offsets = 1e-5 * np.vstack([np.eye(size), -np.eye(size)])

        def slopes(turns: Array) -> Array:
            values = self.energy_j(turns + offsets)
            return (values[:size] - values[size:]) / 2e-5

        start = np.tile(self.length_m / self.edges * np.array(self.natural_1_m), self.edges)
        found = minimize(
            lambda turns: float(self.energy_j(turns)[0]),
            start,
            jac=slopes,
            method="BFGS",
            options={"gtol": 1e-7, "maxiter": 1000},
        )
        places = self.vertices_m(found.x)[:, 0]
        return np.vstack([places[:1], (places[1:] + places[:-1]) / 2, places[-1:]])
