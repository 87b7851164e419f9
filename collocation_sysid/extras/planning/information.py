"""Information of a plan: how well a recording of the planned motion determines the constants.

The recording has the markers, force sensors and nuisance parameters of the problem's recording.
With the information M(c) of its measurements about the parameters q, from which the nuisance
parameters are eliminated with their priors, and the covariance P of q before the recording, the
covariance after it is C = (P⁻¹ + M)⁻¹ = L Lᵀ. The criterion is the mean square of the half widths
of the 95 % intervals of the constants, in units of the wanted one: tr(D C Dᵀ) = ‖Lᵀ Dᵀ‖².

Its expansion to second order in a change Σ d_j M_j of the information is a sum of squares,

    ‖½ Lᵀ Dᵀ − Σ d_j Lᵀ M_j C Dᵀ‖² + constant,

so that a plan takes the same steps as for references.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from ...common.array_types import Array
from ...errors import InputError, require_among
from ...program.collocation import Collocation
from ...program.driven_motion import DrivenMotion
from ...recording import Experiment
from ...recording.measurement_selection import moved_grasp
from ...statistics.budget.combined_intervals import NORMAL_95
from ...statistics.estimates import UNDETERMINED, relative_derivatives
from ...statistics.linearised import DerivedModuli, least_squares_of_fit, linearise_fit
from .planned_body import PlannedBody
from .task import InformationSection

# Change of an unknown for differences of the information.
DIFFERENCE = 1e-6


def recorded_information(
    body: PlannedBody, driven: DrivenMotion, moved: Experiment, x: Array
) -> Array:
    """Return the information (nq, nq) about the parameters q of a recording of the motion
    x (N, 3n) [m] of the experiment of a plan, without the priors of q.
    """
    problem, template, t_s = body.problem, body.template, moved.t_s
    # Measurements are placeholders: the information does not depend on their values.
    grasps = [
        moved_grasp(replace(each, wrench=held.wrench), each.poses, t_s)
        for each, held in zip(moved.grasps, template.grasps, strict=True)
    ]
    tracks = np.zeros((len(t_s), len(template.markers.names), 3))
    recording = replace(
        moved,
        grasps=grasps,
        markers=template.markers.with_samples(t_s, tracks),
        nuisance=template.nuisance,
    )
    substeps = driven.transcription.substeps
    collocation = Collocation(
        [recording], problem.parameters, scheme=problem.scheme, substeps=substeps
    )
    p = np.append(driven.q, collocation.transcriptions[0].guess_phi)
    fit = linearise_fit(collocation, collocation.pack(p, [x]))
    shared = least_squares_of_fit(fit).marginal(fit.shared_count)
    return shared.information - np.diag(fit.prior_jacobian[: fit.shared_count] ** 2)


def root_after(root_before: Array, information: Array) -> Array:
    """Return a root L (nq, r) of the covariance after a recording with this information (nq, nq),
    from a root of the covariance before it.
    """
    whole = np.eye(root_before.shape[1]) + root_before.T @ information @ root_before
    return solve_triangular(np.linalg.cholesky(whole), root_before.T, lower=True).T


def root_of_covariance(covariance: Array) -> Array:
    """Return a root (nq, nq) of a covariance that may be singular."""
    variances, directions = np.linalg.eigh(covariance)
    return directions * np.sqrt(np.maximum(variances, 0.0))


@dataclass(frozen=True, eq=False)
class InformationCriterion:
    """Widths of the intervals of constants after a recording of a plan."""

    section: InformationSection
    body: PlannedBody
    driven: DrivenMotion
    # Function of the unknowns (c,) that returns the experiment of the plan.
    moved_experiment: Callable[[Array], Experiment]

    def require_identifiable(self) -> None:
        """Raise an `InputError` if a constant is not estimated, or nothing would be measured."""
        template = self.body.template
        if not template.markers.names and not template.wrenches:
            raise InputError(
                "the recording has neither markers nor a force sensor, from which constants could "
                "be identified; expected a recording that has",
                None,
                where="information",
            )
        for name in self.section.constants:
            require_among(name, self._known_slopes, where="information.constants", count="some")

    @property
    def _known_slopes(self) -> dict[str, Array]:
        """Derivatives (nq,) by q, over the value, of estimated constants, and of moduli that follow
        from these.
        """
        parameters, q = self.body.problem.parameters, self.driven.q
        rows = np.diag(relative_derivatives(parameters, q))
        slopes = {parameters.free[k].name: rows[k] for k in parameters.scalar_coordinates}
        moduli = DerivedModuli.from_bodies([self.driven.transcription.constants], q)
        for name, by_q in moduli.derivatives.items():
            if by_q.any():
                slopes[name] = by_q / moduli.values[name]
        return slopes

    @cached_property
    def half_width_slopes(self) -> Array:
        """Derivatives (k, nq) by q of the wanted constants, over their values, times 1.96."""
        return NORMAL_95 * np.array([self._known_slopes[name] for name in self.section.constants])

    @cached_property
    def root_before(self) -> Array:
        """Root (nq, nq) of the covariance of q before the recording: of the noise of the run, or
        of the priors.
        """
        covariance = self.body.statistical_covariance
        if covariance is not None:
            return root_of_covariance(covariance)
        parameters, q = self.body.problem.parameters, self.driven.q
        widest = relative_derivatives(parameters, q) / UNDETERMINED
        return np.diag(1 / np.hypot(parameters.prior_residuals(q)[1], widest))

    def _information(self, c: Array, x: Array) -> Array:
        return recorded_information(self.body, self.driven, self.moved_experiment(c), x)

    def half_widths(self, c: Array, x: Array) -> Array:
        """Return the half widths (k,) of the 95 % intervals of the constants after a recording of
        the motion x (N, 3n) [m] at the unknowns c, relative to the values.
        """
        root = root_after(self.root_before, self._information(c, x))
        return np.linalg.norm(self.half_width_slopes @ root, axis=1)

    def value(self, c: Array, x: Array) -> float:
        """Return the criterion for a motion x (N, 3n) [m] at the unknowns c."""
        return float(np.mean((self.half_widths(c, x) / self.section.half_width) ** 2))

    def suffices(self, c: Array, x: Array) -> bool:
        """Return whether no interval is wider than wanted."""
        return bool(self.half_widths(c, x).max() <= self.section.half_width)

    def linearise(self, c: Array, x: Array, slopes: Array) -> tuple[Array, Array]:
        """Return the criterion near the unknowns c (c,) as a sum of squares, to a constant: the
        derivatives (m, c) of residuals, and their values (m,).

        Parameters
        ----------
        x : (N, 3n) array
            Motion [m].
        slopes : (N, 3n, c) array
            Its derivatives by the unknowns.
        """
        wanted = self.half_width_slopes.T / self.section.half_width
        wanted = wanted / np.sqrt(len(self.section.constants))
        information = self._information(c, x)
        root = root_after(self.root_before, information)
        goal = root.T @ wanted
        columns = []
        for k, way in enumerate(DIFFERENCE * np.eye(len(c))):
            near = self._information(c + way, x + DIFFERENCE * slopes[..., k])
            change = (near - information) / DIFFERENCE
            columns.append(-(root.T @ change @ root @ goal).ravel())
        return np.column_stack(columns), goal.ravel() / 2
