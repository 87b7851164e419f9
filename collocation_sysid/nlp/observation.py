"""The loss of one experiment: marker residuals in units of their standard deviation.

A marker reads, from node positions x and the experiment's nuisance parameters φ (`nlp.nuisance`),

    y = R(a) (Σ_i ℓ_i(τ) h(x_i) − c) + c + d + b,

with ℓ the Lagrange weights of up to five neighbouring samples at the shifted time, and the plain
h(x_t) without φ. One sample's residual and loss are CasADi expressions in its few inputs
u = (h(x_i), φ of its marker), mapped over all samples; linear operators lead from (x, φ) to u.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index
from ..experiment.markers import Markers
from .nuisance import NuisanceMap, rotation

# Samples that a time-shifted marker is interpolated from: an error of (ωΔt)⁵ / 3500 of a swing.
NEIGHBOURS = 5


class _Sample(NamedTuple):
    """Functions of one sample's u and data; each holds what its users need and no more."""

    value: ca.Function  # residual
    slope: ca.Function  # residual, and its Jacobian by u
    loss: ca.Function  # loss, and its gradient
    hessian: ca.Function  # of the loss


@dataclass(frozen=True, eq=False)
class Observation:
    """L(x, φ) = Σ ρ(‖(ŷ_t − y(x, φ)) / σ‖) over present samples of the tracks.

    Attributes
    ----------
    markers : Markers
    grid_rows : (T,) row of the collocation grid at each sample
    nuisance : NuisanceMap
    huber : float or None
        Huber's loss: ρ(d) = d² up to this many standard deviations, linear beyond; d² without it.
    from_rest : bool
        The body rests in its first state before the first time: a shifted marker reads that there.
    """

    markers: Markers
    grid_rows: Index
    nuisance: NuisanceMap
    huber: float | None = None
    from_rest: bool = True

    @property
    def count(self) -> int:
        """Number of scalar measurements present."""
        return 3 * self.markers.samples

    @cached_property
    def weights(self) -> Array:
        """(T, 3M) of 1/σ, zero where a sample is missing."""
        weights = self.markers.present / self.markers.sigma_m
        return np.repeat(weights, 3, axis=1)

    # One sample -------------------------------------------------------------------------------

    @cached_property
    def _neighbours(self) -> int:
        shifted = len(self.nuisance.places("time")) > 0
        return min(NEIGHBOURS, len(self.grid_rows)) if shifted else 1

    @cached_property
    def _first_neighbour(self) -> Index:
        """(T,) the first sample that each one is interpolated from; negative before the start."""
        samples = np.arange(len(self.grid_rows))
        first = np.minimum(samples - self._neighbours // 2, len(samples) - self._neighbours)
        return first if self.from_rest else np.maximum(first, 0)

    @cached_property
    def _window(self) -> Index:
        """(T, neighbours) samples that each one is interpolated from."""
        return np.maximum(self._first_neighbour[:, None] + np.arange(self._neighbours), 0)

    @cached_property
    def _phi_places(self) -> Index:
        """(M, f) positions in φ of what each marker's reading depends on."""
        common = self.nuisance.places("time", "turn", "shift")
        offsets = self.nuisance.places("offset").reshape(-1, 3)
        if not len(offsets):
            offsets = np.zeros((len(self.markers.names), 0), dtype=np.int64)
        return np.hstack([offsets, np.tile(common, (len(offsets), 1))])

    @cached_property
    def _sample(self) -> _Sample:
        nodes = ca.SX.sym("h", 3 * self._neighbours)
        phi = ca.SX.sym("phi", self._phi_places.shape[1])
        data = ca.SX.sym("data", 3 + 1 + 1)  # ŷ, 1/σ, place in the window
        measured, weight, place = ca.vertsplit(data, [0, 3, 4, 5])
        u = ca.vertcat(nodes, phi)
        residual = weight * (self._reading(nodes, phi, place) - measured)
        square = ca.sumsqr(residual)
        loss = square
        if self.huber is not None:
            limit = self.huber**2
            beyond = 2 * self.huber * ca.sqrt(ca.fmax(square, limit)) - limit
            loss = ca.if_else(square > limit, beyond, square)
        hessian, gradient = ca.hessian(loss, u)
        return _Sample(
            ca.Function("value", [u, data], [residual]),
            ca.Function("slope", [u, data], [residual, ca.densify(ca.jacobian(residual, u))]),
            ca.Function("loss", [u, data], [loss, gradient]),
            ca.Function("hessian", [u, data], [ca.densify(hessian)], {"cse": True}),
        )

    def _reading(self, nodes: ca.SX, phi: ca.SX, place: ca.SX) -> ca.SX:
        """The reading y of one sample."""
        scale = self.nuisance.scales[self._phi_places[0]]
        kinds = [self.nuisance.kinds[i] for i in self._phi_places[0]]

        def values(kind: str) -> ca.SX:
            chosen = [i for i, name in enumerate(kinds) if name == kind]
            return phi[chosen] * scale[chosen]

        at = ca.reshape(nodes, 3, self._neighbours)
        reading = at[:, 0]
        if "time" in kinds:
            step_s = float(self.markers.t_s[1] - self.markers.t_s[0])
            reading = at @ lagrange_weights(place + values("time") / step_s, self._neighbours)
        if "turn" in kinds:
            pivot = ca.DM(self.nuisance.pivot_m)
            reading = rotation(values("turn")) @ (reading - pivot) + pivot
        if "shift" in kinds:
            reading += values("shift")
        if "offset" in kinds:
            reading += values("offset")
        return reading

    @cached_property
    def _data(self) -> Array:
        """(5, T, M) measured position, 1/σ, and place in the window of every sample."""
        tracks = np.nan_to_num(self.markers.positions_m)
        samples, count = tracks.shape[:2]
        place = np.arange(samples) - self._first_neighbour
        return np.stack(
            [
                *np.moveaxis(tracks, 2, 0),
                self.weights[:, ::3],
                np.broadcast_to(place[:, None], (samples, count)),
            ]
        )

    def _inputs(self, x: Array, phi: Array, samples: int) -> Array:
        """(3 neighbours + f, samples, M): u of the first samples."""
        rows = self.grid_rows[: self._window[samples - 1, -1] + 1]
        at = self.markers.observe(x[rows].reshape(len(rows), -1, 3))  # (·, M, 3)
        around = np.moveaxis(at[self._window[:samples]], (1, 3), (0, 1))
        places = self._phi_places.T[:, None]
        here = np.broadcast_to(phi[places], (len(places), *around.shape[2:]))
        return np.concatenate([around.reshape(-1, *around.shape[2:]), here])

    def _mapped(self, chosen: ca.Function, u: Array, data: Array | None = None) -> list[Array]:
        """Outputs of a function of `_sample` for the first samples, (…, samples, M) each."""
        samples, count = u.shape[1:]
        data = self._data[:, :samples] if data is None else data
        outputs = chosen.map(samples * count)(u.reshape(len(u), -1), data.reshape(len(data), -1))
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        shaped = []
        for k, output in enumerate(outputs):
            rows, columns = chosen.size_out(k)
            full = output.full().reshape(rows, samples * count, columns).transpose(0, 2, 1)
            shaped.append(full.reshape(rows, columns, samples, count))
        return shaped

    # All samples ------------------------------------------------------------------------------

    def residuals(self, x: Array, phi: Array) -> Array:
        """(T, 3M) of (y − ŷ) / σ at grid positions x (N, 3n); zero where missing."""
        (values,) = self._mapped(self._sample.value, self._inputs(x, phi, len(self.grid_rows)))
        return np.moveaxis(values[:, 0], 0, 2).reshape(values.shape[2], -1)

    def at_samples(self, by_p: Array) -> Array:
        """Derivatives of h(x) at the samples, (R, 3M, m), from those of the first rows of x."""
        rows = self.grid_rows[self.grid_rows < len(by_p)]
        _, dofs, moving = by_p.shape
        columns = by_p[rows].transpose(1, 0, 2).reshape(dofs, len(rows) * moving)
        at = self.markers.operator @ columns
        return at.reshape(len(at), len(rows), moving).transpose(1, 0, 2)

    def linearised(
        self, x: Array, phi: Array, at_samples: Array, columns: Index, shared: int
    ) -> tuple[Array, Array]:
        """Residuals, and their slopes by the parameters (q, φ) of the experiment.

        Only samples that are read from the rows given count.

        Parameters
        ----------
        x : (rows, 3n), the first grid rows
        phi : (k,)
        at_samples : (R, 3M, len(columns)) derivatives of h(x) by those of (q, φ) that move the body
        columns : positions of those in (q, φ)
        shared : number of q

        Returns
        -------
        residual : (t, M, 3) ndarray, slope : (t, M, 3, shared + k) ndarray
        """
        samples = self._readable(x)
        count, size = len(self.markers.names), shared + self.nuisance.size
        if samples == 0:
            return np.zeros((0, count, 3)), np.zeros((0, count, 3, size))
        values, by_u = self._mapped(self._sample.slope, self._inputs(x, phi, samples))
        nodes = 3 * self._neighbours
        by_nodes = by_u[:, :nodes].reshape(3, self._neighbours, 3, samples, count)
        around = at_samples.reshape(len(at_samples), count, 3, at_samples.shape[2])
        around = around[self._window[:samples]]
        slope = np.zeros((samples, count, 3, size))
        slope[..., columns] = np.einsum("riatm,timak->tmrk", by_nodes, around, optimize=True)
        by_phi = np.moveaxis(by_u[:, nodes:], (0, 1), (2, 3))  # (t, M, 3, f)
        for m, places in enumerate(self._phi_places):
            slope[:, m, :, shared + places] += np.moveaxis(by_phi[:, m], 2, 0)
        return np.moveaxis(values[:, 0], 0, 2), slope

    def predicted(self, x: Array, phi: Array) -> Array:
        """Readings y (t, M, 3) [m] at the first grid positions x (rows, 3n), as far as they go."""
        samples = self._readable(x)
        u = self._inputs(x, phi, samples)
        data = self._data[:, :samples].copy()
        data[:3], data[3] = 0.0, 1.0
        (values,) = self._mapped(self._sample.value, u, data)
        return np.moveaxis(values[:, 0], 0, 2)

    def of_samples(self, positions_m: Array, phi: Array) -> Array:
        """Readings (T, M, 3) [m] of the body's positions (T, n, 3) at the samples."""
        rows = np.arange(len(positions_m))
        return replace(self, grid_rows=rows).predicted(positions_m.reshape(len(rows), -1), phi)

    def squared_distances_m2(self, x: Array, phi: Array) -> Array:
        """Squared distances between readings of the first grid positions and present samples."""
        samples = self._readable(x)
        if samples == 0:
            return np.zeros(0)
        tracks, present = self.markers.positions_m[:samples], self.markers.present[:samples]
        return np.sum((self.predicted(x, phi) - tracks) ** 2, axis=2)[present]

    def _readable(self, x: Array) -> int:
        """Samples that the first grid positions suffice to read."""
        rows = np.count_nonzero(self.grid_rows < len(x))
        return int(np.count_nonzero(self._window[:, -1] < rows))

    def loss(self, x: Array, phi: Array) -> float:
        """L(x, φ)."""
        losses, _ = self._mapped(self._sample.loss, self._inputs(x, phi, len(self.grid_rows)))
        return float(losses.sum())

    def gradient(self, x: Array, phi: Array) -> tuple[Array, Array]:
        """∂L/∂x (N, 3n) and ∂L/∂φ (k,)."""
        _, slope = self._mapped(self._sample.loss, self._inputs(x, phi, len(self.grid_rows)))
        nodes, of_phi = np.split(slope[:, 0], [3 * self._neighbours])
        nodes = nodes.reshape(self._neighbours, 3, *nodes.shape[1:]).transpose(0, 2, 3, 1)
        at = np.zeros((len(self.grid_rows), len(self.markers.names), 3))
        for i in range(self._neighbours):
            np.add.at(at, self._window[:, i], nodes[i])
        by_x, by_phi = np.zeros_like(x), np.zeros(self.nuisance.size)
        by_x[self.grid_rows] = (self.markers.operator.T @ at.reshape(len(at), -1).T).T
        np.add.at(by_phi, self._phi_places, of_phi.sum(axis=1).T)
        return by_x, by_phi

    # Second derivatives -----------------------------------------------------------------------

    @cached_property
    def _operator(self) -> sp.csr_array:
        """From (x, φ) to u, stacked: rows by sample, marker, and entry of u; x by row and dof."""
        dofs = 3 * self.markers.placement.node_count
        columns = (self.grid_rows[-1] + 1) * dofs
        markers, entries = len(self.markers.names), 3 * self._neighbours + self._phi_places.shape[1]
        reading = sp.coo_array(self.markers.operator)
        marker, axis = np.divmod(np.asarray(reading.coords[0]), 3)
        parts = []
        for i in range(self._neighbours):
            sample = np.repeat(np.arange(len(self.grid_rows)), len(marker))
            row = (sample * markers + np.tile(marker, len(self.grid_rows))) * entries
            row += np.tile(3 * i + axis, len(self.grid_rows))
            first = np.repeat(self.grid_rows[self._window[:, i]] * dofs, len(marker))
            column = first + np.tile(reading.coords[1], len(self.grid_rows))
            parts.append((row, column, np.tile(reading.data, len(self.grid_rows))))
        samples = np.arange(len(self.grid_rows) * markers).reshape(-1, markers, 1)
        row = samples * entries + 3 * self._neighbours + np.arange(self._phi_places.shape[1])
        column = np.broadcast_to(columns + self._phi_places, row.shape)
        parts.append((row.ravel(), column.ravel(), np.ones(row.size)))
        row, column, value = (np.concatenate(part) for part in zip(*parts, strict=True))
        shape = (samples.size * entries, columns + self.nuisance.size)
        return sp.csr_array((value, (row, column)), shape=shape)

    def _hessian(self, operator: sp.csr_array, by_u: Array) -> sp.coo_array:
        """Upper triangle from that of each sample (samples, M, u, u)."""
        entries = by_u.shape[-1]
        blocks = by_u.reshape(-1, entries, entries)
        indices = np.arange(len(blocks))
        middle = sp.bsr_array((blocks, indices, np.arange(len(blocks) + 1)))
        return sp.coo_array(sp.triu(operator.T @ (middle.tocsr() @ operator), format="coo"))

    @cached_property
    def hessian_structure(self) -> tuple[Index, Index]:
        """Rows and columns of the entries of ∂²L/∂(x, φ)², upper triangle, sorted by column."""
        markers, entries = len(self.markers.names), 3 * self._neighbours + self._phi_places.shape[1]
        ones = np.ones((len(self.grid_rows), markers, entries, entries))
        # Positive numbers cannot cancel, so that no entry is lost.
        found = self._hessian(abs(self._operator), ones)
        order = np.lexsort(found.coords)
        rows, columns = (np.asarray(index, dtype=np.int64)[order] for index in found.coords)
        return rows, columns

    def hessian(self, x: Array, phi: Array) -> Array:
        """Values of the entries of `hessian_structure`."""
        if self.nuisance.size == 0 and self.huber is None:
            return self._constant_hessian
        return self._hessian_values(x, phi)

    @cached_property
    def _constant_hessian(self) -> Array:
        dofs = 3 * self.markers.placement.node_count
        return self._hessian_values(np.zeros((self.grid_rows[-1] + 1, dofs)), np.zeros(0))

    def _hessian_values(self, x: Array, phi: Array) -> Array:
        (by_u,) = self._mapped(self._sample.hessian, self._inputs(x, phi, len(self.grid_rows)))
        found = self._hessian(self._operator, np.moveaxis(by_u, (0, 1), (2, 3)))
        rows, columns = self.hessian_structure
        size = columns[-1] + 1
        row, column = (np.asarray(index, dtype=np.int64) for index in found.coords)
        values = np.zeros(len(rows))
        values[np.searchsorted(columns * size + rows, column * size + row)] = found.data
        return values


def lagrange_weights(place: ca.SX, count: int) -> ca.SX:
    """Weights of samples 0 … count − 1 at a place between them."""
    return ca.vertcat(
        *(
            ca.SX(1.0)
            if count == 1
            else _product([(place - j) / (i - j) for j in range(count) if j != i])
            for i in range(count)
        )
    )


def _product(factors: list[ca.SX]) -> ca.SX:
    result = factors[0]
    for factor in factors[1:]:
        result = result * factor
    return result
