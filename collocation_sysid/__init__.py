"""Identify what a soft object is made of from how it moves in a robot's hand.

>>> import collocation_sysid as cs
>>> problem = cs.load_problem("problem.toml")         # doctest: +SKIP
>>> solution = cs.solve(problem)                      # doctest: +SKIP
>>> solution.parameters                               # doctest: +SKIP
"""

from importlib.metadata import version

from .errors import InputError, SimulationError
from .experiment import Experiment, Grasp, Markers, PoseSequence
from .fem.body import Body
from .fem.mesh import TetMesh
from .methods.solution import Solution, Status
from .nlp.collocation import Collocation
from .nlp.parameters import Parameter, Parameters, Tied, Unknown
from .nlp.simulation import Trajectory, simulate
from .output.record import write_run
from .problem import Problem, load_problem
from .run import run, solve

__version__ = version("collocation-sysid")

__all__ = [
    "Body",
    "Collocation",
    "Experiment",
    "Grasp",
    "InputError",
    "Markers",
    "Parameter",
    "Parameters",
    "PoseSequence",
    "Problem",
    "SimulationError",
    "Solution",
    "Status",
    "TetMesh",
    "Tied",
    "Trajectory",
    "Unknown",
    "load_problem",
    "run",
    "simulate",
    "solve",
    "write_run",
]
