"""What may be described wrongly: the description without a mistake, how it is tried, what is said.

A hypothesis is tried by what is left of the misfit if it holds: by the modes of bodies of many
stiffnesses (`modal`), by another fit, or by the wrench that a fit to the markers alone has
(`causes`). What jumps or contradicts itself needs no trial (`plausible`). All are ranked by the
factor by which the misfit falls. The sentence is looked up by the code, of which the first part is
the cause.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

# By code: what is likely wrong, and the remedy.
SENTENCES: Mapping[str, str] = {
    "poses-inverted": "the markers move as if the poses were inverted: invert them, they are to "
    "map the undeformed body to where it is",
    "rotation-inverted": "the markers move as if the poses' rotations were inverted: transpose the "
    "matrices or conjugate the quaternions, and leave the positions",
    "quaternion-order": "the markers move as if the quaternions were in another order: set "
    'grasp.quaternion = "{order}" or swap the columns',
    "length-unit": "{who} were {factor:g} times as large: {remedy}",
    "length-unit/size": "the body is {size_m:.3g} m large; expected {least:g} to {most:g} m: check "
    "object.length_unit, {likely}",
    "density": "the body's density is {density_kg_m3:.4g} kg/m³; expected {least:g} to {most:g}: "
    "set object.density_kg_m3 or mass_kg, {likely}, and check object.length_unit",
    "gravity": "the markers hang as if gravity were along {axis}: set gravity_m_s2 = [{vector}]",
    "gripper-frame": "the markers move with the poses, but the body is elsewhere in them: the "
    "poses are of the gripper's own frame, or the mesh is in another one; multiply every pose on "
    "the right by the transform from the mesh's frame to the gripper's, or fit the poses by "
    "grasp.markers",
    "camera-frame": "the markers fit if all are moved rigidly: cameras and robot have different "
    "frames; set markers.template_m and template_window_s",
    "clock": "the markers' clock is {when} by about {by_ms:.3g} ms against the poses': {do} that "
    "to t_s of the poses, or estimate it with nuisance.time_shift",
    "grasp-layer": "the fit is better if the grasp holds one layer of nodes {deep}: check the box "
    "of grasp.nodes against where the fingers end",
    "markers-exchanged": "markers have each other's names: {names}; correct markers.labels or "
    "reference_m",
    "markers-exchanged/later": "markers have each other's names {when}: {names}; exchange them "
    "back there, or leave these samples out",
    "marker-slip": "marker {marker} slips at about t = {t_s:.4g} s: give it markers.weights = 0, "
    "or end window_s before",
    "marker-slip/alone": "marker {marker} slips by {by_mm:.2g} mm at t = {t_s:.4g} s, the others "
    "do not: give it markers.weights = 0, or end window_s before",
    "pose-jump": "the poses jump by {by_mm:.2g} mm at t = {t_s:.4g} s and the markers do not: "
    "repair the poses there, or end window_s before",
    "sign": "along {axis} grasp {grasp} and the force that it gives go opposite ways (correlation "
    "{correlation:.2f}), as if the body gave work: one of both signs is wrong; set sign = -1 of "
    "its displacement or of its wrench",
    "wrench-sign": "all of it fits with the other sign: it is what the body gives the grasp; "
    "change its sign",
    "wrench-frame": 'it is in the frame of the {other}: set frame = "{other}"',
    "wrench-unit": "its {what} seem to be in {unit}: multiply by {factor:g}",
    "wrench-clock": "it was measured about {by_ms:.2g} ms {when} than its times say: its clock is "
    "not that of the poses",
    "wrench-tare": "it seems zeroed with the body in hand: zero it before, or widen nuisance.tare",
}


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One thing of a description that may be wrong.

    Attributes
    ----------
    code : str
        The cause and how it shows, such as "marker-slip/alone".
    of : str
        What is described, as sentences begin with it; may be empty.
    data : mapping
        What its sentence holds.
    without : optional
        The description without the mistake, of whatever kind its trial takes; None where what is
        given tells it.
    handicap : float
        What has numbers to fit has to fit so many times better than what has none.
    strength : float
        Factor by which the misfit falls if this is assumed, zero until it is tried.
    """

    code: str
    of: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)
    without: Any = None
    handicap: float = 1.0
    strength: float = 0.0

    @property
    def cause(self) -> str:
        """Short name of what is wrong, such as "poses-inverted"."""
        return self.code.partition("/")[0]

    @property
    def sentence(self) -> str:
        """What is likely wrong, and the remedy."""
        said = SENTENCES[self.code].format(**self.data)
        nearer = "" if self.without is None else f" ({self.strength:.2g} times nearer)"
        return f"{self.of}: {said}{nearer}" if self.of else said

    def as_dict(self) -> dict[str, Any]:
        """For JSON and tables."""
        return {"cause": self.cause, "sentence": self.sentence, "strength": self.strength}


@dataclass(frozen=True, eq=False)
class Trial:
    """A way to try hypotheses.

    Attributes
    ----------
    misfit : float
        Of the description as given.
    left : callable
        What is left of it with another description; None where that cannot be told.
    better : float
        The factor by which the misfit has to fall.
    least : float
        A smaller misfit tells nothing.
    noise : float
        From a misfit above this to one below any factor will do.
    """

    misfit: float
    left: Callable[[Any], float | None]
    better: float
    least: float = 0.0
    noise: float = 0.0

    def of(self, hypotheses: Iterable[Hypothesis]) -> Iterator[Hypothesis]:
        """Those that fit far better, with their strength."""
        for each in hypotheses:
            if (left := self.left(each.without)) is None:
                continue
            strength = self.misfit / max(self.least, left) / each.handicap
            if strength > self.better or left < self.noise < self.misfit:
                yield replace(each, strength=strength)


def clock(of: str, lag_s: float, without: Any, handicap: float = 1.0) -> Hypothesis:
    """That the markers' clock is late by `lag_s` against the poses'."""
    when, do = ("late", "add") if lag_s > 0 else ("early", "subtract")
    data = {"when": when, "by_ms": 1e3 * abs(lag_s), "do": do}
    return Hypothesis("clock", of, data, without, handicap)


def ranked(hypotheses: Iterable[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Each cause once, likeliest first."""
    strongest: dict[str, Hypothesis] = {}
    for each in sorted(hypotheses, key=lambda each: -each.strength):
        strongest.setdefault(each.cause, each)
    return tuple(strongest.values())
