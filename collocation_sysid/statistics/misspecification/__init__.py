"""Misspecification hypotheses: mistakes in a description that would explain the misfit.

- `hypothesis`: a hypothesis, its strength and how hypotheses are ranked.
- `plausibility`: contradictions that no simulation is needed for; `modes`:
  predictions by natural modes; `initial_motion`: bodies that were not at rest at the beginning.
- `refits`: hypotheses after a fit.

Hypotheses about force sensors, cameras, specimens and obstacles are in the package `features`.
"""
