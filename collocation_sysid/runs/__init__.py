"""Runs: the operations on a problem, and their results.

- `check`: examine a problem before it is solved.
- `solving`: solve it, by the `searches` of a list: of smaller problems first (`smaller_problem`: a coarser
  mesh, some samples, fewer points of cameras), then from `several_starts`; `warm_start` for a start from an
  earlier run.
- `forward_simulation`: simulate recordings with the estimates, and compare with the
measurements.
- `verdict`: concerns about a solution; `mesh_resolution`: concerns about too coarse meshes;
- `numerical_error`: solve at finer discretisations, for the numerical error.
- `solved_problem`: the solved problem with all of this; `result_builder` converts it to
  `result_content`, the content of
``result.json``.
"""
