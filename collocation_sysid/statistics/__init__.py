"""Statistics of a fit: error bars, systematic effects, identifiability, residuals and the verdict.

Basis
    `linearised` computes residuals and derivatives at the answer, which all other modules use.
    `distributions` has quantiles and tails of common distributions.
Error bars
    `uncertainty` computes the statistical intervals, from the noise, correlated errors and
    differences between recordings (package `residuals`) and the noise of the poses (`pose_noise`);
    `estimates` expresses them in the user's parameters. `field_estimates` treats
    spatially varying constants.
Combined intervals
    The package `budget` adds the discretisation error and systematic effects (type B) and computes
    the intervals to publish.
Checks
    `combinations` and `scale_identifiability` describe what the data determine. `hypothesis` is a
    likely mistake in the description, which the package `judge` finds (`axes`: exchanged or reversed
    axes); `plausibility` has sizes, densities and copies. `stability_concerns` judges materials.
    `assessment` combines everything into a verdict with the messages of `concerns`.
"""
