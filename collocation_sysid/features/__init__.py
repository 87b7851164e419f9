"""Features: kinds of measurements and forces, each with all that it contributes to checks and runs.

Runs, checks and verdicts iterate over the features of the kinds that the recordings have, and name
none of them. To add one, write a module with a `Feature` and add it to the registry; its residual,
its force or its recording belong into the packages `program`, `model` and `recording`.

- `feature`: `Feature`, the functions that a feature may declare.
- `registry`: the features, in the order of the residuals.
- `measurements`: comparison of predictions with measurements, for all kinds.
- `wrenches`: likely errors in the description of force sensors, after a fit (`causes`) and by the
  simulation at the guess (`at_guess`).
- `cameras`: likely errors in the description of depth cameras (`poses`), their images (`images`) and
  times (`times`).
- `image_tracks`: tracks of points in the images of ordinary cameras, with all their parts.
- `outlines`: masks of the body in images of ordinary cameras, with all their parts.
- `specimens`: material tests without a mesh.
- `contact`: obstacles (`obstacles`), and bodies in parts or inside obstacles (`placement`).
"""
