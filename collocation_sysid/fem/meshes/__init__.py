"""Tetrahedral meshes: construction, checks, files and selections.

- `mesh`: tetrahedral mesh and nodes of the elements; `checks` validates it.
- `structured`: boxes and cylinders; `surface`: mesh of a closed surface; `refinement`: finer
  meshes;
  `coarsening`: coarser meshes.
- `files`: files; `selection`: nodes, cells and faces by position or name.
"""
