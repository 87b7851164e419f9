"""Thresholds of all tests of a fit: each number with its reason.

A test decides by one of these numbers: the verdict (`assessment`), the effects of the budget
(`effect_estimates`), and the refits of likely mistakes (package `judge`). Limits of effort, and
ranges of what is physically possible, stand where they are used.
"""

from __future__ import annotations

# Probability of a false alarm of each test: at least 95 % of fits to faultless data are to be
# good, however many tests there are.
RARE = 1e-4
# Residuals over sigma, or sigma over residuals: from here on check. The noise of cameras is
# known to about this factor.
MISFIT = 1.5
# Residuals over sigma: from here on doubtful if they are not white, or are those of a
# prediction; the only threshold for doubtful residuals.
GROSS_MISFIT = 3.0
# Factor by which one marker may be noisier than the others.
MARKER_MISFIT = 2.0
# Autocorrelation from which on residuals are not noise, if it is significant.
PERSISTENT = 0.2
# Autocorrelation of residuals of more than `GROSS_MISFIT` that are not noise, although the
# samples are too few for a test at the level `RARE`.
CLEARLY_PERSISTENT = 0.8
# Additional misfit of a forward simulation, over that of the fit or of noise: check.
ROLLOUT = 0.35
# The additional misfit of a forward simulation that is doubtful.
GROSS_ROLLOUT = 2.0
# Misfit of a prediction over that of the fit or of noise: check.
PREDICTION = 3.0
# The misfit of a prediction that is doubtful.
GROSS_PREDICTION = 10.0
# Onset of a validation recording in standard deviations of its prior: check.
OWN_ONSET = 2.0
# Share of the samples beyond Huber's threshold that is doubtful.
HARDLY_TAME = 0.2
# Damping ratio that a scheme adds, over that of the mode: check.
DAMPING_SHARE = 0.2
# The added damping ratio over that of the mode that is doubtful.
GROSS_DAMPING_SHARE = 1.0
# Added damping ratio that never matters.
LITTLE_DAMPING = 0.005
# Relative change of a period by the scheme: check.
PERIOD_ERROR = 0.02
# The relative change of a period that is doubtful.
GROSS_PERIOD_ERROR = 0.1
# Powers of e by which a disturbance may grow in a recording: check.
E_FOLDINGS = 1.0
# The powers of e that are doubtful.
GROSS_E_FOLDINGS = 7.0
# Combined standard uncertainties by which step and mesh may change a parameter: the half width
# of its 95 % interval.
MOVED = 2.0
# Factor of the misfit from which on a hypothesis is as good as certain.
AS_GOOD_AS_CERTAIN = 2.0
# Share of the samples beyond Huber's threshold that noise alone may explain.
MOST_WILD = 0.05
# RMS residual over σ up to which residuals count as noise, whatever their correlation.
NOISE = 1.15
# Probability that a faultless run has any effect of the budget, or nuisance parameter, that is not
# expected, or residuals that are larger than noise.
CHANCE = 0.01
# Factor by which the misfit of a refit must decrease, unless only noise remains.
BETTER = 1.5
# Factor of the misfit from which on no other hypothesis, and no other specimen, is tested.
#
CERTAIN = 4.0
# Standard deviations of an estimated time shift up to which the fit follows a lag by itself.
#
ESTIMATED_LAGS = 2.0
# Difference of losses (χ²) below which two corrections explain the data equally well.
INDISTINGUISHABLE = 10.0
# Strength over the largest one from which on a correction that does not suffice is mentioned.
#
PARTIAL = 0.7
# Error of gravity or of the pose in the grasp, in standard deviations, from which on mirror
# images of the mesh and other directions of gravity are fitted.
FAR = 6.0
# Factor by which the misfit must decrease.
LEAST_IMPROVEMENT = 2.0
# Additional factor for hypotheses with fitted numbers.
FITTED = 1.5
# Additional factor for each of many variants of one mistake.
ONE_OF_MANY = 1.05
# Decrease of χ² by a linear step below which a hypothesis is not fitted again: e⁻⁸ as likely.
#
LEAST_DECREASE = 16.0
# Autocorrelation of its residuals, in standard deviations of that of noise, 1/√n, up to which
# they are noise.
UNCORRELATED = 2.0
# Decrease of χ² from which on one kind of test is likelier than another, if E changes by
# `KIND_CHANGE`: a wrong answer then costs more than a question. Right tests reach it in at most
# 2 of 100 cases. Study: specimens.
LIKELIER = 6.0
# Change of the logarithm of E, a factor of 1.5, from which on another kind of test is named
# although the stated one fits. Study: specimens.
KIND_CHANGE = 0.4
# Deviation of the mass over the volume of the mesh from the known density: data sheets are right
# to 1 %, meshes and balances too.
DENSITY_DEVIATION = 0.05
# Relative difference up to which the ratio of both is that of a round and a square section.
#
SECTION_RATIO = 0.03
# Correlation of load and displacement below which a sign is wrong; noise and hysteresis leave it
# positive.
AGAINST = -0.8
# Residuals this many times sigma, below which there is nothing to explain. Study: specimens.
NOTEWORTHY = 1.1
# Probability of a false alarm of the F test. Study: specimens.
OFFSET_FALSE_ALARMS = 0.01
# Offset over its standard error from which on its specimen is named. Study: specimens.
NAMED_ERRORS = 1.5
