"""Concerns about materials that are unstable at the strains of a motion or at rest, and about
equilibria that are not on the stable path of the loads.

By Drucker's criterion a material is stable if a further strain does positive work on the change of
stress that it causes. For an isotropic material this is the positive definiteness of the Hessian of
the energy density ψ by the logarithms of the principal stretches, ∂²ψ/∂εᵢ∂εⱼ, whose gradient is the
Kirchhoff stress. A law identified from small strains may violate it at larger ones, and then predicts
a collapse that the object does not have.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache

import casadi as ca
import numpy as np

from ..common.array_types import Array
from ..fem.body import Body
from ..fem.laws.materials import MATERIALS, Material
from ..program.experiment_iterate import ExperimentIterate
from ..program.forward.stable_path import BranchChange, find_branch_change
from .concerns import Concern

# Number of states of a motion that are examined.
STATES = 8
# Largest number of quadrature points examined in a part, those with the largest strains.
POINTS = 2000
# Margin over the shear modulus that is rounding.
ROUNDING = 1e-9


def rest_stability_concerns(body: Body, theta: Array) -> Iterator[Concern]:
    """Yield a "doubtful" concern for each part whose material is unstable without any strain, at
    constants `theta` (k,) of the body; materials that are not examined (`is_examined`) yield
    none.
    """
    for part, constants in zip(body.parts, body.split_theta(theta), strict=True):
        if is_examined(part.material):
            own = np.asarray(constants[: len(part.material.constants)])
            if not stability_margins(part.material, own, stretches=np.ones((1, 3)))[0] > 0:
                lam, mu = body.lame(theta)[part.name]
                data = {
                    "material": part.material.name,
                    "where": part.name or "the body",
                    "mu_pa": mu,
                    "kappa_pa": lam + 2 / 3 * mu,
                }
                yield Concern("stability/rest", "doubtful", data=data)


def strain_stability_concerns(iterates: Iterable[ExperimentIterate]) -> Iterator[Concern]:
    """Yield a concern for each experiment and part whose material is unstable at its strains.

    Up to `STATES` samples and, in each part, the `POINTS` quadrature points with the largest
    strains are examined. A constant that varies in space is taken at its mean.

    Parameters
    ----------
    iterates : iterable of ExperimentIterate
        Motions at the estimates.

    Notes
    -----
    The concerns have the grade "check"; materials that are not examined (`is_examined`) yield none.
    """
    for iterate in iterates:
        experiment = iterate.transcription.experiment
        samples = np.linspace(0, len(experiment.t_s) - 1, STATES).round().astype(int)
        samples = np.unique(samples)
        states = iterate.x[iterate.transcription.sample_rows[samples]]
        body = experiment.body
        theta = np.asarray(iterate.equations.dynamics.theta)
        if any(is_examined(part.material) for part in body.parts):
            stretches = principal_stretches(body, states, theta=theta)
            yield from _part_concerns(
                body,
                theta,
                stretches=stretches,
                experiment=experiment.name,
                t_s=experiment.t_s[samples],
                has_times=experiment.specimen is None,
            )


def branch_concerns(iterates: Iterable[ExperimentIterate]) -> Iterator[Concern]:
    """Yield a concern for each static experiment whose equilibria leave the stable path of its
    loads: "doubtful" if its surface wrinkles, which depends on the mesh, "check" if it buckles.
    """
    for iterate in iterates:
        experiment = iterate.transcription.experiment
        if experiment.is_static:
            change = find_branch_change(experiment, iterate.equations.dynamics, iterate.x)
            if change is not None:
                yield branch_concern(experiment.name, change)


def branch_concern(experiment: str, change: BranchChange) -> Concern:
    """Return the concern about the equilibria of an experiment, by name, see `branch_concerns`."""
    wrinkles = change.loss is not None and change.loss.is_surface_instability
    return Concern(
        "stability/branch",
        "doubtful" if wrinkles else "check",
        data={"experiment": experiment, "time_s": change.time_s, "why": change.describe()},
    )


def _part_concerns(
    body: Body, theta: Array, stretches: Array, experiment: str, t_s: Array, *, has_times: bool
) -> Iterator[Concern]:
    """Yield a concern for each part with an unstable point, about the point of least margin.

    Of each part with a material that is examined, the `POINTS` points with the largest strains of
    all times are examined; inverted elements and margins that are not finite are left out.
    """
    for part, constants in zip(body.parts, body.split_theta(theta), strict=True):
        if not is_examined(part.material):
            continue
        own = np.asarray(constants[: len(part.material.constants)])
        of_part = stretches[:, part.cells]
        times = np.repeat(t_s, of_part[0, ..., 0].size)
        points = of_part.reshape(-1, 3)
        valid = points.min(axis=1) > 0
        points = points[valid]
        times = times[valid]
        largest = np.argsort(-np.abs(np.log(points)).max(axis=1), kind="stable")[:POINTS]
        margins = stability_margins(part.material, own, stretches=points[largest])
        shear_pa = abs(body.lame(theta)[part.name][1])
        if not np.isfinite(margins).any() or np.nanmin(margins) >= -ROUNDING * shear_pa:
            continue
        worst = largest[np.nanargmin(margins)]
        yield Concern(
            "stability/material",
            "check",
            data={
                "material": part.material.name,
                "where": f" of region '{part.name}'" if part.name else "",
                "experiment": experiment,
                "time_s": float(times[worst]),
                # The times of a table of a material test may be numbers of rows.
                "when": f"{times[worst]:.3g} s and " if has_times else "",
                "stretches": ", ".join(f"{each:.3g}" for each in points[worst][::-1]),
            },
        )


# Linear elasticity depends on the rotation of the body; energies of users may be anisotropic.
EXAMINED = tuple(material for name, material in MATERIALS.items() if name != "linear")


def is_examined(material: Material) -> bool:
    """Return whether the criterion applies to a material: the built-in ones except linear
    elasticity. Energies of users could be anisotropic. Of a material with fibres the matrix alone
    is examined.
    """
    return material.matrix in EXAMINED


def stability_margins(material: Material, constants: Array, stretches: Array) -> Array:
    """Return the smallest eigenvalue of ∂²ψ/∂ε∂ε [Pa] at principal stretches; negative if unstable.

    Parameters
    ----------
    material : Material
        Isotropic material, see `is_examined`, or one with fibres.
    constants : (c,)
        Constants of the material; those of fibres are not used.
    stretches : (n, 3)
        Principal stretches.

    Returns
    -------
    (n,) array
        NaN where the energy is not defined, such as beyond the limit of Gent's material.
    """
    if not len(stretches):
        return np.zeros(0)
    matrix = material.matrix
    hessian = _log_strain_hessian(matrix).map(len(stretches))
    own = np.asarray(constants)[: len(matrix.constants)]
    values = np.repeat(own[:, None], len(stretches), axis=1)
    entries = hessian(np.log(stretches).T, values).full()
    matrices = entries.T.reshape(-1, 3, 3)
    margins = np.full(len(stretches), np.nan)
    finite = np.isfinite(matrices).all(axis=(1, 2))
    margins[finite] = np.linalg.eigvalsh(matrices[finite])[:, 0]
    return margins


def principal_stretches(body: Body, positions: Array, theta: Array) -> Array:
    """Return the principal stretches at which the material is evaluated (T, E, q, 3), ascending.

    They are relative to the stress-free shape, with the averaged dilatation of elements that
    average it. Stretches are square roots of the eigenvalues of FᵀF, so that they do not show an
    inversion, except with averaged dilatation: there they are negative if det F has another sign
    than its mean.

    Parameters
    ----------
    positions : (T, 3n)
        Node positions [m].
    theta : (k,)
        Constants of the body.

    Raises
    ------
    RestShapeError
        If there is no stress-free shape at θ.
    """
    geometry = body.stress_free_geometry(theta)
    cells, points = geometry.shape[:2]
    gradients = geometry[..., :-1].reshape(cells, points, body.element.nodes, 3)
    nodes = positions.reshape(len(positions), -1, 3)[:, body.cells]
    F = np.einsum("teai,eqaj->teqij", nodes, gradients, optimize=True)
    squares = np.linalg.eigvalsh(np.swapaxes(F, -1, -2) @ F)
    stretches = np.sqrt(np.maximum(squares, 0.0))
    if body.element.mean_dilatation:
        ratios = np.linalg.det(F)
        volumes = geometry[..., -1]
        means = (ratios * volumes).sum(axis=-1) / volumes.sum(axis=-1)
        stretches *= np.cbrt(means[..., None] / ratios)[..., None]
    return stretches


@lru_cache(32)
def _log_strain_hessian(material: Material) -> ca.Function:
    """Return the function from (ε, constants) to ∂²ψ/∂ε∂ε (9,)."""
    strain = ca.SX.sym("strain", 3)
    values = ca.SX.sym("values", len(material.constants))
    psi = material.psi(ca.diag(ca.exp(strain)), values)
    hessian, _ = ca.hessian(psi, strain)
    return ca.Function("hessian", [strain, values], [ca.densify(ca.vec(hessian))], {"cse": True})
