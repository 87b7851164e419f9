"""What to do about a concern: a sentence or two, and the how-to page that says more."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ..statistics.trust import Concern


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
        "check looks for mistakes in the recordings before any solve.",
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
        "Look at the residuals over time: a constant part means a wrong place or offset, a large "
        "beginning a wrong time of release, an oscillation a wrong stiffness or damping. "
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
        "Ask whether it can be true: are gravity, clock, grasp and places as the file describes "
        "them? If the value can be true, widen its prior in [experiment.nuisance].",
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
        "Does the body buckle there? If not, the damping feeds energy in: take damping = "
        '"kelvin-voigt", which cannot, and make sure that moduli and densities are plausible.',
    ),
    "mesh": Remedy(
        "The mesh",
        "mesh",
        'Refine it, and take element = "tet10", or "tet10-p0" from ν = 0.45 on. '
        "refine RUN measures what is left.",
    ),
    "roll-out": Remedy(
        "The forward simulation",
        "trust",
        "If the fit is good and the simulation is not, the step is too long. If a recording is "
        "predicted badly, the model lacks something that this recording shows.",
    ),
    "memory": Remedy("RAM", "large", "Take reduced-space, fewer timesteps or a coarser mesh."),
    "solve": Remedy(
        "The solve",
        "trust",
        "Start from another guess, or from none, and make sure that check finds nothing wrong.",
    ),
}


def remedies_for(concerns: Iterable[Concern]) -> dict[str, Remedy]:
    """The remedies for several concerns by topic, each once."""
    return {concern.topic: REMEDIES[concern.topic] for concern in concerns}
