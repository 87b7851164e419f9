"""Thresholds of all tests of a fit: each number with its reason, and its study.

A test decides by one of these numbers: the verdict (`assessment`), the effects of the budget
(`effect_estimates`), and the refits of likely mistakes (package `judge`). Limits of effort, and
ranges of what is physically possible, stand where they are used.
"""

from __future__ import annotations


class Threshold(float):
    """Number with its reason; used like the number.

    Attributes
    ----------
    reason : str
        Meaning, and reason for the value, as sentences.
    study : str
        Page of docs/studies whose cases decide by the test; "" if there is none.
    """

    reason: str
    study: str

    def __new__(cls, value: float, reason: str = "", study: str = "") -> Threshold:
        made = super().__new__(cls, value)
        made.reason, made.study = reason, study
        return made


RARE = Threshold(
    1e-4,
    "Probability of a false alarm of each test: at least 95 % of fits to faultless data are "
    "to be good, however many tests there are.",
    study="verdict_reliability",
)
MISFIT = Threshold(
    1.5,
    "Residuals over sigma, or sigma over residuals: from here on check. The noise of cameras "
    "is known to about this factor.",
    study="verdict_reliability",
)
GROSS_MISFIT = Threshold(
    3.0,
    "Residuals over sigma: from here on doubtful if they are not white, or are those of a "
    "prediction; the only threshold for doubtful residuals.",
    study="verdict_reliability",
)
MARKER_MISFIT = Threshold(
    2.0, "Factor by which one marker may be noisier than the others.", study="verdict_reliability"
)
PERSISTENT = Threshold(
    0.2,
    "Autocorrelation from which on residuals are not noise, if it is significant.",
    study="verdict_reliability",
)
CLEARLY_PERSISTENT = Threshold(
    0.8,
    "Autocorrelation of residuals of more than `GROSS_MISFIT` that are not noise, although "
    "the samples are too few for a test at the level `RARE`.",
    study="verdict_reliability",
)
ROLLOUT = Threshold(
    0.35,
    "Additional misfit of a forward simulation, over that of the fit or of noise: check.",
    study="verdict_reliability",
)
GROSS_ROLLOUT = Threshold(
    2.0,
    "The additional misfit of a forward simulation that is doubtful.",
    study="verdict_reliability",
)
PREDICTION = Threshold(
    3.0,
    "Misfit of a prediction over that of the fit or of noise: check.",
    study="verdict_reliability",
)
GROSS_PREDICTION = Threshold(
    10.0, "The misfit of a prediction that is doubtful.", study="verdict_reliability"
)
OWN_ONSET = Threshold(
    2.0,
    "Onset of a validation recording in standard deviations of its prior: check.",
    study="verdict_reliability",
)
ABSURD = Threshold(
    6.0,
    'Nuisance parameters in standard deviations of their priors: "doubtful".',
    study="verdict_reliability",
)
LATE = Threshold(
    3.0, "Time shift in standard deviations of its prior: check.", study="verdict_reliability"
)
HARDLY_TAME = Threshold(
    0.2,
    "Share of the samples beyond Huber's threshold that is doubtful.",
    study="verdict_reliability",
)
DAMPING_SHARE = Threshold(0.2, "Damping ratio that a scheme adds, over that of the mode: check.")
GROSS_DAMPING_SHARE = Threshold(
    1.0, "The added damping ratio over that of the mode that is doubtful."
)
LITTLE_DAMPING = Threshold(0.005, "Added damping ratio that never matters.")
PERIOD_ERROR = Threshold(0.02, "Relative change of a period by the scheme: check.")
GROSS_PERIOD_ERROR = Threshold(0.1, "The relative change of a period that is doubtful.")
E_FOLDINGS = Threshold(1.0, "Powers of e by which a disturbance may grow in a recording: check.")
GROSS_E_FOLDINGS = Threshold(7.0, "The powers of e that are doubtful.")
MOVED = Threshold(
    2.0,
    "Combined standard uncertainties by which step and mesh may change a parameter: the half "
    "width of its 95 % interval.",
    study="verdict_reliability",
)
AS_GOOD_AS_CERTAIN = Threshold(
    2.0, "Factor of the misfit from which on a hypothesis is as good as certain.", study="mistakes"
)
MOST_WILD = Threshold(
    0.05,
    "Share of the samples beyond Huber's threshold that noise alone may explain.",
    study="verdict_reliability",
)
NOISE = Threshold(
    1.15,
    "RMS residual over σ up to which residuals count as noise, whatever their correlation.",
    study="verdict_reliability",
)
CHANCE = Threshold(
    0.01,
    "Probability that a faultless run has any effect of the budget that is not expected, or "
    "residuals that are larger than noise.",
    study="verdict_reliability",
)
BETTER = Threshold(
    1.5,
    "Factor by which the misfit of a refit must decrease, unless only noise remains.",
    study="mistakes",
)
CERTAIN = Threshold(
    4.0,
    "Factor of the misfit from which on no other hypothesis, and no other specimen, is tested.",
    study="mistakes",
)
ESTIMATED_LAGS = Threshold(
    2.0,
    "Standard deviations of an estimated time shift up to which the fit follows a lag by itself.",
    study="mistakes",
)
INDISTINGUISHABLE = Threshold(
    10.0,
    "Difference of losses (χ²) below which two corrections explain the data equally well.",
    study="mistakes",
)
PARTIAL = Threshold(
    0.7,
    "Strength over the largest one from which on a correction that does not suffice is mentioned.",
    study="mistakes",
)
FAR = Threshold(
    6.0,
    "Error of gravity or of the pose in the grasp, in standard deviations, from which on mirror "
    "images of the mesh and other directions of gravity are fitted.",
    study="mistakes",
)
LEAST_IMPROVEMENT = Threshold(2.0, "Factor by which the misfit must decrease.", study="mistakes")
FITTED = Threshold(1.5, "Additional factor for hypotheses with fitted numbers.", study="mistakes")
ONE_OF_MANY = Threshold(
    1.05, "Additional factor for each of many variants of one mistake.", study="mistakes"
)
LEAST_DECREASE = Threshold(
    16.0,
    "Decrease of χ² by a linear step below which a hypothesis is not fitted again: e⁻⁸ as likely.",
    study="mistakes",
)
UNCORRELATED = Threshold(
    2.0,
    "Autocorrelation of its residuals, in standard deviations of that of noise, 1/√n, up to "
    "which they are noise.",
    study="mistakes",
)
LIKELIER = Threshold(
    6.0,
    "Decrease of χ² from which on one kind of test is likelier than another, if E changes by "
    "`KIND_CHANGE`: a wrong answer then costs more than a question. Right tests reach it in at most "
    "2 of 100 cases.",
    study="specimens",
)
KIND_CHANGE = Threshold(
    0.4,
    "Change of the logarithm of E, a factor of 1.5, from which on another kind of test is named "
    "although the stated one fits.",
    study="specimens",
)
DENSITY_DEVIATION = Threshold(
    0.05,
    "Deviation of the mass over the volume of the mesh from the known density: data sheets "
    "are right to 1 %, meshes and balances too.",
    study="mistakes",
)
SECTION_RATIO = Threshold(
    0.03,
    "Relative difference up to which the ratio of both is that of a round and a square section.",
    study="mistakes",
)
AGAINST = Threshold(
    -0.8,
    "Correlation of load and displacement below which a sign is wrong; noise and hysteresis "
    "leave it positive.",
    study="mistakes",
)
NOTEWORTHY = Threshold(
    1.1,
    "Residuals this many times sigma, below which there is nothing to explain.",
    study="specimens",
)
OFFSET_FALSE_ALARMS = Threshold(
    0.01, "Probability of a false alarm of the F test.", study="specimens"
)
NAMED_ERRORS = Threshold(
    1.5, "Offset over its standard error from which on its specimen is named.", study="specimens"
)

# Every threshold, by its name.
THRESHOLDS = {name: each for name, each in [*vars().items()] if isinstance(each, Threshold)}
