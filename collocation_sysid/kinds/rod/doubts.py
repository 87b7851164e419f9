"""Likely mistakes in the description of a rod, and mirror images of it.

Where gravity, the motion of the clamp and all that was measured lie in a plane, the mirror image of a
motion by this plane is a motion as well, with the same measurements. Directors are mirrored such that
they keep their place in the clamp and stay right-handed: D ↦ M D S with M = I − 2 n nᵀ, n the normal
of the plane, and S = I − 2 ν νᵀ, ν = Dᵀ n in the clamp. The curvatures κ, the axial vector of Dᵀ D′,
become −S κ = 2 ν (ν·κ) − κ: the one that bends in the plane remains, the others change their signs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...common.array_types import Array
from ...errors import InputError, SimulationError
from ...fem.laws.constants import symbol_of, without_region
from ...judge.doubt import Correction, Doubt
from ...methods.reduced_space import ReducedSpace
from ...methods.solution import Solution
from ...methods.starts.initial_trajectories import associated_at_guess
from ...program.experiment_iterate import ExperimentIterate
from ...program.measured_motion import fitted_values
from ...recording.experiment import Experiment
from ...recording.loads import PointMass
from ...recording.markers import Markers
from ...statistics.hypothesis import Hypothesis
from ...statistics.thresholds import INDISTINGUISHABLE
from .effects import end_mass_effect, free_end
from .element import frames_of_sections

# Sum of squared changes of markers by the reflection, over the loss, above which it is no image.
REFUTED = 10.0
# Sweeps from the mirror image of an answer, which has the same loss where it is one.
MOST_SWEEPS = 15


def _with_end_mass(experiment: Experiment, size: Array) -> Correction:
    mass_kg = float(size[0])
    if mass_kg <= 0:
        return None
    end = PointMass(free_end(experiment), mass_kg)
    return replace(experiment, masses=[*experiment.masses, end]), {"mass_g": 1e3 * mass_kg}


ROWS = (Doubt("end-mass", "kg", _with_end_mass, effect=end_mass_effect, mean=0.0, wide=0.1),)


def mirror_images(solution: Solution, _: Mapping[str, float | None]) -> list[Hypothesis]:
    """Return the hypothesis, as a list, that a mirror image of the rods fits as well as the answer;
    empty without estimated natural curvatures.
    """
    parameters, stated = solution.collocation.parameters, solution.parameters
    free = {item.name: stated[item.name] for item in parameters.free}
    body = solution.parts[0].transcription.body
    indices = body.natural_strain_indices
    names = [[*body.constants][k] for k in indices]
    names = [name if name in free else without_region(name) for name in names]
    if not free.keys() & names:
        return []
    centre_m, normal, directors = _plane(solution)
    loss = solution.history[-1].loss
    if _reflected_loss(solution.parts[0], centre_m, normal) > REFUTED * max(1.0, loss):
        return []
    strains = body.theta_from_values(stated)[indices].reshape(-1, 3)
    across = np.append(normal @ directors, 0.0)
    across /= np.linalg.norm(across)
    mirrored = 2 * np.outer(strains @ across, across) - strains
    image = {n: each for n, each in zip(names, mirrored.ravel(), strict=True) if n in free}
    limit = loss + INDISTINGUISHABLE
    try:
        begun = parameters.with_estimates(free | image)
        method = ReducedSpace(max_iterations=MOST_SWEEPS, largest_loss=limit)
        refit = method(associated_at_guess(solution.collocation.with_parameters(begun)))
    except (InputError, SimulationError):
        return []
    refit.unless_interrupted()
    found = refit.parameters
    returned = sum(abs(found[n] - image[n]) - abs(found[n] - stated[n]) for n in image) >= 0
    if returned or not refit.history or refit.history[-1].loss > limit:
        return []
    other = [n for n in image if not np.isclose(found[n], stated[n], rtol=0.1)]
    texts = ([f"{symbol_of(n)} = {at[n]:.3g} 1/m" for n in other] for at in (found, stated))
    data: dict[str, object] = dict(zip(("found", "stated"), texts, strict=True))
    return [Hypothesis("several/mirror", data=data, strength=1.0)]


def _plane(solution: Solution) -> tuple[Array, Array, Array]:
    """Return a point (3,) [m] and the normal (3,) of the plane that has gravity, the motion of the
    clamp and measured markers of the first recording, and d₁ and d₂ (3, 2) in the clamp.
    """
    experiment, x = solution.parts[0].transcription.experiment, solution.positions_m[0]
    held = experiment.body_grasps[0].nodes[0] // 3
    clamps = [(at[held], frame[held]) for at, frame in map(frames_of_sections, x)]
    centres, frames = map(np.array, zip(*clamps, strict=True))
    away_m = np.nan_to_num(experiment.markers.positions_m - centres[0]).reshape(-1, 3)
    moved_m = np.vstack([centres - centres[0], away_m]) / x.std()
    rows = np.vstack([experiment.gravity_m_s2, frames[:, :, 0], moved_m])
    return centres[0], np.linalg.svd(rows, full_matrices=False)[2][-1], frames[0, :, 1:]


def _reflected_loss(part: ExperimentIterate, centre_m: Array, normal: Array) -> float:
    """Return the sum of the squared changes of predicted markers, in σ, by a reflection."""
    pairs = zip(part.transcription.experiment.measurements, fitted_values(part), strict=True)
    changes = [
        2
        * np.multiply.outer((values.reshape(len(values), -1, 3) - centre_m) @ normal, normal)
        / np.where(np.isfinite(each.positions_m), each.sigma_m[:, None], np.inf)
        for each, values in pairs
        if isinstance(each, Markers) and isinstance(values, np.ndarray)
    ]
    return float(sum(np.nansum(change**2) for change in changes))
