"""The collocation NLP: all node positions at all timesteps beside the parameters.

    minimise   L(q, x, φ) = Σ ρ(‖(ŷ − y(x, φ)) / σ‖) + priors(q) + Σ φ²
    subject to c_{e,t,i}(x, θ(q), φ) = 0 for free dofs, x_{e,t,i} = u_t x̄_i for grasped ones.

Variables z, in this order:

=================  =========================================================================
q                  of each estimated parameter, in the order of `Parameters.free`
x_{e,t,i} / ℓ_e    positions: experiment e, grid time t, dof i = 3·node + axis, the last
                   index fastest; ℓ_e is the mean edge length
φ_e                the own unknowns of experiment e, see `nlp.local`; experiment by experiment
=================  =========================================================================

Constraints g, in this order:

=================  =========================================================================
c_{e,t,i} / f_e    equations of motion: experiment e, grid time t from 0 (start in
                   equilibrium) or 1, free dofs i ascending; f_e is the mean of
                   |∂c_t/∂x_t| ℓ_e at the guess
(x − u x̄) / ℓ_e    for dofs grasped for a while only, in place of c at those times; and with
                   explicit grasps for all grasped ones, so that every dof has a row
=================  =========================================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index
from ..errors import InputError
from ..experiment.experiment import Experiment
from .parameters import Parameters
from .schemes import Scheme
from .segment import Segment
from .setting import Setting


@dataclass(frozen=True)
class Violation:
    """One unsatisfied equation of motion."""

    experiment: str
    time_s: float
    node: int
    axis: str
    newtons: float

    def __str__(self) -> str:
        return (
            f"{self.experiment}: t = {self.time_s:.4g} s, node {self.node}, {self.axis}: "
            f"{self.newtons:+.3g} N"
        )


class Collocation:
    """Values and derivatives of the collocation NLP of one or several experiments.

    Parameters
    ----------
    experiments : sequence of Experiment
        They share the parameters; those for validation are left out.
    parameters : Parameters
    scheme : str or Scheme, default "midpoint"
    substeps : int, default 1
        Grid steps between samples.
    explicit_grasps : bool, default False
        Grasped nodes as constraint rows instead of bounds.
    huber : float, optional
        Huber's loss beyond this many standard deviations, see `Observation`.

    Raises
    ------
    InputError
        If nothing is to be fitted.
    """

    def __init__(
        self,
        experiments: Sequence[Experiment],
        parameters: Parameters,
        scheme: str | Scheme = "midpoint",
        substeps: int = 1,
        explicit_grasps: bool = False,
        huber: float | None = None,
    ) -> None:
        fitted = [experiment for experiment in experiments if not experiment.validation]
        if not fitted:
            raise InputError("every experiment is for validation: there is nothing to fit")
        if substeps < 1:
            raise InputError(f"substeps = {substeps}, expected at least 1")
        if huber is not None and not huber > 0:
            raise InputError(f"huber = {huber:g}, expected a positive number", None, "solver")
        self.parameters = parameters
        self.huber = huber
        self.scheme = scheme
        self.substeps = substeps
        self.nq = len(parameters.free)
        parameters.fit({id(e.body): e.body for e in fitted}.values())
        self.segments = [
            Segment(experiment, scheme, substeps, parameters, explicit_grasps, huber)
            for experiment in fitted
        ]
        sizes = [segment.variables for segment in self.segments]
        self._x_starts = self.nq + np.concatenate([[0], np.cumsum(sizes)])
        own = [segment.local.size for segment in self.segments]
        self._phi_starts = self._x_starts[-1] + np.concatenate([[0], np.cumsum(own)])
        rows = [segment.constraints for segment in self.segments]
        self._row_starts = np.concatenate([[0], np.cumsum(rows)])
        self.loss_scale = 1.0 / max(1, self.measurements)

    # Sizes and layout -------------------------------------------------------------------------

    @property
    def variables(self) -> int:
        """Length of z."""
        return int(self._phi_starts[-1])

    @property
    def own(self) -> int:
        """Number of the experiments' own unknowns φ, all together."""
        return int(self._phi_starts[-1] - self._phi_starts[0])

    @property
    def constraints(self) -> int:
        """Length of g."""
        return int(self._row_starts[-1])

    @property
    def measurements(self) -> int:
        """Scalar measurements that are present."""
        return sum(segment.observation.count for segment in self.segments)

    def pack(
        self, q: Array, positions: Sequence[Array], own: Sequence[Array] | None = None
    ) -> Array:
        """Variables z from q (nq,), and each experiment's positions (N, 3n) [m] and φ (or zero)."""
        scaled = [
            np.ravel(x) / segment.length_m
            for x, segment in zip(positions, self.segments, strict=True)
        ]
        return np.concatenate([q, *scaled, *(own or [np.zeros(self.own)])])

    def unpack(self, z: Array) -> tuple[Array, list[Array]]:
        """Parameters q and positions, as `pack` takes them."""
        positions = [
            z[a:b].reshape(segment.grid_rows, segment.dofs) * segment.length_m
            for segment, a, b in self._spans()
        ]
        return z[: self.nq], positions

    def unpack_own(self, z: Array) -> list[Array]:
        """φ of each experiment."""
        return [z[a:b] for a, b in self._phi_spans()]

    @cached_property
    def places(self) -> list[Index]:
        """Positions of each experiment's (q, φ_e) in p = (q, φ_1, φ_2, …)."""
        shared, first = np.arange(self.nq), self.nq - self._phi_starts[0]
        return [np.concatenate([shared, np.arange(a, b) + first]) for a, b in self._phi_spans()]

    @property
    def names(self) -> tuple[str, ...]:
        """What each entry of p is: the parameters' names, then the experiments' own unknowns."""
        own = [name for segment in self.segments for name in segment.local.names]
        return (*(item.name for item in self.parameters.free), *own)

    def parameters_of(self, z: Array) -> Array:
        """All estimated parameters p = (q, φ_1, φ_2, …)."""
        return np.concatenate([z[: self.nq], z[self._phi_starts[0] :]])

    def split(self, p: Array) -> tuple[Array, list[Array]]:
        """Parameters q and the φ of each experiment from p."""
        return p[: self.nq], [p[places[self.nq :]] for places in self.places]

    def settings(self, p: Array) -> list[Setting]:
        """Physical parameters of each experiment at p."""
        q, own = self.split(p)
        return [segment.setting(q, phi) for segment, phi in zip(self.segments, own, strict=True)]

    def prior(self, p: Array) -> tuple[Array, Array]:
        """Residuals of the priors at p, and their slopes; φ counts in its deviations."""
        residuals, slopes = self.parameters.prior(p[: self.nq])
        return (
            np.concatenate([residuals, p[self.nq :]]),
            np.concatenate([slopes, np.ones(self.own)]),
        )

    @property
    def bounds_p(self) -> tuple[Array, Array]:
        """Lower and upper bounds of p."""
        lower, upper = self.parameters.bounds_q
        limits = np.concatenate([np.zeros(0), *(s.local.limits for s in self.segments)])
        return np.concatenate([lower, -limits]), np.concatenate([upper, limits])

    @property
    def guess_p(self) -> Array:
        """The guess of p; own unknowns are zero."""
        return np.concatenate([self.parameters.guess_q, np.zeros(self.own)])

    @property
    def reach_p(self) -> Array:
        """What a trust region of one allows each entry of p."""
        return np.concatenate([np.ones(self.nq), *(s.local.reach for s in self.segments)])

    def _phi_spans(self) -> list[tuple[int, int]]:
        return list(zip(self._phi_starts[:-1], self._phi_starts[1:], strict=True))

    def _parts(self, z: Array) -> list[tuple[Segment, Array, Array, Setting]]:
        """Segments with their positions, φ, and setting."""
        _, positions = self.unpack(z)
        settings = self.settings(self.parameters_of(z))
        return list(zip(self.segments, positions, self.unpack_own(z), settings, strict=True))

    def _spans(self) -> list[tuple[Segment, int, int]]:
        return list(zip(self.segments, self._x_starts[:-1], self._x_starts[1:], strict=True))

    def _row_spans(self) -> list[tuple[int, int]]:
        return list(zip(self._row_starts[:-1], self._row_starts[1:], strict=True))

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of z; equal for what is given."""
        (lower, own_lower), (upper, own_upper) = map(self.split, self.bounds_p)
        lows, highs = zip(*(segment.bounds() for segment in self.segments), strict=True)
        return self.pack(lower, lows, own_lower), self.pack(upper, highs, own_upper)

    # Objective --------------------------------------------------------------------------------

    def objective(self, z: Array) -> float:
        """L divided by the number of measurements."""
        _, positions = self.unpack(z)
        residuals, _ = self.prior(self.parameters_of(z))
        loss = float(residuals @ residuals)
        for segment, x, phi in zip(self.segments, positions, self.unpack_own(z), strict=True):
            loss += segment.observation.loss(x, phi)
        return self.loss_scale * loss

    def gradient(self, z: Array) -> Array:
        """∂objective/∂z."""
        _, positions = self.unpack(z)
        residuals, slopes = self.prior(self.parameters_of(z))
        by_p, by_x = 2 * residuals * slopes, []
        parts = zip(self.segments, positions, self.unpack_own(z), self.places, strict=True)
        for segment, x, phi, places in parts:
            of_x, of_phi = segment.observation.gradient(x, phi)
            by_x.append(of_x.ravel() * segment.length_m)
            by_p[places[self.nq :]] += of_phi
        return self.loss_scale * np.concatenate([by_p[: self.nq], *by_x, by_p[self.nq :]])

    # Constraints ------------------------------------------------------------------------------

    def constraint_values(self, z: Array) -> Array:
        """g, scaled."""
        return np.concatenate(
            [segment.constraint_values(x, setting) for segment, x, _, setting in self._parts(z)]
        )

    @cached_property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of ∂g/∂z by compressed columns."""
        dense = np.arange(self.nq + 1) * self.constraints
        indptr, indices = [dense], [np.tile(np.arange(self.constraints), self.nq)]
        used = int(dense[-1])
        for segment, first_row in zip(self.segments, self._row_starts[:-1], strict=True):
            indptr.append(used + segment.jacobian.indptr[1:])
            indices.append(first_row + segment.jacobian.indices)
            used += segment.jacobian.nnz
        for segment, (a, b) in zip(self.segments, self._row_spans(), strict=True):
            moves = np.isin(np.arange(segment.local.size), segment.local.moving)
            indptr.append(used + np.cumsum(moves * (b - a)))
            indices.append(np.tile(np.arange(a, b), int(moves.sum())))
            used = int(indptr[-1][-1]) if len(moves) else used
        return np.concatenate(indptr), np.concatenate(indices)

    def jacobian_values(self, z: Array, out: Array | None = None) -> Array:
        """Values of ∂g/∂z in the order of `jacobian_structure`."""
        return self.constraints_and_jacobian(z, out)[1]

    def constraints_and_jacobian(self, z: Array, out: Array | None = None) -> tuple[Array, Array]:
        """Constraints g and the values of ∂g/∂z, from one evaluation of the elements."""
        values = np.empty(len(self.jacobian_structure[1])) if out is None else out
        columns = values[: self.nq * self.constraints].reshape(self.nq, self.constraints)
        rows, by_phi = np.empty(self.constraints), []
        used = columns.size
        for (segment, x, _, setting), (a, b) in zip(self._parts(z), self._row_spans(), strict=True):
            here = values[used : used + segment.jacobian.nnz]
            rows[a:b], by_p = segment.constraints_and_jacobian(x, setting, here)
            columns[:, a:b] = by_p[:, : self.nq].T
            by_phi.append(by_p[:, self.nq :].T.ravel())
            used += segment.jacobian.nnz
        values[used:] = np.concatenate(by_phi)
        return rows, values

    def jacobian(self, z: Array) -> sp.csc_array:
        """∂g/∂z as a sparse matrix."""
        indptr, indices = self.jacobian_structure
        shape = (self.constraints, self.variables)
        return sp.csc_array((self.jacobian_values(z), indices, indptr), shape=shape)

    # Lagrangian -------------------------------------------------------------------------------

    @cached_property
    def hessian_structure(self) -> tuple[Index, Index]:
        """The same of the upper triangle of ∇²_z (w L + yᵀ g)."""
        counts = np.arange(self.nq + 1)
        indptr = [counts * (counts + 1) // 2]
        indices = [np.concatenate([np.arange(k) for k in counts])]
        used = int(indptr[0][-1])
        for segment, start, _ in self._spans():
            layout = segment.hessian_layout
            indptr.append(used + layout.x_indptr[1:])
            shift = np.where(layout.x_indices < self.nq, 0, start - self.nq)
            indices.append(layout.x_indices + shift)
            used += layout.x_entries
        for (segment, start, _), (first, _) in zip(self._spans(), self._phi_spans(), strict=True):
            layout = segment.hessian_layout
            indptr.append(used + layout.phi_indptr[1:])
            of_x = layout.phi_indices < segment.variables
            indices.append(layout.phi_indices + np.where(of_x, start, first - segment.variables))
            used += len(layout.phi_indices)
        return np.concatenate(indptr), np.concatenate(indices)

    @cached_property
    def hessian_diagonals(self) -> tuple[Index, Index]:
        """Positions of the diagonal entries of q, and of x, in the values of the Hessian."""
        used = self.nq * (self.nq + 1) // 2
        of_x = []
        for segment in self.segments:
            of_x.append(used + segment.hessian_layout.diagonal)
            used += segment.hessian_layout.x_entries
        return np.cumsum(np.arange(1, self.nq + 1)) - 1, np.concatenate(of_x)

    def hessian_values(
        self, z: Array, loss_weight: float, multipliers: Array, out: Array | None = None
    ) -> Array:
        """Values of ∇²_z (loss_weight · objective + multipliers · g), upper triangle."""
        q = z[: self.nq]
        values = np.empty(len(self.hessian_structure[1])) if out is None else out
        used = self.nq * (self.nq + 1) // 2
        own = used + sum(segment.hessian_layout.x_entries for segment in self.segments)
        by_q = np.zeros((self.nq, self.nq))
        weight = loss_weight * self.loss_scale
        for (segment, x, phi, setting), (a, b) in zip(
            self._parts(z), self._row_spans(), strict=True
        ):
            of_x = segment.hessian_layout.x_entries
            of_phi = segment.hessian_layout.entries - of_x
            here = np.empty(of_x + of_phi) if of_phi else values[used : used + of_x]
            by_q += segment.hessian_values(x, phi, setting, multipliers[a:b], weight, here)
            if of_phi:
                values[used : used + of_x], values[own : own + of_phi] = here[:of_x], here[of_x:]
            used, own = used + of_x, own + of_phi
        _, slopes = self.parameters.prior(q)
        by_q += np.diag(2 * weight * slopes**2)
        rows, columns = np.triu_indices(self.nq)
        order = np.lexsort((rows, columns))
        values[: len(rows)] = by_q[rows[order], columns[order]]
        return values

    def kkt_residual(self, z: Array, multipliers: Array) -> float:
        """Largest violation of the first-order conditions of the whole NLP, in its scaling.

        Stationarity of objective + multipliers · g in every variable that is not given; a
        parameter at a bound may only push against it. And feasibility.
        """
        rows, values = self.constraints_and_jacobian(z)
        indptr, indices = self.jacobian_structure
        jacobian = sp.csc_array((values, indices, indptr), shape=(len(rows), len(z)))
        slope = self.gradient(z) + jacobian.T @ multipliers
        lower, upper = self.bounds()
        slope[lower == upper] = 0
        near = 1e-6
        for part in (slice(self.nq), slice(self._phi_starts[0], None)):
            at_lower, at_upper = (z - lower)[part] < near, (upper - z)[part] < near
            slope[part][at_lower] = np.minimum(slope[part][at_lower], 0)
            slope[part][at_upper] = np.maximum(slope[part][at_upper], 0)
        return float(max(np.abs(slope).max(initial=0.0), np.abs(rows).max(initial=0.0)))

    def hessian(self, z: Array, loss_weight: float, multipliers: Array) -> sp.csc_array:
        """∇²_z (loss_weight · objective + multipliers · g), both triangles, as a sparse matrix."""
        indptr, indices = self.hessian_structure
        values = self.hessian_values(z, loss_weight, multipliers)
        upper = sp.csc_array((values, indices, indptr), shape=(len(z), len(z)))
        return sp.csc_array(upper + sp.triu(upper, 1).T)

    # Reading a point --------------------------------------------------------------------------

    def violations_n(self, z: Array) -> list[Array]:
        """(N, free dofs) residual of the equations of motion of each experiment [N]."""
        return [segment.residual_n(x, setting) for segment, x, _, setting in self._parts(z)]

    def largest_force_n(self, z: Array) -> float:
        """Largest internal or external force on a free dof [N], the yardstick of violations."""
        largest = 0.0
        for segment, x, _, setting in self._parts(z):
            dynamics = setting.dynamics
            internal = dynamics.internal_force(x, setting.theta)
            for force in (internal, dynamics.external_force_n):
                largest = max(largest, float(np.abs(force[:, segment.free_dofs]).max()))
        return largest

    def largest_violations(self, z: Array, count: int = 5) -> list[Violation]:
        """The worst equations of motion in newtons, largest first."""
        found = []
        for segment, residual in zip(self.segments, self.violations_n(z), strict=True):
            flat = np.argsort(-np.abs(residual), axis=None)[:count]
            for t, place in zip(*np.unravel_index(flat, residual.shape), strict=True):
                node, axis = divmod(int(segment.free_dofs[place]), 3)
                found.append(
                    Violation(
                        segment.experiment.name,
                        float(segment.dynamics.t_s[t]),
                        node,
                        "xyz"[axis],
                        float(residual[t, place]),
                    )
                )
        return sorted(found, key=lambda violation: -abs(violation.newtons))[:count]

    def rms_m(self, z: Array) -> float:
        """Root mean square distance of markers from their measurements."""
        _, positions = self.unpack(z)
        squares = samples = 0.0
        for segment, x, phi in zip(self.segments, positions, self.unpack_own(z), strict=True):
            squares += float(segment.observation.squared_distances_m2(x, phi).sum())
            samples += segment.experiment.markers.samples
        return float(np.sqrt(squares / max(1.0, samples)))

    def values(self, z: Array) -> dict[str, float]:
        """The parameters of z by the user's names."""
        return self.parameters.values(z[: self.nq])
