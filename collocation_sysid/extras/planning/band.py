"""Deviations of the executed points of a plan from their prediction, to first order.

An effect acts in the recording and in the execution. With the derivatives of a point y by constants q
and nuisance parameters φ, and its change E_k by effect k along the plan, the deviation is

    d = ∂y/∂(q, φ) δ(q, φ) + Σ E_k b_k + ∂y/∂g (g − ĝ),

where δ(q, φ) and b have the joint posterior of the run: what acts alike in both motions cancels. The
grip g of another session is drawn anew from its prior, and the plan has the grip ĝ of the recording;
a grip that recordings share is one of φ.
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
from ...statistics.budget.effect_estimates import EFFECT
from ...statistics.budget.mesh_error import mesh_residual_changes
from ...statistics.budget.systematic_effects import ASSUMPTIONS, DISCRETISATION
from ...statistics.linearised import linearise_fit
from .planned_body import PlannedBody

# Sources of the deviations beside effects.
OF_GRIP, DESCRIPTION, OTHERS = "grip", "description", "noise, places of markers, mesh and time step"


def point_deviations(
    body: PlannedBody, moved: Experiment, x: Array, steps_m: Array
) -> tuple[Array, dict[str, Array]] | None:
    """Return the mean (T, P, 3) [m] of the deviations of the points of a plan at all samples, and
    their variances (T, P, 3) [m²] by source; None without posterior.

    Parameters
    ----------
    moved : Experiment
        Experiment of the plan, whose markers are the points.
    x : (N, 3n) array
        Its motion [m].
    steps_m : (T, P, 3) array
        Change of the points with a quarter of the time step, which the prediction contains [m].
    """
    problem, nuisance, joint = body.problem, body.template.nuisance, body.joint
    if joint is None:
        return None
    instruments = {r.name: None for r in nuisance.kinds if not (r.changes_motion or r == PLACE)}
    own = [row for row in nuisance.own if row.changes_motion]
    moved = replace(moved, nuisance=replace(nuisance, **instruments, own=own))
    substeps = (len(x) - 1) // (len(moved.t_s) - 1)
    collocation = Collocation([moved], problem.parameters, problem.scheme, substeps)
    (transcription,) = collocation.transcriptions
    z = collocation.pack(np.append(body.q, transcription.guess_phi), [x])
    sigma_m = moved.markers.sigma_m[:, None]
    by_p = np.moveaxis(linearise_fit(collocation, z).blocks[0].jacobian, 3, 0) * sigma_m
    slopes = dict(zip(collocation.parameter_names, by_p, strict=True))
    mean_m = of_grip = zero = 0 * steps_m
    by_nuisance = transcription.nuisance
    for entry, name in zip(by_nuisance.entries, by_nuisance.names, strict=True):
        if entry.row in GRIP and entry.row.name not in nuisance.scope:
            of_grip = of_grip + slopes[name] ** 2
            mean_m = mean_m - body.grip.get(name, 0.0) / entry.sigma * slopes[name]
        # In the unit of its label.
        slopes[name] = slopes[name] / entry.sigma
    known = {
        name.removeprefix(EFFECT).partition(" ")[0]
        for name in joint.names
        if name.startswith(EFFECT)
    }
    sizes = problem.assumed_deviations
    assumed = [(row, sizes[row.name] or 0.0) for row in ASSUMPTIONS if row.name in known]
    changes = changed_residuals(collocation, z, assumed)
    by_effect = np.moveaxis(changes.blocks[0], 3, 0) * sigma_m
    slopes |= zip([EFFECT + name for name in changes.names], by_effect, strict=True)
    mesh, time_step = DISCRETISATION
    if mesh.name in known:
        change = mesh_residual_changes(collocation, z)[0][..., 0] * sigma_m
        slopes[EFFECT + mesh.name] = (mesh.considered or 1.0) * extrapolated(change, MESH_ORDER)
    if time_step.name in known:
        change = extrapolated(steps_m, 2 * as_scheme(problem.scheme).order)
        slopes[EFFECT + time_step.name] = (time_step.considered or 1.0) * change
        mean_m = mean_m - steps_m
    at = np.stack([slopes.get(name, zero) for name in joint.names], axis=-1)
    of_sources = np.moveaxis(at @ joint.by_source, -1, 0) ** 2
    others = (at @ joint.covariance * at).sum(axis=-1) - of_sources.sum(axis=0)
    variances = {OTHERS: others, OF_GRIP: of_grip, DESCRIPTION: zero + body.description_std_m**2}
    for row, each in zip(joint.sources, of_sources, strict=True):
        variances[row] = variances.get(row, 0.0) + each
    return mean_m + at @ joint.offset, variances
