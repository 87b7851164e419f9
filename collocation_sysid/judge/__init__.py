"""Judgement of an answer; no module of a search imports this package.

- `posterior`: parameters, nuisance parameters and effects of the budget in one fit, for a solution
  by `augmented_fit`.
- `doubt`: a likely mistake in a description, its correction, and the test by the misfit that
  remains.
- `contradictions`, `modes` and `initial_motion` need no fit; `bodies`, `sensors` and `tracks` belong to
  a fit, which `engine` tests by linear steps and refits.
- `registry` lists the likely mistakes of the features, `source` declares what these contribute.
"""
