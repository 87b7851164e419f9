"""Every public callable refuses wrong values of every argument with an `InputError`.

The list of calls is generated: each callable of `__all__` × each argument × wrong kinds of values.
A value passes if the annotation of the argument has its kind, or if `ALLOWED` lists it.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

import collocation_sysid as cs
from collocation_sysid.errors import printable

T_S = 0.01 * np.arange(5)
PLACES_M = np.array([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)])
TRACKS_M = np.tile(PLACES_M, (5, 1, 1))
MATRIX = [[100.0, 0.0, 50.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]]
KNOWN = {"young_pa": 1e4, "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 1.0}
MASK = np.zeros((80, 100), dtype=bool)
MASK[20:40, 20:40] = True
LINE_M = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.1)]
TASK = {
    "reference": [{"point_m": (0.05, 0.05, 0.0), "t_s": [0.1], "position_m": [(0.05, 0.05, 0.01)]}]
}

# Classes whose instances are made by functions of the package or by other classes, never by a user,
# and base classes.
NOT_CALLED = {
    *("Collocation", "CustomSensor", "FollowingSensor", "GraspQuantities", "Iteration"),
    *(
        "ModelComparison",
        "MotionPlan",
        "PathQuantities",
        "PointQuantities",
        "Run",
        "Solution",
        "Status",
        "Trajectory",
    ),
    *("live.Frame", "live.LiveUpdate", "InputError", "SimulationError"),
    *("Assumptions.exact", "DepthCamera.of_images", "RodMesh"),
}


@cache
def valid(name: str) -> dict[str, Any]:
    """Arguments with which a callable can be called, or raises only because a file is missing."""
    mesh = cs.box_mesh((0.1, 0.1, 0.1), (1, 1, 1))
    body = cs.Body(mesh, density_kg_m3=30.0)
    fixed = cs.PoseSequence.fixed()
    grasp = cs.Grasp(cs.Face("top"), fixed)
    markers = cs.Markers(T_S, TRACKS_M, 1e-3, places_m=PLACES_M)
    experiment = cs.Experiment(body, T_S, grasp, markers)
    unknown = {**KNOWN, "young_pa": cs.Unknown(1e4)}
    problem = cs.Problem(experiment, unknown)
    camera = cs.Camera(MATRIX, size_px=(100, 80))
    constant = cs.Constant("c_pa")
    parameter = cs.Parameter("a", 1.0, 0.1, 10.0)
    stencil = cs.Stencil((0.0, 1.0), (0.0, 1.0), (0.0, 1.0), (0.0, 1.0))
    calls: dict[str, dict[str, Any]] = {
        "Assumptions": {},
        "AugmentedLagrangian": {},
        "Ball": {"center_m": (0, 0, 0), "radius_m": 0.1},
        "Body": {"mesh": mesh, "density_kg_m3": 30.0},
        "Along": {"first_m": 0.0, "last_m": 0.1},
        "Box": {"low_m": (0, 0, 0), "high_m": (1, 1, 1)},
        "Camera": {"matrix": MATRIX, "pose": np.eye(4), "size_px": (100, 80)},
        "Capsule": {"radius_m": 0.1, "ends_m": LINE_M},
        "Constant": {"name": "c_pa"},
        "CrossSection": {
            **{"area_m2": 1e-6, "moments_m4": (1e-13, 1e-13), "torsion_m4": 2e-13},
            **{"extent_m": (1e-3, 1e-3)},
        },
        "CrossSection.round": {"diameter_m": 0.01},
        "CrossSection.rectangle": {"width_m": 0.01, "height_m": 0.01},
        "Cuboid": {"corners_m": [(0, 0, 0), (1, 1, 1)]},
        "Cylinder": {"radius_m": 0.1, "ends_m": LINE_M},
        "DampingLaw": {
            "name": "d",
            "constants": (constant,),
            "potential": lambda rate, c: c * rate,
        },
        "Depth": {"name": "d", "t_s": [0.0], "clouds": [np.zeros((5, 3))], "sigma_m": 1e-3},
        "Depth.of_images": {
            "name": "d",
            "images_m": np.ones((8, 8)),
            "camera": camera,
            "sigma_m": 1e-3,
        },
        "DepthCamera": {"matrix": MATRIX},
        "Deviation": {"name": "n", "unit": "m"},
        "Experiment": {"body": body, "t_s": T_S, "grasps": grasp, "markers": markers},
        "Face": {"name": "top"},
        "Fibres": {"axis": (0.0, 0.0, 1.0)},
        "Field": {"length_m": 0.1},
        "FieldCoefficients": {"name": "f", "components": (parameter,)},
        "Force": {"nodes": [0], "force_n": (0.0, 0.0, 1.0)},
        "Gauge": {
            **{"name": "g", "expression": lambda p: p.position_m[0], "t_s": T_S},
            **{"values": np.zeros((5, 1)), "sigma": 0.1, "points_m": [(0, 0, 0)]},
        },
        "Grasp": {"nodes": [0, 1], "poses": fixed},
        "ImageTracks": {
            **{"name": "f", "camera": camera, "t_s": T_S, "pixels": np.ones((5, 4, 2))},
            **{"names": list("abcd")},
        },
        "Indices": {"indices": [0, 1]},
        "InteriorPoint": {},
        "Limits": {
            **{
                "workspace_m": ((-1.0,) * 3, (1.0,) * 3),
                "speed_m_s": 1.0,
                "acceleration_m_s2": 1.0,
            },
            **{
                "rotation_deg": 90.0,
                "angular_speed_deg_s": 9.0,
                "angular_acceleration_deg_s2": 9.0,
            },
        },
        "Limits.read": {"path": "none.toml"},
        "Markers": {"t_s": T_S, "positions_m": TRACKS_M, "sigma_m": 1e-3},
        "Markers.none": {"t_s": T_S},
        "Material": {
            **{"name": "m", "energy": lambda F, mu_pa: mu_pa * (F[0, 0] - 1) ** 2},
            **{"constants": (cs.Constant("mu_pa"),)},
        },
        "Material.from_energy": {"energy": lambda F, mu_pa: mu_pa * (F[0, 0] - 1) ** 2},
        "Named": {"name": "x"},
        "rod_mesh": {"centreline_m": LINE_M, "section": cs.CrossSection.round(0.01)},
        "NodeForce": {"name": "f", "law": lambda x, v, c: c * x, "constants": (constant,)},
        "NodeForce.from_law": {"law": lambda x, v, at, c_pa: -c_pa * (x - at.rest_m)},
        "Nuisance": {},
        "Nuisance.none": {},
        "NuisanceRow": {"name": "n", "unit": "m"},
        "Obstacle": {"shape": cs.Sphere(0.1), "poses": fixed},
        "Outlines": {"name": "o", "camera": camera, "t_s": [0.0], "masks": [MASK]},
        "Parameter": {"name": "a", "guess": 1.0, "lower": 0.1, "upper": 10.0},
        "Parameters": {"items": (parameter,)},
        "Parameters.from_mapping": {"statements": unknown},
        "PathCost": {"function": lambda at: at.position_m[0]},
        "PathLimit": {"function": lambda at: at.position_m[0], "upper": 1.0},
        "Penalty": {},
        "Placement": {
            **{"nodes": np.array([[0, 1, 2, 3]]), "weights": np.ones((1, 4)) / 4},
            **{"distance_m": np.zeros(1), "node_count": 8},
        },
        "Plane": {},
        "PointMass": {"nodes": [0], "mass_kg": 0.1},
        "PoseSequence": {
            **{"t_s": [0.0, 1.0], "positions_m": np.zeros((2, 3))},
            **{"quaternions_xyzw": [(0.0, 0.0, 0.0, 1.0)] * 2},
        },
        "PoseSequence.fixed": {},
        "PoseSequence.from_two_points": {
            "t_s": [0.0, 1.0],
            "points_m": np.tile(np.eye(3)[:2], (2, 1, 1)),
            "reference_m": np.eye(3)[:2],
        },
        "PoseSequence.from_matrices": {
            "t_s": [0.0, 1.0],
            "matrices": np.tile(np.eye(4), (2, 1, 1)),
        },
        "PoseSigma": {},
        "Pressure": {"faces": [[0, 1, 2]], "pressure_pa": 1e3},
        "Problem": {"experiments": experiment, "parameters": unknown},
        "Problem.read": {"path": "none.toml"},
        "Prony": {"name": "p"},
        "ReducedSpace": {},
        "Region": {"name": "r", "cells": [0]},
        "RolloutOptions": {},
        "Scheme": {"name": "s", "order": 1, "regular": stencil, "start": (stencil,)},
        "Shooting": {},
        "Sleqp": {},
        "Specimen": {
            **{"test": "uniaxial", "strain": np.linspace(0, 0.1, 5)},
            **{"stress_pa": np.linspace(0, 1e4, 5), "sigma_pa": 1e2},
        },
        "Specimen.harmonic": {
            **{"frequency_hz": [1.0, 2.0], "storage_pa": [2.0, 3.0], "loss_pa": [2.0, 1.0]},
            **{"relative_sigma": 0.1},
        },
        "Specimen.relaxation": {"t_s": [1.0, 2.0], "modulus_pa": [2.0, 1.0], "sigma_pa": 0.1},
        "Sphere": {"radius_m": 0.1},
        "SqpMethod": {},
        "Stencil": dict.fromkeys("pqws", (0.0, 1.0)),
        "Task": {"duration_s": 0.1, **TASK},
        "Task.read": {"path": "none.toml"},
        "Tendon": {"points_m": LINE_M, "tension_n": 1.0},
        "TetMesh": {"points_m": mesh.points_m, "tetrahedra": mesh.tetrahedra},
        "TetMesh.from_surface": {"surface": "none.stl", "edge_length_m": 0.1},
        "TetMesh.read": {"path": "none.vtu"},
        "Tied": {"to": "a"},
        "UncertaintyOptions": {},
        "UnderGravity": {"nodes": cs.Face("top")},
        "Unknown": {},
        "Wrench": {"t_s": T_S, "values": np.zeros((5, 6)), "sigma_n": 0.1, "sigma_nm": 0.01},
        "box_mesh": {"size_m": (0.1, 0.1, 0.1), "divisions": (1, 1, 1)},
        "compare_models": {"models": {"a": problem}},
        "cylinder_mesh": {"radius_m": 0.1, "height_m": 0.1, "rings": 1, "layers": 1},
        "datasets.diani": {},
        "datasets.fetch": {"name": "diani"},
        "datasets.hyperelastic_curves": {"author": "Meunier_2008", "material": "yeoh"},
        "datasets.kawabata_1981": {},
        "datasets.read_problem": {"name": "kawabata_1981"},
        "datasets.treloar_1944": {},
        "depth_image": {
            **{"camera": camera, "shape": (8, 8)},
            **{"triangles_m": [[(0.0, 0.0, 1.0), (0.0, 1.0, 1.0), (1.0, 0.0, 1.0)]]},
        },
        "live.FrameReader": {"experiment": experiment, "problem": problem},
        "live.LiveEstimator": {"problem": problem},
        "place_markers": {
            "points_m": [(0.05,) * 3],
            "node_positions_m": mesh.points_m,
            "body": body,
        },
        "plan_motion": {"source": problem, "task": cs.Task(duration_s=0.1, **TASK)},
        "refine": {"run": None},
        "run": {"problem": "none.toml"},
        "simulate": {"experiment": experiment, "parameters": KNOWN},
        "simulate_each": {"experiment": experiment, "parameters": KNOWN},
        "solve": {"problem": "none.toml"},
        "testing.check_damping": {"law": "kelvin-voigt"},
        "testing.check_force": {"force": None},
        "testing.check_material": {"material": "neo-hookean"},
        "testing.check_method": {"method": None},
        "testing.check_program": {"problem": None},
        "testing.check_sensor": {"sensor": None},
        "with_markers": {"experiment": experiment, "positions_m": TRACKS_M},
        "with_readings": {"experiment": experiment, "values": []},
        "with_wrenches": {"experiment": experiment, "wrenches": []},
        "write_plan": {"plan": None, "folder": "none"},
    }
    return calls[name]


WRONG: dict[str, Any] = {
    **{
        "None": None,
        "text": "text",
        "-1.0": -1.0,
        "nan": np.nan,
        "inf": np.inf,
        "{}": {},
        "[]": [],
    },
    **{"object": object(), "shape": np.zeros((2, 2, 2)), "control": "a\x07b", "complex": 1j},
    **{"table": {"a": 1}, "code": len},
    **{"ragged": [[0, 1, 2], [3, 4]], "ragged floats": [[0.5], [], 1.5]},
}
# Kinds that words of an annotation accept.
KINDS = {
    "None": r"\bNone\b|Optional",
    **dict.fromkeys(("text", "control"), r"\bstr\b|\bText\b|FileName|Noise"),
    "[]": r"Sequence|tuple|list|Array|Index|Shares",
    "{}": r"Mapping|Section|Assumptions|dict",
    "table": r"Mapping\[str, object\]",
    "code": r"Callable|Log\b|Watch|Law\b|Energy|Method\b|Progress|PoseLimit|Potential|Stress\b|Say\b",
}
# Values that are right beyond their kinds, by argument: negative numbers where the sign has a
# meaning, infinite limits, and values that are checked with more information later.
ALLOWED = {
    # None stands for the default, as a key that a problem file does not state.
    **dict.fromkeys(("from_s", "until_s"), "None -1.0 inf"),
    **dict.fromkeys(("Pressure.name", "Tendon.name", "Obstacle.name"), "None"),
    "loaded_since_s": "None inf",
    **dict.fromkeys(("below", "at_least", "low", "high", "largest"), "-1.0 inf"),
    **dict.fromkeys(("max_distance_m", "largest_stretch"), "inf"),
    **dict.fromkeys(("Constant.usual", "Deviation.reference", "NuisanceRow.reference"), "-1.0"),
    **dict.fromkeys(
        ("temperature_difference_k", "cut_angle_deg", "t0_s", "displacement_scale"), "-1.0"
    ),
    **dict.fromkeys(("Stencil.p", "Stencil.q", "Stencil.w", "Stencil.s", "Stencil.r"), "-1.0"),
    **dict.fromkeys(("Unknown.guess", "Unknown.lower", "Unknown.upper", "Tied.ratio"), "-1.0"),
    **dict.fromkeys(("Obstacle.relaxed", "Pressure.pressure_pa"), "-1.0"),
    **dict.fromkeys(("PathLimit.lower", "PathLimit.upper"), "-1.0"),
    # Calibrations, which an estimate may change in both directions.
    **dict.fromkeys(("factor", "loss_n", "loss_pa"), "-1.0"),
    # Not known until the stiffness is scanned.
    "Parameter.unit": "-1.0 nan inf",
    "Markers.places_sigma_m": "nan",
    # Checked with the body, with which they are resolved.
    **dict.fromkeys(("Region.cells", "UnderGravity.nodes"), "-1.0 nan inf shape"),
    # Names and constants that are used elsewhere, or not declared by a law and then ignored.
    **dict.fromkeys(("by_origin", "constants", "statements", "ipopt"), "table"),
    **dict.fromkeys(("Deviation.typical", "NuisanceRow.typical"), "table"),
}
# Arguments that the package sets itself.
INTERNAL = {"body_measure", "located"}


def public_callables() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Functions, classes, and other constructors of classes, of `__all__` and its modules."""
    for name in cs.__all__:
        value = getattr(cs, name)
        if isinstance(value, ModuleType):
            found = {f"{name}.{each}": getattr(value, each) for each in value.__all__}
        else:
            found = {name: value}
        for each, called in found.items():
            if not callable(called) or each in NOT_CALLED:
                continue
            if each.startswith("datasets.") and not inspect.signature(called).parameters:
                continue
            yield each, called
            others = vars(called).items() if isinstance(called, type) else ()
            for method, made in others:
                if isinstance(made, classmethod) and f"{each}.{method}" not in NOT_CALLED:
                    yield f"{each}.{method}", getattr(called, method)


def annotations(called: Any) -> dict[str, str]:
    """Annotation of each argument as a text, with "None" if that is the default."""
    if isinstance(called, type) and issubclass(called, BaseModel):
        return {name: str(field.annotation) for name, field in called.model_fields.items()}
    parameters = inspect.signature(called).parameters.values()
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return {
        each.name: f"{each.annotation}" + " | None" * (each.default is None)
        for each in parameters
        if each.kind not in several
    }


@pytest.mark.parametrize("name", ["../above", "a\x1b[31mb", "a/b", ".", "a\nb", "a\0b"])
def test_names_that_cannot_be_those_of_files_are_refused(name: str) -> None:
    calls = (
        lambda: cs.Experiment(**{**valid("Experiment"), "name": name}),
        lambda: cs.Constant(name),
        lambda: cs.Parameter(name, 1.0, 0.1, 10.0),
        lambda: cs.Region(name, [0]),
    )
    for call in calls:
        with pytest.raises(cs.InputError, match="expected a valid file name"):
            call()


CALLABLES = dict(public_callables())


@pytest.mark.parametrize("name", CALLABLES)
def test_wrong_values_are_refused(
    name: str, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path_factory.mktemp("empty"))
    called = CALLABLES[name]
    faults = []
    for argument, annotation in annotations(called).items():
        allowed = ALLOWED.get(f"{name}.{argument}", ALLOWED.get(argument, "")).split()
        for kind, value in () if argument in INTERNAL else WRONG.items():
            if kind == "code" and re.search(KINDS[kind], annotation):
                continue  # whose own errors pass
            what = f"{name}({argument}={kind})"
            try:
                called(**{**valid(name), argument: value})
            except cs.InputError as error:
                text = str(error)
                if "\n" in text or printable(text) != text:
                    faults.append(f"{what}: not one line: {text}")
            except Exception as error:
                faults.append(f"{what}: {type(error).__name__}: {error}")
            else:
                if kind not in allowed and not re.search(KINDS.get(kind, "$^"), annotation):
                    faults.append(f"{what}: accepted")
    assert not faults, "\n".join(faults)
