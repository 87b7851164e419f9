"""Small motions about an equilibrium.

- `natural_modes`: natural frequencies and modes; `stability`: stability of time integration.
- `modal_prediction`: approximate predictions while the stiffness is unknown.
"""
