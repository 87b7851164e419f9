"""The loss of one experiment: marker residuals in units of their standard deviation.

A marker reads, from node positions x and the experiment's nuisance parameters φ (`nlp.nuisance`),

    y = R(a) (Σ_i ℓ_i(τ) h(x_i) − c) + c + d + b,

with ℓ the Lagrange weights of up to five neighbouring samples at the shifted time, and the plain
h(x_t) without φ. One sample's residual and loss are CasADi expressions in its few inputs
u = (h(x_i), φ of its marker), mapped over all samples. What leads from (x, φ) to u is linear in x,
and in the places of the markers as the shape functions are: h(x) = Σ_a N_a(X) x_a, see `charts`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from ..arrays import Array, Index
from ..experiment.markers import Markers
from ..experiment.nuisance import PLACE
from .charts import Chart, ShapeFunctions
from .nuisance import NuisanceMap
from .reading import Reading, lagrange_weights

# Samples that a time-shifted marker is interpolated from: an error of (ωΔt)⁵ / 3500 of a swing.
NEIGHBOURS = 5


@dataclass(frozen=True, eq=False)
class Observation:
    """L(x, φ) = Σ ρ(‖(ŷ_t − y(x, φ)) / σ‖) over present samples of the tracks.

    Attributes
    ----------
    markers : Markers
    grid_rows : (T,) row of the collocation grid at each sample
    nuisance : NuisanceMap
    chart : Chart
    huber : float or None
        Huber's loss: ρ(d) = d² up to this many standard deviations, linear beyond; d² without it.
    from_rest : bool
        The body rests in its first state before the first time: a shifted marker reads that there.
    """

    markers: Markers
    grid_rows: Index
    nuisance: NuisanceMap
    chart: Chart
    huber: float | None = None
    from_rest: bool = True

    @property
    def count(self) -> int:
        """Number of scalar measurements present."""
        return 3 * int(self.present.sum())

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """(T, M) samples that are there, at shifted times that the motion covers."""
        shifted = np.arange(len(self.grid_rows)) + self.chart.samples
        covered = (shifted < len(shifted)) & ((shifted >= 0) | self.from_rest)
        return self.markers.present & covered[:, None]

    @cached_property
    def weights(self) -> Array:
        """(T, 3M) of 1/σ, zero where a sample is missing."""
        return np.repeat(self.present / self.markers.sigma_m, 3, axis=1)

    def reading(self, phi: Array) -> tuple[Index, ShapeFunctions]:
        """Nodes (M, npe) that the markers read, and with what weights, at φ."""
        return self.chart.reading(_extended(phi)[self.place_places])

    def operator(self, phi: Array) -> sp.csr_array:
        """H as a (3M, 3n) matrix at φ; row 3 m + axis, column 3 node + axis."""
        nodes, reading = self.reading(phi)
        return operator_of(nodes, reading.weights, self.markers.placement.node_count)

    @cached_property
    def place_places(self) -> Index:
        """(M, k) positions in φ of the places of the markers; −1 for exact ones."""
        markers, _, axes = self.chart.axes.shape
        found = np.full((markers, axes), -1)
        found[self.chart.estimated] = self.nuisance.places(PLACE).reshape(-1, found.shape[1])
        return found

    # One sample -------------------------------------------------------------------------------

    @cached_property
    def _neighbours(self) -> int:
        return min(NEIGHBOURS, len(self.grid_rows)) if len(self.nuisance.of_clock) else 1

    @cached_property
    def _first_neighbour(self) -> Index:
        """(T,) the first sample that each one is interpolated from; negative before the start."""
        samples = np.arange(len(self.grid_rows))
        first = samples + self.chart.samples - self._neighbours // 2
        first = np.minimum(first, len(samples) - self._neighbours)
        return first if self.from_rest else np.maximum(first, 0)

    @cached_property
    def _window(self) -> Index:
        """(T, neighbours) samples that each one is interpolated from."""
        return np.maximum(self._first_neighbour[:, None] + np.arange(self._neighbours), 0)

    @cached_property
    def _phi_places(self) -> Index:
        """(M, f) positions in φ of what each marker's reading depends on."""
        return self.nuisance.of_markers(len(self.markers.names))

    @cached_property
    def _sample(self) -> Reading:
        """Of u = (h(x_i), φ of its marker), with the sample's place in the window."""
        inputs = 3 * self._neighbours + self._phi_places.shape[1]
        return Reading(self._reading, inputs, 1, 3, self.huber)

    def _reading(self, u: ca.SX, place: ca.SX) -> ca.SX:
        """The reading y of one sample."""
        nodes, phi = ca.vertsplit(u, [0, 3 * self._neighbours, u.numel()])
        own = (phi, self._phi_places[0] if len(self._phi_places) else np.zeros(0, dtype=np.int64))
        at = ca.reshape(nodes, 3, self._neighbours)
        reading, t_s = at[:, 0], ca.SX(0)
        if len(self.nuisance.of_clock):
            step_s = float(self.markers.t_s[1] - self.markers.t_s[0])
            places = [ca.SX(k) for k in range(self._neighbours)]
            reading = at @ lagrange_weights(
                place + self.nuisance.late_s(*own, t_s) / step_s, places
            )
        return self.nuisance.read(reading, *own, t_s)

    @cached_property
    def _data(self) -> Array:
        """(7, T, M) place in the window, measured position, and 1/σ thrice, of every sample."""
        tracks = np.moveaxis(np.nan_to_num(self.markers.positions_m), 2, 0)
        place = np.arange(tracks.shape[1]) - self._first_neighbour
        place = np.broadcast_to(place[:, None], tracks.shape[1:])
        weights = np.broadcast_to(self.weights[:, ::3], tracks.shape)
        return np.concatenate([place[None], tracks, weights])

    @property
    def _all(self) -> int:
        return len(self.grid_rows)

    def _inputs(self, x: Array, phi: Array, samples: int) -> Array:
        """(3 neighbours + f, samples, M): u of the first samples."""
        nodes, reading = self.reading(phi)
        at = self._read(x, nodes, reading.weights, samples)
        around = np.moveaxis(at[self._window[:samples]], (1, 3), (0, 1))
        places = self._phi_places.T[:, None]
        here = np.broadcast_to(phi[places], (len(places), *around.shape[2:]))
        return np.concatenate([around.reshape(3 * self._neighbours, *around.shape[2:]), here])

    def _read(self, x: Array, nodes: Index, weights: Array, samples: int) -> Array:
        """Σ_a weights[m, a, …] x_a of each marker, (·, M, 3, …), as far as samples are read."""
        rows = self.grid_rows[: self._window[:samples].max() + 1]
        at = x[rows].reshape(len(rows), -1, 3)[:, nodes]
        return np.einsum("ma...,tmai->tmi...", weights, at)

    # All samples ------------------------------------------------------------------------------

    def residuals(self, x: Array, phi: Array) -> Array:
        """(T, 3M) of (y − ŷ) / σ at grid positions x (N, 3n); zero where missing."""
        values = self._sample.residual.value(self._inputs(x, phi, self._all), self._data)
        return np.moveaxis(values, 0, 2).reshape(self._all, -1)

    def at_samples(self, by_p: Array, phi: Array) -> Array:
        """Derivatives of h(x) at the samples, (R, 3M, m), from those of the first rows of x."""
        rows = self.grid_rows[self.grid_rows < len(by_p)]
        _, dofs, moving = by_p.shape
        columns = by_p[rows].transpose(1, 0, 2).reshape(dofs, len(rows) * moving)
        at = self.operator(phi) @ columns
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
        u, data = self._inputs(x, phi, samples), self._data[:, :samples]
        values, by_u = self._sample.residual.slopes(u, data)
        by_nodes = self._by_readings(by_u)
        slope = np.zeros((samples, count, 3, size))
        slope[..., columns] = self._around(by_nodes, at_samples)
        by_phi = np.moveaxis(by_u[:, 3 * self._neighbours :], (0, 1), (2, 3))  # (t, M, 3, f)
        for m, places in enumerate(self._phi_places):
            slope[:, m, :, shared + places] += np.moveaxis(by_phi[:, m], 2, 0)
        of_nodes, reading = self.reading(phi)
        by_place = self._read(x, of_nodes, reading.slopes, samples)[self._window[:samples]]
        for m in self.chart.estimated:
            slope[:, m, :, shared + self.place_places[m]] = np.einsum(
                "riat,tiak->ktr", by_nodes[..., m], by_place[:, :, m]
            )
        return np.moveaxis(values, 0, 2), slope

    def response(self, x: Array, phi: Array, at_samples: Array) -> Array:
        """Change (T, M, 3, c) of the residuals where h(x) at the samples changes by (T, 3M, c)."""
        _, by_u = self._sample.residual.slopes(self._inputs(x, phi, self._all), self._data)
        return self._around(self._by_readings(by_u), at_samples)

    def _by_readings(self, by_u: Array) -> Array:
        """(3, neighbours, 3, t, M) slopes of the residual by h(x) at the neighbours."""
        count, samples = by_u.shape[3], by_u.shape[2]
        of_nodes = by_u[:, : 3 * self._neighbours]
        return of_nodes.reshape(3, self._neighbours, 3, samples, count)

    def _around(self, by_nodes: Array, at_samples: Array) -> Array:
        samples, count = by_nodes.shape[3:]
        around = at_samples.reshape(len(at_samples), count, 3, at_samples.shape[2])
        around = around[self._window[:samples]]
        return np.einsum("riatm,timak->tmrk", by_nodes, around, optimize=True)

    def predicted(self, x: Array, phi: Array) -> Array:
        """Readings y (t, M, 3) [m] at the first grid positions x (rows, 3n), as far as they go."""
        samples = self._readable(x)
        u = self._inputs(x, phi, samples)
        data = self._data[:, :samples].copy()
        data[1:4], data[4:] = 0.0, 1.0
        return np.moveaxis(self._sample.residual.value(u, data), 0, 2)

    def of_samples(self, positions_m: Array, phi: Array) -> Array:
        """Readings (T, M, 3) [m] of the body's positions (T, n, 3) at the samples."""
        rows = np.arange(len(positions_m))
        return replace(self, grid_rows=rows).predicted(positions_m.reshape(len(rows), -1), phi)

    def squared_distances_m2(self, x: Array, phi: Array) -> Array:
        """Squared distances between readings of the first grid positions and present samples."""
        samples = self._readable(x)
        if samples == 0:
            return np.zeros(0)
        tracks, present = self.markers.positions_m[:samples], self.present[:samples]
        return np.sum((self.predicted(x, phi) - tracks) ** 2, axis=2)[present]

    def _readable(self, x: Array) -> int:
        """Samples that the first grid positions suffice to read."""
        rows = np.count_nonzero(self.grid_rows < len(x))
        return int(np.count_nonzero(self._window[:, -1] < rows))

    def loss(self, x: Array, phi: Array) -> float:
        """L(x, φ)."""
        return float(self._sample.loss.value(self._inputs(x, phi, self._all), self._data).sum())

    def gradient(self, x: Array, phi: Array) -> tuple[Array, Array]:
        """∂L/∂x (N, 3n) and ∂L/∂φ (k,)."""
        by_u = self._slope(x, phi)
        at = self._slope_by_reading(x, phi, by_u)
        by_x, by_phi = np.zeros_like(x), np.zeros(self.nuisance.size)
        by_x[self.grid_rows] = (self.operator(phi).T @ at.reshape(len(at), -1).T).T
        np.add.at(by_phi, self._phi_places, by_u[3 * self._neighbours :].sum(axis=1).T)
        nodes, reading = self.reading(phi)
        by_place, here = self._read(x, nodes, reading.slopes, len(at)), self.chart.estimated
        seen = at[: len(by_place)]  # a clock that is off reads nothing of the last rows
        by_phi[self.place_places[here]] = np.einsum("tmi,tmik->mk", seen, by_place)[here]
        return by_x, by_phi

    def _slope(self, x: Array, phi: Array) -> Array:
        """(u, T, M) slope of each sample's loss."""
        _, slope = self._sample.loss.slopes(self._inputs(x, phi, self._all), self._data)
        return slope[0]

    def _slope_by_reading(self, x: Array, phi: Array, by_u: Array | None = None) -> Array:
        """(T, M, 3) slope of the loss by h(x) at each sample."""
        by_u = self._slope(x, phi) if by_u is None else by_u
        nodes = by_u[: 3 * self._neighbours].reshape(self._neighbours, 3, *by_u.shape[1:])
        at = np.zeros((len(self.grid_rows), len(self.markers.names), 3))
        for i in range(self._neighbours):
            np.add.at(at, self._window[:, i], nodes[i].transpose(1, 2, 0))
        return at

    # Second derivatives -----------------------------------------------------------------------

    @cached_property
    def _read_nodes(self) -> tuple[Index, Index]:
        """Markers and corners of their elements that a reading can depend on, both (w,)."""
        reads = self.chart.weights != 0
        reads[self.chart.estimated] = True
        marker, corner = np.nonzero(reads)
        return marker, corner

    @cached_property
    def _entries(self) -> int:
        return 3 * self._neighbours + self._phi_places.shape[1]

    @cached_property
    def _first_phi(self) -> int:
        """Place of the first φ after all x."""
        return (self.grid_rows[-1] + 1) * 3 * self.markers.placement.node_count

    @cached_property
    def _operator_places(self) -> tuple[Index, Index]:
        """Rows and columns of the entries of ∂u/∂(x, φ), in the order of `_operator_values`."""
        nodes, _ = self.reading(np.zeros(self.nuisance.size))
        marker, corner = self._read_nodes
        samples, axes = np.arange(len(self.grid_rows)), np.arange(3)
        neighbour, count = np.arange(self._neighbours), len(self.markers.names)
        sample_marker = (samples[:, None] * count + np.arange(count)) * self._entries  # (T, M)
        inner = 3 * neighbour[:, None] + axes  # (i, axis)
        row_x = sample_marker[:, None, marker, None] + inner[:, None]  # (T, i, w, axis)
        dof = 3 * nodes[marker, corner][:, None] + axes
        grid = self.grid_rows[self._window] * (3 * self.markers.placement.node_count)
        column_x = grid[:, :, None, None] + dof
        common = np.arange(self._phi_places.shape[1])
        row_phi = sample_marker[..., None] + 3 * self._neighbours + common
        column_phi = np.broadcast_to(self._first_phi + self._phi_places, row_phi.shape)
        here = self.chart.estimated
        row_place = sample_marker[:, None, here, None, None] + inner[:, None, :, None]
        shape = (*row_place.shape[:4], self.chart.axes.shape[2])
        column_place = self._first_phi + self.place_places[here][:, None]
        pairs = (
            (row_x, column_x),
            (row_phi, column_phi),
            (np.broadcast_to(row_place, shape), np.broadcast_to(column_place, shape)),
        )
        rows, columns = zip(*pairs, strict=True)
        return (
            np.concatenate([row.ravel() for row in rows]),
            np.concatenate([column.ravel() for column in columns]),
        )

    def _operator_values(self, x: Array, phi: Array) -> Array:
        samples = len(self.grid_rows)
        nodes, reading = self.reading(phi)
        of_x = reading.weights[self._read_nodes]
        of_x = np.broadcast_to(of_x[:, None], (samples, self._neighbours, len(of_x), 3))
        by_place = self._read(x, nodes, reading.slopes, samples)[self._window]
        by_place = by_place[:, :, self.chart.estimated]
        return np.concatenate(
            [of_x.ravel(), np.ones(samples * self._phi_places.size), by_place.ravel()]
        )

    def _operator(self, values: Array) -> sp.csr_array:
        """∂u/∂(x, φ), rows by sample, marker, and entry of u; x by row and dof."""
        rows = len(self.grid_rows) * len(self.markers.names) * self._entries
        shape = (rows, self._first_phi + self.nuisance.size)
        return sp.csr_array((values, self._operator_places), shape=shape)

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
        if not self.markers.names:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        ones = np.ones((len(self.grid_rows), len(self.markers.names), self._entries, self._entries))
        # Positive numbers cannot cancel, so that no entry is lost.
        found = self._hessian(self._operator(np.ones(len(self._operator_places[0]))), ones)
        order = np.lexsort(found.coords)
        rows, columns = (np.asarray(index, dtype=np.int64)[order] for index in found.coords)
        return rows, columns

    def hessian(self, x: Array, phi: Array, bent: bool = True) -> Array:
        """Values of the entries of `hessian_structure`; of readings that are bent, or linear."""
        if not self.markers.names:
            return np.zeros(0)
        if self.nuisance.size == 0 and self.huber is None:
            return self._constant_hessian
        return self._hessian_values(x, phi, bent)

    @cached_property
    def _constant_hessian(self) -> Array:
        dofs = 3 * self.markers.placement.node_count
        return self._hessian_values(np.zeros((self.grid_rows[-1] + 1, dofs)), np.zeros(0), True)

    def _hessian_values(self, x: Array, phi: Array, bent: bool) -> Array:
        by_u = self._sample.curvature(self._inputs(x, phi, self._all), self._data, bent)
        operator = self._operator(self._operator_values(x, phi))
        found = self._hessian(operator, np.moveaxis(by_u, (0, 1), (2, 3)))
        rows, columns = self.hessian_structure
        size = columns[-1] + 1
        codes, values = columns * size + rows, np.zeros(len(rows))

        def add(row: ArrayLike, column: ArrayLike, value: ArrayLike) -> None:
            wanted = np.asarray(column, dtype=np.int64) * size + np.asarray(row, dtype=np.int64)
            np.add.at(values, np.searchsorted(codes, wanted.ravel()), np.ravel(value))

        row, column = found.coords
        add(row, column, found.data)
        if bent and len(self.chart.estimated):
            self._add_curvature_of_places(x, phi, add)
        return values

    def _add_curvature_of_places(self, x: Array, phi: Array, add: Callable[..., None]) -> None:
        """The part of ∂²h/∂(x, X)², weighted with the loss's slope by h."""
        here, at = self.chart.estimated, self._slope_by_reading(x, phi)[:, self.chart.estimated]
        nodes, reading = self.reading(phi)
        dofs = 3 * self.markers.placement.node_count
        dof = 3 * nodes[here][:, :, None] + np.arange(3)  # (m, a, axis)
        row = self.grid_rows[:, None, None, None, None] * dofs + dof[..., None]
        column = self._first_phi + self.place_places[here]
        value = np.einsum("tmi,mak->tmaik", at, reading.slopes[here])
        rows, columns = np.broadcast_arrays(row, column[:, None, None])
        add(rows, columns, value)
        curved = self._read(x, nodes, reading.curvatures, len(at))[:, here]
        value = np.einsum("tmi,tmikl->mkl", at[: len(curved)], curved)
        upper = np.triu(np.ones(value.shape[1:]))
        kept = np.nonzero(np.broadcast_to(upper, value.shape))
        add(column[kept[0], kept[1]], column[kept[0], kept[2]], value[kept])


def operator_of(nodes: Index, weights: Array, node_count: int) -> sp.csr_array:
    """Readings Σ_a weights[m, a] x_a as a (3M, 3n) matrix; row 3 m + axis, column 3 node + axis."""
    marker = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    per_node = sp.csr_array(
        (weights.ravel(), (marker, nodes.ravel())), shape=(len(nodes), node_count)
    )
    per_node.eliminate_zeros()
    return sp.csr_array(sp.kron(per_node, sp.eye_array(3), format="csr"))


def _extended(phi: Array) -> Array:
    """φ with a zero after it, which −1 finds."""
    return np.append(phi, 0.0)
