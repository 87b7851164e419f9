"""Starts of a search: parameters and trajectories from which a method begins.

- `stiffness_scan`: parameters without a guess, by simulations; `power_law`: constants of power laws,
  from closed forms of specimens.
- `initial_trajectories`: motions at the guess; `initial_point`: a coarse solution by reduced space, for
  interior point.
"""
