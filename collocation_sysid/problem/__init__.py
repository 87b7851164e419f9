"""The problem file: schema, validation, loading."""

from .loading import Problem, load_problem
from .reading import read_problem_file
from .schema import ProblemFile

__all__ = ["Problem", "ProblemFile", "load_problem", "read_problem_file"]
