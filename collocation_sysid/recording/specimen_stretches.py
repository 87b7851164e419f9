"""Principal stretches of material tests, and the range in which laws can be evaluated."""

from __future__ import annotations

import numpy as np

from ..common.array_types import Array
from ..errors import InputError
from ..fem.body import Body
from ..fem.laws.ogden import is_power_law
from .homogeneous_deformation import AXES, HomogeneousDeformation

# Smallest principal stretch at which laws in powers of the stretches are accurate to 0.1 %.
SMALLEST_POWER_STRETCH = 0.05


def require_evaluable_law(
    body: Body, deformation: HomogeneousDeformation, strain: Array, second_strain: Array | None
) -> None:
    """Raise an `InputError` if stretches leave the range in which the law is evaluated accurately.

    Only laws in powers of the stretches are checked, which integrate over invariants, see
    `fem.laws.power_traces`: no principal stretch without change of volume may be below
    `SMALLEST_POWER_STRETCH`.

    Parameters
    ----------
    body : Body
        Cell of the specimen.
    deformation : HomogeneousDeformation
        Deformation of the test.
    strain : (T,) array
        Strain of the test.
    second_strain : (T,) array or None
        Strain along the second axis of a biaxial test; None for other tests.
    """
    names = [part.material.matrix.name for part in body.parts]
    laws = [name for name in names if is_power_law(name)]
    if not laws or not len(strain):
        return
    stretches = isochoric_stretches(deformation, strain, second_strain=second_strain)
    row = int(stretches.min(axis=1).argmin())
    smallest = float(stretches[row].min())
    if smallest < SMALLEST_POWER_STRETCH:
        raise InputError(
            f"row {row + 1} has a strain of {strain[row]:.4g}, at which the smallest principal "
            f"stretch is {smallest:.3g}; expected at least {SMALLEST_POWER_STRETCH:g}, below which "
            f"'{laws[0]}' is evaluated with an error above 0.1 %. Leave out these rows, or use "
            "another law"
        )


def isochoric_stretches(
    deformation: HomogeneousDeformation, strain: Array, second_strain: Array | None
) -> Array:
    """Return the principal stretches (T, 3) without their change of volume, so that their product
    is 1, not sorted.

    Free stretches are those of an incompressible material.

    Parameters
    ----------
    deformation, strain, second_strain
        See `require_evaluable_law`.
    """
    gradients = deformation.gradients(strain, second_strain)
    free = [AXES.index(axis) for axis in deformation.free]
    if free:
        gradients[:, free, free] = np.linalg.det(gradients)[:, None] ** (-1 / len(free))
    stretches = np.linalg.svd(gradients, compute_uv=False)
    return stretches / np.cbrt(stretches.prod(axis=1, keepdims=True))
