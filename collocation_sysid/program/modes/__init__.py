"""Small motions about an equilibrium.

- `natural`: natural frequencies and modes; `stability`: stability of time integration.
- `modal_prediction`: approximate predictions while the stiffness is unknown.
"""
