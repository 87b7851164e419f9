"""Where markers may be if the stiffness is unknown: the grasp's motion, and the body's sway.

In the frame that the grasp carries, a body of small strains sways under gravity and the grasp's
acceleration in its modes φ_k, q̈ + 2ζω_k q̇ + ω_k² q = φ_kᵀM Rᵀ(g − ẍ). A stiffness that is not known
scales all ω_k; so a few scales and dampings predict the markers of any body of this shape roughly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..model.forces import Forces
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp
from .modes import natural_modes

MODES = 20
# The softest body sags by half its size; first frequencies from there on, and a rigid body.
SOFTEST_SAG, STIFFNESSES, STIFFEST = 0.5, 12, 30.0
DAMPING_RATIOS = (0.03, 0.25)
STANDARD_GRAVITY_M_S2 = 9.81
MOST_SAMPLES = 300


@dataclass(frozen=True, eq=False)
class Described:
    """What an experiment says of poses, markers, mesh and gravity, all of which may be wrong.

    Attributes
    ----------
    t_s : (T,)
    rotations : (T, 3, 3) R of the grasp's poses
    translations_m : (T, 3) p of them
    tracks_m : (T, M, 3) measured, NaN where missing
    gravity_m_s2 : (3,)
    mesh_scale : float
        By which the mesh and the markers' places on it are too small.
    lag_s : float
        By which the markers' clock is late.
    name : str
        The experiment's, quoted.
    """

    t_s: Array
    rotations: Array
    translations_m: Array
    tracks_m: Array
    gravity_m_s2: Array
    mesh_scale: float = 1.0
    lag_s: float = 0.0
    name: str = ""

    @classmethod
    def of(cls, experiment: Experiment) -> Described | None:
        """Its first samples; None where no single motion carries the body throughout, or none."""
        grasp = carrying(experiment)
        if grasp is None or experiment.static:
            return None
        t_s = experiment.t_s[:MOST_SAMPLES]
        rotations, translations = grasp.poses.at(t_s)
        tracks = experiment.markers.positions_m[:MOST_SAMPLES]
        name, gravity_m_s2 = f"'{experiment.name}'", experiment.gravity_m_s2
        return cls(t_s, rotations, translations, tracks, gravity_m_s2, name=name)

    def carry(self, points_m: Array) -> Array:
        """Points (..., T, M, 3) in the grasp's frame where it carries them."""
        turned = np.einsum("tij,...tmj->...tmi", self.rotations, points_m)
        return turned + self.translations_m[:, None]

    def pulled_back(self, points_m: Array) -> Array:
        """Points (T, M, 3) of the cameras' frame in that of the grasp."""
        return np.einsum("tji,tmj->tmi", self.rotations, points_m - self.translations_m[:, None])

    def after(self, rotation: Array, translation_m: Array) -> Described:
        """The same with another rigid motion before the poses: x → U(Cx)."""
        shifted = self.translations_m + self.rotations @ translation_m
        return replace(self, rotations=self.rotations @ rotation, translations_m=shifted)


def carrying(experiment: Experiment) -> Grasp | None:
    """The grasp that carries the body throughout, if all others that hold move with it.

    One that holds some axes only carries none.
    """
    holding = [grasp for grasp in experiment.grasps if grasp.holds(experiment.t_s).any()]
    holding.sort(key=lambda grasp: grasp.axes != "xyz")
    if not holding or holding[0].axes != "xyz":
        return None
    if not all(grasp.holds(experiment.t_s).all() for grasp in holding):
        return None
    motions = [grasp.poses.at(experiment.t_s) for grasp in holding]
    together = all(
        np.allclose(a, b, atol=1e-9)
        for motion in motions[1:]
        for a, b in zip(motion, motions[0], strict=True)
    )
    return holding[0] if together else None


@dataclass(frozen=True, eq=False)
class Sway:
    """The modes of a body in its grasp as its markers show them.

    Attributes
    ----------
    places_m : (M, 3) on the undeformed body
    omega : (K,) angular frequencies over the first one
    shapes : (K, M, 3) displacement of the markers
    pushed : (K, 3) φᵀM for an acceleration common to all nodes
    turned : (K, 3, 3) φᵀM xᵀ for one that is linear in the place
    size_m : float
        Diagonal of the body.
    from_rest : bool
        Whether it starts in its equilibrium, else undeformed.
    """

    places_m: Array
    omega: Array
    shapes: Array
    pushed: Array
    turned: Array
    size_m: float
    from_rest: bool

    @classmethod
    def of(cls, experiment: Experiment, constants: Mapping[str, float]) -> Sway:
        """Of an experiment; of the constants only ratios count."""
        body, markers = experiment.body, experiment.markers
        forces = Forces.of(experiment, experiment.t_s[:1], body.theta(constants)).undriven()
        modes = natural_modes(forces, body.nodes_m, experiment.free_dofs, MODES)
        weighed = modes.shapes * forces.mass.kg[0, ::3, None]
        omega = modes.angular_frequencies_rad_s
        return cls(
            markers.observe(body.nodes_m),
            omega / omega[:1],
            markers.observe(modes.shapes),
            weighed.sum(axis=1),
            np.einsum("kni,nj->kij", weighed, body.nodes_m),
            float(np.linalg.norm(np.ptp(body.nodes_m, axis=0))),
            experiment.start == "equilibrium",
        )

    def predicted(self, described: Described) -> Array:
        """(S, T, M, 3) markers of bodies of S stiffnesses and dampings, the last one rigid."""
        scale = described.mesh_scale
        loads = self._loads(described)
        step_s = float(described.t_s[1] - described.t_s[0])
        omega = self._omega(scale)
        states = [
            _responses(omega, ratio, loads, step_s, self.from_rest) for ratio in DAMPING_RATIOS
        ]
        q = np.concatenate([*states, np.zeros((1, *loads.shape))])
        swayed = np.tensordot(q, self.shapes, axes=1)
        limit = scale * self.size_m
        # Small strains are assumed: what sways farther than the body is long, stays there.
        far = np.linalg.norm(swayed, axis=3, keepdims=True) / limit
        seen = described.carry(scale * self.places_m + swayed / np.maximum(far, 1.0))
        return later(seen, described.t_s, described.lag_s) if described.lag_s else seen

    def _omega(self, scale: float) -> Array:
        """(S, K) angular frequencies."""
        softest = np.sqrt(STANDARD_GRAVITY_M_S2 / (SOFTEST_SAG * scale * self.size_m))
        stiffnesses = softest * np.geomspace(1.0, STIFFEST, STIFFNESSES)
        return np.asarray(np.outer(stiffnesses, self.omega), dtype=np.float64)

    def _loads(self, described: Described) -> Array:
        """(T, K) of gravity and the grasp's acceleration."""
        inverse = described.rotations.transpose(0, 2, 1)
        step_s = float(described.t_s[1] - described.t_s[0])
        lift = described.gravity_m_s2 - _acceleration(described.translations_m, step_s)
        pushed = np.einsum("tij,tj->ti", inverse, lift)
        spun = inverse @ _acceleration(described.rotations, step_s) * described.mesh_scale
        return pushed @ self.pushed.T - np.einsum("tij,kij->tk", spun, self.turned)


def later(seen: Array, t_s: Array, lag_s: float) -> Array:
    """Predictions (S, T, M, 3) seen `lag_s` later, NaN where they end."""
    at = np.arange(len(t_s)) - lag_s / (t_s[1] - t_s[0])
    low = np.clip(np.floor(at).astype(int), 0, len(t_s) - 2)
    share = (at - low)[:, None, None]
    found = (1 - share) * seen[:, low] + share * seen[:, low + 1]
    found[:, (at < 0) | (at > len(t_s) - 1)] = np.nan
    return found


def _acceleration(x: Array, step_s: float) -> Array:
    """Second differences of (T, ...), which rests before the first sample."""
    padded = np.concatenate([x[1:2], x, x[-1:]])
    second = (padded[2:] - 2 * padded[1:-1] + padded[:-2]) / step_s**2
    second[-1] = second[-2]
    return second


def _responses(omega: Array, ratio: float, loads: Array, step_s: float, from_rest: bool) -> Array:
    """(S, T, K) coordinates of oscillators (S, K), exact for loads linear between samples.

    y = q̇ − λ̄q, the imaginary part of which is ω_d q, obeys ẏ = λy + load with λ = −ζω + iω_d.
    """
    damped = omega * np.sqrt(1 - ratio**2)
    root = -ratio * omega + 1j * damped
    fading, of_constant = np.exp(root * step_s), np.expm1(root * step_s) / root
    of_rise = (of_constant - step_s) / (root * step_s)
    pushes = of_constant * loads[:-1, None] + of_rise * np.diff(loads, axis=0)[:, None]
    at_rest = -root.conj() * loads[0] / omega**2
    found = [at_rest if from_rest else np.zeros_like(root)]
    for push in pushes:
        found.append(fading * found[-1] + push)
    return np.imag(np.stack(found, axis=1)) / damped[:, None]
