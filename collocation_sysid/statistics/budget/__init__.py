"""Uncertainty budget: systematic effects (type B), their propagation and combined intervals.

- `systematic_effects`: the effects and their standard uncertainties, with `shape_error`,
  `obstacle_effects`, `platen_slip` and `memory_effect`; `discretisation_error`: errors of time step
  and mesh.
- `consider_analysis`: their effect on the residuals (Schmidt); `variance_sources`: on the
  estimates; `combined_intervals`: the intervals to publish.
"""
