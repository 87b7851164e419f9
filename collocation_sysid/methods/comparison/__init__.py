"""Methods of the literature, to compare with reduced space and interior point.

`penalty` is the quadratic penalty of the paper and the augmented Lagrangian; `merit` is their merit
function, which `conjugate_gradients` and `levenberg_marquardt` minimise. `shooting` is single
shooting. `casadi_nlp` contains further NLP solvers of CasADi.
"""
