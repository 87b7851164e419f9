"""Collocation program: node positions at all grid times and the parameters as unknowns.

    minimise   L(q, x, φ) = Σ ρ(‖(ŷ − y(x, φ)) / σ‖) + priors(q) + Σ φ²
    subject to c_{e,t,i}(x, θ(q), φ) = 0 for free dofs, x_{e,t,i} = u_t x̄_i for grasped ones.

Variables z, in this order:

=================  =========================================================================
q                  estimated parameters, in the order of `Parameters.free`
x_{e,t,i} / ℓ_e    positions: experiment e, grid time t, dof i = 3·node + axis, the last
                   index fastest; ℓ_e is the mean edge length
φ_e                nuisance parameters of experiment e, see `model.nuisance_map`, experiment by
                   experiment; shared ones are those of the first experiment that has them,
                   see `model.nuisance_map.nuisance_indices`
=================  =========================================================================

History variables, reaction forces, their resultants and pressures of obstacles are eliminated. A
subclass, `lifted.collocation.LiftedCollocation`, has them as variables at the end of z, with
equations at the end of g.

Constraints g, in this order:

=================  =========================================================================
c_{e,t,i} / f_e    equations of motion: experiment e, grid time t from 0 (start in
                   equilibrium) or 1, free dofs i ascending; f_e is the mean of
                   |∂c_t/∂x_t| ℓ_e at the guess, or of a rod a force that bends it
(x − u x̄) / ℓ_e    prescribed displacements, in place of c: of dofs grasped for a part of the
                   time; with `has_grasp_constraints` of all grasped dofs, so that every dof has a
                   constraint
=================  =========================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, ClassVar, get_args

import numpy as np
import scipy.sparse as sp

from ..common.array_types import Array, Index
from ..common.validated_classes import validated
from ..common.validated_types import Positive, Substeps
from ..errors import InputError, require_among
from ..fem.schemes import Scheme, as_scheme
from ..model.nuisance_map import nuisance_indices
from ..model.parameters import Parameters
from ..recording.experiment import Experiment
from .association import Association, shared_associations
from .casadi_functions import CasadiProgram, Hessian
from .experiment_iterate import ExperimentIterate
from .linear_algebra.sparse_assembly import SparseAssembly
from .measurement_models import belongs_to, first_association
from .motion_transcription import Offsets, RowWeights, WeightedHistory
from .transcription import Transcription

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Most pixels of the picture of a pattern along a side.
MOST_PIXELS = 400
# Distance of a parameter from its bound, in units of z, at which it counts as at the bound: more
# than the distance at which interior-point methods stop.
BOUND_TOLERANCE = 1e-6


def convert_variables(z: Array, source: Collocation, target: Collocation) -> Array:
    """Convert the variables z of a program to those of the same program with or without lifted
    variables.

    Parameters
    ----------
    z : (variables,) array
        Variables of the program `source`.
    source : Collocation
        The program that z belongs to.
    target : Collocation
        The same program, with or without lifted variables.

    Returns
    -------
    (target.variable_count,) array
        Variables of `target`, z itself if both have the same number. Lifted variables of the target
        follow from positions and parameters; those of the source are dropped.
    """
    return z if len(z) == target.variable_count else target.pack(*source.unpack(z))


@dataclass(frozen=True)
class Violation:
    """Residual of one equation of motion."""

    experiment: str
    time_s: float  # grid time [s]
    node: int  # index of the node
    axis: str  # "x", "y" or "z"
    residual_n: float  # residual [N]

    def __str__(self) -> str:
        return (
            f"{self.experiment}: t = {self.time_s:.4g} s, node {self.node}, {self.axis}: "
            f"{self.residual_n:+.3g} N"
        )


@validated
@dataclass(frozen=True, eq=False)
class Collocation:
    """Values and derivatives of the collocation program of one or several experiments.

    Attributes
    ----------
    experiments : sequence of Experiment
        Experiments with common parameters q; those for validation are left out.
    parameters : Parameters
        Shared parameters.
    scheme : str or Scheme, default "midpoint"
        Time discretisation.
    substeps : int, default 1
        Grid steps between samples; static experiments have one.
    has_grasp_constraints : bool, default False
        If true, prescribed displacements are constraints instead of bounds.
    huber : float, optional
        Threshold of Huber's loss in standard deviations, see `measurement_residual`; None means a
        quadratic loss.
    associations : mapping of experiment name to Association
        Elements, clock samples and correspondences of the measurements. Experiments that are
        missing, or whose association belongs to another body or other priors, get that of the
        stated places.

    Raises
    ------
    InputError
        If all experiments are for validation, or an option is not positive.
    """

    OTHER_CONSTRUCTORS: ClassVar = ("problem.collocation()",)

    experiments: Sequence[Experiment]
    parameters: Parameters
    scheme: str | Scheme = "midpoint"
    substeps: Substeps = 1
    has_grasp_constraints: bool = False
    huber: Positive | None = None
    associations: Mapping[str, Association] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if all(experiment.validation for experiment in self.experiments):
            raise InputError(
                "every experiment is for validation, so that none is left for the fit; expected at "
                "least one without validation = true"
            )
        as_scheme(self.scheme)  # refuses an unknown one
        # Building the transcriptions checks what experiments share.
        self.parameters.require_constants_of(
            {id(s.body): s.body for s in self.transcriptions}.values()
        )

    # Sizes and layout -------------------------------------------------------------------------

    @cached_property
    def transcriptions(self) -> tuple[Transcription, ...]:
        """Transcriptions of the experiments that are fitted, in their order; validation recordings
        have none.
        """
        fitted = [each for each in self.experiments if not each.validation]
        transcriptions = list[Transcription]()
        for experiment, local in zip(fitted, nuisance_indices(fitted, self.nq), strict=True):
            association = self.associations.get(experiment.name)
            if association is None or not belongs_to(association, experiment):
                association = first_association(experiment)
            transcriptions.append(
                Transcription(
                    experiment,
                    self.parameters,
                    scheme=self.scheme,
                    substeps=1 if experiment.is_static else self.substeps,
                    has_grasp_constraints=self.has_grasp_constraints,
                    huber=self.huber,
                    offsets=transcriptions[-1].next_offsets
                    if transcriptions
                    else Offsets(self.nq, 0),
                    nuisance_indices=local,
                    association=association,
                )
            )
        return _with_shared_associations(
            transcriptions, [transcription.association for transcription in transcriptions]
        )

    def with_parameters(self, parameters: Parameters) -> Collocation:
        """Return the program with other shared parameters, or other guesses of them, and the
        present associations of the measurements, which are not computed again.
        """
        return replace(
            self,
            parameters=parameters,
            associations={each.experiment.name: each.association for each in self.transcriptions},
        )

    @property
    def nq(self) -> int:
        """Number of shared parameters q."""
        return len(self.parameters.free)

    @property
    def nphi(self) -> int:
        """Number of nuisance parameters φ of all fitted experiments; shared ones count once."""
        return int(np.concatenate(self.parameter_indices).max(initial=self.nq - 1)) + 1 - self.nq

    @property
    def variable_count(self) -> int:
        """Number of variables z."""
        return self.phi_columns.stop

    @property
    def constraint_count(self) -> int:
        """Number of constraints g."""
        return self.transcriptions[-1].next_offsets.row

    @property
    def measurement_count(self) -> int:
        """Number of scalar measurements that are compared, of all fitted experiments."""
        return sum(
            int(residual.is_compared.sum())
            for transcription in self.transcriptions
            for residual in transcription.residuals
        )

    @property
    def loss_scale(self) -> float:
        """Factor of the loss in the objective: one over the number of measurements, or 1 without
        any.
        """
        return 1.0 / max(1, self.measurement_count)

    def pack(self, p: Array, positions: Sequence[Array]) -> Array:
        """Return the variables z.

        Parameters
        ----------
        p : (nq + nphi,) array
            Parameters (q, φ_1, φ_2, …).
        positions : sequence of (N, 3n) arrays
            Positions of each fitted experiment [m].

        Returns
        -------
        (variables,) array
            Scaled variables: q, scaled positions, φ.
        """
        pairs = zip(self.transcriptions, positions, strict=True)
        scaled = [np.ravel(x) / transcription.length_m for transcription, x in pairs]
        return np.concatenate([p[: self.nq], *scaled, p[self.nq :]])

    def unpack(self, z: Array) -> tuple[Array, list[Array]]:
        """Return the parameters p (nq + nphi,) and the positions (N, 3n) of each fitted experiment
        [m] from z.
        """
        return self.parameters_from(z), [
            z[transcription.columns].reshape(transcription.grid_times, transcription.dof_count)
            * transcription.length_m
            for transcription in self.transcriptions
        ]

    def parameters_from(self, z: Array) -> Array:
        """Return all estimated parameters p = (q, φ_1, φ_2, …) from z."""
        return np.concatenate([z[: self.nq], z[self.phi_columns]])

    @property
    def phi_columns(self) -> slice:
        """Slice of the nuisance parameters in z."""
        first = self.transcriptions[-1].next_offsets.variable
        return slice(first, first + self.nphi)

    def iterates(self, z: Array) -> list[ExperimentIterate]:
        """Return every fitted experiment at the variables z."""
        return self.iterates_at(*self.unpack(z))

    @cached_property
    def parameter_indices(self) -> list[Index]:
        """Indices (nq + k,) of (q, φ) of each experiment in p."""
        return [transcription.parameter_indices for transcription in self.transcriptions]

    @property
    def threads(self) -> int:
        """Number of threads that every body may use: the least of the bodies' numbers."""
        return min(transcription.body.threads for transcription in self.transcriptions)

    def iterates_at(self, p: Array, positions: Sequence[Array]) -> list[ExperimentIterate]:
        """Return every fitted experiment at parameters and positions, from which all other
        quantities follow.

        Parameters
        ----------
        p : (nq + nphi,) array
            Parameters (q, φ_1, φ_2, …).
        positions : sequence of (N, 3n) arrays
            Positions of each fitted experiment [m], or their first rows.
        """
        return [
            ExperimentIterate(
                transcription, p[: self.nq], phi=p[transcription.nuisance_indices.indices], x=x
            )
            for transcription, x in zip(self.transcriptions, positions, strict=True)
        ]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Name of each entry of p: the parameters' names, then the labels of the
        nuisance parameters; of a shared one, the label in the last experiment that has it.
        """
        names = [item.name for item in self.parameters.free] + [""] * self.nphi
        for transcription in self.transcriptions:
            for place, name in zip(
                transcription.nuisance_indices.indices, transcription.nuisance.names, strict=True
            ):
                names[place] = name
        return tuple(names)

    def with_values(self, values: Mapping[str, float], p: Array) -> Array:
        """Return p (np,) with other values of the entries whose names, see `parameter_names`, have
        one.
        """
        pairs = zip(self.parameter_names, p.tolist(), strict=True)
        return np.array([values.get(name, value) for name, value in pairs], dtype=np.float64)

    def prior_residuals(self, p: Array) -> tuple[Array, Array]:
        """Return residuals (nq + nphi,) of the priors at p, and the derivative (nq + nphi,) of each
        by its own parameter, both in standard deviations.

        A parameter without a prior has the residual and the derivative 0; φ is measured in standard
        deviations already.
        """
        residuals, slopes = self.parameters.prior_residuals(p[: self.nq])
        return (
            np.concatenate([residuals, p[self.nq :]]),
            np.concatenate([slopes, np.ones(self.nphi)]),
        )

    @property
    def parameter_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of p, (nq + nphi,) each; infinite for most φ. For a
        shared φ, the narrowest of all experiments.
        """
        lower, upper = self.parameters.bounds_q
        low, high = (np.full(self.nphi, bound) for bound in (-np.inf, np.inf))
        for transcription in self.transcriptions:
            indices = transcription.nuisance_indices.indices - self.nq
            least, most = transcription.nuisance.bounds(transcription.association.clock_samples)
            low[indices] = np.maximum(low[indices], least)
            high[indices] = np.minimum(high[indices], most)
        return np.concatenate([lower, low]), np.concatenate([upper, high])

    # Where recordings are read ----------------------------------------------------------------

    @property
    def excluded_loss(self) -> float:
        """Loss of measurements that the present correspondences exclude.

        A loss leaves out points beyond the gate of a camera: compared by it, the point that loses
        most of them would seem the best.
        """
        return sum(
            model.excluded_loss
            for transcription in self.transcriptions
            for model in transcription.main_residuals
        )

    def follow_estimates(
        self, p: Array, positions: Sequence[Array] = ()
    ) -> tuple[Collocation, Array]:
        """Return the program with associations that belong to the estimates p, and p relative to
        them; see `Transcription.follow_estimates`.

        Parameters
        ----------
        p : (nq + nphi,) array
            Parameters; not modified.
        positions : sequence of (rows, 3n) arrays
            First rows of each experiment [m], which cameras need; empty without cameras.

        Returns
        -------
        (Collocation, array)
            The program with the new associations, which is self if none has changed, and p in it.
        """
        rows = positions or [
            np.zeros((0, transcription.dof_count)) for transcription in self.transcriptions
        ]
        pairs = zip(self.transcriptions, rows, strict=True)
        updates = [s.follow_estimates(p[s.nuisance_indices.indices], x) for s, x in pairs]
        if all(
            association is s.association
            for (association, _), s in zip(updates, self.transcriptions, strict=True)
        ):
            return self, p
        return self._with_associations(
            [association for association, _ in updates], p, phis=[phi for _, phi in updates]
        )

    def place_unknown_markers(
        self, p: Array, positions: Sequence[Array], only_poses: bool = False
    ) -> tuple[Collocation, Array]:
        """Return the program with unknown marker places and poses of cameras initialised before
        a solve, and p in it; see `Transcription.place_unknown_markers`.

        Parameters
        ----------
        p : (nq + nphi,) array
            Parameters; not modified.
        positions : sequence of (rows, 3n) arrays
            First rows of each experiment [m].
        only_poses : bool
            Whether to keep the correspondences of cameras and align their poses alone.

        Returns
        -------
        (Collocation, array)
            The program with the new associations, and p in it; self and p if no experiment has
            unknown places or cameras.
        """
        if not any(transcription.rows_to_place for transcription in self.transcriptions):
            return self, p
        updates = [
            part.transcription.place_unknown_markers(part.phi, part.x, only_poses=only_poses)
            for part in self.iterates_at(p, positions)
        ]
        return self._with_associations(
            [association for association, _ in updates], p, phis=[phi for _, phi in updates]
        )

    def with_marker_places(self, places_m: Sequence[Array]) -> Collocation:
        """Return the program with associations centred at given marker places, one array (M, 3) [m]
        on the undeformed body for each fitted experiment.
        """
        associations = [
            s.association.centred_at(m) for s, m in zip(self.transcriptions, places_m, strict=True)
        ]
        transcriptions = [
            s.with_association(c) for s, c in zip(self.transcriptions, associations, strict=True)
        ]
        return self._with_associations(
            associations, self.guess_p, phis=[s.guess_phi for s in transcriptions]
        )[0]

    def _with_associations(
        self, associations: Sequence[Association], p: Array, phis: Sequence[Array]
    ) -> tuple[Collocation, Array]:
        """Return the program with other associations, and p with `phis`, which refer to these."""
        # Of shared entries, those of the first experiment are used; caches of motions are shared.
        updated = self._combine_parameters(p[: self.nq], phis)
        transcriptions = _with_shared_associations(self.transcriptions, associations)
        other = replace(
            self, associations={s.experiment.name: s.association for s in transcriptions}
        )
        # The same transcriptions, with the values that they have cached.
        vars(other)["transcriptions"] = transcriptions
        return other, updated

    @property
    def guess_p(self) -> Array:
        """Guess of p: that of q, and φ at the centres of the associations."""
        return self._combine_parameters(
            self.parameters.guess_q, [s.guess_phi for s in self.transcriptions]
        )

    def _combine_parameters(self, q: Array, phis: Sequence[Array]) -> Array:
        """Return p from q and φ of each experiment, the first of shared ones."""
        p = np.concatenate([q, np.zeros(self.nphi)])
        for transcription, phi in reversed([*zip(self.transcriptions, phis, strict=True)]):
            p[transcription.nuisance_indices.indices] = phi
        return p

    @property
    def reach_p(self) -> Array:
        """Scale (nq + nphi,) of p: the change of each entry that a trust region of
        radius one allows, which is one for q.
        """
        return self._combine_parameters(
            np.ones(self.nq), [s.nuisance.step_limits for s in self.transcriptions]
        )

    def bounds(self) -> tuple[Array, Array]:
        """Return lower and upper bounds of z, (variables,) each; equal where a value is prescribed,
        ∓∞ where there is none.
        """
        lower, upper = self.parameter_bounds
        lows, highs = zip(
            *(transcription.bounds() for transcription in self.transcriptions), strict=True
        )
        # Additional variables of a subclass have bounds of their own.
        pack = partial(Collocation.pack, self)
        return pack(lower, lows), pack(upper, highs)

    # Objective --------------------------------------------------------------------------------

    def objective(self, z: Array) -> float:
        """Return the objective at z: loss and priors, divided by the number of measurements;
        constraints do not contribute.
        """
        residuals, _ = self.prior_residuals(self.parameters_from(z))
        loss = sum(part.loss for part in self.iterates(z))
        return self.loss_scale * float(residuals @ residuals + loss)

    def gradient(self, z: Array) -> Array:
        """Return the gradient (variables,) of the objective by z, at constant values of all other
        variables.
        """
        parts = self.iterates(z)
        residuals, slopes = self.prior_residuals(self.parameters_from(z))
        by_p = 2 * residuals * slopes
        by_x = []
        for part in parts:
            of_x, of_p = part.gradient()
            by_x.append(of_x.ravel() * part.transcription.length_m)
            by_p[part.transcription.parameter_indices] += of_p
        return self.loss_scale * np.concatenate(
            [by_p[: self.nq], *by_x, by_p[self.nq :], *self._additional_gradients(parts)]
        )

    # Constraints ------------------------------------------------------------------------------

    def constraint_values(self, z: Array) -> Array:
        """Return the scaled constraints g (constraints,) at z: equations of motion and grasps."""
        parts = self.iterates(z)
        rows = [
            part.transcription.constraint_values(part.x, part.equations, histories=part.histories)
            for part in parts
        ]
        return np.concatenate([*rows, *self._additional_equations(parts, z)])

    @property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of ∂g/∂z in compressed columns."""
        return self._jacobian.structure

    @cached_property
    def _jacobian(self) -> SparseAssembly:
        """Structure of ∂g/∂z: columns of q and x, then those of φ, then additional entries."""
        own = self.transcriptions[-1].next_offsets.row
        indptr = [np.arange(self.nq + 1) * own]
        indices = [np.tile(np.arange(own), self.nq)]
        of_phi = []
        for transcription in self.transcriptions:
            indptr.append(indptr[-1][-1] + transcription.motion_rows.structure.indptr[1:])
            indices.append(transcription.offsets.row + transcription.motion_rows.structure.indices)
            moving = (
                transcription.nuisance_indices.indices[transcription.nuisance.motion_indices]
                - self.nq
            )
            rows = transcription.offsets.row + np.arange(transcription.constraint_count)
            columns = self.phi_columns.start + np.repeat(moving, len(rows))
            of_phi.append((np.tile(rows, len(moving)), columns))
        structure = np.concatenate(indptr), np.concatenate(indices)
        return SparseAssembly.from_groups(
            structure,
            (self.constraint_count, self.variable_count),
            groups=of_phi + self._additional_jacobian_entries(),
        )

    def jacobian_values(self, z: Array, out: Array | None = None) -> Array:
        """Return the values of ∂g/∂z in the order of `jacobian_structure`; history variables that
        are eliminated are treated as constant.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        out : array, optional
            Overwritten with the result and returned; a new array by default.
        """
        return self.constraints_and_jacobian(z, out)[1]

    def constraints_and_jacobian(self, z: Array, out: Array | None = None) -> tuple[Array, Array]:
        """Return constraints g (constraints,) and the values of ∂g/∂z, see `jacobian_values`, from
        one evaluation of the elements.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        out : array, optional
            Overwritten with the values of ∂g/∂z and returned; a new array by default.
        """
        parts = self.iterates(z)
        height = self.transcriptions[-1].next_offsets.row
        count = self.nq * height + sum(s.motion_rows.structure.nnz for s in self.transcriptions)
        values, own = self._jacobian.allocate(out, count)
        columns = own[: self.nq * height].reshape(self.nq, height)
        rows = np.empty(height)
        further = []
        used = columns.size
        for part in parts:
            transcription = part.transcription
            here = own[used : used + transcription.motion_rows.structure.nnz]
            constraints, by_p = transcription.constraints_and_jacobian(
                part.x, part.equations, forces=part.forces, values=here
            )
            rows[transcription.rows] = constraints
            columns[:, transcription.rows] = by_p[:, : self.nq].T
            further.append(by_p[:, self.nq :].T.ravel())
            used += transcription.motion_rows.structure.nnz
        added = self._additional_jacobian(parts, z)
        self._jacobian.assemble(values, own, groups=further + [entries for _, entries in added])
        return np.concatenate([rows, *(equations for equations, _ in added)]), values

    def jacobian(self, z: Array) -> sp.csc_array:
        """Return ∂g/∂z (constraints, variables) as a sparse matrix; history variables that are
        eliminated are treated as constant.
        """
        indptr, indices = self.jacobian_structure
        shape = (self.constraint_count, self.variable_count)
        return sp.csc_array((self.jacobian_values(z), indices, indptr), shape=shape)

    @property
    def has_eliminated_histories(self) -> bool:
        """Whether history variables are eliminated, so that ∂g/∂z has more entries than
        `jacobian`.
        """
        return any(transcription.has_histories() for transcription in self.transcriptions)

    def jacobian_vjp(self, z: Array, multipliers: Array) -> Array:
        """Return the vector–Jacobian product (∂g/∂z)ᵀ multipliers (variables,) at z, for
        multipliers (constraints,), including the dependence through eliminated history variables.
        """
        slope = self.jacobian(z).T @ multipliers
        for part in self.iterates(z) if self.has_eliminated_histories else ():
            transcription = part.transcription
            weights = transcription.lagrangian_weights(multipliers[transcription.rows]).forces
            by_x, by_p = transcription.history_vjp(part.x, part.equations, weights=weights)
            slope[transcription.columns] += transcription.length_m * by_x.ravel()
            slope[transcription.dynamic_columns(self.phi_columns.start)] += by_p
        return slope

    # Lagrangian -------------------------------------------------------------------------------

    @property
    def hessian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of the upper triangle of ∇²_z (w L + yᵀ g), in
        compressed columns.
        """
        return self._hessian.structure

    @cached_property
    def _hessian(self) -> SparseAssembly:
        """Structure of the Hessian: columns of q, of x from the motion, all others."""
        counts = np.arange(self.nq + 1)
        further = []
        indptr = [counts * (counts + 1) // 2]
        indices = [np.concatenate([np.arange(k) for k in counts])]
        for transcription in self.transcriptions:
            indptr.append(indptr[-1][-1] + transcription.hessian.indptr[1:])
            shift = np.where(
                transcription.hessian.indices < self.nq, 0, transcription.offsets.variable - self.nq
            )
            indices.append(transcription.hessian.indices + shift)
            further += transcription.additional_hessian_entries(self.phi_columns.start)
        further += self._additional_hessian_entries()
        structure = np.concatenate(indptr), np.concatenate(indices)
        return SparseAssembly.from_groups(
            structure, (self.variable_count, self.variable_count), groups=further
        )

    @cached_property
    def hessian_diagonals(self) -> tuple[Index, Index]:
        """Positions of the diagonal entries of q (nq,), and of x of all experiments, in the values
        of the Hessian.
        """
        of_q = np.cumsum(np.arange(1, self.nq + 1)) - 1
        of_x = []
        used = self.nq * (self.nq + 1) // 2
        for transcription in self.transcriptions:
            of_x.append(used + transcription.find_hessian_diagonal())
            used += transcription.hessian.nnz
        return of_q, self._hessian.positions_of(np.concatenate(of_x))

    def hessian_values(
        self, z: Array, loss_weight: float, multipliers: Array | None, out: Array | None = None
    ) -> Array:
        """Return the values of ∇²_z (loss_weight · objective + multipliers · g), upper triangle.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        loss_weight : float
            Factor of the objective.
        multipliers : (constraints,) array or None
            Multipliers of g. None gives the Gauss–Newton matrix, which neglects the curvature of
            constraints and observations and is convex; the exact Hessian of the loss is not where
            residuals are large, because marker places and positions multiply.
        out : array, optional
            Overwritten with the result and returned.
        """
        uses_observation_curvature = multipliers is not None
        parts = [
            replace(part, has_observation_curvature=uses_observation_curvature)
            for part in self.iterates(z)
        ]
        multipliers = np.zeros(self.constraint_count) if multipliers is None else multipliers
        used = self.nq * (self.nq + 1) // 2
        count = used + sum(transcription.hessian.nnz for transcription in self.transcriptions)
        values, own = self._hessian.allocate(out, count)
        by_q = np.zeros((self.nq, self.nq))
        further = list[Array]()
        weights = list[RowWeights]()
        weight = loss_weight * self.loss_scale
        for number, part in enumerate(parts):
            transcription = part.transcription
            here = own[used : used + transcription.hessian.nnz]
            of_rows, histories = self._additional_weights(number, part, multipliers=multipliers)
            weights.append(
                transcription.lagrangian_weights(multipliers[transcription.rows], of_rows)
            )
            by_q_own, further_own = transcription.hessian_values(
                part.x,
                part.phi,
                equations=part.equations,
                weights=weights[number],
                loss_weight=weight,
                values=here,
                lifted_histories=histories,
                has_observation_curvature=uses_observation_curvature,
            )
            by_q = by_q + by_q_own
            further = further + further_own
            used = used + len(here)
        further = further + self._additional_hessian(
            parts, z, loss_weight=weight, multipliers=multipliers, weights=weights
        )
        _, slopes = self.parameters.prior_residuals(parts[0].q)
        by_q += np.diag(2 * weight * slopes**2)
        rows, columns = np.triu_indices(self.nq)
        order = np.lexsort((rows, columns))
        own[: len(rows)] = by_q[rows[order], columns[order]]
        self._hessian.assemble(values, own, groups=further)
        return values

    # The program for other solvers ------------------------------------------------------------

    @property
    def eliminates_variables(self) -> bool:
        """Whether history variables, measured reactions or pressures of obstacles are eliminated, so
        that not all derivatives of the program are sparse and exact.
        """
        return any(
            transcription.has_histories()
            or len(transcription.sensed_dofs)
            or transcription.dynamics.forces.complementarity_terms
            for transcription in self.transcriptions
        )

    def casadi(self, hessian: Hessian = "exact") -> CasadiProgram:
        """Return the program as a CasADi function with exact derivatives, for `casadi.nlpsol`.

        Parameters
        ----------
        hessian : {"exact", "gauss-newton"}
            Second derivatives; those of Gauss–Newton are convex, see `hessian_values`.

        Raises
        ------
        InputError
            If the program eliminates variables, a parameter has no guess, or `hessian` is another
            text.
        """
        require_among(hessian, get_args(Hessian), where="hessian")
        if self.eliminates_variables:
            raise InputError(
                "this program eliminates history variables, measured reactions or pressures of "
                "obstacles, whose derivatives are not sparse; expected "
                "problem.collocation(lifted=True), in which they are variables"
            )
        positions = [
            s.with_prescribed_positions(
                s.experiment.rigid_positions(s.dynamics.t_s).reshape(s.grid_times, -1), s.guess_phi
            )
            for s in self.transcriptions
        ]
        lower, upper = self.bounds()
        start = self.pack(self.guess_p, positions)
        return CasadiProgram(self, hessian, x0=start, lbx=lower, ubx=upper)

    def plot(self) -> Figure:
        """Draw the patterns of the Jacobian of g and of the Hessian of the Lagrangian: darker
        pixels have more entries.

        Returns
        -------
        Figure
            Matplotlib figure; ``savefig`` writes it.
        """
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9, 4.5), layout="constrained")
        size, count = self.variable_count, self.constraint_count
        indptr, indices = self.hessian_structure
        columns = np.repeat(np.arange(size), np.diff(indptr))
        is_above = indices < columns
        both = (
            np.concatenate([indices, columns[is_above]]),
            np.concatenate([columns, indices[is_above]]),
        )
        indptr, indices = self.jacobian_structure
        jacobian = indices, np.repeat(np.arange(size), np.diff(indptr))
        patterns = (
            (r"Jacobian $\partial g/\partial z$", jacobian, count),
            (r"Hessian $\nabla^2(wf + y^Tg)$", both, size),
        )
        for axes, (title, (rows, at), height) in zip(figure.subplots(1, 2), patterns, strict=True):
            pixels = [min(MOST_PIXELS, height), min(MOST_PIXELS, size)]
            filled, *_ = np.histogram2d(rows, at, pixels, range=[[0, height], [0, size]])
            axes.imshow(
                np.sqrt(filled), cmap="Greys", extent=(0, size, height, 0), interpolation="nearest"
            )
            axes.set_title(f"{title}: {height} × {size}, {len(rows)} entries")
            axes.set_aspect("auto")
        return figure

    def kkt_residual(self, z: Array, multipliers: Array) -> float:
        """Return the largest violation of the first-order optimality conditions at z, in the
        scaling of the program: the maximum norm of both conditions.

        The conditions are stationarity of objective + multipliers · g in every variable that is not
        prescribed, and feasibility. A parameter closer than 1e-6 to its bound may have a gradient
        that points outwards; bounds of other variables are not considered.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        multipliers : (constraints,) array
            Multipliers of g.
        """
        rows = self.constraint_values(z)
        slope = self.gradient(z) + self.jacobian_vjp(z, multipliers)
        lower, upper = self.bounds()
        slope[lower == upper] = 0
        for part in (slice(self.nq), self.phi_columns):
            at_lower = (z - lower)[part] < BOUND_TOLERANCE
            at_upper = (upper - z)[part] < BOUND_TOLERANCE
            slope[part][at_lower] = np.minimum(slope[part][at_lower], 0)
            slope[part][at_upper] = np.maximum(slope[part][at_upper], 0)
        return float(max(np.abs(slope).max(initial=0.0), np.abs(rows).max(initial=0.0)))

    def hessian(self, z: Array, loss_weight: float, multipliers: Array | None) -> sp.csc_array:
        """Return ∇²_z (loss_weight · objective + multipliers · g), both triangles, as a sparse
        matrix.

        Arguments as in `hessian_values`; `multipliers` is None for the Gauss–Newton matrix.
        """
        indptr, indices = self.hessian_structure
        values = self.hessian_values(z, loss_weight, multipliers=multipliers)
        upper = sp.csc_array((values, indices, indptr), shape=(len(z), len(z)))
        return sp.csc_array(upper + sp.triu(upper, 1).T)

    # Additional variables of subclasses ---------------------------------------------------------

    def _additional_equations(self, parts: Sequence[ExperimentIterate], z: Array) -> list[Array]:
        """Return the equations of additional variables, last of the constraints."""
        return []

    def _additional_jacobian_entries(self) -> list[tuple[Index, Index]]:
        """Return groups of rows in g and columns in z of additional entries of the Jacobian."""
        return []

    def _additional_jacobian(
        self, parts: Sequence[ExperimentIterate], z: Array
    ) -> list[tuple[Array, Array]]:
        """Return them with the values of `_additional_jacobian_entries`."""
        return []

    def _additional_gradients(self, parts: Sequence[ExperimentIterate]) -> list[Array]:
        """Return the gradient of the loss by additional variables, at the iterates `parts`."""
        return []

    def _additional_weights(
        self, number: int, part: ExperimentIterate, multipliers: Array
    ) -> tuple[Array | float, list[WeightedHistory]]:
        """Return what the equations of additional variables add to the Lagrangian of an experiment."""
        return 0.0, []

    def _additional_hessian_entries(self) -> list[tuple[Index, Index]]:
        """Rows and columns in z of additional entries, upper triangle."""
        return []

    def _additional_hessian(
        self,
        parts: Sequence[ExperimentIterate],
        z: Array,
        loss_weight: float,
        multipliers: Array,
        weights: Sequence[RowWeights],
    ) -> list[Array]:
        return []

    # Reading a point --------------------------------------------------------------------------

    def residuals_n(self, z: Array) -> list[Array]:
        """Return the residuals of the equations of motion (N, free dofs) of each fitted experiment
        [N], zero while a grasp prescribes the dof.
        """
        return [part.compute_residual_n() for part in self.iterates(z)]

    def largest_force_n(self, z: Array) -> float:
        """Return the largest magnitude of a force on a dof [N] at z, as a scale for violations.

        Internal and external forces are compared separately, without inertia, at all dofs including
        grasped ones.
        """
        largest = 0.0
        for part in self.iterates(z):
            dynamics = part.equations.dynamics
            total = dynamics.force(part.x, part.histories)
            external = dynamics.select_evaluated_forces().weight.external_n
            for force in (total - external, external):
                # What a grasp bears counts too: where nothing else acts, all other forces vanish.
                largest = max(largest, float(np.abs(force).max()))
        return largest

    def largest_violations(self, z: Array, count: int = 5) -> list[Violation]:
        """Return the `count` residuals of the equations of motion at z with the largest magnitudes,
        of all experiments together, in descending order; fewer if there are fewer.
        """
        violations = []
        for part in self.iterates(z):
            transcription = part.transcription
            residual = part.compute_residual_n()
            worst = np.argsort(-np.abs(residual), axis=None)[:count]
            for t, place in zip(*np.unravel_index(worst, residual.shape), strict=True):
                node, axis = divmod(int(transcription.free_dofs[place]), 3)
                violations.append(
                    Violation(
                        transcription.experiment.name,
                        float(transcription.dynamics.t_s[t]),
                        node=node,
                        axis="xyz"[axis],
                        residual_n=float(residual[t, place]),
                    )
                )
        return sorted(violations, key=lambda violation: -abs(violation.residual_n))[:count]

    def rms_marker_distance_m(self, z: Array) -> float:
        """Return the root mean square distance of the markers from their measurements [m], over all
        samples of all experiments; 0 without markers.
        """
        squares = samples = 0.0
        for part in self.iterates(z):
            squares_m2 = part.transcription.markers.squared_distances_m2(part.x, part.phi)
            squares = squares + float(squares_m2.sum())
            samples = samples + len(squares_m2)
        return float(np.sqrt(squares / max(1.0, samples)))

    def parameter_values(self, z: Array) -> dict[str, float]:
        """Return the shared parameters q of z by the user's names,
        as physical values in SI units.
        """
        return self.parameters.values(z[: self.nq])


def _with_shared_associations(
    transcriptions: Sequence[Transcription], associations: Sequence[Association]
) -> tuple[Transcription, ...]:
    """Return transcriptions with places and clocks of the first that shares them."""
    parts = zip(transcriptions, associations, strict=True)
    same = shared_associations(
        (s.nuisance_indices, s.nuisance, association) for s, association in parts
    )
    return tuple(
        s.with_association(association) for s, association in zip(transcriptions, same, strict=True)
    )
