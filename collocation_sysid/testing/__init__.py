"""Checks of extensions, from materials to methods.

Call one function for each kind, in a test of your own. A check raises `AssertionError` with one
sentence: which property failed, where, what was found and what was expected. See
docs/howto/extend.md.

- `material_check`: energy, stress, stiffness, objectivity.
- `damping_check`: derivatives, dissipation, objectivity.
- `force_check`, `sensor_check`: values, derivatives and predictions.
- `program_check`: derivatives of a whole problem.
- `method_check`: answer, history, restart and options.
- `property_check`, `finite_differences`: comparisons.
- `small_problems`: bodies and recordings of the checks.
"""

from .damping_check import check_damping
from .force_check import check_force
from .material_check import check_material
from .method_check import check_method
from .program_check import check_program
from .sensor_check import check_sensor

__all__ = [
    "check_damping",
    "check_force",
    "check_material",
    "check_method",
    "check_program",
    "check_sensor",
]
