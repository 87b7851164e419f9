"""What to do about a concern: a sentence or two, and the how-to page that says more."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Remedy:
    """A cure.

    Attributes
    ----------
    about : str
        Its title.
    words : str
        Regular expression of the concerns that it is for.
    cure : str
    page : str
        The page of `docs/howto` that says more.
    """

    about: str
    words: str
    cure: str
    page: str

    @property
    def anchor(self) -> str:
        """Where it is on a web page."""
        return "cure-" + re.sub(r"\W+", "-", self.about.lower()).strip("-")


REMEDIES = (
    Remedy(
        "The scale",
        r"^only the ratios",
        "Measure a force, tie on a known mass, or fix a density: motion alone tells ratios only.",
        "forces",
    ),
    Remedy(
        "The description",
        r"^likely:|times nearer|poses jump|slips (by|at)|density|dense|m large|is as .* as|"
        r"mm across|cuts through elements",
        "Compare units, frames, labels and clocks of the problem file with the laboratory's notes; "
        "check draws conclusions from the recordings before any solve.",
        "wrong_description",
    ),
    Remedy(
        "The size of the noise",
        r"sigma_n?m?\b",
        "Error bars follow the residuals. State the sensor's noise in sigma where it is known; "
        "where one marker alone is off, look at its track for swaps and reflections.",
        "verdict",
    ),
    Remedy(
        "Residuals that are not noise",
        r"not noise|disagree|Huber",
        "Look at the residuals over time: a constant part is a place or an offset, a large "
        "beginning the time of release, an oscillation stiffness or damping that differ. "
        "compare --materials tells whether another model predicts better.",
        "trust",
    ),
    Remedy(
        "What the data do not tell",
        r"do not tell|ended at (its|their) bound|no information|"
        r"samples a period|than the .* recorded",
        "Fix such a parameter at a known value, give it a prior or wider bounds, or record a "
        "motion that it matters to.",
        "trust",
    ),
    Remedy(
        "The markers",
        r"^marker ",
        "Look at the markers' labels, unit, frame and places, and at when each is seen.",
        "motion_capture",
    ),
    Remedy(
        "What is not known of a recording",
        r"deviations? of its prior|largest value allowed|times say",
        "Look whether it can be true: gravity, clock, grasp or places as the file describes them. "
        "If so, widen its prior in [experiment.nuisance].",
        "motion_capture",
    ),
    Remedy(
        "Step and scheme",
        r"the step moves|scheme (adds|changes)|steps a period|damping ratio|turns? by|rad within",
        "Raise transcription.substeps, or take the midpoint scheme, which damps least. "
        "refine RUN measures what is left.",
        "scheme",
    ),
    Remedy(
        "States that are not stable",
        r"disturbances grow",
        "Look whether the body buckles there. If not, the damping feeds energy in: take "
        'damping = "kelvin-voigt", which cannot, and see that moduli and densities can be true.',
        "material",
    ),
    Remedy(
        "The mesh",
        r"step and mesh move|elements lock|elements lie across|nearly flat",
        'Refine it, and take element = "tet10", or "tet10-p0" from ν = 0.45 on. '
        "refine RUN measures what is left.",
        "mesh",
    ),
    Remedy(
        "The roll-out",
        r"roll-out|predicted",
        "Where the fit is good and the simulation is not, the step is too long; where a recording "
        "is predicted badly, the model lacks something that this recording shows.",
        "trust",
    ),
    Remedy(
        "The memory",
        r" GB",
        "Take reduced-space, fewer timesteps or a coarser mesh.",
        "large",
    ),
)
LAST = Remedy(
    "The solve",
    r"",
    "Start from another guess, or none, and see that check finds nothing wrong.",
    "trust",
)


def remedy_for(concern: str) -> Remedy:
    """The remedy for a concern of the verdict, or for a warning."""
    return next((r for r in REMEDIES if re.search(r.words, concern)), LAST)


def remedies_for(concerns: Iterable[str]) -> list[Remedy]:
    """The remedies for several concerns, each once."""
    return list(dict.fromkeys(map(remedy_for, concerns)))
