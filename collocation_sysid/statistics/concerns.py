"""Warnings: message by code, remedy by topic.

A concern has a code, a grade and data. The first part of the code is the topic: "noise/larger" is
about the noise. Codes stay the same when messages are reworded. `TOPICS` contains the messages
about bodies, fits and statistics; kinds add theirs (`features.registry`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from ..errors import listed
from .budget.systematic_effects import DEVIATIONS
from .description_texts import MESSAGES

Grade = Literal["check", "doubtful"]


@dataclass(frozen=True)
class Topic:
    """Subject of several concerns, and its remedy."""

    title: str  # title of the topic for headings
    page: str  # topic of the page with more information, see `pages`
    remedy: str  # remedy, in a sentence or two
    # mapping of str to str: message for the rest of the code, with placeholders for the data.
    messages: Mapping[str, str]


MODE = "the first mode of '{experiment}' ({frequency_hz:.3g} Hz at the guess)"
TURN = "the grasp of '{experiment}' turns by {angle_rad:.2g} rad within a step of {step_ms:.3g} ms"
SAMPLE = (
    "the sample at t = {t_s:.4g} s deviates by {deviations:.2g} sigma and contributes "
    "{percent:.0f} % of the sum of squared residuals: "
)
NO_DAMPING = "no information on damping"
FIX_DAMPING = "fix {damping}, or add a recording of a motion"

TOPICS: dict[str, Topic] = {
    "scale": Topic(
        "The scale",
        "forces",
        remedy="Measure a force, attach a known mass, or fix a density: motion alone determines only "
        "ratios.",
        messages={
            "unknown": "only the ratios of {names} are identifiable (E/ρ), because no known "
            "force or mass sets their scale; fix a density, state a known mass, or measure a "
            "force"
        },
    ),
    "description": Topic(
        "The description",
        "trust",
        remedy="Compare units, frames, labels and clocks of the problem file with the laboratory's "
        "notes. The command check tests the recordings for common mistakes before a solve.",
        messages={
            **MESSAGES,
            "length-unit/size": "the body is {size_m:.3g} m large; expected {least:g} to {most:g} "
            "m: check {likely}",
            "density": "the body's density is {density_kg_m3:.4g} kg/m³; expected {least:g} to "
            "{most:g}: correct object.density_kg_m3 or mass_kg ({likely}), and check "
            "object.length_unit",
            "density-of-mesh": "mass_kg over the volume of the mesh is {density_kg_m3:.4g} kg/m³, but "
            "material_density_kg_m3 is {stated:.4g}: the mesh has {times:.3g} times the volume of the "
            "body; probably {likely}",
            "density-of-making": "the stated density of {density_kg_m3:.4g} kg/m³ is not one of bodies "
            'with made = "{made}", which have {least:g} to {most:g} kg/m³: check object.mass_kg (does '
            "it contain the gripper?), length_unit, made and the section of the mesh (that of a round "
            "body meshed as a square of the same width gives 0.785 times the density)",
            "density/metal": "the body is as dense as metal ({density_kg_m3:.4g} kg/m³) and as "
            "soft as rubber (E = {young_pa:.3g} Pa): both are 1000 times too large if the mass "
            "was stated in g instead of kg; check object.density_kg_m3 or mass_kg",
            "grasp": "the box of the grasp of '{experiment}' selects {nodes} nodes, but "
            "{nearly_grasped} more if it is enlarged by a tenth of an element's edge, or "
            "{nearly_free} fewer if it is reduced by as much, and the estimated stiffness "
            "depends on them; mesh the body with a layer of nodes where the fingers end, and let "
            "the box of grasp.nodes end slightly beyond it",
            "grasp-extent": "the box of the grasp of '{experiment}' ends {gap_mm:.3g} mm beyond "
            "the elements that it holds along {axis}, {percent:.2g} % of the free length "
            "of {free_mm:.4g} mm: if the fingers end where the box does, the modelled body is too "
            "long, and its stiffness is estimated too high, in bending by three to four times "
            "this share; mesh the body with a layer of nodes where the fingers end "
            "(object.edge_length_m), or let the box end at the nodes that are really held",
            "measured-twice": "the values of {first} and {second} are exactly the same, which those of "
            "two measurements are not: one is a copy of the other; correct the file or its columns, or "
            "omit one of them",
        },
    ),
    "noise": Topic(
        "Size of the noise",
        "trust",
        remedy="The error bars are computed from the residuals. State the sensor's noise as sigma "
        "if it is known. If a single marker deviates, look for exchanged labels and "
        "reflections in its track.",
        messages={
            "larger": "the residuals are {factor:.2g} times as large as expected from {stated}: "
            "check {stated}, and what the model or the description of the experiment lacks",
            "smaller": "{stated} seems {factor:.2g} times too large for these residuals: state "
            "the noise of the sensor",
            "marker": "the residuals of {marker} are {factor:.2g} times sigma_m: check its label, "
            "its reference_m and reflections in its track",
            "markers": "the residuals of {count} markers are larger than sigma_m, most of all "
            "those of {marker} ({factor:.2g} times): check their labels, reference_m and sigma_m",
            "sensor": "the residuals of {marker} are {factor:.2g} times {stated}: check {stated}, and "
            "the unit, the axes and signs, and the zero of this sensor",
            "sensors": "the residuals of {count} sensors and markers are larger than expected, most of "
            "all those of {marker} ({factor:.2g} times {stated}): check {stated}, and the unit, the "
            "axes and signs, and the zero of this sensor",
            "allowance": "sigma_m = {sigma_mm:.3g} mm is {share:.2g} of the body's size, more "
            "than the error of cameras: if it is an allowance for model errors, the error bars "
            "are too short, because they assume independent errors; state the noise of the "
            "cameras",
        },
    ),
    "residuals": Topic(
        "Residuals that are not noise",
        "trust",
        remedy="Look at the residuals over time: a constant part indicates a wrong position or "
        "offset, large residuals at the beginning a wrong time of release, an oscillation a "
        "wrong stiffness, damping or mass. The command compare-models --materials tests whether another "
        "material law predicts better.",
        messages={
            "outlier": f"{SAMPLE}remove it, or set solver.huber",
            "first": f"{SAMPLE}the body is assumed to be relaxed at the first sample; start the "
            "recording before the load, or remove the sample",
            "persist": "the residuals are not independent noise: consecutive samples are "
            "correlated (autocorrelation {autocorrelation:.2f}). The model or the description of "
            "the experiment lacks an effect: look at the residuals over time",
            "shared": "the residuals are not independent noise: they are correlated between "
            "markers or axes. The model or the description of the experiment lacks an effect: "
            "look at the residuals over time",
            "recordings": "the recordings disagree on {names}: model errors exceed the noise; "
            "find out what differs between the recordings, such as temperature or clamping",
            "wild": "{percent:.0f} % of the samples are outliers, beyond the threshold of the "
            "Huber loss: look for exchanged labels and wrong samples in the residuals over time",
        },
    ),
    "effect": Topic(
        "Effects that the data need",
        "budget",
        remedy="The residuals need an effect of the budget that is larger than its deviation, or "
        "something that looks the same and is not described, such as a mass at the markers, another "
        "law of the material, memory, or a wrong time or place. The estimates are corrected for the "
        "effect, which is right only if it is the cause. The table of effects (solve --budget) has "
        "all of them.",
        messages={
            "surprising": "the residuals need {effect}: {surprise:.1f} standard deviations"
            "{alike}; {remedy}, and check what else the description lacks",
            "impossible": "the residuals look like those of {effect}, which is not possible: check "
            "what the description lacks",
        },
    ),
    "information": Topic(
        "Parameters that the data do not determine",
        "budget",
        remedy="Fix such a parameter at a known value, give it a prior or wider bounds, or record a "
        "motion or a test that depends on it.",
        messages={
            "bound": "{names} ended at a bound: widen the bound if you stated it, or fix the parameter",
            "default-bound": "{names} ended at a bound that the problem does not state: the best "
            "value may lie beyond it, and the other reasons may follow from this; state guess, "
            "lower and upper, or fix the parameter",
            "flat": "the data do not determine {names}, which the search therefore left at a bound; the "
            "other reasons may follow from this: fix the parameter, state its prior, or add a "
            "recording that depends on it",
            "liquid": "the stress relaxes to zero, as that of a liquid: {names} grew without limit, "
            "so that the data determine the instantaneous modulus and the relaxation times, and no "
            "long-term modulus; record for longer if there is one",
            "none": "the data do not determine {names}: state known values or priors, or record a "
            "motion on which these parameters have a larger influence",
            "static": f"{{names}} {{verb}} static: {NO_DAMPING}; {FIX_DAMPING}",
            "still": f"nothing moves in {{names}}: {NO_DAMPING}, and only the deflection under "
            f"gravity determines the stiffness; {FIX_DAMPING}",
            "rate": f"{MODE} has only {{samples:.1f}} samples per period, too few to resolve it: "
            "record at {needed_hz:.2g} Hz or more",
            "short": f"one period of {MODE} is longer than the {{duration_s:.3g}} s recorded, "
            "which leaves the damping uncertain: record longer",
        },
    ),
    "markers": Topic(
        "The markers",
        "motion_capture",
        remedy="Check labels, unit, frame and positions of the markers, and when each marker is visible.",
        messages={
            "off": "marker '{marker}' of '{experiment}' lies {by_mm:.3g} mm outside the body, so "
            "that its motion is extrapolated: give its reference_m, or check the frame and "
            "unit",
            "unseen": "marker '{marker}' of '{experiment}' is never visible: leave it out of markers.names",
            "missing": "marker '{marker}' of '{experiment}' is missing in {missing} of {frames} "
            "samples: shorten window_s to where it is visible, or leave it out of markers.names",
            "astray": "marker '{marker}' of '{experiment}' is first measured {by_mm:.3g} mm away "
            "from its position simulated at the guess: check length_unit, the frame of the "
            "poses, reference_m, and whether the guess is far too soft",
        },
    ),
    "nuisance": Topic(
        "Nuisance parameters of a recording",
        "motion_capture",
        remedy="An error of mesh, places, clocks, sensors or laws can hide in such a value: check these "
        "first, and compare laws with compare-models. Widen a prior only if nothing else explains the "
        "value and a measurement confirms it.",
        messages={
            "limit": "{name} ended at the largest value allowed: check mesh, places, clocks and "
            "sensors, and compare laws with compare-models, whose errors it can hide",
            "far": "{name} is {deviations:.1f} standard deviations of its prior away from zero: "
            "check mesh, places, clocks and sensors, and compare laws with compare-models, whose "
            "errors it can hide",
            "sized": "{name} is {deviations:.1f} standard deviations of its prior away from zero "
            "({size}): check mesh, places, clocks and sensors, and compare laws with compare-models, "
            "whose errors it can hide; if nothing else explains this value, measure it, and widen "
            "its prior in {where} if it is confirmed",
            "large": "{name} is {deviations:.1f} standard deviations of its prior away from zero "
            "({size}), more than such an error can be: it hides another error. Check mesh, places, "
            "clocks and sensors, and compare laws with compare-models; do not widen its prior",
        },
    ),
    "specimen": Topic(
        "Material tests",
        "specimen",
        remedy="A law that does not fit the material is the most frequent cause: compare-models "
        "--materials. Then check the table: does the strain begin at zero in the unloaded specimen, "
        "are the area and the units right, and are the first cycles left out? If the value of an "
        "unknown is possible, widen its prior in the [[experiment]], for example strain_zero = 0.02.",
        messages={
            "limit": "{name} ended at the largest value allowed: check whether this value is "
            "possible, and if it is, widen its prior in the [[experiment]]",
            "far": "{name} is {deviations:.1f} standard deviations of its prior away from zero: "
            "{advice}",
            "law": "the residuals are {factor:.2g} times as large as expected from sigma_pa: "
            "{advice}; then check sigma_pa, the units of the columns, the kind of test, and whether "
            'the stresses are true ones (stress = "true")',
            "branches": "the residuals are {factor:.2g} times as large as expected from the stated "
            "noise: branches of the memory ({branches}) may be too few, or their times too far from "
            "those of the table. First add an [[object.prony]] about every decade of time or "
            "frequency; then check which column is which modulus, the units and the noise",
            "outlier": "{sample} deviates by {deviations:.2g} sigma and contributes "
            "{percent:.0f} % of the sum of squared residuals: correct or remove this row, or set "
            "solver.huber",
            "stress": "the residuals of {marker} are {factor:.2g} times {stated}: check {stated}, "
            "the unit of the column and the kind of test, and {remedy}",
            "stresses": "the residuals of {count} tests or stresses are larger than {stated}, most "
            "of all those of {marker} ({factor:.2g} times): check {stated}, the units of the "
            "columns and the kinds of test, and {remedy}",
            "persist": "the residuals are not independent noise: consecutive samples are "
            "correlated (autocorrelation {autocorrelation:.2f}). The law or the description of the "
            "test lacks an effect: look at measured and fitted stresses over the strain",
            "none": "the data do not determine {names}: state known values or priors, or add "
            "another kind of test or larger stretches",
        },
    ),
    "scheme": Topic(
        "Step and scheme",
        "scheme",
        remedy="Raise transcription.substeps, or use the midpoint scheme, which damps least. The "
        "command refine RUN measures the remaining error.",
        messages={
            "damping": "the time-stepping scheme adds a damping ratio of {added:.2g} to the "
            "{damping:.2g} of the first mode of '{experiment}': raise transcription.substeps, or "
            "use the midpoint scheme",
            "period": "the time-stepping scheme changes the period of the first mode of "
            "'{experiment}' by {change:+.1%}: raise transcription.substeps",
            "adds": "{scheme} at {step_ms:.3g} ms adds a damping ratio of {ratio:.2g} to "
            f"{MODE}, which makes the estimated damping too low: {{remedy}}",
            "takes": "{scheme} at {step_ms:.3g} ms removes a damping ratio of {ratio:.2g} "
            f"from {MODE}, which makes the estimated damping too high: {{remedy}}",
            "coarse": f"{MODE} has only {{steps:.1f}} time steps per period, which makes its "
            "period {error:.0%} too long: {remedy}",
            "impacts": "with {stated} time steps per sample the body of '{experiment}' moves by much "
            "more than the noise of its markers in each of them, and may strike an obstacle: leave "
            "out transcription.substeps, or state {needed}",
            "turn": f"{TURN}: raise transcription.substeps",
            "turns": f"{TURN} at t = {{time_s:.4g}} s ({{rate_rad_s:.3g}} rad/s). Steps follow "
            "the chord of a rotation instead of its arc, which biases the estimates, especially "
            "damping: {remedy}",
        },
    ),
    "stability": Topic(
        "Unstable states",
        "material",
        remedy="Does the body buckle there? If not, check moduli and densities, and the damping law: "
        'only "kelvin-voigt" never generates energy.',
        messages={
            "grows": "the motion of '{experiment}' is unstable at t = {time_s:.3g} s: disturbances "
            "grow at a rate of {growth_1_s:.2g} 1/s. If the body does not buckle there, "
            'check moduli and densities, and the damping law: only "kelvin-voigt" never generates energy',
            "branch": "the equilibria of '{experiment}' from {time_s:.4g} s on are not those that "
            "its loads lead to from the samples before, and depend on mesh and rounding: {why}",
            "material": "the material {material}{where} is unstable at strains of '{experiment}' "
            "(Drucker): at {when}the principal stretches {stretches} a further strain "
            "lowers its stress; use a law with fewer terms, or bound its constants",
            "rest": "the material {material} of {where} is unstable without any strain: its shear "
            "modulus is {mu_pa:.3g} Pa and its bulk modulus {kappa_pa:.3g} Pa; both must be "
            "positive. In Ogden's law the shear modulus is half the sum of mu_p alpha_p",
        },
    ),
    "mesh": Topic(
        "The mesh",
        "mesh",
        remedy='Refine it, and use element = "tet10", or "tet10-p0" for ν ≥ 0.45. The command '
        "refine RUN measures the remaining error. Recordings that were simulated with the same "
        'elements have no such error: declare them by assumptions = "none" in [uncertainty], or '
        'damping_law = "none" in [uncertainty.assumptions].',
        messages={
            "refined": "step and mesh dominate the uncertainty of {name}: it was corrected by "
            "{change}, {errors:.2g} standard uncertainties; use smaller steps "
            "(transcription.substeps) or smaller elements",
            "error": "the elements are too large: with half their lengths {name} would change by more "
            "than half, too much for an estimate to first order; use smaller ones",
            "flat": "element {number} is nearly flat (mean-ratio quality {quality:.2g}, aspect "
            "ratio {aspect_ratio:.0f}), which makes the body stiffer and Newton's steps short: "
            "improve the mesh there",
            "locks": "Poisson's ratio is {poisson:.6g} at the guess and {element} elements lock "
            "from {limit:g} on, so that the estimated stiffness will be too low: {remedy}",
            "few": "only about {cells:.1f} {element} elements lie across the body's thickness of "
            "{thickness_mm:.3g} mm, which makes it too {off} in bending, so that the "
            "estimated stiffness of a real body will be too {level} (not that of data "
            "simulated with the same elements): {remedy} the mesh to {needed:.0f} or more",
        },
    ),
    "roll-out": Topic(
        "The forward simulation",
        "trust",
        remedy="If the fit is good and the simulation is not, the step is too long. If a recording is "
        "predicted badly, the model lacks an effect that this recording contains.",
        messages={
            "failed": "the forward simulation of '{experiment}' failed: {why}",
            "misses": "the forward simulation of '{experiment}' deviates from {what} by "
            "{simulated}, but the fit only by {fitted}: {why}",
            "predicted": "the prediction of '{experiment}' misses {what} by {size}, which is "
            "{sigmas:.3g} times {stated} and {times:.2g} times what noise and the fit of the other "
            "recordings explain{absorbed}: the model lacks an effect that this recording contains, "
            "or the recording is described wrongly",
            "onset": "'{name}' of the validation recording '{experiment}' is estimated from that "
            "recording, as its description asks, {deviations:.2g} standard deviations from zero: "
            "the prediction may owe its fit to this time",
        },
    ),
    "prediction": Topic(
        "The prediction",
        "trust",
        remedy="The parameters are stated, not estimated: make sure that they belong to this body, and "
        "that sigma is the sensor's noise. Then check which effects the model lacks, or estimate a "
        "parameter.",
        messages={
            "misses": "the prediction of '{experiment}' deviates from {what} by {size}{sigmas:.2g} "
            "times {stated}: check the stated parameters, {stated}, and what the model lacks",
            "closer": "the prediction of '{experiment}' deviates from {what} by {size}only "
            "{sigmas:.2g} times {stated}: measurements scatter more; are these the predicted values, "
            "or is {stated} too large?",
        },
    ),
    "memory": Topic(
        "RAM",
        "large",
        remedy="Use the method reduced-space, fewer time steps or a coarser mesh.",
        messages={
            "short": "{method} will take about {needed_gb:.2g} GB, more than this machine's "
            "{there_gb:.2g} GB: {remedy}"
        },
    ),
    "field": Topic(
        "The field",
        "field",
        remedy="State the amplitude or lengths that the data suggest, or use regions where constants are "
        "known to differ: a prior that is too tight makes intervals too narrow.",
        messages={
            "amplitude": "{name} varies more within the body than the prior of its field allows: "
            "the data suggest an amplitude of about {likely:.2g}, not {stated:.2g}",
            "negative": "{name} is zero or negative in {below} of {elements} elements (minimum "
            "{least:.3g}): lower the amplitude of its field, {stated:.2g}, or raise its "
            "length_m",
            "shapes": "the {modes} shapes of the field of {name} represent only {share:.0%} of its "
            "variance for a length of {length_m:.2g} m: variations finer than {detail_m:.2g} "
            "m are covered by the intervals only; raise modes",
            "length": "{name} changes over less than the length of its field: the data suggest "
            "about {likely:.2g} m, not {stated:.2g} m; give several lengths in length_m to "
            "choose from",
        },
    ),
    "solve": Topic(
        "The solve",
        "trust",
        remedy="Start from another guess, or without one, and make sure that the command check "
        "reports no mistake.",
        messages={
            "lost": "the solve did not converge: {why}",
            "acceptable": "the solve converged to the acceptable tolerance, but not to the desired "
            "one: start from another guess, or raise max_iterations",
            "no-error-bars": "no error bars could be computed; the notes of the run "
            'state the reason, after "no error bars"',
            "interrupted": "interrupted: {left_out}",
        },
    ),
}


def message_of(code: str, data: Mapping[str, Any]) -> str:
    """Return the message of a code with its data.

    If the data contain a non-empty "of", the message begins with that subject; only then, and if
    they contain "nearer", the factor by which the misfit decreases is appended. Lists and tuples
    are joined to a phrase; data without a placeholder are ignored.

    Parameters
    ----------
    code : str
        Topic and the rest of the code, such as "noise/larger".
    data : mapping of str to value
        Values of the placeholders.

    Raises
    ------
    KeyError
        If the code is unknown or a placeholder has no value.
    """
    topic, _, rest = code.partition("/")
    shown = {k: listed(v) if isinstance(v, (list, tuple)) else v for k, v in data.items()}
    message = TOPICS[topic].messages[rest].format(**shown)
    distance_text = (
        f" (the misfit becomes {data['nearer']:.2g} times smaller)" if "nearer" in data else ""
    )
    return f"{data['of']}: {message}{distance_text}" if data.get("of") else message


@dataclass(frozen=True)
class Concern:
    """One reason for concern."""

    code: str  # topic and kind, such as "noise/larger"; stable when messages are reworded
    grade: Grade = "check"  # severity: "doubtful" is graver
    # mapping of str to value: values of the placeholders in the message.
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def topic(self) -> str:
        """Topic of the concern, a key of `TOPICS`: the code up to the first slash."""
        return self.code.partition("/")[0]

    @property
    def message(self) -> str:
        """Message of the concern for the user, see `message_of`."""
        return message_of(self.code, self.data)


def concern_if(is_present: bool, is_gross: bool, code: str, **data: Any) -> list[Concern]:
    """Return a list with the concern of a code and its data, graded "doubtful" if `is_gross` and
    else "check"; an empty list unless `is_present`.
    """
    return [Concern(code, "doubtful" if is_gross else "check", data=data)] if is_present else []


def topics_of(concerns: Iterable[Concern]) -> dict[str, Topic]:
    """Return the topics of several concerns by key, each once, in the order of their first
    concern.
    """
    return {concern.topic: TOPICS[concern.topic] for concern in concerns}


# One remedy per source of the budget, as an imperative phrase that ends a sentence.
REMEDIES: Mapping[str, str] = {
    **{name: row.remedy for name, row in DEVIATIONS.items() if row.remedy},
    "noise": "record longer, more often, or a motion or test that depends more on this parameter",
    "nuisance parameters": "measure clocks, marker positions and the grip, or the area and "
    "unloaded length of a specimen, and state tighter priors",
    "step and mesh": "raise transcription.substeps, or run refine",
    "between recordings": "find out what differs between the recordings, such as temperature or clamping",
}


def remedy_for(source: str) -> str:
    """Return what to measure in order to reduce a source of the budget, as an imperative phrase
    without a full stop.

    Any other source, such as a nuisance parameter that is budgeted instead of estimated, gets a
    phrase with its name.
    """
    fallback = f"measure {source}, or estimate it with its prior in [experiment.nuisance]"
    return REMEDIES.get(source, fallback)
