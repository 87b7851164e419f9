"""Statistics of a fit: error bars, systematic effects, identifiability, residuals and the verdict.

Basis
    `linearised` computes residuals and derivatives at the answer, which all other modules use.
    `distributions` has quantiles and tails of common distributions.
Error bars
    `uncertainty` computes the statistical intervals, from the noise (`noise_level`), correlated
    errors (`autocorrelation`, `spatial_correlation`), noise of the poses (`pose_noise`) and
    differences between recordings (`recording_scatter`); `estimates` expresses them in the user's
    parameters. `profile_likelihood` computes profile-likelihood intervals. `field_estimates` and
    `phase_sampling` treat spatially varying constants.
Combined intervals
    `discretisation_error` is the discretisation error. `systematic_effects` lists the systematic
    effects (type B), with `shape_error` and `size_effect`; `consider_analysis` propagates them
    to the residuals (consider analysis), `uncertainty_budget` to the estimates, and
    `combined_intervals` computes the intervals to publish. `remedies` says what to measure.
Checks
    `identifiability` and `scale_identifiability` describe what the data determine.
    `residual_diagnostics` analyses the residuals of each marker. `relaxed_assumptions`,
    `routine_probes` and `deep_probes` relax assumptions and refit parts of the data.
    Misspecification hypotheses (`misspecification_hypothesis`) are generated without simulation by
    `plausibility` and `placement_causes`, with natural modes by `modal_misspecifications`, for
    depth cameras by `camera_misspecifications`, and after a fit by `fit_misspecifications` and
    `wrench_causes`. `assessment` combines everything into a verdict with the messages of
    `concerns`.
"""
