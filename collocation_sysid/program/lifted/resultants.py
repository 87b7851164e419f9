"""Resultants of the reactions of a grasp on the time grid, as variables of the program.

    W_k − Σ_g moment(x_g, R_g) − tool(φ) = 0,  variables W_k,
    Y_k − e Y_{k−1} − a W_{k−1} − b W_k = 0,   variables Y_k, where a low-pass is estimated,

see `reactions.resultant`; without a low-pass Y is W. The loss is a function of Y, whose Hessian
couples only the few grid times around a sample. R are the lifted reaction forces of
`reactions`. W and Y are scaled by their measurement uncertainty, so that the loss has
similar curvature by them as by positions; their equations are scaled like other equations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np
import scipy.sparse as sp

from ...common.array_types import Array, Index
from ...model.generated_functions import GeneratedFunction
from ..experiment_iterate import ExperimentIterate
from ..measurement_residual import MeasurementResidual
from ..motion_transcription import RowWeights
from ..reactions.resultant import LOW_PASS, MOMENT, ReactionResultant
from .expression_patterns import ExpressionPattern, PatternIndices
from .reactions import LiftedReactions
from .variables import LiftedVariables

# Identity: the value (6,) of a resultant.
ITSELF = GeneratedFunction(lambda u, _: u, 6, data_size=0)


@dataclass(frozen=True, eq=False)
class LiftedResultant(LiftedVariables):
    """Lifted resultants W and low-pass filtered resultants Y of one sensor."""

    residual_index: int  # index of the measurement among those of the transcription
    residual: MeasurementResidual
    reactions: LiftedReactions  # lifted reaction forces of the experiment
    kind = "reaction"

    @property
    def observable(self) -> ReactionResultant:
        """Resultant of the grasp's reactions as an observable."""
        return cast(ReactionResultant, self.residual.observable)

    @property
    def _resultant_size(self) -> int:
        """Number of components of W at all grid times."""
        return 6 * self.observable.count

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (1 or 2, times, 6): W and, with a low-pass, Y; grid times; forces and moments."""
        return (1 + len(self.observable.low_pass_parameters), self.observable.count, 6)

    @cached_property
    def _unit(self) -> Array:
        """Unit (6,) of W and Y [N, N m], for which the mean loss has a curvature of about one."""
        # That of reaction forces for components that are not measured.
        count = max(1, int(self.residual.is_compared.sum()))
        sigmas = self.residual.observable_sigmas
        return np.where(np.isfinite(sigmas), np.sqrt(count) * sigmas, self._compute_reaction_unit())

    @cached_property
    def _row_unit(self) -> Array:
        """Unit (6,) of the equations, between `_unit` and that of R for good conditioning."""
        return self._compute_reaction_unit() ** 0.75 * self._unit**0.25

    def _compute_reaction_unit(self) -> Array:
        """Return the unit (6,) of reaction forces and their moments [N, N m]."""
        return self.transcription.force_n * np.repeat([1.0, self.transcription.length_m], 3)

    def with_lifted(self, iterate: ExperimentIterate, z: Array) -> ExperimentIterate:
        """Return a copy of the iterate with the measured resultant Y (times, 2, 3) [N, N m] taken
        from z, W without a low-pass.
        """
        resultant = z[self._observable_columns].reshape(-1, 6) * self._unit
        return replace(
            iterate,
            lifted_observables={
                **iterate.lifted_observables,
                self.residual_index: resultant.reshape(-1, 2, 3),
            },
        )

    @property
    def _observable_columns(self) -> slice:
        """Slice of Y in z, of W without a low-pass."""
        return slice(self.columns.stop - self._resultant_size, self.columns.stop)

    def consistent_values(self, iterate: ExperimentIterate) -> Array:
        own = [self.observable.evaluate_unfiltered(iterate.reactions, iterate.phi)]
        if evolution := self.observable.filter_resultant(own[0], iterate.phi):
            own += [*evolution.states]
        return (np.stack(own) / self._unit).ravel()

    # Equations ----------------------------------------------------------------------------------

    @cached_property
    def patterns(self) -> tuple[ExpressionPattern, ...]:
        """Expressions of the equations: W itself, moments of the nodes, tool, and low-pass."""
        channel = self.observable
        indices = np.arange(self.count).reshape(self.shape)
        resultant = self.offsets.variable + indices[0].T
        of_resultant = indices[0].T
        unit = self._unit[:, None]
        minus = -self._row_unit[:, None]
        own = PatternIndices(of_resultant, -minus)
        terms = [
            ExpressionPattern.from_arrays(
                ITSELF, np.zeros((0, 1)), inputs=[PatternIndices(resultant, unit)], rows=own
            )
        ]
        reaction_columns = self.reactions.columns_of(
            channel.known_rows + channel.reaction_grid.delay_steps, channel.node_dofs
        )
        units = np.array([[self.transcription.length_m], [self.transcription.force_n]])
        observed = [
            PatternIndices(np.moveaxis(each.reshape(channel.count, -1, 3), 2, 0), unit)
            for each, unit in zip(
                (self._compute_position_columns(), reaction_columns), units, strict=True
            )
        ]
        reaction_indices = PatternIndices(of_resultant[..., None], minus[..., None])
        terms.append(
            ExpressionPattern.from_arrays(
                MOMENT, channel.moment_data, inputs=observed, rows=reaction_indices
            )
        )
        if len(tool := channel.tool_parameters):
            data = channel.tool_inputs(np.zeros(len(self.phi_columns)), channel.count)[1]
            by_phi = PatternIndices(self.phi_columns[tool][:, None])
            terms.append(
                ExpressionPattern.from_arrays(
                    channel.tool, data, inputs=[by_phi], rows=PatternIndices(of_resultant, minus)
                )
            )
        if len(lag := channel.low_pass_parameters):
            places = self.offsets.variable + indices
            by_phi = self.phi_columns[lag][:, None, None]
            unfiltered, filtered = (PatternIndices(places[k : k + 1], self._unit) for k in (0, 1))
            terms.append(
                ExpressionPattern.from_recursion(
                    LOW_PASS,
                    channel.low_pass_data[..., None],
                    states=filtered,
                    input_indices=unfiltered,
                    constants=PatternIndices(by_phi),
                    rows=PatternIndices(indices[1:], self._row_unit),
                )
            )
        return tuple(terms)

    def _compute_position_columns(self) -> Index:
        """Return the columns (n, d) in z of the positions of the grasp's dofs at n grid times."""
        dofs = self.reactions.transcription.sensed_dofs[self.observable.node_dofs]
        return (
            self.transcription.offsets.variable
            + self.observable.known_rows[:, None] * self.transcription.dof_count
            + dofs
        )

    # Loss ---------------------------------------------------------------------------------------

    def loss_gradient(self, iterate: ExperimentIterate) -> Array:
        """Return the gradient of the loss by the scaled variables (count,); zero for W if there is
        a low-pass.
        """
        own = np.zeros(self.count)
        by_observables, _ = iterate.loss_gradients[self.residual_index]
        own[self.count - self._resultant_size :] = (
            by_observables.reshape(-1, 6) * self._unit
        ).ravel()
        return own

    @cached_property
    def _unit_derivatives(self) -> sp.csr_array:
        """Diagonal matrix of the derivatives of (Y, φ) by (scaled Y, φ)."""
        scale = np.tile(self._unit, self.observable.count)
        return sp.csr_array(sp.diags_array(np.append(scale, np.ones(len(self.phi_columns)))))

    @cached_property
    def _loss_entries(self) -> tuple[Index, Index]:
        """Upper triangle among (Y, φ) of the Hessian of the loss by (scaled Y, φ), by column."""
        return self.residual.hessian_structure(self._unit_derivatives)

    def hessian_entries(self) -> tuple[Index, Index]:
        """Return rows and columns of the entries of the equations, then of the loss."""
        rows, columns = super().hessian_entries()
        both = np.concatenate(
            [
                np.arange(self._observable_columns.start, self._observable_columns.stop),
                self.phi_columns,
            ]
        )
        i, j = (both[each] for each in self._loss_entries)
        # Experiments that share a φ need not have them in the same order.
        return np.append(rows, np.minimum(i, j)), np.append(columns, np.maximum(i, j))

    def hessian_values(
        self,
        iterate: ExperimentIterate,
        z: Array,
        loss_weight: float,
        multipliers: Array,
        weights: RowWeights,
    ) -> Array:
        of_equations = super().hessian_values(
            iterate, z, loss_weight=loss_weight, multipliers=multipliers, weights=weights
        )
        rows, columns = self._loss_entries
        size = self._resultant_size + len(iterate.phi)
        observables = iterate.observables[self.residual_index]
        of_loss = self.residual.hessian(
            observables,
            iterate.phi,
            derivatives=self._unit_derivatives,
            has_observation_curvature=iterate.has_observation_curvature,
        )
        positions = np.searchsorted(columns * size + rows, of_loss.columns * size + of_loss.rows)
        values = np.zeros(len(rows))
        np.add.at(values, positions, loss_weight * of_loss.values)
        return np.append(of_equations, values)
