"""Young's modulus of a block that falls on a plane: error, interval and coverage, for twins.

    nice python scripts study_falling [--seeds 20] [--rates 120 240] [--guesses none 1e6] [--element tet10]
    nice python scripts study_falling --seeds 1 --linear 20

A block of 0.1 m with E = 200 kPa falls by 0.15 m on a plane with friction. Points of its surface are
measured with a noise of 1 mm. The twin is simulated with one cell more along an edge and with finer
time steps than those of the fit, which chooses its number of time steps itself. E, ν and γ_r are
estimated, E without a guess or from a wrong one. The table has the common logarithm of E over its
true value, the factor between the ends of the combined interval, and whether it contains the true
value. Linear tetrahedra (``--element tet4 --cells 3``) show the error of a coarse mesh. With
``--linear`` the noise of so many seeds takes the place of that of each solve, and the estimates
follow by one linear step from its solution.
"""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import product

import numpy as np
from script_arguments import make_parser

import collocation_sysid as cs
from collocation_sysid.statistics.budget.consider_analysis import changes_of_assumptions
from collocation_sysid.statistics.budget.variance_sources import VarianceSources
from collocation_sysid.statistics.linearised import gauss_newton_step

SIDE_M, DROP_M, DURATION_S, SIGMA_M = 0.1, 0.15, 0.4, 1e-3
TRUTH = {"young_pa": 2e5, "poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.1}
FREE = ("young_pa", "poisson", "gamma_r_s")
# Steps per second of the simulated twins.
TWIN_HZ = 3840
# Corners, middles of edges and of faces, in half edges.
PLACES = np.array([place for place in product(range(3), repeat=3) if place != (1, 1, 1)])


def falling_block(
    cells: int,
    t_s: np.ndarray,
    element: str = "tet10",
    side_m: float = SIDE_M,
    drop_m: float = DROP_M,
) -> cs.Experiment:
    """Return the experiment with empty tracks, with so many cells along an edge."""
    mesh = cs.box_mesh((side_m,) * 3, (cells,) * 3)
    body = cs.Body(mesh, density_kg_m3=1000.0, element=element, made="cast", mesh_from="cad")
    floor = cs.Obstacle(shape=cs.Plane((0, 0, 1), (0, 0, -drop_m)), friction=0.3, name="floor")
    unseen_m = np.zeros((len(t_s), len(PLACES), 3))
    return cs.Experiment(
        body,
        t_s,
        [floor],
        cs.Markers(t_s, unseen_m, SIGMA_M, places_m=side_m / 2 * PLACES),
        start="undeformed",
        air_density_kg_m3="none",
        nuisance=cs.Nuisance.none(),
    )


def noise_of(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    return SIGMA_M * np.random.default_rng(seed).normal(size=shape)


def errors_by_linear_steps(run: cs.Run, other_noises_m: list[np.ndarray]) -> np.ndarray:
    """Return the common logarithm of E over its true value for measurements with other noise, one
    linear step from a solution; `other_noises_m` are the differences from its own noise.
    """
    assert run.fit is not None
    assert run.uncertainty is not None
    collocation, z = run.solution.collocation, run.solution.z
    granted = run.problem.assumed_deviations
    changes = changes_of_assumptions(collocation, z, granted)
    (block,) = run.fit.blocks
    errors = []
    for other_m in other_noises_m:
        seen = replace(block, residual=block.residual - other_m / SIGMA_M)
        fit = replace(run.fit, blocks=(seen,))
        sources = VarianceSources.from_fit(
            fit,
            changes,
            collocation.parameters,
            run.solution.q,
            run.uncertainty,
            deviations=granted,
            has_rulers=True,
        )
        step = gauss_newton_step(fit)[: collocation.nq] + sources.shift
        young_pa = collocation.parameters.values(run.solution.q + step)["young_pa"]
        errors.append(np.log10(young_pa / TRUTH["young_pa"]))
    return np.array(errors)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--rates", type=int, nargs="+", default=[120, 240])
    parser.add_argument("--guesses", nargs="+", default=["none", "1e6"])
    parser.add_argument("--cells", type=int, default=2, help="of the fit along an edge")
    parser.add_argument("--element", default="tet10", help="of twin and fit")
    parser.add_argument("--linear", type=int, default=0, help="seeds by one linear step each")
    arguments = parser.parse_args()
    print("rate [Hz] | guess [Pa] | seed | steps | status | log10 error | factor | holds | CPU [s]")
    for rate_hz in arguments.rates:
        t_s = np.arange(round(DURATION_S * rate_hz)) / rate_hz
        twin = falling_block(arguments.cells + 1, t_s, arguments.element)
        exact_m = cs.simulate(twin, TRUTH, "bdf2", substeps=TWIN_HZ // rate_hz).markers_m
        unseen = falling_block(arguments.cells, t_s, arguments.element)
        for guess, seed in product(arguments.guesses, range(arguments.seeds)):
            noise_m = noise_of(seed, exact_m.shape)
            fall = cs.with_markers(unseen, exact_m + noise_m)
            unknown = {name: cs.Unknown() for name in FREE}
            if guess != "none":
                unknown["young_pa"] = cs.Unknown(float(guess))
            began_s = time.process_time()
            run = cs.run(cs.Problem([fall], TRUTH | unknown, scheme="bdf2"))
            low, high = run.interval("young_pa")
            error = np.log10(run.parameters["young_pa"] / TRUTH["young_pa"])
            print(
                f"{rate_hz} | {guess} | {seed} | {run.solution.collocation.substeps} | "
                f"{run.solution.status.value} | {error:+.3f} | {high / low:.2f} | "
                f"{low <= TRUTH['young_pa'] <= high} | {time.process_time() - began_s:.0f}",
                flush=True,
            )
            if arguments.linear:
                others_m = [noise_of(k, exact_m.shape) - noise_m for k in range(arguments.linear)]
                errors = errors_by_linear_steps(run, others_m)
                inside = np.abs(errors) < np.log10(high / low) / 2
                print(
                    f"by linear steps: mean {errors.mean():+.3f}, standard deviation "
                    f"{errors.std():.3f}, largest {np.abs(errors).max():.3f}, {inside.sum()} inside",
                    flush=True,
                )


if __name__ == "__main__":
    main()
