"""Problems, and the problem file: schema, validation, reading."""

from .options import Origin, RolloutOptions, UncertaintyOptions
from .problem import Problem

__all__ = ["Origin", "Problem", "RolloutOptions", "UncertaintyOptions"]
