"""Outcomes of wrong calls of the public classes and functions, counted.

    python scripts wrong_calls [--all]

Each public class and function has valid arguments (`CALLS`). One argument after the other is
replaced by values that are wrong for its kind (`WRONG`). The outcome of a call is

    refused     `InputError`; or `TypeError` that names an unknown or a missing argument
    clear       the call returns, and the meaning of the value is clear (`CLEAR`)
    accepted    the call returns: the mistake is silent
    other       any other exception, or a warning of a library
    hang        more than `LIMIT_S`

Outcomes other than "refused" are printed; `--all` prints all, with the messages.
"""

from __future__ import annotations

import signal
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from typing import Any

import numpy as np
from script_arguments import make_parser

import collocation_sysid as cs

LIMIT_S = 20
Arguments = dict[str, tuple[str, Any]]


@dataclass(frozen=True)
class Outcome:
    """Outcome of a call: the replaced argument, its value, the kind of outcome and its message."""

    call: str
    argument: str
    value: str
    kind: str
    message: str


def _masked(values: Any) -> Any:
    array = np.ma.masked_array(np.array(values, dtype=float))
    array[(0,) * array.ndim] = np.ma.masked
    return array


def _filled(value: Any) -> Callable[[Any], Any]:
    """Return a function that gives an array of the same shape with the first entry replaced."""

    def replaced(valid: Any) -> Any:
        array = np.array(valid, dtype=np.result_type(float, type(value)))
        array[(0,) * array.ndim] = value
        return array

    return replaced


# Wrong values by kind of argument; a function makes the value from the valid one.
NUMBER = (True, "300", [1.0], 1j, float("nan"), object(), np.array([1.0, 2.0]), 1e200, 1e-300)
ARRAY = (
    lambda valid: np.array(valid) * (1 + 1j),
    _masked,
    lambda valid: np.array(valid, dtype=float).astype(str),
    lambda valid: np.ones(np.shape(valid), dtype=bool),
    lambda valid: np.array(valid, dtype=float)[None],
    lambda valid: np.array(valid, dtype=float).astype(int).astype("datetime64[s]"),
    lambda valid: [np.array(valid, dtype=float).tolist(), [1.0, [2.0]]],
    _filled(1e200),
    "x",
    5.0,
    object(),
    (),
)
FINITE = (_filled(np.nan), _filled(np.inf))
COUNT = (1.5, -1, True, "2", [1], 1e3, float("nan"), 10**9)
WRONG: dict[str, tuple[Any, ...]] = {
    "number": (*NUMBER, float("inf"), None),
    "optional": (*NUMBER, float("inf")),
    "limit": NUMBER,
    "array": (*ARRAY, *FINITE),
    "gaps": ARRAY,
    "count": COUNT,
    "flag": ("no", "false", 2, None, [True]),
    "word": ("nonsense", 3, ["midpoint"], True, None),
    "name": (3, ["a"], True, None),
    "object": ("x", 5, [1], object(), np.zeros(3)),
    "objects": ("x", 5, [1], [object()], {"a": 1}),
    "mapping": ("x", 5, [1], {"nonsense": object()}),
    "selection": (object(), -1, [0.5], [10**9], "nowhere", np.zeros((2, 2))),
    "prior": ("x", (1.0,), (1.0, -1.0), (1.0, 0.0), (float("nan"), 1.0), (True, 1.0), 5.0),
}


def _calls() -> dict[str, tuple[Callable[..., Any], Arguments]]:
    """Return the public callables by name, with the kind and a valid value of their arguments."""
    mesh = cs.box_mesh((0.1, 0.1, 0.1), (2, 2, 2))
    body = cs.Body(mesh, density_kg_m3=30.0)
    t_s = 0.01 * np.arange(11)
    top = cs.Box((-1, -1, 0.0999), (1, 1, 1))
    low = cs.Ball((0.0, 0.0, 0.0), 0.02)
    still = cs.PoseSequence.fixed()
    grasp = cs.Grasp(top, still)
    places = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)]
    tracks = np.tile(np.array(places), (11, 1, 1))
    markers = cs.Markers(t_s, tracks, 1e-3, places_m=places)
    experiment = cs.Experiment(body, t_s, [grasp], markers)
    unknown = {
        "lambda_pa": 200.0,
        "mu_pa": cs.Unknown(guess=150.0, lower=10.0, upper=1e5),
        "gamma_r_s": 0.01,
        "gamma_m_1_s": 1.0,
    }
    values = {**unknown, "mu_pa": 300.0}
    problem = cs.Problem([experiment], unknown)
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (11, 1))
    camera = cs.DepthCamera(matrix=[[100.0, 0, 10], [0, 100.0, 10], [0, 0, 1]])
    strain = np.linspace(0.1, 1.0, 8)
    constant = cs.Constant("mu_pa")

    def gauge_expression(at: Any) -> Any:
        return at.position_m[0]

    return {
        "Ball": (cs.Ball, {"center_m": ("array", (0.0, 0, 0)), "radius_m": ("number", 0.1)}),
        "Box": (cs.Box, {"low_m": ("array", (0.0, 0, 0)), "high_m": ("array", (1.0, 1, 1))}),
        "Face": (cs.Face, {"name": ("word", "top")}),
        "Named": (cs.Named, {"name": ("name", "clamp")}),
        "Indices": (cs.Indices, {"indices": ("selection", [0, 1])}),
        "TetMesh": (
            cs.TetMesh,
            {
                "points_m": ("array", mesh.points_m),
                "tetrahedra": ("array", mesh.tetrahedra),
                "point_arrays": ("mapping", {}),
            },
        ),
        "box_mesh": (
            cs.box_mesh,
            {
                "size_m": ("array", (0.1, 0.1, 0.1)),
                "divisions": ("array", (2, 2, 2)),
                "origin_m": ("array", (0.0, 0, 0)),
            },
        ),
        "cylinder_mesh": (
            cs.cylinder_mesh,
            {
                "radius_m": ("number", 0.05),
                "height_m": ("number", 0.1),
                "rings": ("count", 2),
                "layers": ("count", 2),
                "sectors": ("count", 6),
            },
        ),
        "Body": (
            cs.Body,
            {
                "mesh": ("object", mesh),
                "material": ("word", "neo-hookean"),
                "density_kg_m3": ("optional", 30.0),
                "element": ("word", "tet4"),
                "damping": ("word", "kelvin-voigt"),
                "regions": ("objects", ()),
                "prony": ("objects", ()),
                "forces": ("objects", ()),
                "field": ("object", None),
                "rest_shape": ("object", None),
                "evaluator": ("word", "auto"),
            },
        ),
        "Body of a mass": (cs.Body, {"mesh": ("object", mesh), "mass_kg": ("number", 0.1)}),
        "Region": (
            cs.Region,
            {
                "name": ("name", "core"),
                "cells": ("selection", low),
                "density_kg_m3": ("optional", 30.0),
                "prony": ("objects", ()),
            },
        ),
        "Field": (
            cs.Field,
            {
                "length_m": ("number", 0.05),
                "parameter": ("name", "young_pa"),
                "modes": ("count", 10),
                "amplitude": ("optional", 1.0),
                "prior": ("word", "smooth"),
            },
        ),
        "UnderGravity": (
            cs.UnderGravity,
            {"nodes": ("selection", top), "gravity_m_s2": ("array", (0.0, 0, -9.81))},
        ),
        "Prony": (cs.Prony, {"name": ("name", "slow")}),
        "Constant": (
            cs.Constant,
            {
                "name": ("name", "mu_pa"),
                "bounds": ("prior", (1.0, 2.0)),
                "scale": ("word", "log"),
                "typical": ("optional", 1.5),
            },
        ),
        "Material": (
            cs.Material,
            {
                "name": ("name", "mine"),
                "energy": ("object", lambda F, mu_pa: mu_pa),
                "constants": ("objects", (constant,)),
            },
        ),
        "NodeForce": (
            cs.NodeForce,
            {
                "name": ("name", "mine"),
                "law": ("object", lambda points, **_: points),
                "constants": ("objects", (constant,)),
                "on": ("word", "nodes"),
                "internal_variable_count": ("count", 0),
                "is_compiled": ("flag", False),
            },
        ),
        "Sphere": (cs.Sphere, {"radius_m": ("number", 0.1), "centre_m": ("array", (0.0, 0, 0))}),
        "Plane": (cs.Plane, {"normal": ("array", (0.0, 0, 1)), "point_m": ("array", (0.0, 0, 0))}),
        "Capsule": (
            cs.Capsule,
            {"radius_m": ("number", 0.1), "ends_m": ("array", [(0.0, 0, 0), (0, 0, 1)])},
        ),
        "Cylinder": (
            cs.Cylinder,
            {
                "radius_m": ("number", 0.1),
                "ends_m": ("array", [(0.0, 0, 0), (0, 0, 1)]),
                "rounding_m": ("number", 0.01),
            },
        ),
        "Cuboid": (
            cs.Cuboid,
            {"corners_m": ("array", [(0.0, 0, 0), (1, 1, 1)]), "rounding_m": ("number", 0.01)},
        ),
        "Obstacle": (
            cs.Obstacle,
            {
                "poses": ("object", still),
                "shape": ("object", cs.Plane()),
                "name": ("name", "table"),
                "friction": ("number", 0.2),
                "stiffness_pa_m": ("optional", 1e6),
                "width_m": ("optional", 1e-3),
            },
        ),
        "DepthCamera": (
            cs.DepthCamera,
            {
                "matrix": ("array", camera.matrix),
                "distortion": ("array", (0.0, 0.0, 0.0, 0.0)),
                "pose": ("array", np.eye(4)),
            },
        ),
        "Depth": (
            cs.Depth,
            {
                "name": ("name", "front"),
                "t_s": ("array", t_s[:2]),
                "clouds": ("objects", [np.ones((5, 3)), np.ones((5, 3))]),
                "sigma_m": ("number", 1e-3),
                "camera": ("object", camera),
                "spacing_m": ("number", 0.004),
                "gate_m": ("number", 0.01),
            },
        ),
        "PoseSequence": (
            cs.PoseSequence,
            {
                "t_s": ("array", t_s),
                "positions_m": ("array", np.zeros((11, 3))),
                "quaternions_xyzw": ("array", quaternions),
                "interpolation": ("word", "smooth"),
            },
        ),
        "PoseSequence.from_matrices": (
            cs.PoseSequence.from_matrices,
            {"t_s": ("array", t_s), "matrices": ("array", np.tile(np.eye(4), (11, 1, 1)))},
        ),
        "Grasp": (
            cs.Grasp,
            {
                "nodes": ("selection", top),
                "poses": ("object", still),
                "from_s": ("limit", 0.0),
                "until_s": ("limit", 1.0),
                "sigma_m": ("optional", 1e-3),
                "sigma_rad": ("optional", 1e-3),
                "axes": ("word", "xyz"),
                "wrench": ("object", None),
                "displacement_scale": ("number", 1.0),
            },
        ),
        "Markers": (
            cs.Markers,
            {
                "t_s": ("array", t_s),
                "positions_m": ("gaps", tracks),
                "sigma_m": ("number", 1e-3),
                "names": ("objects", ("a", "b")),
                "places_m": ("gaps", places),
                "on_surface": ("flag", False),
                "attach": ("word", "auto"),
                "max_distance_m": ("optional", 0.01),
            },
        ),
        "PointMass": (
            cs.PointMass,
            {"nodes": ("selection", low), "mass_kg": ("number", 0.1), "from_s": ("limit", 0.0)},
        ),
        "Force": (
            cs.Force,
            {
                "nodes": ("selection", low),
                "force_n": ("array", (0.0, 0, 1)),
                "from_s": ("limit", 0.0),
            },
        ),
        "Tendon": (
            cs.Tendon,
            {
                "points_m": ("array", [(0.0, 0, 0), (0, 0, 0.1)]),
                "tension_n": ("array", [1.0, 2.0]),
                "t_s": ("array", [0.0, 0.1]),
                "factor": ("number", 1.0),
                "loss_n": ("number", 0.1),
            },
        ),
        "Pressure": (
            cs.Pressure,
            {
                "faces": ("selection", cs.Named("chamber")),
                "pressure_pa": ("array", [1.0, 2.0]),
                "t_s": ("array", [0.0, 0.1]),
                "factor": ("number", 1.0),
                "lag_s": ("number", 0.1),
            },
        ),
        "Wrench": (
            cs.Wrench,
            {
                "t_s": ("array", t_s),
                "values": ("gaps", np.ones((11, 6))),
                "sigma_n": ("number", 0.1),
                "sigma_nm": ("optional", 0.1),
                "frame": ("word", "world"),
                "point_m": ("array", (0.0, 0, 0)),
                "symmetry": ("count", 1),
            },
        ),
        "Gauge": (
            cs.Gauge,
            {
                "name": ("name", "mine"),
                "expression": ("object", gauge_expression),
                "t_s": ("array", t_s),
                "values": ("gaps", np.ones((11, 1))),
                "sigma": ("number", 0.1),
                "points_m": ("array", [(0.0, 0, 0)]),
                "unknowns": ("mapping", {}),
                "unit": ("name", "m"),
            },
        ),
        "Specimen": (
            cs.Specimen,
            {
                "test": ("word", "uniaxial"),
                "strain": ("array", strain),
                "stress_pa": ("gaps", 1e3 * strain),
                "sigma_pa": ("number", 10.0),
                "t_s": ("array", np.arange(8.0)),
                "lateral_stretch": ("gaps", 1 - 0.3 * strain),
                "lateral_sigma": ("number", 0.005),
                "strain_zero": ("number", 0.001),
                "area_error": ("number", 0.01),
                "stress_zero_pa": ("number", 1.0),
                "length_m": ("optional", 0.1),
                "area_m2": ("optional", 1e-4),
            },
        ),
        "Experiment": (
            cs.Experiment,
            {
                "body": ("object", body),
                "t_s": ("array", t_s),
                "grasps": ("objects", [grasp]),
                "markers": ("object", markers),
                "gravity_m_s2": ("array", (0.0, 0, -9.81)),
                "name": ("name", "swing"),
                "kind": ("word", "dynamic"),
                "start": ("word", "equilibrium"),
                "loaded_since_s": ("limit", 1.0),
                "validation": ("flag", False),
                "masses": ("objects", ()),
                "forces": ("objects", ()),
                "tendons": ("objects", ()),
                "pressures": ("objects", ()),
                "readings": ("objects", ()),
            },
        ),
        "Unknown": (
            cs.Unknown,
            {
                "guess": ("optional", 150.0),
                "lower": ("optional", 10.0),
                "upper": ("optional", 1e5),
                "prior": ("prior", (100.0, 10.0)),
                "scale": ("word", "log"),
                "typical": ("optional", 100.0),
            },
        ),
        "Parameter": (
            cs.Parameter,
            {
                "name": ("name", "mu_pa"),
                "guess": ("optional", 150.0),
                "lower": ("limit", 10.0),
                "upper": ("limit", 1e5),
                "is_fixed": ("flag", False),
                "prior": ("prior", (100.0, 10.0)),
                "scale": ("word", "log"),
            },
        ),
        "Parameters": (
            cs.Parameters,
            {"items": ("objects", (cs.Parameter("mu_pa", 150.0, 1.0, 1e4),))},
        ),
        "Tied": (cs.Tied, {"to": ("name", "mu_pa"), "ratio": ("number", 2.0)}),
        "Nuisance": (
            cs.Nuisance,
            {"marker_offset_m": ("optional", 1e-3), "time_shift_s": ("optional", 1e-3)},
        ),
        "Assumptions": (
            cs.Assumptions,
            {"body_scale": ("number", 0.01), "mass": ("number", 0.01), "poisson": ("number", 0.01)},
        ),
        "RolloutOptions": (
            cs.RolloutOptions,
            {"integrator": ("word", "newmark"), "timestep_s": ("optional", 1e-3)},
        ),
        "UncertaintyOptions": (
            cs.UncertaintyOptions,
            {
                "noise": ("word", "auto"),
                "errors": ("word", "auto"),
                "profile": ("objects", ()),
                "numerical": ("flag", False),
                "surface_correlation": ("number", 0.5),
            },
        ),
        "ReducedSpace": (
            cs.ReducedSpace,
            {
                "tolerance": ("number", 1e-8),
                "max_iterations": ("count", 10),
                "hessian": ("word", "exact"),
            },
        ),
        "InteriorPoint": (
            cs.InteriorPoint,
            {"tolerance": ("number", 1e-8), "ipopt": ("mapping", {}), "warm_up": ("number", 0.1)},
        ),
        "Problem": (
            cs.Problem,
            {
                "experiments": ("objects", [experiment]),
                "parameters": ("mapping", unknown),
                "scheme": ("word", "midpoint"),
                "substeps": ("count", 1),
                "explicit_grasps": ("flag", False),
                "huber": ("optional", 2.0),
                "method": ("word", "reduced-space"),
                "rollout": ("object", cs.RolloutOptions()),
                "uncertainty": ("object", cs.UncertaintyOptions()),
                "title": ("name", "swing"),
                "notes": ("objects", ()),
            },
        ),
        "Collocation": (
            cs.Collocation,
            {
                "experiments": ("objects", [experiment]),
                "parameters": ("object", problem.parameters),
                "scheme": ("word", "midpoint"),
                "substeps": ("count", 1),
                "has_grasp_constraints": ("flag", False),
                "huber": ("optional", 2.0),
            },
        ),
        "simulate": (
            cs.simulate,
            {
                "experiment": ("object", experiment),
                "parameters": ("mapping", values),
                "integrator": ("word", "midpoint"),
                "timestep_s": ("optional", 0.01),
                "substeps": ("count", 1),
            },
        ),
        "run": (cs.run, {"problem": ("object", None), "method": ("word", None)}),
        "solve": (cs.solve, {"problem": ("object", None), "method": ("word", None)}),
        "refine": (cs.refine, {"run": ("object", None), "levels": ("count", 2)}),
        "with_markers": (
            cs.with_markers,
            {"experiment": ("object", experiment), "positions_m": ("gaps", tracks)},
        ),
        "place_markers": (
            cs.place_markers,
            {
                "points_m": ("gaps", places),
                "node_positions_m": ("array", body.nodes_m),
                "body": ("object", body),
                "attach": ("word", "auto"),
                "max_distance_m": ("optional", 0.01),
            },
        ),
        "depth_image": (
            cs.depth_image,
            {
                "camera": ("object", camera),
                "shape": ("array", (10, 10)),
                "triangles_m": ("array", np.array([[(0.0, 0, 1), (0.1, 0, 1), (0, 0.1, 1)]])),
            },
        ),
    }


# Arguments for which values that are wrong in general are clear, by a part of their text: bounds may
# be infinite, masked entries are missing values, and selections are resolved on a body later.
CLEAR = {
    ("Box", "high_m"): ("inf", "e+200"),
    ("Ball", "center_m"): ("e+200",),
    ("Indices", "indices"): ("",),
    ("Region", "cells"): ("",),
    ("UnderGravity", "nodes"): ("",),
    ("Body", "prony"): ("x",),
    ("Region", "prony"): ("x",),
    ("Problem", "notes"): ("x",),
    ("Field", "length_m"): ("[1.0]", "[1., 2.]"),
    ("Field", "modes"): ("1000000000",),
    ("DepthCamera", "distortion"): ("()",),
    ("Obstacle", "name"): ("None",),
    ("Obstacle", "friction"): ("'300'",),
    ("Grasp", "nodes"): ("1000000000",),
    ("PointMass", "nodes"): ("1000000000",),
    ("Force", "nodes"): ("1000000000",),
    ("Force", "force_n"): ("[[0., 0., 1.]]",),
    ("Wrench", "symmetry"): ("1000000000",),
    ("Unknown", "scale"): ("None",),
    ("Parameter", "lower"): ("1e-300",),
    ("Parameter", "upper"): ("1e+200",),
    ("ReducedSpace", "max_iterations"): ("1000000000",),
    ("Markers", "sigma_m"): ("[1., 2.]",),
    ("place_markers", "max_distance_m"): ("inf",),
    ("Assumptions", "body_scale"): ("None",),
    **{
        (name, argument): ("masked",)
        for name, arguments in {
            "Markers": ("positions_m", "places_m"),
            "Wrench": ("values",),
            "Gauge": ("values",),
            "Specimen": ("stress_pa", "lateral_stretch"),
            "with_markers": ("positions_m",),
            "place_markers": ("points_m",),
        }.items()
        for argument in arguments
    },
}


def is_clear(call: str, argument: str, value: str) -> bool:
    """Return whether the meaning of a value is clear although it is wrong in general."""
    return any(part in value for part in CLEAR.get((call, argument), ()))


def wrong_calls() -> Iterator[tuple[str, str, Any, Callable[[], Any]]]:
    """Yield the call, the argument, the wrong value and the call itself."""
    for name, (function, arguments) in _calls().items():
        valid = {argument: value for argument, (_, value) in arguments.items()}
        if name not in ("run", "solve", "refine", "Material", "NodeForce"):
            function(**valid)
        for argument, (kind, value) in arguments.items():
            for wrong in WRONG[kind]:
                changed = wrong
                if callable(wrong):
                    changed = wrong(value)
                elif wrong is None and value is None:
                    continue
                yield name, argument, changed, _call(function, {**valid, argument: changed})


def _call(function: Callable[..., Any], arguments: dict[str, Any]) -> Callable[[], Any]:
    return lambda: function(**arguments)


def outcome(name: str, argument: str, value: Any, call: Callable[[], Any]) -> Outcome:
    """Return how a call ends."""

    def late(*_: object) -> None:
        raise TimeoutError

    shown = " ".join(repr(value).split())[:60]
    previous = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT_S)
    try:
        with warnings.catch_warnings(), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            warnings.simplefilter("error")
            call()
    except cs.InputError as error:
        return Outcome(name, argument, shown, "refused", str(error))
    except TimeoutError:
        return Outcome(name, argument, shown, "hang", "")
    except Exception as error:
        return Outcome(name, argument, shown, "other", f"{type(error).__name__}: {error}"[:150])
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, previous)
    return Outcome(name, argument, shown, "accepted", "")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--all", action="store_true", help="print all outcomes")
    arguments = parser.parse_args()
    counts = Counter[str]()
    for case in wrong_calls():
        ended = outcome(*case)
        if ended.kind == "accepted" and is_clear(ended.call, ended.argument, ended.value):
            ended = replace(ended, kind="clear")
        counts[ended.kind] += 1
        if arguments.all or ended.kind not in ("refused", "clear"):
            print(f"{ended.kind:9} {ended.call}({ended.argument}={ended.value}) {ended.message}")
    print(dict(counts), file=sys.stderr)


if __name__ == "__main__":
    main()
