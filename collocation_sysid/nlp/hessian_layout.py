"""Where the entries of one experiment's Hessian go: the dynamics' band, the loss, and φ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from .block_band import BlockBand


@dataclass(frozen=True, eq=False)
class HessianLayout:
    """Compressed columns of x, then of φ, upper triangle; values in that order.

    Attributes
    ----------
    x_indptr, x_indices : columns of x; rows 0 … nq − 1 are q, then x
    phi_indptr, phi_indices : columns of φ; rows 0 … nq − 1 are q, then x, then φ
    band : place of each entry of the dynamics' band; None where the band is all there is
    loss, scale : place of each entry of the loss, and its factor in scaled variables
    phi : place of each entry (i <= j) of φ by φ, row after row
    by_q : (nq k,) places of the entries of φ that move the body by q, those of one q together
    by_x : (variables k,) those of some of them by all x, those of one x together
    diagonal : places of the diagonal of x
    """

    x_indptr: Index
    x_indices: Index
    phi_indptr: Index
    phi_indices: Index
    band: Index | None
    loss: Index
    scale: Array
    phi: Index
    by_q: Index
    by_x: Index
    diagonal: Index

    @property
    def x_entries(self) -> int:
        """Entries in the columns of x."""
        return len(self.x_indices)

    @property
    def entries(self) -> int:
        """All entries."""
        return self.x_entries + len(self.phi_indices)

    @classmethod
    def of(
        cls,
        band: BlockBand,
        diagonal: Index,
        variables: int,
        nq: int,
        rows: Index,
        columns: Index,
        nphi: int,
        length_m: float,
        moving: Index,
        by_state: Index,
    ) -> HessianLayout:
        """Merge the band in the columns of x with the loss's entries.

        Parameters
        ----------
        diagonal : positions of the diagonal of x in the band
        rows, columns : entries of the loss by (x, φ), upper triangle, sorted by column
        nphi : number of φ
        length_m : unit of the scaled x
        moving, by_state : (k,) which φ have entries by q, and by all x
        """
        of_x = columns < variables
        band_columns = np.repeat(np.arange(variables), np.diff(band.indptr))
        height = nq + variables
        codes = band_columns * height + band.indices
        wanted = columns[of_x] * height + nq + rows[of_x]
        absent = ~_contains(codes, wanted)
        merged = np.sort(np.concatenate([codes, wanted[absent]])) if absent.any() else codes
        x_indptr = np.searchsorted(merged, np.arange(variables + 1) * height)
        loss = np.empty(len(rows), dtype=np.int64)
        loss[of_x] = np.searchsorted(merged, wanted)

        triangle = [(i, j) for j in range(nphi) for i in range(j + 1)]
        dense = np.array(triangle, dtype=np.int64).reshape(-1, 2)
        tall = height + nphi
        of_phi = (columns[~of_x] - variables) * tall + nq + rows[~of_x]
        by_q = (moving * tall + np.arange(nq)[:, None]).ravel()
        by_x = (by_state * tall + nq + np.arange(variables)[:, None]).ravel()
        among_phi = dense[:, 1] * tall + height + dense[:, 0]
        phi_codes = np.unique(np.concatenate([of_phi, by_q, by_x, among_phi]))
        loss[~of_x] = len(merged) + np.searchsorted(phi_codes, of_phi)
        first, second = np.triu_indices(nphi)
        placed = None if merged is codes else np.searchsorted(merged, codes)
        return cls(
            x_indptr=x_indptr,
            x_indices=merged % height,
            phi_indptr=np.searchsorted(phi_codes, np.arange(nphi + 1) * tall),
            phi_indices=phi_codes % tall,
            band=placed,
            loss=loss,
            scale=length_m ** ((rows < variables).astype(float) + (columns < variables)),
            phi=len(merged) + np.searchsorted(phi_codes, second * tall + height + first),
            by_q=len(merged) + np.searchsorted(phi_codes, by_q),
            by_x=len(merged) + np.searchsorted(phi_codes, by_x),
            diagonal=diagonal if placed is None else placed[diagonal],
        )


def _contains(sorted_codes: Index, wanted: Index) -> NDArray[np.bool_]:
    found = np.minimum(np.searchsorted(sorted_codes, wanted), len(sorted_codes) - 1)
    return sorted_codes[found] == wanted
