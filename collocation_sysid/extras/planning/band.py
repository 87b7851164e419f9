"""Deviations of the executed points of a plan from their prediction, to first order.

An effect acts in the recording and in the execution. With the derivatives of a point y by constants q
and nuisance parameters φ, and its change E_k by effect k along the plan, the deviation is

    d = ∂y/∂(q, φ) δ(q, φ) + Σ E_k b_k + ∂y/∂g (g − ĝ),

where δ(q, φ) and b have the joint posterior of the run: what acts alike in both motions cancels. The
grip g of another session is drawn anew from its prior, and the plan has the grip ĝ of the recording.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...common.array_types import Array
from ...fem.schemes import as_scheme
from ...program.collocation import Collocation
from ...recording import Experiment
from ...recording.nuisance import GRIP, PLACE
from ...statistics.budget.consider_analysis import changed_residuals
from ...statistics.budget.discretisation_error import MESH_ORDER, extrapolated
from ...statistics.budget.effect_estimates import EFFECT, JointPosterior
from ...statistics.budget.mesh_error import mesh_residual_changes
from ...statistics.budget.systematic_effects import ASSUMPTIONS, DISCRETISATION
from ...statistics.linearised import linearise_fit
from .planned_body import PlannedBody

# Sources of the deviations beside effects.
OF_GRIP, OTHERS = "grip", "noise, places of markers, mesh and time step"


def point_deviations(
    body: PlannedBody, joint: JointPosterior, moved: Experiment, x: Array, steps_m: Array
) -> tuple[Array, dict[str, Array]]:
    """Return the mean (T, P, 3) [m] of the deviations of the points of a plan at all samples, and
    their variances (T, P, 3) [m²] by source: the effects, the grip, and others together.

    Parameters
    ----------
    moved : Experiment
        Experiment of the plan, whose markers are the points.
    x : (N, 3n) array
        Its motion [m].
    steps_m : (T, P, 3) array
        Change of the points with a quarter of the time step, which the prediction contains [m].
    """
    problem, nuisance = body.problem, body.template.nuisance
    instruments = {r.name: None for r in nuisance.kinds if not (r.changes_motion or r == PLACE)}
    own = [row for row in nuisance.own if row.changes_motion]
    recorded = replace(moved, nuisance=replace(nuisance, **instruments, own=own))
    substeps = (len(x) - 1) // (len(moved.t_s) - 1)
    collocation = Collocation(
        [recorded], problem.parameters, scheme=problem.scheme, substeps=substeps
    )
    (transcription,) = collocation.transcriptions
    z = collocation.pack(np.append(body.q, transcription.guess_phi), [x])
    sigma_m = moved.markers.sigma_m[:, None]
    by_p = np.moveaxis(linearise_fit(collocation, z).blocks[0].jacobian, 3, 0) * sigma_m
    slopes = dict(zip(collocation.parameter_names, by_p, strict=True))
    mean_m, of_grip = np.zeros_like(steps_m), np.zeros_like(steps_m)
    for entry, name in zip(
        transcription.nuisance.entries, transcription.nuisance.names, strict=True
    ):
        if entry.row in GRIP:
            of_grip += slopes[name] ** 2
        # In the unit of its label.
        slopes[name] = slopes[name] / entry.sigma
        mean_m -= body.grip.get(name, 0.0) * slopes[name]
    effects = [n.removeprefix(EFFECT) for n in joint.names if n.startswith(EFFECT)]
    known = {name.partition(" ")[0] for name in effects}
    deviations = problem.assumed_deviations
    sizes = [(row, deviations[row.name] or 0.0) for row in ASSUMPTIONS if row.name in known]
    changes = changed_residuals(collocation, z, sizes)
    by_effect = dict(
        zip(changes.names, np.moveaxis(changes.blocks[0], 3, 0) * sigma_m, strict=True)
    )
    mesh, time_step = DISCRETISATION
    if mesh.name in known:
        change = mesh_residual_changes(collocation, z)[0][..., 0] * sigma_m
        by_effect[mesh.name] = (mesh.considered or 1.0) * extrapolated(change, MESH_ORDER)
    if time_step.name in known:
        order = 2 * as_scheme(problem.scheme).order
        by_effect[time_step.name] = (time_step.considered or 1.0) * extrapolated(steps_m, order)
        mean_m -= steps_m
    slopes |= {EFFECT + name: change_m for name, change_m in by_effect.items()}
    at = np.stack([slopes.get(name, np.zeros_like(steps_m)) for name in joint.names], axis=-1)
    mean_m += at @ joint.offset
    variances = {OTHERS: np.sum(at @ joint.covariance * at, axis=-1), OF_GRIP: of_grip}
    for row, change_m in zip(joint.sources, np.moveaxis(at @ joint.by_source, -1, 0), strict=True):
        variances[row] = variances.get(row, 0.0) + change_m**2
        variances[OTHERS] = variances[OTHERS] - change_m**2
    return mean_m, variances
