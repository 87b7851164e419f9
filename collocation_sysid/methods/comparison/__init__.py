"""Methods of the literature, to compare with reduced space and interior point.

`penalty` is the quadratic penalty of the paper and the augmented Lagrangian; `merit` is their merit
function and `inner` their inner solvers, of which `cg_descent` and `levenberg_marquardt` are
implemented here. `shooting` is single shooting. `casadi_nlp` contains further NLP solvers of
CasADi.
"""
