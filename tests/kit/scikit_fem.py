"""Assembly by scikit-fem, in the order of unknowns of this package."""

from __future__ import annotations

import numpy as np
import skfem


class Library:
    """Scikit-fem's assembly on the same mesh, in this package's order of unknowns."""

    def __init__(self, mesh, element=None, intorder: int = 1) -> None:
        self.basis = skfem.Basis(
            skfem.MeshTet(mesh.points_m.T.copy(), mesh.tetrahedra.T.copy()),
            skfem.ElementVector(element or skfem.ElementTetP1()),
            intorder=intorder,
        )
        nodal_dofs = np.asarray(self.basis.nodal_dofs)
        self.dofs = nodal_dofs.T.ravel()  # node after node, xyz in each
        self.points_m = mesh.points_m
        edge_dofs = np.asarray(self.basis.edge_dofs)
        if edge_dofs.size:
            # Both number edges by their sorted ends, but in orders of their own.
            theirs = np.sort(np.asarray(self.basis.mesh.edges).T, axis=1).tolist()
            column = {tuple(edge): k for k, edge in enumerate(theirs)}
            columns = [column[tuple(edge)] for edge in mesh.edges.tolist()]
            self.dofs = np.concatenate([self.dofs, edge_dofs[:, columns].T.ravel()])
            self.points_m = np.vstack([mesh.points_m, mesh.points_m[mesh.edges].mean(axis=1)])

    def displacement(self, positions):
        nodal = np.zeros(self.basis.N)
        nodal[self.dofs] = (positions - self.points_m).ravel()
        return self.basis.interpolate(nodal)

    def scalar(self, form, positions) -> float:
        return skfem.Functional(form).assemble(self.basis, u=self.displacement(positions))

    def vector(self, form, positions) -> np.ndarray:
        u = self.displacement(positions)
        return skfem.LinearForm(form).assemble(self.basis, u=u)[self.dofs].reshape(-1, 3)

    def matrix(self, form, positions) -> np.ndarray:
        u = self.displacement(positions)
        return (
            skfem.BilinearForm(form)
            .assemble(self.basis, u=u)
            .toarray()[np.ix_(self.dofs, self.dofs)]
        )
