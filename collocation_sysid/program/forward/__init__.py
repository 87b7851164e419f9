"""Forward simulation of one experiment from its initial equilibrium.

- `scheme_simulation`: simulation by a collocation scheme; `newmark`: by Newmark's method, as an
  independent check.
- `newton_solver`: Newton's method for one time step or an equilibrium; `newton_linearisation`: the
  equations that it solves, linearised; `condensed_steps`: time steps with local forces, condensed
  to the dofs on which they act; `retraction`: updates of positions by rotation and strain.
- `initial_equilibrium`: static equilibrium; `loss_of_stability`: buckling and wrinkling on the way;
  `stable_path`: whether equilibria are on the path to which the loads lead.
"""
