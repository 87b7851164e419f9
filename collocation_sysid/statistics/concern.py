"""What speaks against an answer, or gives concern before a solve: a code, how grave, and data.

Sentence and cure are looked up by the code, of which the first part is the topic: "noise/larger"
is about the noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from ..errors import listed

Grade = Literal["check", "doubtful"]

# By code; of others the sentence is in the data, as `said`.
SENTENCES: Mapping[str, str] = {
    "description/cause": "likely: {said}",
    "noise/larger": "the residuals are {factor:.2g} times as large as {stated} says",
    "noise/smaller": "{stated} seems {factor:.2g} times too large for these residuals",
    "noise/marker": "{marker} is off by {factor:.2g} times sigma_m",
    "noise/markers": "{count} markers, most of all {marker}, are off by {factor:.2g} times sigma_m",
    "noise/allowance": "sigma_m = {sigma_mm:.3g} mm is {share:.2g} of the body's size, more than "
    "cameras miss: if the model's error decides, error bars of independent errors are too short",
    "residuals/persist": "the residuals are not noise: they persist from sample to sample "
    "(autocorrelation {autocorrelation:.2f})",
    "residuals/shared": "the residuals are not noise: markers or axes share them",
    "residuals/recordings": "the recordings disagree on {names}: model error decides, not noise",
    "residuals/wild": "{percent:.0f} % of the samples are beyond Huber's threshold",
    "residuals/far": "{percent:.0f} % of the markers' samples lie far from where they can be",
    "information/bound": "{names} ended at its bound",
    "information/bounds": "{names} ended at their bounds",
    "information/none": "these data do not tell {names}",
    "information/at-bound": "{name} is at a bound",
    "information/not-yet": "{name} is not known yet: {reason}",
    "nuisance/limit": "{name} ended at the largest value allowed",
    "nuisance/far": "{name} is {deviations:.1f} deviations of its prior away from zero",
    "nuisance/clock": "the markers of '{experiment}' were seen {shift_ms:.2g} ms {when} than their "
    "times say: the estimates allow for it; better find out why",
    "scheme/step": "the step moves {name} by {percent:+.2g} %, {errors:.2g} standard errors: its "
    "interval allows for that; raise transcription.substeps, or run refine to measure it",
    "scheme/damping": "the scheme adds a damping ratio of {added:.2g} to the {damping:.2g} of the "
    "first mode of '{experiment}'",
    "scheme/period": "the scheme changes the first period of '{experiment}' by {change:+.1%}",
    "mesh/refined": "step and mesh move {name} by {percent:+.2g} %, {errors:.2g} standard errors: "
    "its interval allows for that",
    "roll-out/failed": "the forward simulation of '{experiment}' failed: {said}",
    "roll-out/misses": "the forward simulation of '{experiment}' misses by {rms_mm:.2g} mm, "
    "the fit by {fit_mm:.2g} mm",
    "roll-out/predicted": "'{experiment}' is predicted {times:.2g} times worse than the others are "
    "fitted",
    "solve/lost": "the solve did not converge: {said}",
    "solve/acceptable": "the solve converged to the acceptable tolerance only",
    "solve/no-error-bars": "no error bars could be found",
    "solve/interrupted": "interrupted: {said}",
    "solve/moves": "the estimate still moves: it is farther than its error bar from where it was "
    "simulated",
    "solve/anew": "restarted {times}, as if the body had been at rest there",
}


@dataclass(frozen=True)
class Concern:
    """One thing that gives concern.

    Attributes
    ----------
    code : str
        Topic and what it is, such as "noise/larger"; stays the same where words change.
    grade : {"check", "doubtful"}
    data : mapping
        What its sentence holds.
    """

    code: str
    grade: Grade = "check"
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def topic(self) -> str:
        """What it is about, by which it is cured."""
        return self.code.partition("/")[0]

    @property
    def sentence(self) -> str:
        """The same for people."""
        data = {k: listed(v) if isinstance(v, (list, tuple)) else v for k, v in self.data.items()}
        return SENTENCES.get(self.code, "{said}").format(**data)


def concerned(found: bool, gross: bool, code: str, **data: Any) -> list[Concern]:
    """A concern where there is one, doubtful where it is gross."""
    return [Concern(code, "doubtful" if gross else "check", data)] if found else []


def as_said(code: str, sentences: Iterable[str]) -> list[Concern]:
    """Concerns of one code whose sentences were made elsewhere."""
    return [Concern(code, data={"said": sentence}) for sentence in sentences]
