"""Statistics of a fit: error bars, systematic effects, identifiability, residuals and the verdict.

Basis
    `linearised` computes residuals and derivatives at the answer, which all other modules use.
    `distributions` has quantiles and tails of common distributions.
Error bars
    `uncertainty` computes the statistical intervals, from the noise (`noise`), correlated errors
    (`process_autocorrelation`, `spatial`), noise of the poses (`pose_noise`) and differences
    between
    recordings (`scatter`); `estimates` expresses them in the user's parameters. `compute_profile`
    computes
    profile-likelihood intervals. `fields` and `phases` treat spatially varying constants.
Combined intervals
    `numerical` is the discretisation error. `assumptions` lists the systematic effects (type B),
    with `shape_error` and `size_effect`; `changes_of_nuisances` propagates them to the residuals
    (consider
    analysis), `budget` to the estimates, and `combined` computes the intervals to publish.
    `remedies` says what to measure.
Checks
    `identifiability` and `scale` describe what the data determine. `diagnostics` analyses the
    residuals of each marker. `relaxation`, `routine_probes` and `deep_probes` relax assumptions and
    refit parts of the data. Misspecification hypotheses (`hypothesis`) are generated without
    simulation by `plausible` and `placement_causes`, with natural modes by `modal`, for depth
    cameras by `cameras`, and after a fit by `causes` and `wrench_causes`. `trust` combines
    everything into a verdict with the messages of `concern`.
"""
