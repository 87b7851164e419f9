"""Rough predictions of markers while the stiffness is unknown: motion of the grasp and natural
modes.

In the frame of the grasp, a body at small strain responds to gravity and the grasp's acceleration
in its modes φ_k, q̈ + 2ζω_k q̇ + ω_k² q = φ_kᵀM Rᵀ(g − ẍ). An unknown stiffness scales all ω_k; a
few scales and damping ratios therefore predict the markers of any body of this shape roughly. Use
it to test statements of a problem (poses, places, units) before anything is fitted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ...common.array_types import Array
from ...fem.body import Body
from ...model.forces import Forces
from ...recording.experiment import Experiment
from ...recording.grasp import Grasp
from ...recording.markers import Markers
from .natural import natural_modes

# Largest number of natural modes of the prediction.
MODES = 20
# Sag of the softest body, relative to its size.
SOFTEST_SAG = 0.5
# Number of stiffnesses, besides a rigid body.
STIFFNESSES = 12
# Largest first frequency relative to that of the softest body.
STIFFEST = 30.0
# Damping ratios that are tried with each stiffness.
DAMPING_RATIOS = (0.03, 0.25)
# Gravity by which the sag of the softest body is estimated [m/s²].
STANDARD_GRAVITY_M_S2 = 9.81
# Largest number of samples that are predicted.
MOST_SAMPLES = 300


@dataclass(frozen=True, eq=False)
class DeclaredMotion:
    """Statements of an experiment about poses, markers, mesh size and gravity, each of which may be
    wrong.
    """

    t_s: Array  # (T,): times [s]
    rotations: Array  # (T, 3, 3): rotations R of the grasp's poses
    translations_m: Array  # (T, 3): translations p of the poses [m]
    tracks_m: Array  # (T, M, 3): measured markers [m], NaN where missing
    gravity_m_s2: Array  # (3,): gravity [m/s²]
    mesh_scale: float = 1.0  # factor of the size of the mesh and of the markers' places on it
    lag_s: float = 0.0  # delay of the markers' clock [s]
    name: str = ""  # name of the experiment
    # (4, 4): constant motion that is part of the poses and is applied first, such as
    # `gripper_to_body`.
    first_motion: Array = field(default_factory=lambda: np.eye(4))

    @classmethod
    def from_experiment(cls, experiment: Experiment) -> DeclaredMotion | None:
        """Return the statements of an experiment for its first `MOST_SAMPLES` samples.

        None if the experiment is static, or no single rigid motion carries the body at all times,
        see `carrying_grasp`.
        """
        grasp = carrying_grasp(experiment)
        if grasp is None or experiment.is_static:
            return None
        t_s = experiment.t_s[:MOST_SAMPLES]
        rotations, translations = grasp.poses.at(t_s)
        tracks = experiment.markers.positions_at_samples_m[:MOST_SAMPLES]
        gravity_m_s2 = experiment.gravity_m_s2
        return cls(
            t_s,
            rotations,
            translations_m=translations,
            tracks_m=tracks,
            gravity_m_s2=gravity_m_s2,
            name=experiment.name,
            first_motion=grasp.poses.first_motion,
        )

    def to_world(self, points_m: Array) -> Array:
        """Return points (..., T, M, 3) [m] of the grasp's frame in the world, with the pose of each
        time [m].
        """
        turned = np.einsum("tij,...tmj->...tmi", self.rotations, points_m)
        return turned + self.translations_m[:, None]

    def to_grasp_frame(self, points_m: Array) -> Array:
        """Return points (T, M, 3) [m] of the world in the grasp's frame, with the pose of each time
        [m].
        """
        return np.einsum("tji,tmj->tmi", self.rotations, points_m - self.translations_m[:, None])

    def without_first_motion(self) -> DeclaredMotion:
        """Return the statements with the poses before `first_motion` is applied."""
        inverse: Array = np.linalg.inv(self.first_motion).astype(np.float64)
        return self.with_prior_motion(inverse[:3, :3], inverse[:3, 3])

    def with_first_motion(self) -> DeclaredMotion:
        """Return the statements with `first_motion` applied before the poses, as the inverse of
        `without_first_motion`.
        """
        first = self.first_motion
        return self.with_prior_motion(first[:3, :3], first[:3, 3])

    def with_prior_motion(self, rotation: Array, translation_m: Array) -> DeclaredMotion:
        """Return the statements with a rigid motion C (`rotation` (3, 3), `translation_m` (3,) [m])
        of the body before the poses U: x → U(Cx).
        """
        shifted = self.translations_m + self.rotations @ translation_m
        return replace(self, rotations=self.rotations @ rotation, translations_m=shifted)


def carrying_grasp(experiment: Experiment) -> Grasp | None:
    """Return the grasp that carries the body at all samples, or None if there is none.

    It must prescribe all axes. All grasps that hold at some sample must hold at all of them and
    have the same poses; of several, the first that prescribes all axes is returned.
    """
    holding = [grasp for grasp in experiment.grasps if grasp.is_active(experiment.t_s).any()]
    holding.sort(key=lambda grasp: grasp.axes != "xyz")
    if not holding or holding[0].axes != "xyz":
        return None
    if not all(grasp.is_active(experiment.t_s).all() for grasp in holding):
        return None
    motions = [grasp.poses.at(experiment.t_s) for grasp in holding]
    together = all(
        np.allclose(a, b, atol=1e-9)
        for motion in motions[1:]
        for a, b in zip(motion, motions[0], strict=True)
    )
    return holding[0] if together else None


@dataclass(frozen=True, eq=False)
class ModalResponse:
    """Natural modes of a body in its grasp, evaluated at its M markers."""

    places_m: Array  # (M, 3): markers on the undeformed body [m]
    relative_frequencies: Array  # (K,): angular frequencies relative to the lowest
    node_shapes: Array  # (K, n, 3): displacements of the nodes, for modes with φᵀ M φ = 1 kg
    shapes: Array  # (K, M, 3): displacements of the markers in these modes
    translation_loads: Array  # (K, 3): modal loads φᵀM of a uniform acceleration
    # (K, 3, 3): modal loads φᵀM xᵀ of an acceleration that is linear in the place.
    rotation_loads: Array
    size_m: float  # diagonal of the body [m]
    is_initially_at_rest: bool  # whether the body starts in equilibrium; otherwise undeformed

    @classmethod
    def from_experiment(
        cls, experiment: Experiment, constants: Mapping[str, float]
    ) -> ModalResponse:
        """Compute the modes of an experiment in the grasp and under the loads of its first time.

        Parameters
        ----------
        constants : mapping of str to float
            Constants of the body by name; only their ratios matter.
        """
        body = experiment.body
        markers = experiment.markers
        forces = Forces.from_experiment(
            experiment, experiment.t_s[:1], theta=body.theta_from_values(constants)
        ).only_loads()
        modes = natural_modes(forces, body.nodes_m, free_dofs=experiment.free_dofs, count=MODES)
        weighted = modes.shapes * forces.mass.inertia_kg[0, ::3, None]
        omega = modes.angular_frequencies_rad_s
        return cls(
            markers.predict_positions(body.nodes_m),
            omega / omega[:1],
            node_shapes=modes.shapes,
            shapes=markers.predict_positions(modes.shapes),
            translation_loads=weighted.sum(axis=1),
            rotation_loads=np.einsum("kni,nj->kij", weighted, body.nodes_m),
            size_m=float(np.linalg.norm(np.ptp(body.nodes_m, axis=0))),
            is_initially_at_rest=experiment.start == "equilibrium",
        )

    def with_markers(self, markers: Markers, body: Body) -> ModalResponse:
        """Return the response at the places of other markers on the same body."""
        return replace(
            self,
            places_m=markers.predict_positions(body.nodes_m),
            shapes=markers.predict_positions(self.node_shapes),
        )

    def predict(self, declared: DeclaredMotion) -> Array:
        """Return predictions (S, T, M, 3) [m] of the markers for S combinations of stiffness and
        damping, the last for a rigid body.

        The damping ratios of `DAMPING_RATIOS` are tried one after the other, each with
        `STIFFNESSES` stiffnesses in ascending order. Displacements are limited to the size of the
        body. Predictions are NaN beyond the range of a delayed track.
        """
        scale = declared.mesh_scale
        loads = self._modal_loads(declared)
        step_s = float(declared.t_s[1] - declared.t_s[0])
        omega = self._frequencies(scale)
        states = [
            oscillator_responses(
                omega,
                ratio,
                loads=loads,
                step_s=step_s,
                is_initially_at_rest=self.is_initially_at_rest,
            )
            for ratio in DAMPING_RATIOS
        ]
        q = np.concatenate([*states, np.zeros((1, *loads.shape))])
        swayed = np.tensordot(q, self.shapes, axes=1)
        limit = scale * self.size_m
        # Small strains are assumed: larger displacements than the size of the body are meaningless.
        relative_size = np.linalg.norm(swayed, axis=3, keepdims=True) / limit
        predictions = declared.to_world(
            scale * self.places_m + swayed / np.maximum(relative_size, 1.0)
        )
        return (
            delayed_tracks(predictions, declared.t_s, lag_s=declared.lag_s)
            if declared.lag_s
            else predictions
        )

    def _frequencies(self, scale: float) -> Array:
        """Return the angular frequencies (`STIFFNESSES`, K) [rad/s] for a mesh scale, ascending."""
        softest = np.sqrt(STANDARD_GRAVITY_M_S2 / (SOFTEST_SAG * scale * self.size_m))
        stiffnesses = softest * np.geomspace(1.0, STIFFEST, STIFFNESSES)
        return np.asarray(np.outer(stiffnesses, self.relative_frequencies), dtype=np.float64)

    def _modal_loads(self, declared: DeclaredMotion) -> Array:
        """Return the modal loads (T, K) of gravity and of the grasp's acceleration."""
        inverse = declared.rotations.transpose(0, 2, 1)
        step_s = float(declared.t_s[1] - declared.t_s[0])
        lift = declared.gravity_m_s2 - _second_differences(declared.translations_m, step_s)
        pushed = np.einsum("tij,tj->ti", inverse, lift)
        rotated = inverse @ _second_differences(declared.rotations, step_s) * declared.mesh_scale
        return pushed @ self.translation_loads.T - np.einsum(
            "tij,kij->tk", rotated, self.rotation_loads
        )


def delayed_tracks(predictions: Array, t_s: Array, lag_s: float) -> Array:
    """Return predictions (S, T, M, 3) at uniform times `t_s` (T,) [s] delayed by `lag_s` [s], by
    linear interpolation; NaN beyond their range.
    """
    at = np.arange(len(t_s)) - lag_s / (t_s[1] - t_s[0])
    low = np.clip(np.floor(at).astype(int), 0, len(t_s) - 2)
    share = (at - low)[:, None, None]
    shifted = (1 - share) * predictions[:, low] + share * predictions[:, low + 1]
    shifted[:, (at < 0) | (at > len(t_s) - 1)] = np.nan
    return shifted


def _second_differences(x: Array, step_s: float) -> Array:
    """Return second differences [1/s²]: zero velocity at the first sample, last one repeated."""
    padded = np.concatenate([x[1:2], x, x[-1:]])
    second = (padded[2:] - 2 * padded[1:-1] + padded[:-2]) / step_s**2
    second[-1] = second[-2]
    return second


def oscillator_responses(
    omega: Array, ratio: float, loads: Array, step_s: float, is_initially_at_rest: bool
) -> Array:
    """Return the coordinates (S, T, K) of oscillators (S, K), exact for loads that are linear
    between samples.

    y = q̇ − λ̄q, the imaginary part of which is ω_d q, obeys ẏ = λy + load with λ = −ζω + iω_d.

    Parameters
    ----------
    omega : (S, K) array
        Angular frequencies [rad/s].
    ratio : float
        Damping ratio.
    loads : (T, K) array
        Modal loads.
    step_s : float
        Time between samples [s].
    is_initially_at_rest : bool
        Whether to start in equilibrium with the first load; otherwise at zero.
    """
    damped = omega * np.sqrt(1 - ratio**2)
    root = -ratio * omega + 1j * damped
    fading = np.exp(root * step_s)
    of_constant = np.expm1(root * step_s) / root
    of_rise = (of_constant - step_s) / (root * step_s)
    pushes = of_constant * loads[:-1, None] + of_rise * np.diff(loads, axis=0)[:, None]
    at_rest = -root.conj() * loads[0] / omega**2
    coordinates = [at_rest if is_initially_at_rest else np.zeros_like(root)]
    for push in pushes:
        coordinates.append(fading * coordinates[-1] + push)
    return np.imag(np.stack(coordinates, axis=1)) / damped[:, None]
