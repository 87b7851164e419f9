"""Concerns about materials that are unstable at the strains of a motion or at rest, and about
equilibria that are not on the stable path of the loads.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ..common.array_types import Array
from ..fem.body import Body
from ..fem.laws.material_stability import is_examined, principal_stretches, stability_margins
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
