"""Runs: the operations on a problem, and their results.

- `check`: examine a problem before it is solved.
- `solving`: solve it, `several_starts` for local minima, `warm_start` for a start from an earlier run,
`smaller_problem` for starts from smaller problems: on a coarser mesh, and with fewer points of cameras.
- `forward_simulation`: simulate recordings with the estimates, and compare with the
measurements.
- `verdict`: concerns about a solution; `mesh_resolution`: concerns about too coarse meshes;
- `numerical_error`: solve at finer discretisations, for the numerical error.
- `solved_problem`: the solved problem with all of this; `result_builder` converts it to
  `result_content`, the content of
``result.json``.
"""
