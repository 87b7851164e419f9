"""What error bars do not tell by themselves, in sentences that end with the remedy."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..fem.constants import SHARE, TAU, bare, is_damping
from ..model.parameters import Parameters
from .autocorrelation import Dependence
from .estimates import Estimate
from .linearised import LinearisedFit
from .noise import Noise, NoiseLevel
from .scatter import Scatter

# A relaxation time beyond so many recordings is not seen to end.
LONG = 1.0
# Residuals this many times sigma, or one over it, are worth a word.
NOTEWORTHY = 1.1


def parameter_notes(parameters: Parameters, estimates: Mapping[str, Estimate]) -> list[str]:
    """Parameters at a bound, not determined, or not identifiable."""
    notes, reasons = [], {}
    for item in parameters.free:
        name, found = item.name, estimates[item.name]
        if found.at_bound:
            nearer = min(
                ("lower", "upper"), key=lambda side: abs(getattr(item, side) - found.value)
            )
            notes.append(
                f"{name} ended at its {nearer} bound {getattr(item, nearer):g}: it has no error "
                "bar, and the others' allow for other values of it; widen the bound, or fix it "
                "if it is known"
            )
        elif found.ci95 is None:
            damping = is_damping(name)
            by = ": no information on damping in these data" if damping else " by these data"
            notes.append(
                f"{name} is not determined{by}; fix it, give it a prior, or move the body"
                f"{'' if damping else ' differently'}"
            )
        elif found.std_error is None:
            reasons[name] = str(found.reason)
    return [*notes, *_unidentifiable(reasons)]


def _unidentifiable(reasons: Mapping[str, str]) -> list[str]:
    """One sentence a parameter, and one for two that are confounded with each other."""
    notes, told = [], set()
    for name, reason in reasons.items():
        because, other = reason, reason.removeprefix("confounded with ").split(" ")[0]
        which, pronoun = f"{name} is", "it"
        if reasons.get(other, "").startswith(f"confounded with {name} "):
            which, pronoun = f"{name} and {other} are", "one of them"
            because = reason.replace(other, "each other", 1)
        if other not in told:
            notes.append(
                f"{which} not identifiable from these data: {because}; fix {pronoun}, give it a "
                "prior, or move the body differently"
            )
        told.add(name)
    return notes


def memory_notes(estimates: Mapping[str, Estimate], longest_s: float) -> list[str]:
    """Branches of a memory that were not found, and those slower than the longest recording."""
    notes = []
    for name, share in estimates.items():
        if bare(name) != SHARE.name:
            continue
        branch = name.removesuffix(f".{SHARE.name}")
        tau = estimates.get(f"{branch}.{TAU.name}")
        if share.at_bound and share.value < 1e-6:
            notes.append(
                f"no memory found: the share of {branch} ended at 0, and its relaxation time "
                "means nothing; leave that branch out"
            )
        elif share.ci95 is not None and share.ci95[0] <= 0:
            notes.append(
                f"no memory is told from none: the share of {branch} may be 0, and is at most "
                f"{share.ci95[1]:.2g} (95 %)"
            )
        elif (share.at_bound or share.ci95) and tau and tau.value > LONG * longest_s:
            notes.append(
                f"{branch} relaxes within {tau.value:.2g} s, slower than the longest recording of "
                f"{longest_s:.2g} s: its share and long-term moduli rest on how it begins; record "
                "for longer"
            )
    return notes


def size_notes(asked: str, kind: Noise, level: NoiseLevel, errors: str) -> list[str]:
    """Residuals larger or smaller than σ as stated, and what error bars make of that.

    Parameters
    ----------
    asked, kind : what the errors' size was to be taken from, and what it is taken from
    level : NoiseLevel
    errors : {"independent", "autocorrelated"}
    """
    if asked == "estimated" or level.kind == "given":
        return []
    factor, stated = float(np.sqrt(level.pooled)), level.stated
    low, high = (pick(level.factors, key=level.factors.__getitem__) for pick in (min, max))
    if level.unequal and level.factors[high] > NOTEWORTHY**2 * level.factors[low]:
        least, most = f"{level.factors[low]:.2g} ({low})", f"{level.factors[high]:.2g} ({high})"
        size = f"between {least} and {most} times as large as {stated} says"
    elif factor > NOTEWORTHY:
        size = f"{factor:.2g} times as large as {stated} says"
    elif factor < 1 / NOTEWORTHY:
        size = f"only {factor:.2g} times as large as {stated} says: it seems {1 / factor:.2g} "
        size += "times too large"
    else:
        return []
    if kind != "given" or (factor > 1 and errors == "autocorrelated"):
        so = f"the error bars follow the residuals. Check {stated} and the model"
    elif factor > 1:
        so = "the error bars are too small by about that much; check "
        so += f"{stated} and the model, or use noise = 'auto'"
    elif asked == "given":
        so = f"the error bars keep to {stated}, as asked for"
    else:
        so = f"the residuals are not independent, so the error bars keep to {stated}"
    return [f"the residuals are {size}; {so}"]


def correlation_notes(asked: str, errors: str, found: Dependence) -> list[str]:
    """Residuals that hang together, and what error bars make of that."""
    if not found.found or (errors != "autocorrelated" and asked != "independent"):
        return []
    pattern = "have parts that markers or axes share"
    if found.in_time:
        pattern = f"persist from sample to sample (autocorrelation {found.lag1:.2f})"
    if errors == "autocorrelated":
        return [
            f"the residuals {pattern}: noise seldom does, so something is missing in the "
            "model or in the experiment's description. The error bars are widened by a model of "
            "autocorrelated errors; a bias is not covered"
        ]
    return [
        f"the residuals {pattern}, but error bars for independent errors were asked for: too small"
    ]


def scatter_notes(fit: LinearisedFit, scatter: Scatter | None) -> list[str]:
    """Recordings that disagree."""
    if scatter is None:
        return []
    return [
        f"the recordings disagree on {fit.names[k]} (χ² {scatter.chi_squared[k]:.3g} for "
        f"{scatter.freedom[k]} degrees of freedom): model error decides, and its interval holds "
        "what they disagree by"
        for k in np.flatnonzero(scatter.disagreeing).tolist()
    ]
