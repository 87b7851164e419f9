"""Problems, and the problem file: schema, validation, reading."""

from .problem import Origin, Problem, RolloutOptions, UncertaintyOptions

__all__ = ["Origin", "Problem", "RolloutOptions", "UncertaintyOptions"]
