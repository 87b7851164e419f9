"""Likely mistakes in a description that would explain a misfit; no module of a search imports it.

- `doubt`: a row, its correction, and the test by the misfit that remains; `texts`: all messages.
- `contradictions`, `modes` and `initial_motion` need no fit; `bodies`, `sensors` and `tracks` belong to
  a fit, which `engine` tests by linear steps and refits.
- `registry` lists the likely mistakes of the features, `source` declares what these contribute.
"""
