"""Estimation problems, and the problem file (TOML).

`problem` defines `Problem`, and `options` its options for checks and uncertainties. The other
modules read a problem file: `reading` parses and validates it, `loading` converts it to a problem,
`recording` reads the files of one experiment (`tracking` its markers, `code` Python files,
`bench_files` tables of a test bench, `densities` the mass), and `size` estimates memory and time.
`schema`, `recording_schema`, `nuisance_schema` and `solver_schema` define the keys, and
`explaining` words validation errors. `beginning` writes the file of a new problem.

Use `Problem` in Python and `Problem.read` for a file.
"""

from .options import Origin, RolloutOptions, UncertaintyOptions
from .problem import Problem

__all__ = ["Origin", "Problem", "RolloutOptions", "UncertaintyOptions"]
