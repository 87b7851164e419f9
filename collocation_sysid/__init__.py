"""Identify what a soft object is made of from how it moves in a robot's hand.

>>> import collocation_sysid as cs
>>> problem = cs.Problem.read("problem.toml")         # doctest: +SKIP
>>> run = cs.run(problem)                             # doctest: +SKIP
>>> run.parameters, run.interval("mu_pa")             # doctest: +SKIP
"""

from .common import starting as _starting  # noqa: F401  (before all that takes time to import)

# isort: split
import ast as _ast
from importlib import import_module as _import_module
from pathlib import Path as _Path
from typing import TYPE_CHECKING
from typing import Any as _Any

# The public names. Type checkers and editors read these imports; at run time `__getattr__` imports
# a module when one of its names is used, because the import of all takes seconds.
if TYPE_CHECKING:
    from . import datasets, testing
    from .errors import InputError, SimulationError
    from .extras import live
    from .extras.planning.folder import write_plan
    from .extras.planning.hand_limits import Limits
    from .extras.planning.motion_plan import MotionPlan, plan_motion
    from .extras.planning.path_terms import PathCost, PathLimit, PathQuantities
    from .extras.planning.task import Task
    from .extras.studies.model_comparison import ModelComparison, compare_models
    from .fem.body import Body
    from .fem.laws.constants import Constant
    from .fem.laws.fibres import Fibres
    from .fem.laws.materials import DampingLaw, Material, Prony
    from .fem.meshes.mesh import TetMesh
    from .fem.meshes.selection import Along, Ball, Box, Face, Indices, Named
    from .fem.meshes.structured import box_mesh, cylinder_mesh
    from .fem.node_force import NodeForce
    from .fem.regions import Region
    from .fem.rest_shape import UnderGravity
    from .fem.schemes import Scheme, Stencil
    from .fem.spatial_field import Field
    from .kinds.image_tracks.tracks import ImageTracks, PoseSigma
    from .kinds.outlines.outlines import Outlines
    from .kinds.rod.element import CrossSection, RodMesh, rod_mesh
    from .kinds.rod.friction import bending_friction
    from .methods.comparison.casadi_nlp import Sleqp, SqpMethod
    from .methods.comparison.penalty import AugmentedLagrangian, Penalty
    from .methods.comparison.shooting import Shooting
    from .methods.interior_point import InteriorPoint
    from .methods.reduced_space import ReducedSpace
    from .methods.solution import Iteration, Solution, Status
    from .model.parameters import FieldCoefficients, Parameter, Parameters, Tied, Unknown
    from .pipeline import Run, run
    from .problem import Problem, RolloutOptions, UncertaintyOptions
    from .program.collocation import Collocation
    from .program.simulation import (
        Trajectory,
        simulate,
        simulate_each,
        with_markers,
        with_readings,
        with_wrenches,
    )
    from .recording import (
        Camera,
        Capsule,
        Cuboid,
        CustomSensor,
        Cylinder,
        Depth,
        DepthCamera,
        Deviation,
        Experiment,
        FollowingSensor,
        Force,
        Gauge,
        Grasp,
        GraspQuantities,
        Markers,
        Nuisance,
        NuisanceRow,
        Obstacle,
        Placement,
        Plane,
        PointMass,
        PointQuantities,
        PoseSequence,
        Pressure,
        Specimen,
        Sphere,
        Tendon,
        Wrench,
        depth_image,
        place_markers,
    )
    from .runs.numerical_error import refine
    from .runs.solving import solve
    from .statistics.budget.systematic_effects import Assumptions

    __version__: str

__all__ = [
    "Along",
    "Assumptions",
    "AugmentedLagrangian",
    "Ball",
    "Body",
    "Box",
    "Camera",
    "Capsule",
    "Collocation",
    "Constant",
    "CrossSection",
    "Cuboid",
    "CustomSensor",
    "Cylinder",
    "DampingLaw",
    "Depth",
    "DepthCamera",
    "Deviation",
    "Experiment",
    "Face",
    "Fibres",
    "Field",
    "FieldCoefficients",
    "FollowingSensor",
    "Force",
    "Gauge",
    "Grasp",
    "GraspQuantities",
    "ImageTracks",
    "Indices",
    "InputError",
    "InteriorPoint",
    "Iteration",
    "Limits",
    "Markers",
    "Material",
    "ModelComparison",
    "MotionPlan",
    "Named",
    "NodeForce",
    "Nuisance",
    "NuisanceRow",
    "Obstacle",
    "Outlines",
    "Parameter",
    "Parameters",
    "PathCost",
    "PathLimit",
    "PathQuantities",
    "Penalty",
    "Placement",
    "Plane",
    "PointMass",
    "PointQuantities",
    "PoseSequence",
    "PoseSigma",
    "Pressure",
    "Problem",
    "Prony",
    "ReducedSpace",
    "Region",
    "RodMesh",
    "RolloutOptions",
    "Run",
    "Scheme",
    "Shooting",
    "SimulationError",
    "Sleqp",
    "Solution",
    "Specimen",
    "Sphere",
    "SqpMethod",
    "Status",
    "Stencil",
    "Task",
    "Tendon",
    "TetMesh",
    "Tied",
    "Trajectory",
    "UncertaintyOptions",
    "UnderGravity",
    "Unknown",
    "Wrench",
    "bending_friction",
    "box_mesh",
    "compare_models",
    "cylinder_mesh",
    "datasets",
    "depth_image",
    "live",
    "place_markers",
    "plan_motion",
    "refine",
    "rod_mesh",
    "run",
    "simulate",
    "simulate_each",
    "solve",
    "testing",
    "with_markers",
    "with_readings",
    "with_wrenches",
    "write_plan",
]


# Public names that are packages themselves.
_SUBPACKAGES = {"datasets": ".datasets", "live": ".extras.live", "testing": ".testing"}


def _modules_of_names() -> dict[str, str]:
    """Return the module of each public name, from the imports for type checkers above."""
    tree = _ast.parse(_Path(__file__).read_text(encoding="utf-8"))
    (block,) = (each for each in tree.body if isinstance(each, _ast.If) and _is_for_types(each))
    imports = (each for each in block.body if isinstance(each, _ast.ImportFrom))
    modules = {a.name: f".{each.module}" for each in imports for a in each.names}
    return modules | _SUBPACKAGES


def _is_for_types(block: _ast.If) -> bool:
    """Return whether a block is executed by type checkers alone."""
    return isinstance(block.test, _ast.Name) and block.test.id == "TYPE_CHECKING"


# Type checkers do not see the function, so that they report misspelt names.
if not TYPE_CHECKING:
    _MODULES = _modules_of_names()

    def __getattr__(name: str) -> _Any:
        """Return a public name; its module is imported at the first use."""
        if name == "__version__":
            from .common.installation import package_version

            return package_version()
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module = _import_module(_MODULES[name], __name__)
        attribute = module if name in _SUBPACKAGES else getattr(module, name)
        return globals().setdefault(name, attribute)


def __dir__() -> list[str]:
    return [*globals(), *__all__, "__version__"]
