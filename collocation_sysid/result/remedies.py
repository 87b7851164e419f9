"""What to do about a concern: a sentence or two, and the how-to page that says more."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ..statistics.concern import Concern


@dataclass(frozen=True)
class Remedy:
    """A cure.

    Attributes
    ----------
    about : str
        Its title.
    page : str
        The page of `docs/howto` that says more.
    cure : str
    """

    about: str
    page: str
    cure: str


REMEDIES: Mapping[str, Remedy] = {
    "scale": Remedy(
        "The scale",
        "forces",
        "Measure a force, tie on a known mass, or fix a density: motion alone tells ratios only.",
    ),
    "description": Remedy(
        "The description",
        "wrong_description",
        "Compare units, frames, labels and clocks of the problem file with the laboratory's notes; "
        "check draws conclusions from the recordings before any solve.",
    ),
    "noise": Remedy(
        "The size of the noise",
        "verdict",
        "Error bars follow the residuals. State the sensor's noise in sigma where it is known; "
        "where one marker alone is off, look at its track for swaps and reflections.",
    ),
    "residuals": Remedy(
        "Residuals that are not noise",
        "trust",
        "Look at the residuals over time: a constant part is a place or an offset, a large "
        "beginning the time of release, an oscillation stiffness or damping that differ. "
        "compare --materials tells whether another model predicts better.",
    ),
    "information": Remedy(
        "What the data do not tell",
        "trust",
        "Fix such a parameter at a known value, give it a prior or wider bounds, or record a "
        "motion that it matters to.",
    ),
    "markers": Remedy(
        "The markers",
        "motion_capture",
        "Look at the markers' labels, unit, frame and places, and at when each is seen.",
    ),
    "nuisance": Remedy(
        "What is not known of a recording",
        "motion_capture",
        "Look whether it can be true: gravity, clock, grasp or places as the file describes them. "
        "If so, widen its prior in [experiment.nuisance].",
    ),
    "scheme": Remedy(
        "Step and scheme",
        "scheme",
        "Raise transcription.substeps, or take the midpoint scheme, which damps least. "
        "refine RUN measures what is left.",
    ),
    "stability": Remedy(
        "States that are not stable",
        "material",
        "Look whether the body buckles there. If not, the damping feeds energy in: take "
        'damping = "kelvin-voigt", which cannot, and see that moduli and densities can be true.',
    ),
    "mesh": Remedy(
        "The mesh",
        "mesh",
        'Refine it, and take element = "tet10", or "tet10-p0" from ν = 0.45 on. '
        "refine RUN measures what is left.",
    ),
    "roll-out": Remedy(
        "The roll-out",
        "trust",
        "Where the fit is good and the simulation is not, the step is too long; where a recording "
        "is predicted badly, the model lacks something that this recording shows.",
    ),
    "memory": Remedy(
        "The memory", "large", "Take reduced-space, fewer timesteps or a coarser mesh."
    ),
    "solve": Remedy(
        "The solve",
        "trust",
        "Start from another guess, or none, and see that check finds nothing wrong.",
    ),
}


def remedies_for(concerns: Iterable[Concern]) -> dict[str, Remedy]:
    """The remedies for several concerns by topic, each once."""
    return {concern.topic: REMEDIES[concern.topic] for concern in concerns}
