"""Estimation problems, and the problem file (TOML).

`problem` defines `Problem`, and `options` its options for checks and uncertainties. The
other modules read a problem file: `loading` reads it, with `overrides`, and converts it
to a problem, `recording_reader` reads the files of one experiment (`recording_frames` its
markers and the frames of logs, `code_loader` Python files, `bench_files` tables of a test bench), and
`size` estimates memory and time; `specimen_reader` reads tests without a mesh, and `gripper_transforms`
the poses of bodies in grippers. `schema`, `recording_schema`, `camera_section` (a
`measurement_section`, which reads its own files), `nuisance_schema`, `specimen_schema` and
`solver_schema` define the keys, those of declared classes by reference to these
(`common.schema_tables.Section`); `editor_schema` describes the keys for editors,
`key_descriptions` for readers, and `validation_messages` words validation errors. `new`
writes the file of a new problem.

Use `Problem` in Python and `Problem.read` for a file.
"""

from .options import Origin, RolloutOptions, UncertaintyOptions
from .problem import Problem

__all__ = ["Origin", "Problem", "RolloutOptions", "UncertaintyOptions"]
