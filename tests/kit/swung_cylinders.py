"""A swung cylinder, simulated by MuJoCo's flex and by a model that scikit-fem assembles.

The cylinder has the energy of St. Venant and Kirchhoff and the damping stress
S_v = γ_r (λ tr(Ė) I + 2 μ Ė). It hangs from a hand for half a second and is then swung by it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import skfem.helpers
from numpy.typing import NDArray
from scipy.sparse import diags_array
from scipy.sparse.linalg import splu
from skfem import BilinearForm, LinearForm

import collocation_sysid as cs
from kit.scikit_fem import Library

Array = NDArray[np.float64]
# Untyped: scikit-fem's annotations exclude what its helpers return, MuJoCo's lack its names.
tensors: Any = skfem.helpers
mujoco: Any = import_module("mujoco")

# True values: Young's modulus [Pa], Poisson's ratio [1], damping time γ_r [s].
TRUTH = {"young_pa": 20e3, "poisson": 0.3, "gamma_r_s": 4e-3}
GRAVITY_M_S2 = np.array([0.0, 0.0, -9.81])
SAMPLE_S = 0.02
SAMPLE_COUNT = 45
# MuJoCo settles the hanging body for so many samples before the recording begins.
SETTLING_SAMPLES = 25
MUJOCO_STEP_S = 5e-5
SEEN_NODES = [0, 1, 3, 5, 21, 24]
NOISE_M = 3e-4
# Our runs choose six steps per sample for this body, see docs/howto/from_simulator.md.
STEPS_PER_SAMPLE = 6
NEWTON_TOLERANCE_N = 1e-8
MOST_NEWTON_STEPS = 30


def cylinder(rings: int, layers: int) -> cs.TetMesh:
    """Return the mesh of the cylinder, 2 cm in radius and 12 cm high."""
    return cs.cylinder_mesh(radius_m=0.02, height_m=0.12, rings=rings, layers=layers)


def held_nodes(mesh: cs.TetMesh) -> NDArray[np.intp]:
    """Return the nodes at the top, which the hand holds."""
    return np.flatnonzero(mesh.points_m[:, 2] > 0.119)


# MuJoCo -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FlexMotion:
    """Motion of a flex and of the hand that holds it.

    Attributes
    ----------
    positions_m : (T, n, 3) array
        Positions of the vertices [m].
    poses : (T, 4, 4) array
        Poses of the hand.
    masses_kg : (n,) array
        Masses of the vertices [kg].
    """

    positions_m: Array
    poses: Array
    masses_kg: Array


def simulate_flex(mesh: cs.TetMesh, values: dict[str, float]) -> FlexMotion:
    """Simulate the cylinder by MuJoCo with values of the parameters of `TRUTH`."""
    model = mujoco.MjModel.from_xml_string(_flex_description(mesh, values))
    data = mujoco.MjData(model)
    steps = round(SAMPLE_S / MUJOCO_STEP_S)
    poses = np.tile(np.eye(4), (SAMPLE_COUNT, 1, 1))
    positions_m = np.empty((SAMPLE_COUNT, len(mesh.points_m), 3))
    mujoco.mj_step(model, data, SETTLING_SAMPLES * steps)
    for sample in range(SAMPLE_COUNT):
        mujoco.mj_forward(model, data)
        positions_m[sample] = data.flexvert_xpos
        poses[sample, :3, 3] = data.body("hand").xpos
        poses[sample, :3, :3] = data.body("hand").xmat.reshape(3, 3)
        for step in range(steps):
            time_s = sample * SAMPLE_S + step * MUJOCO_STEP_S
            data.ctrl[:] = _hand_command(time_s)
            mujoco.mj_step(model, data)
    return FlexMotion(positions_m, poses, model.body_mass[model.flex_vertbodyid].copy())


def _hand_command(time_s: float) -> Array:
    """Return the hand's place along x [m] and angle about y [rad], which begin smoothly."""
    swing = np.array([0.03 * np.sin(16 * time_s), 0.25 * np.sin(11 * time_s)])
    return swing * min(1.0, time_s / 0.2) ** 2


def _flex_description(mesh: cs.TetMesh, values: dict[str, float]) -> str:
    """Return MuJoCo's description of the hand and the cylinder."""
    return f"""
<mujoco>
  <option timestep="{MUJOCO_STEP_S}" jacobian="sparse"/>
  <worldbody>
    <body name="hand">
      <joint name="along_x" type="slide" axis="1 0 0"/>
      <joint name="about_y" type="hinge" axis="0 1 0" pos="0 0 0.12"/>
      <geom type="box" size=".03 .03 .01" pos="0 0 .14" mass="50" contype="0"
            conaffinity="0"/>
      <flexcomp name="foam" type="direct" dim="3" mass="0.06" radius="0.0005"
                point="{_words(mesh.points_m)}"
                element="{_words(mesh.tetrahedra)}">
        <pin id="{_words(held_nodes(mesh))}"/>
        <contact contype="0" conaffinity="0" selfcollide="none"/>
        <elasticity young="{values["young_pa"]}" poisson="{values["poisson"]}"
                    damping="{values["gamma_r_s"]}"/>
      </flexcomp>
    </body>
  </worldbody>
  <actuator>
    <position joint="along_x" kp="20000" dampratio="1"/>
    <position joint="about_y" kp="200" dampratio="1"/>
  </actuator>
</mujoco>"""


def _words(array: NDArray) -> str:
    """Return numbers separated by spaces."""
    return " ".join(map(str, np.ravel(array).tolist()))


# The recording ------------------------------------------------------------------------------------


def recording(mesh: cs.TetMesh, motion: FlexMotion, seed: int) -> cs.Experiment:
    """Return the experiment of six noisy markers on a flex, with the masses of its vertices.

    MuJoCo gives all vertices the same mass. The body therefore gets the largest density at which no
    node is heavier than its vertex, and point masses add what is missing.
    """
    t_s = SAMPLE_S * np.arange(SAMPLE_COUNT)
    held = held_nodes(mesh)
    free = np.setdiff1d(np.arange(len(mesh.points_m)), held)
    volumes_m3 = cs.Body(mesh, density_kg_m3=1.0).node_mass
    density = 0.999 * (motion.masses_kg / volumes_m3)[free].min()
    body = cs.Body(mesh, "st-venant-kirchhoff", density_kg_m3=density, damping="material")
    added = [cs.PointMass([n], float(motion.masses_kg[n] - body.node_mass[n])) for n in free]
    tracks_m = motion.positions_m[:, SEEN_NODES]
    noise = np.random.default_rng(seed).normal(size=tracks_m.shape)
    markers = cs.Markers(
        t_s, tracks_m + NOISE_M * noise, sigma_m=NOISE_M, places_m=mesh.points_m[SEEN_NODES]
    )
    return cs.Experiment(
        body,
        t_s,
        [cs.Grasp(held, motion.poses)],
        markers,
        name="flex",
        masses=added,
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )


# scikit-fem ---------------------------------------------------------------------------------------


class ScikitFemCylinder:
    """The cylinder assembled by scikit-fem, integrated by the implicit midpoint rule.

    Parameters
    ----------
    experiment : Experiment
        The recording: its mesh, masses and grasp; its markers are not used.
    """

    def __init__(self, experiment: cs.Experiment) -> None:
        body = experiment.body
        self.rest_m = body.nodes_m
        library = Library(body.mesh)
        self.basis = library.basis
        self.order = library.dofs
        masses = body.node_mass.copy()
        for added in experiment.masses:
            masses[added.nodes] += added.mass_kg
        self.mass_kg = np.repeat(masses, 3)
        (grasp,) = experiment.grasps
        prescribed = (3 * np.asarray(grasp.nodes)[:, None] + np.arange(3)).ravel()
        self.prescribed = prescribed
        self.free = np.setdiff1d(np.arange(self.rest_m.size), prescribed)
        step_s = SAMPLE_S / STEPS_PER_SAMPLE
        count = (SAMPLE_COUNT - 1) * STEPS_PER_SAMPLE + 1
        self.step_s = step_s
        at_s = np.minimum(step_s * np.arange(count), experiment.t_s[-1])
        held_m = grasp.positions_at(body.nodes_m, at_s)
        self.prescribed_m = held_m.reshape(count, -1)

    def simulate(self, values: dict[str, float]) -> Array:
        """Return the node positions (T, n, 3) [m] at the samples, from equilibrium."""
        lame = _lame_constants(values)
        x = self._equilibrium(lame)
        v = np.zeros_like(x)
        samples = [x]
        for step in range(1, len(self.prescribed_m)):
            middle_velocity = self._midpoint_velocity(
                x, v, self.prescribed_m[step], lame, values["gamma_r_s"]
            )
            x = x + self.step_s * middle_velocity
            v = 2 * middle_velocity - v
            if step % STEPS_PER_SAMPLE == 0:
                samples.append(x)
        return np.array(samples).reshape(len(samples), -1, 3)

    def _equilibrium(self, lame: tuple[float, float]) -> Array:
        """Return the static positions (3 n,) [m] under gravity, by Newton's method in load steps."""
        x = self.rest_m.ravel().copy()
        x[self.prescribed] = self.prescribed_m[0]
        weight = self.mass_kg * np.tile(GRAVITY_M_S2, len(self.rest_m))
        for share in (0.25, 0.5, 0.75, 1.0):
            for _ in range(MOST_NEWTON_STEPS):
                force = self._force(x, 0 * x, lame, damping_s=0.0)
                residual = (force - share * weight)[self.free]
                if np.abs(residual).max() < NEWTON_TOLERANCE_N:
                    break
                stiffness = self._tangent(x, 0 * x, lame, damping_s=0.0, position=1.0, velocity=0.0)
                x[self.free] -= self._solve(stiffness, residual)
        return x

    def _midpoint_velocity(
        self, x: Array, v: Array, end_m: Array, lame: tuple[float, float], damping_s: float
    ) -> Array:
        """Return the velocity (3 n,) at the middle of a step that ends at prescribed positions."""
        u = v.copy()
        u[self.prescribed] = (end_m - x[self.prescribed]) / self.step_s
        weight = self.mass_kg * np.tile(GRAVITY_M_S2, len(self.rest_m))
        for _ in range(MOST_NEWTON_STEPS):
            middle = x + 0.5 * self.step_s * u
            inertia = self.mass_kg * 2 * (u - v) / self.step_s
            force = self._force(middle, u, lame, damping_s)
            residual = (inertia + force - weight)[self.free]
            if np.abs(residual).max() < NEWTON_TOLERANCE_N:
                return u
            tangent = self._tangent(
                middle, u, lame, damping_s, position=0.5 * self.step_s, velocity=1.0
            ) + diags_array(2 * self.mass_kg / self.step_s)
            u[self.free] -= self._solve(tangent, residual)
        raise RuntimeError("Newton's method did not converge")

    def _solve(self, matrix: Any, residual: Array) -> Array:
        """Return the Newton step of the free unknowns."""
        free = self.free
        return splu(matrix.tocsc()[free][:, free]).solve(residual)

    def _force(self, x: Array, v: Array, lame: tuple[float, float], damping_s: float) -> Array:
        """Return the internal forces (3 n,) [N]."""
        fields = self._fields(x, v)
        vector = _internal_force().assemble(self.basis, **fields, lame=lame, damping_s=damping_s)
        return vector[self.order]

    def _tangent(
        self,
        x: Array,
        v: Array,
        lame: tuple[float, float],
        damping_s: float,
        *,
        position: float,
        velocity: float,
    ) -> Any:
        """Return the derivative of the forces where positions and velocities change by these."""
        fields = self._fields(x, v)
        matrix = _internal_tangent().assemble(
            self.basis,
            **fields,
            lame=lame,
            damping_s=damping_s,
            position=position,
            velocity=velocity,
        )
        return matrix.tocsr()[self.order][:, self.order]

    def _fields(self, x: Array, v: Array) -> dict[str, Any]:
        """Return displacement and velocity as fields of the basis."""
        displacement = np.empty_like(x)
        displacement[self.order] = x - self.rest_m.ravel()
        speed = np.empty_like(v)
        speed[self.order] = v
        return {
            "displacement": self.basis.interpolate(displacement),
            "speed": self.basis.interpolate(speed),
        }


def _lame_constants(values: dict[str, float]) -> tuple[float, float]:
    """Return λ and μ [Pa]."""
    young = values["young_pa"]
    poisson = values["poisson"]
    first = young * poisson / (1 + poisson) / (1 - 2 * poisson)
    return first, young / 2 / (1 + poisson)


def _isotropic(strain: Array, lame: tuple[float, float]) -> Array:
    """Return λ tr(strain) I + 2 μ strain."""
    unit = tensors.identity(strain)
    return lame[0] * tensors.trace(strain) * unit + 2 * lame[1] * strain


def _symmetric(tensor: Array) -> Array:
    """Return the symmetric part."""
    return 0.5 * (tensor + tensors.transpose(tensor))


def _state(w: Any) -> tuple[Array, Array]:
    """Return F and the second Piola–Kirchhoff stress of elasticity and damping."""
    F = tensors.grad(w["displacement"]) + tensors.identity(tensors.grad(w["displacement"]))
    rate = tensors.grad(w["speed"])
    strain = 0.5 * (tensors.mul(tensors.transpose(F), F) - tensors.identity(F))
    strain_rate = _symmetric(tensors.mul(tensors.transpose(F), rate))
    stress = _isotropic(strain + w["damping_s"] * strain_rate, w["lame"])
    return F, stress


@functools.cache
def _internal_force() -> LinearForm:
    """Return the form of the virtual work P : ∇v."""

    @LinearForm
    def work(v, w):
        F, stress = _state(w)
        return tensors.ddot(tensors.mul(F, stress), tensors.grad(v))

    return work


@functools.cache
def _internal_tangent() -> BilinearForm:
    """Return the derivative of the virtual work along u."""

    @BilinearForm
    def work(u, v, w):
        F, stress = _state(w)
        dF = w["position"] * tensors.grad(u)
        d_rate = w["velocity"] * tensors.grad(u)
        d_strain = _symmetric(tensors.mul(tensors.transpose(F), dF))
        d_strain_rate = _symmetric(
            tensors.mul(tensors.transpose(dF), tensors.grad(w["speed"]))
            + tensors.mul(tensors.transpose(F), d_rate)
        )
        d_stress = _isotropic(d_strain + w["damping_s"] * d_strain_rate, w["lame"])
        return tensors.ddot(tensors.mul(dF, stress) + tensors.mul(F, d_stress), tensors.grad(v))

    return work
