"""What the package exports; each module is imported when one of its names is asked for."""

from . import datasets, live
from .errors import InputError, SimulationError
from .fem.body import Body
from .fem.constants import Constant
from .fem.materials import Material, Prony
from .fem.mesh import TetMesh
from .fem.node_force import NodeForce
from .fem.regions import Region
from .fem.rest_shape import UnderGravity
from .fem.selection import Ball, Box, Face, Indices, Named
from .fem.spatial_field import Field
from .fem.structured import box_mesh, cylinder_mesh
from .methods.comparison.casadi_nlp import Sleqp, SqpMethod
from .methods.comparison.penalty import AugmentedLagrangian, Penalty
from .methods.comparison.shooting import Shooting
from .methods.continuation import Continuation
from .methods.interior_point import InteriorPoint
from .methods.reduced_space import ReducedSpace
from .methods.solution import Iteration, Solution, Status
from .model.parameters import Parameter, Parameters, Tied, Unknown
from .model.schemes import Scheme, Stencil
from .pipeline import Run, run, solve
from .problem import Problem, RolloutOptions, UncertaintyOptions
from .program.collocation import Collocation
from .program.simulation import Trajectory, simulate, with_markers, with_readings, with_wrenches
from .recording import (
    Capsule,
    Cuboid,
    Cylinder,
    Depth,
    DepthCamera,
    Experiment,
    Force,
    Gauge,
    Grasp,
    Look,
    Markers,
    Nuisance,
    NuisanceRow,
    Obstacle,
    Placement,
    Plane,
    PointMass,
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
from .statistics.systematic_effects import Assumptions

__all__ = [
    "Assumptions",
    "AugmentedLagrangian",
    "Ball",
    "Body",
    "Box",
    "Capsule",
    "Collocation",
    "Constant",
    "Continuation",
    "Cuboid",
    "Cylinder",
    "Depth",
    "DepthCamera",
    "Experiment",
    "Face",
    "Field",
    "Force",
    "Gauge",
    "Grasp",
    "Indices",
    "InputError",
    "InteriorPoint",
    "Iteration",
    "Look",
    "Markers",
    "Material",
    "Named",
    "NodeForce",
    "Nuisance",
    "NuisanceRow",
    "Obstacle",
    "Parameter",
    "Parameters",
    "Penalty",
    "Placement",
    "Plane",
    "PointMass",
    "PoseSequence",
    "Pressure",
    "Problem",
    "Prony",
    "ReducedSpace",
    "Region",
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
    "Tendon",
    "TetMesh",
    "Tied",
    "Trajectory",
    "UncertaintyOptions",
    "UnderGravity",
    "Unknown",
    "Wrench",
    "box_mesh",
    "cylinder_mesh",
    "datasets",
    "depth_image",
    "live",
    "place_markers",
    "refine",
    "run",
    "simulate",
    "solve",
    "with_markers",
    "with_readings",
    "with_wrenches",
]

__version__: str
