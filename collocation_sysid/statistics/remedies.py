"""Remedies: what to measure in order to reduce a source of the uncertainty budget."""

from __future__ import annotations

from collections.abc import Mapping

from .budget.uncertainty_budget import BETWEEN, NOISE, NUISANCES, NUMERICAL

LAW = "law"

# One remedy per source of the budget, as an imperative phrase that ends a sentence.
REMEDIES: Mapping[str, str] = {
    NOISE: "record longer, more often, or a motion that depends more on this parameter",
    NUISANCES: "measure clocks, marker positions and the grip, and state tighter priors",
    NUMERICAL: "raise transcription.substeps, or run refine",
    BETWEEN: "find out what differs between the recordings, such as temperature or clamping",
    LAW: "record larger strains, which distinguish the material laws",
    "body_scale": "measure two lengths of the real body and scale the mesh to them",
    "rest_shape": "state object.rest_shape: whether the mesh is free of stress, or the shape in "
    "which the body hung or stood during its scan",
    "surface": "measure the thickness of the real body at several places",
    "mass": "weigh the body",
    "density_gradient": "weigh two halves of a specimen",
    "anisotropy": "record a second motion with the body held the other way round, or press a cube "
    "along each of its axes",
    "stiffness_drift": "repeat the first recording at the end",
    "time_scale": "compare all clocks with a reference clock",
    "poisson": "measure Poisson's ratio in a tension test, or estimate it; solid rubber is nearly "
    "incompressible: state poisson = 0.499 in [parameters], and the deviation of this value, "
    "poisson = 0.0005, in [uncertainty.assumptions]",
    "damping_law": "compare the laws with compare-models --damping on faster and slower motions, "
    'or state damping_law = "none" where the law is known',
    "rayleigh_damping": "compare the laws with compare-models --damping on motions that rotate "
    "the body",
    "grip_layer_m": "glue the body to a stiff plate, or attach markers to the body beside the grip",
    "machine_compliance_m_n": "press the platens against each other without a specimen and state "
    "the slope of displacement over force as machine_compliance_m_n = { mean = …, deviation = … } "
    "in [uncertainty.assumptions]",
    "platen_friction": "lubricate the platens, or glue the specimen to them",
    "platen_slip": "measure the bulge, by markers on the side or depth images; or state "
    'platen_slip = "none" in [uncertainty.assumptions] if the faces are glued, or axes = "z" if '
    "they slide",
    "contact_stiffness": "refine the mesh at the contact, or state a larger stiffness_pa_m and a "
    "smaller width_m of the obstacle",
    "buoyancy": "state the density of the air",
    "added_mass": "repeat the motion more slowly, or with a heavier specimen",
    "air_drag": "repeat the motion more slowly, or with a heavier specimen",
    "calibration_scale": "film a ruler where the body moves",
    "calibration_distortion_1_m2": "film a ruler where the body moves",
    "clock_rate": "trigger robot and cameras by one clock",
}


def remedy_for(source: str) -> str:
    """Return what to measure in order to reduce a source of the budget, as an imperative phrase
    without a full stop.

    Any other source, such as a nuisance parameter that is budgeted instead of estimated, gets a
    phrase with its name.
    """
    fallback = f"measure {source}, or estimate it with its prior in [experiment.nuisance]"
    return REMEDIES.get(source, fallback)
