"""Gradient of the marker loss through a simulation of the swung cylinder, written with Warp.

The equations are those of `peer_case`, integrated explicitly as MuJoCo does; Warp records all steps
and differentiates them in reverse. Needs the package `warp-lang`; runs on the CPU.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from peer_case import (
    MARKED_NODES,
    NODE_MASS_KG,
    NOISE_M,
    SAMPLE_COUNT,
    SAMPLE_S,
    cylinder,
    grasped_nodes,
    grasped_positions,
)

Array = NDArray[np.float64]
# Untyped: annotations of Warp's kernels are calls, which type checkers refuse.
wp: Any = import_module("warp")
if TYPE_CHECKING:
    Float = Any
    FloatArray = Any
    IntArray = Any
    IntArray2d = Any
    MatrixArray = Any
    VectorArray2d = Any
else:
    Float = wp.float64
    FloatArray = wp.array(dtype=wp.float64)
    IntArray = wp.array(dtype=int)
    IntArray2d = wp.array2d(dtype=int)
    MatrixArray = wp.array(dtype=wp.mat33d)
    VectorArray2d = wp.array2d(dtype=wp.vec3d)

# As MuJoCo's explicit steps: stable at the truth and the guess.
STEP_S = 5e-5
# The body settles with a drag under which vibrations decay at half its
# value, for eleven decay times.
SETTLING_S = 0.15
SETTLING_DRAG_1_S = 150.0
# Change of the logarithms in the first step of the search.
FIRST_CHANGE = 0.2


@wp.kernel
def set_constants(logarithms: FloatArray, constants: FloatArray):
    """Set λ, μ and γ_r from the logarithms of E, ν and γ_r."""
    young = wp.exp(logarithms[0])
    poisson = wp.exp(logarithms[1])
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    constants[0] = young * poisson / (one + poisson) / (one - two * poisson)
    constants[1] = young / two / (one + poisson)
    constants[2] = wp.exp(logarithms[2])


@wp.kernel
def add_forces(
    x: VectorArray2d,
    v: VectorArray2d,
    tetrahedra: IntArray2d,
    inverses: MatrixArray,
    volumes: FloatArray,
    constants: FloatArray,
    step: int,
    forces: VectorArray2d,
):
    """Add the forces of elasticity and damping of each tetrahedron at a step."""
    k = wp.tid()
    a = tetrahedra[k, 0]
    b = tetrahedra[k, 1]
    c = tetrahedra[k, 2]
    d = tetrahedra[k, 3]
    edges = wp.matrix_from_cols(
        x[step, b] - x[step, a], x[step, c] - x[step, a], x[step, d] - x[step, a]
    )
    edge_rates = wp.matrix_from_cols(
        v[step, b] - v[step, a], v[step, c] - v[step, a], v[step, d] - v[step, a]
    )
    half = wp.float64(0.5)
    unit = wp.identity(n=3, dtype=wp.float64)
    F = edges * inverses[k]
    rate = edge_rates * inverses[k]
    product = wp.transpose(F) * rate
    strain = half * (wp.transpose(F) * F - unit)
    strain_rate = half * (product + wp.transpose(product))
    delayed = strain + constants[2] * strain_rate
    stress = constants[0] * wp.trace(delayed) * unit + wp.float64(2.0) * constants[1] * delayed
    columns = -volumes[k] * (F * stress * wp.transpose(inverses[k]))
    f1 = wp.vec3d(columns[0, 0], columns[1, 0], columns[2, 0])
    f2 = wp.vec3d(columns[0, 1], columns[1, 1], columns[2, 1])
    f3 = wp.vec3d(columns[0, 2], columns[1, 2], columns[2, 2])
    wp.atomic_add(forces, step, b, f1)
    wp.atomic_add(forces, step, c, f2)
    wp.atomic_add(forces, step, d, f3)
    wp.atomic_sub(forces, step, a, f1)
    wp.atomic_sub(forces, step, a, f2)
    wp.atomic_sub(forces, step, a, f3)


@wp.kernel
def advance(
    x: VectorArray2d,
    v: VectorArray2d,
    forces: VectorArray2d,
    grasp_rows: IntArray,
    grasp_positions_m: VectorArray2d,
    step: int,
    step_s: Float,
    mass_kg: Float,
    drag_1_s: Float,
):
    """Set positions and velocities of the next step; grasped nodes (rows ≥ 0) are prescribed."""
    n = wp.tid()
    row = grasp_rows[n]
    if row >= 0:
        x[step + 1, n] = grasp_positions_m[step + 1, row]
        v[step + 1, n] = (grasp_positions_m[step + 1, row] - grasp_positions_m[step, row]) / step_s
    else:
        gravity = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(-9.81))
        acceleration = forces[step, n] / mass_kg + gravity - drag_1_s * v[step, n]
        speed = v[step, n] + step_s * acceleration
        v[step + 1, n] = speed
        x[step + 1, n] = x[step, n] + step_s * speed


@wp.kernel
def add_misfit(
    x: VectorArray2d,
    nodes: IntArray,
    measured_m: VectorArray2d,
    first: int,
    stride: int,
    scale: Float,
    loss: FloatArray,
):
    """Add the squared distances of the markers of all samples, over the noise."""
    k = wp.tid()
    sample = k // nodes.shape[0]
    marker = k % nodes.shape[0]
    residual = (x[first + sample * stride, nodes[marker]] - measured_m[sample, marker]) * scale
    wp.atomic_add(loss, 0, wp.dot(residual, residual))


@dataclass(frozen=True)
class LossGradient:
    """Sum of squared residuals and its gradient (3,) by the logarithms of the parameters."""

    loss: float
    gradient: Array


class WarpCylinder:
    """The cylinder in Warp, with the memory of all its steps.

    Parameters
    ----------
    measured_m : (T, k, 3) array
        Measured marker positions [m].
    """

    def __init__(self, measured_m: Array) -> None:
        mesh = cylinder()
        tetrahedra = np.asarray(mesh.tetrahedra)
        corners_m = mesh.points_m[tetrahedra]
        edges_m = (corners_m[:, 1:] - corners_m[:, :1]).transpose(0, 2, 1)
        self.stride = round(SAMPLE_S / STEP_S)
        self.settling = round(SETTLING_S / STEP_S)
        self.count = self.settling + (SAMPLE_COUNT - 1) * self.stride
        nodes = len(mesh.points_m)
        times_s = STEP_S * (np.arange(self.count + 1) - self.settling)
        grasp_positions_m = grasped_positions(mesh, np.maximum(times_s, 0.0))
        grasp_rows = np.full(nodes, -1)
        grasp_rows[grasped_nodes(mesh)] = np.arange(grasp_positions_m.shape[1])
        shape = (self.count + 1, nodes)
        x = np.zeros((self.count + 1, nodes, 3))
        x[0] = mesh.points_m
        self.x = wp.array(x, dtype=wp.vec3d, requires_grad=True)
        self.v = wp.zeros(shape, dtype=wp.vec3d, requires_grad=True)
        self.forces = wp.zeros(shape, dtype=wp.vec3d, requires_grad=True)
        self.constants = wp.zeros(3, dtype=wp.float64, requires_grad=True)
        self.loss = wp.zeros(1, dtype=wp.float64, requires_grad=True)
        self.tetrahedra = wp.array(tetrahedra, dtype=int)
        self.inverses = wp.array(np.linalg.inv(edges_m), dtype=wp.mat33d)
        self.volumes = wp.array(np.linalg.det(edges_m) / 6, dtype=wp.float64)
        self.grasp_rows = wp.array(grasp_rows, dtype=int)
        self.grasp_positions_m = wp.array(grasp_positions_m, dtype=wp.vec3d)
        self.marked_nodes = wp.array(list(MARKED_NODES), dtype=int)
        self.measured_m = wp.array(measured_m, dtype=wp.vec3d)

    def simulate(self, logarithms: Any) -> None:
        """Simulate with the logarithms (3,) of the parameters, a Warp array, into the memory."""
        wp.launch(set_constants, dim=1, inputs=[logarithms, self.constants])
        for step in range(self.count):
            wp.launch(
                add_forces,
                dim=len(self.volumes),
                inputs=[
                    self.x,
                    self.v,
                    self.tetrahedra,
                    self.inverses,
                    self.volumes,
                    self.constants,
                    step,
                    self.forces,
                ],
            )
            drag_1_s = SETTLING_DRAG_1_S if step < self.settling else 0.0
            wp.launch(
                advance,
                dim=len(self.grasp_rows),
                inputs=[
                    self.x,
                    self.v,
                    self.forces,
                    self.grasp_rows,
                    self.grasp_positions_m,
                    step,
                    STEP_S,
                    NODE_MASS_KG,
                    drag_1_s,
                ],
            )

    def positions_m(self) -> Array:
        """Return the node positions (T, n, 3) [m] at the samples of the last simulation."""
        return np.asarray(self.x.numpy(), dtype=float)[self.settling :: self.stride]

    def evaluate(self, logarithms: Array) -> LossGradient:
        """Simulate with logarithms of the parameters, and differentiate; NaN where unstable."""
        x = wp.array(logarithms, dtype=wp.float64, requires_grad=True)
        self.forces.zero_()
        self.loss.zero_()
        with wp.Tape() as tape:
            self.simulate(x)
            wp.launch(
                add_misfit,
                dim=SAMPLE_COUNT * len(MARKED_NODES),
                inputs=[
                    self.x,
                    self.marked_nodes,
                    self.measured_m,
                    self.settling,
                    self.stride,
                    1.0 / NOISE_M,
                    self.loss,
                ],
            )
        tape.backward(self.loss)
        gradient = np.array(x.grad.numpy(), dtype=float)
        loss = float(self.loss.numpy()[0])
        tape.zero()
        return LossGradient(loss, gradient)
