"""Warnings: message by code, remedy by topic.

A concern has a code, a grade and data. The first part of the code is the topic: "noise/larger" is
about the noise. Codes stay the same when messages are reworded.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from ..errors import listed

Grade = Literal["check", "doubtful"]


@dataclass(frozen=True)
class Topic:
    """Subject of several concerns, and its remedy.

    Attributes
    ----------
    title : str
        Title.
    page : str
        Topic of the page with more information, see `pages`.
    remedy : str
        Remedy, in a sentence or two.
    messages : mapping of str to str
        Message for the rest of the code, with placeholders for the data.
    """

    title: str
    page: str
    remedy: str
    messages: Mapping[str, str]


MODE = "the first mode of '{experiment}' ({frequency_hz:.3g} Hz at the guess)"
TURN = "the grasp of '{experiment}' turns by {angle_rad:.2g} rad within a step of {step_ms:.3g} ms"
SAMPLE = (
    "the sample at t = {t_s:.4g} s, off by {deviations:.2g} sigma, alone has {percent:.0f} % of "
    "the residuals' power: "
)
NO_DAMPING = "no information on damping"
FIX_DAMPING = "fix {damping}, or add a recording of a motion"

TOPICS: Mapping[str, Topic] = {
    "scale": Topic(
        "The scale",
        "forces",
        "Measure a force, attach a known mass, or fix a density: motion alone determines only "
        "ratios.",
        {
            "unknown": "only the ratios of {names} can be told (E/ρ): no known force or mass sets "
            "their scale; fix a density, give a known mass, or measure a wrench",
        },
    ),
    "description": Topic(
        "The description",
        "wrong_description",
        "Compare units, frames, labels and clocks of the problem file with the laboratory's notes; "
        "check tests the recordings for mistakes before any solve.",
        {
            "poses-inverted": "the markers move as if the poses were inverted: invert them, they "
            "are to map the undeformed body to where it is",
            "rotation-inverted": "the markers move as if the poses' rotations were inverted: "
            "transpose the matrices or conjugate the quaternions, and leave the positions",
            "quaternion-order": "the markers move as if the quaternions were in another order: set "
            'grasp.quaternion = "{order}" or swap the columns',
            "length-unit": "{who} were {factor:g} times as large: {remedy}",
            "length-unit/size": "the body is {size_m:.3g} m large; expected {least:g} to {most:g} "
            "m: check {likely}",
            "density": "the body's density is {density_kg_m3:.4g} kg/m³; expected {least:g} to "
            "{most:g}: set object.density_kg_m3 or mass_kg, {likely}, and check object.length_unit",
            "density/metal": "the body is as dense as metal, {density_kg_m3:.4g} kg/m³, and as "
            "soft as rubber, E = {young_pa:.3g} Pa: a thousandth of both, if the mass was in g; "
            "check object.density_kg_m3 or mass_kg",
            "gravity": "the markers hang as if gravity were along {axis}: set gravity_m_s2 = "
            "[{vector}]",
            "gripper-frame": "the markers move with the poses, but at another place relative to "
            "them: the poses are of the gripper's own frame, or the mesh is in another one; "
            "multiply every pose on the right by the transform from the mesh's frame to the "
            "gripper's, or fit the poses by grasp.markers",
            "camera-frame": "the markers fit if all are moved rigidly: cameras and robot have "
            "different frames; set markers.template_m and template_window_s",
            "clock": "the markers' clock is {when} by about {by_ms:.3g} ms against the poses': "
            "{do} that to t_s of the poses, or estimate it with nuisance.time_shift",
            "grasp-layer": "the fit is better if the grasp holds one layer of nodes {deep}: check "
            "the box of grasp.nodes against where the fingers end",
            "grasp": "the grasp of '{experiment}' cuts through elements: with its box a tenth of "
            "an edge larger it holds {nearly_held} nodes more than {nodes}, or as much smaller "
            "{nearly_free} less, and the stiffness found depends on them; move the edge of "
            "grasp.nodes between layers of nodes, or mesh the body with a layer where the fingers "
            "end",
            "markers-exchanged": "markers have each other's names: {names}; correct markers.labels "
            "or reference_m",
            "markers-exchanged/later": "markers have each other's names {when}: {names}; exchange "
            "them back there, or leave these samples out",
            "marker-slip": "marker {marker} slips at about t = {t_s:.4g} s: give it "
            "markers.weights = 0, or end window_s before",
            "marker-slip/alone": "marker {marker} slips by {by_mm:.2g} mm at t = {t_s:.4g} s, the "
            "others do not: give it markers.weights = 0, or end window_s before",
            "pose-jump": "the poses jump by {by_mm:.2g} mm at t = {t_s:.4g} s and the markers do "
            "not: repair the poses there, or end window_s before",
            "markers-jump": "all markers jump together, by {by_mm:.3g} mm at t = {t_s:.4g} s, and "
            "the poses do not: the tracks do not move like a grasped body; a simulation that fails "
            "and restarts, or two recordings in one file, look so: end window_s before",
            "markers-axes": "the markers fit with ({axes}) in the place of (x, y, z): the axes of "
            "their file are exchanged or reversed; reorder its columns, or turn the tracks",
            "poses-constant": "the markers move by {by_mm:.3g} mm, but the poses are constant and "
            "nothing else drives the body, which starts at rest: check the file and the columns of "
            "grasp.poses, and whether they are those of this recording",
            "unlike": "the tracks do not move like a grasped body: whatever its stiffness, they "
            "are {by_mm:.3g} mm (RMS) from where the grasp carries the markers, on a body of "
            "{size_mm:.3g} mm, and no single usual mistake explains it; check frames, poses and "
            "labels, and that a simulation that made them was stable",
            "mesh-parts": "the mesh is in {parts} parts that no element joins, and no grasp holds "
            "{loose} of them, the largest of {nodes} nodes: merge nodes that lie on each other, or "
            "leave loose parts out of the mesh",
            "obstacle-normal": "obstacle '{obstacle}' contains {percent:.0f} % of the undeformed "
            "body at the first time, and with its normal reversed none of it: its normal points "
            "out of the solid, to the side of the body",
            "obstacle-place": "obstacle '{obstacle}' contains {percent:.0f} % of the undeformed "
            "body at the first time: check its place, size, unit and the sign of its motion",
            "sign": "along {axis} grasp {grasp} and the force that it gives go opposite ways "
            "(correlation {correlation:.2f}), as if the body gave work: one of both signs is "
            "wrong; set sign = -1 of its displacement or of its wrench",
            "specimen-true-stress": "its stresses fit as true stresses, force over the deformed "
            'area: set stress = "true", or divide forces by the undeformed area',
            "specimen-compression": "strains and stresses fit as those of compression: set "
            "strain_sign = -1 and stress_sign = -1",
            "specimen-percent": "its strains fit as percent: name the unit in the column, "
            '"strain (%)"',
            "specimen-unit": "its stresses fit if multiplied by {factor:g}: the column seems to be "
            "in {unit}",
            "wrench-sign": "all of it fits with the other sign: it is what the body gives the "
            "grasp; change its sign",
            "wrench-sign/part": "its {what} fit with the other sign, the rest does not: change "
            "the sign of these columns",
            "wrench-axes": "its axes are exchanged or reversed: it fits with ({axes}) in the place "
            "of (x, y, z), forces and torques alike; reorder the columns, or turn the sensor's "
            "axes",
            "wrench-gain": "its {what} fit if multiplied by {factor:.3g}: check the calibration of "
            "the sensor, and the density or mass of the body",
            "wrench-point": "its torques are about a point {by_mm:.3g} mm from point_m: they fit "
            "with point_m = {point}",
            "wrench-frame": 'it is in the frame of the {other}: set frame = "{other}"',
            "wrench-unit": "its {what} seem to be in {unit}: multiply by {factor:g}",
            "wrench-clock": "it was measured about {by_ms:.3g} ms {when} than its times say: its "
            "clock is not that of the poses",
            "camera": "only {percent:.0f} % of the surface have points within {within_mm:.3g} mm: "
            "check camera.pose, that it is of a frame with x to the right, y down, z forward, and "
            "the unit of the depth; see the picture that check draws",
            "camera/likely": "hardly any points are near the body; they would be if {mistakes}",
            "wrench-tare": "it seems zeroed with the body in hand: zero it before, or widen "
            "nuisance.tare",
        },
    ),
    "noise": Topic(
        "The size of the noise",
        "verdict",
        "Error bars follow the residuals. State the sensor's noise in sigma where it is known; "
        "where one marker alone is off, look at its track for swaps and reflections.",
        {
            "larger": "the residuals are {factor:.2g} times as large as {stated} says",
            "smaller": "{stated} seems {factor:.2g} times too large for these residuals",
            "marker": "{marker} is off by {factor:.2g} times sigma_m",
            "markers": "{count} markers, most of all {marker}, are off by {factor:.2g} times "
            "sigma_m",
            "allowance": "sigma_m = {sigma_mm:.3g} mm is {share:.2g} of the body's size, more than "
            "cameras miss: if the model's error decides, error bars of independent errors are too "
            "short",
        },
    ),
    "residuals": Topic(
        "Residuals that are not noise",
        "trust",
        "Look at the residuals over time: a constant part means a wrong place or offset, a large "
        "beginning a wrong time of release, an oscillation a wrong stiffness or damping. "
        "compare --materials tests whether another model predicts better.",
        {
            "outline": "at {percent:.0f} % of its points the outline of the body is more than "
            "{pixels:.0f} pixels off its edge in the images of {camera}: the body may be grasped "
            "or hidden elsewhere, or have another stiffness; where depths are missing on the body "
            'itself, state background = "unknown"',
            "outlier": f"{SAMPLE}leave it out, or set solver.huber",
            "first": f"{SAMPLE}the body counts as relaxed at the first sample; let the recording "
            "begin before the load does, or leave the sample out",
            "persist": "the residuals are not noise: they persist from sample to sample "
            "(autocorrelation {autocorrelation:.2f})",
            "shared": "the residuals are not noise: they are correlated among markers or axes",
            "recordings": "the recordings disagree on {names}: model error decides, not noise",
            "wild": "{percent:.0f} % of the samples are beyond Huber's threshold",
            "far": "{percent:.0f} % of the markers' samples lie far from where they can be",
        },
    ),
    "assumption": Topic(
        "Assumptions that the data contradict",
        "budget",
        "Find out whether the assumption is wrong, for instance by repeating the first recording "
        "at the end, or whether the model lacks something that looks alike, such as memory, which "
        "looks like a drift. solve --probe follows the effect beyond one linear step and relaxes "
        "the other assumptions.",
        {
            "contradicted": "the data contradict the assumption that {assumption}: with "
            "{name} = {size} ± {size_error} χ² falls by {chi_squared:.3g}, and the estimates are "
            "{estimates}{instead}",
        },
    ),
    "information": Topic(
        "What the data do not determine",
        "budget",
        "Fix such a parameter at a known value, give it a prior or wider bounds, or record a "
        "motion that it matters to.",
        {
            "bound": "{names} ended at its bound",
            "bounds": "{names} ended at their bounds",
            "none": "the data do not determine {names}",
            "combined": "{name} is not determined: its combined 95 % interval, {low:.3g} to "
            "{high:.3g}, is wider than its value; largest contribution "
            "{source} ({share:.0%}): {remedy}",
            "at-bound": "{name} is at a bound",
            "not-yet": "{name} is not known yet: {reason}",
            "static": f"{{names}} {{verb}} static: {NO_DAMPING}; {FIX_DAMPING}",
            "still": f"nothing moves in {{names}}: {NO_DAMPING}, and information on stiffness only "
            f"from the sag; {FIX_DAMPING}",
            "rate": f"{MODE} has only {{samples:.1f}} samples a period, too few to see it: record "
            "at {needed_hz:.2g} Hz or more",
            "short": f"one period of {MODE} is longer than the {{duration_s:.3g}} s recorded, "
            "which leaves the damping uncertain: record longer",
        },
    ),
    "markers": Topic(
        "The markers",
        "motion_capture",
        "Check the markers' labels, unit, frame and places, and when each is visible.",
        {
            "off": "marker '{marker}' of '{experiment}' lies {by_mm:.3g} mm from its place on the "
            "body and is extrapolated: give its reference_m, or check the frame and unit",
            "unseen": "marker '{marker}' of '{experiment}' is never visible: leave it out of names",
            "missing": "marker '{marker}' of '{experiment}' is missing in {missing} of {frames} "
            "samples: shorten window_s to where it is visible, or leave it out of names",
            "astray": "marker '{marker}' of '{experiment}' is first seen {by_mm:.3g} mm from where "
            "the guess has it: check length_unit, the frame of the poses, reference_m, and whether "
            "the guess is far too soft",
        },
    ),
    "nuisance": Topic(
        "What is not known of a recording",
        "motion_capture",
        "Check whether the value is possible: are gravity, clock, grasp and places as the file "
        "describes them? If it is possible, widen its prior in [experiment.nuisance].",
        {
            "limit": "{name} ended at the largest value allowed",
            "far": "{name} is {deviations:.1f} deviations of its prior away from zero",
            "camera": "{name} is {deviations:.1f} deviations of its prior away from the pose "
            "stated: a body of another stiffness may fit as well with the camera elsewhere; "
            "measure the pose, or state how well it is known (nuisance.depth_pose)",
            "clock": "the markers of '{experiment}' were seen {shift_ms:.2g} ms {when} than their "
            "times say: the estimates allow for it; better find out why",
        },
    ),
    "scheme": Topic(
        "Step and scheme",
        "scheme",
        "Raise transcription.substeps, or take the midpoint scheme, which damps least. "
        "refine RUN measures what is left.",
        {
            "step": "the estimated time-step error dominates the uncertainty of {name}: it was "
            "corrected by {percent:+.2g} %, {errors:.2g} standard uncertainties; raise "
            "transcription.substeps, or run refine to measure the error",
            "damping": "the scheme adds a damping ratio of {added:.2g} to the {damping:.2g} of the "
            "first mode of '{experiment}'",
            "period": "the scheme changes the first period of '{experiment}' by {change:+.1%}",
            "adds": f"{{scheme}} at {{step_ms:.3g}} ms adds a damping ratio of {{ratio:.2g}} to "
            f"{MODE}, by which the damping found will be too low: {{remedy}}",
            "takes": f"{{scheme}} at {{step_ms:.3g}} ms takes a damping ratio of {{ratio:.2g}} "
            f"from {MODE}, by which the damping found will be too high: {{remedy}}",
            "coarse": f"{MODE} has only {{steps:.1f}} steps a period and is slowed down by "
            "{error:.0%}: {remedy}",
            "turn": TURN,
            "turns": f"{TURN} at t = {{time_s:.4g}} s ({{rate_rad_s:.3g}} rad/s). Steps follow "
            "the chord of a rotation, which biases the estimates, damping most of all: {remedy}",
        },
    ),
    "stability": Topic(
        "States that are not stable",
        "material",
        "Does the body buckle there? If not, the damping law generates energy: use damping = "
        '"kelvin-voigt", which cannot, and make sure that moduli and densities are plausible.',
        {
            "grows": "'{experiment}' is not stable at {time_s:.3g} s: disturbances grow by "
            "{growth_1_s:.2g} 1/s",
        },
    ),
    "contact": Topic(
        "Contact",
        "contact",
        "Check the place, the normal and the motion of the obstacle, and the mesh in the contact "
        "area.",
        {
            "never": "'{experiment}'{more} never touches {obstacle}{guess}; the smallest gap is "
            "{mm:.3g} mm: its force and friction carry no information",
            "coarse": "in '{experiment}'{more} only {faces:.2g} faces, {face_mm:.2g} mm large, "
            "touch {obstacle} at a time{guess}: the width of the contact is that of the mesh; "
            "refine it there",
            "pressed": "in '{experiment}'{more} {obstacle} touches already at the first "
            "sample{guess}: the first contact is not recorded; start the recording earlier",
            "lost": "in '{experiment}'{more} {obstacle} is touched no more at t = "
            "{t_s:.4g} s{guess}: if it was, check its motion and the guess, or let window_s end "
            "before",
        },
    ),
    "mesh": Topic(
        "The mesh",
        "mesh",
        'Refine it, and take element = "tet10", or "tet10-p0" from ν = 0.45 on. '
        "refine RUN measures what is left.",
        {
            "refined": "step and mesh dominate the uncertainty of {name}: it was corrected by "
            "{percent:+.2g} %, {errors:.2g} standard uncertainties",
            "flat": "element {number} is nearly flat (mean-ratio quality {quality:.2g}, aspect "
            "ratio {aspect_ratio:.0f}), which makes the body stiffer and Newton's steps short: "
            "improve the mesh there",
            "locks": "Poisson's ratio is {poisson:.3g} at the guess and {element} elements lock "
            "from {limit:g} on, so that the stiffness found will be too low: {remedy}",
            "few": "only about {cells:.1f} {element} elements lie across the body's "
            "{thickness_mm:.3g} mm, too {off} in bending, so that the stiffness found of a real "
            "body will be too {level} (not of data simulated with these elements, which are as "
            "{off}): {remedy} the mesh to {needed:.0f} or more",
        },
    ),
    "roll-out": Topic(
        "The forward simulation",
        "trust",
        "If the fit is good and the simulation is not, the step is too long. If a recording is "
        "predicted badly, the model lacks an effect that this recording contains.",
        {
            "failed": "the forward simulation of '{experiment}' failed: {why}",
            "misses": "the forward simulation of '{experiment}' misses by {rms_mm:.2g} mm, the fit "
            "by {fit_mm:.2g} mm",
            "predicted": "'{experiment}' is predicted {times:.2g} times worse than the others are "
            "fitted",
        },
    ),
    "prediction": Topic(
        "The prediction",
        "trust",
        "The parameters are stated, not estimated: make sure that they belong to this body, and "
        "that sigma is the sensor's noise. Then check which effects the model lacks, or estimate a "
        "parameter.",
        {
            "misses": "the prediction of '{experiment}' misses {what} by {size}{sigmas:.2g} times "
            "{stated}",
            "unseen": "none of the {seen} points of {camera} is near the predicted surface of "
            "'{experiment}'",
        },
    ),
    "memory": Topic(
        "RAM",
        "large",
        "Take reduced-space, fewer timesteps or a coarser mesh.",
        {
            "short": "{method} will take about {needed_gb:.2g} GB, more than this machine's "
            "{there_gb:.2g} GB: {remedy}",
        },
    ),
    "field": Topic(
        "The field",
        "field",
        "State the amplitude or lengths that the data suggest, or use regions where constants are "
        "known to differ: a prior that is too tight makes intervals too narrow.",
        {
            "amplitude": "{name} differs more from place to place than its field allows for: the "
            "data want an amplitude of about {likely:.2g}, not {stated:.2g}",
            "one-phase": "the data do not show two materials: the contrast of {name} is "
            "{median:.3g} ({lower:.3g} to {upper:.3g}), which contains 1; take prior = 'smooth' or "
            "no field",
            "few": "the smaller phase of {name} has only {elements} elements: with fewer than "
            "{fewest} the contrast was found too low and its interval too narrow; refine the mesh "
            "there",
            "phases": "two phases of {name} do not describe the body: χ² per measurement is "
            "{misfit:.3g}, with a smooth field {smooth:.3g}; more than two materials, or one that "
            "changes gradually: take prior = 'smooth', or regions",
            "negative": "{name} is not above zero in {below} of {elements} elements, down to "
            "{least:.3g}: lower the amplitude of its field, {stated:.2g}, or raise its length_m",
            "shapes": "the {modes} shapes of the field of {name} have only {share:.0%} of its "
            "variance with a length of {length_m:.2g} m: variations finer than {detail_m:.2g} m "
            "are covered by the intervals only; raise modes or length_m",
            "length": "{name} changes over less than the length of its field: the data suggest "
            "about {likely:.2g} m, not {stated:.2g} m; give length_m several to choose from",
        },
    ),
    "solve": Topic(
        "The solve",
        "trust",
        "Start from another guess, or from none, and make sure that check finds nothing wrong.",
        {
            "lost": "the solve did not converge: {why}",
            "no-start": "there is no start yet: the first frame needs a pose",
            "not-simulable": "the body cannot be simulated with these parameters",
            "grasp-lost": "the grasp is lost",
            "seeking": "the start is still being searched",
            "acceptable": "the solve converged to the acceptable tolerance only",
            "no-error-bars": "no error bars could be found",
            "interrupted": "interrupted: {left_out}",
            "moves": "the estimate still moves: it is farther than its error bar from where it was "
            "simulated",
            "anew": "restarted {times}, assuming that the body was at rest there",
        },
    ),
}


def message_of(code: str, data: Mapping[str, Any]) -> str:
    """Return the message of a code with its data.

    If the data contain "of", the message begins with that subject; if they contain "nearer", the
    factor by which the misfit decreases is appended.
    """
    topic, _, rest = code.partition("/")
    shown = {k: listed(v) if isinstance(v, (list, tuple)) else v for k, v in data.items()}
    said = TOPICS[topic].messages[rest].format(**shown)
    nearer = f" ({data['nearer']:.2g} times nearer)" if "nearer" in data else ""
    return f"{data['of']}: {said}{nearer}" if data.get("of") else said


@dataclass(frozen=True)
class Concern:
    """One reason for concern.

    Attributes
    ----------
    code : str
        Topic and kind, such as "noise/larger"; stable when messages are reworded.
    grade : {"check", "doubtful"}
        Severity.
    data : mapping of str to value
        Values of the placeholders in the message.
    """

    code: str
    grade: Grade = "check"
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def topic(self) -> str:
        """Topic of the concern, a key of `TOPICS`."""
        return self.code.partition("/")[0]

    @property
    def message(self) -> str:
        """Message of the concern for the user."""
        return message_of(self.code, self.data)


def concern_if(is_present: bool, is_gross: bool, code: str, **data: Any) -> list[Concern]:
    """Return a list with a concern if `is_present`, graded "doubtful" if `is_gross` and else
    "check"; otherwise an empty list.
    """
    return [Concern(code, "doubtful" if is_gross else "check", data)] if is_present else []


def topics_of(concerns: Iterable[Concern]) -> dict[str, Topic]:
    """Return the topics of several concerns by key, each once."""
    return {concern.topic: TOPICS[concern.topic] for concern in concerns}
