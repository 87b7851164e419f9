"""Effect of the time step of each scheme on the estimates, for data without noise.

A swung cylinder is simulated by Newmark's scheme with a step so fine that its error is negligible,
sampled every 20 ms, and identified with each scheme at steps of 20, 10 … 1.25 ms. The observed order
is the slope of log |relative error| against log Δt. A star marks an estimate at a bound; the other
estimates of that row are then biased, and the row is not used for the order.

    python scripts/study_mismatch.py
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from studies import PARAMETER_SYMBOLS, TRUTH, markdown, save
from study_starts import BOUNDS, hanging_cylinder
from synthetic import Swing

from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp

Array = NDArray[np.float64]

SCHEMES = ("backward-euler", "midpoint", "bdf2")
SAMPLE_S = 0.02
GUESS = (400.0, 150.0, 0.02, 0.5)
# Within this of its bound an estimate is at it.
AT_BOUND = 1e-3


@dataclass(frozen=True, eq=False)
class Fit:
    """One identification.

    Attributes
    ----------
    errors : (4,) relative to the truth
    at_bound : (4,)
    """

    scheme: str
    step_s: float
    converged: bool
    errors: Array
    at_bound: NDArray[np.bool_]
    rms_m: float
    time_s: float


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--schemes", nargs="*", choices=SCHEMES, default=list(SCHEMES)
    )
    parser.add_argument(
        "--substeps", nargs="*", type=int, default=[1, 2, 4, 8, 16]
    )
    parser.add_argument(
        "--layers", type=int, default=7, help="7 (layers + 1) nodes"
    )
    parser.add_argument("--samples", type=int, default=50)
    parser.add_argument(
        "--fine-s", type=float, default=1.25e-4, help="Newmark's step"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("results/study_mismatch")
    )
    arguments = parser.parse_args()
    experiment = measured(arguments.layers, arguments.samples, arguments.fine_s)
    fits = [
        identify(experiment, scheme, substeps)
        for scheme in arguments.schemes
        for substeps in arguments.substeps
    ]
    save(
        arguments.out, "study_mismatch", f"{table(fits)}\n\n{order_table(fits)}"
    )


def measured(layers: int, samples: int, fine_s: float) -> Experiment:
    """The cylinder with Newmark's tracks; poses are known at Newmark's own step."""
    experiment = hanging_cylinder(layers, samples, "midpoint")
    t_s = SAMPLE_S * np.arange(samples, dtype=np.float64)
    motion = Swing(
        duration_s=float(t_s[-1]),
        amplitude_m=(0.05, 0.04, 0.03),
        amplitude_rad=(0.1, 0.1, 0.6),
        frequency_hz=(0.9, 1.1, 1.3),
        rise_s=0.3,
    )
    grasp = Grasp(experiment.grasps[0].nodes, motion.poses(fine_s))
    markers = replace(experiment.markers, t_s=t_s)
    experiment = replace(experiment, t_s=t_s, grasps=(grasp,), markers=markers)
    return with_markers(
        experiment, simulate(experiment, TRUTH, timestep_s=fine_s).markers_m
    )


def identify(experiment: Experiment, scheme: str, substeps: int) -> Fit:
    """The parameters that a scheme takes for the truth."""
    parameters = Parameters(
        tuple(
            Parameter(name, guess, *BOUNDS[name])
            for name, guess in zip(TRUTH, GUESS, strict=True)
        )
    )
    began = time.perf_counter()
    solution = ReducedSpace()(
        Collocation([experiment], parameters, scheme, substeps)
    )
    found = solution.theta
    walls = np.array([BOUNDS[name] for name in TRUTH])
    return Fit(
        scheme,
        experiment.timestep_s / substeps,
        solution.status.converged,
        found / list(TRUTH.values()) - 1,
        np.abs(np.log(found[:, None] / walls)).min(axis=1) < AT_BOUND,
        solution.rms_m,
        time.perf_counter() - began,
    )


def orders(fits: Sequence[Fit]) -> Array:
    """(4,) slopes of log |error| against log Δt; NaN where fewer than two steps tell."""
    telling = [fit for fit in fits if fit.converged and not fit.at_bound.any()]
    if len(telling) < 2:
        return np.full(len(TRUTH), np.nan)
    steps = np.log([fit.step_s for fit in telling])
    return np.polyfit(
        steps, np.log(np.abs([fit.errors for fit in telling])), 1
    )[0]


def table(fits: Sequence[Fit]) -> str:
    """Return a Markdown table of the relative errors."""
    heads = (
        "scheme",
        "Δt [ms]",
        *(f"{name} [%]" for name in PARAMETER_SYMBOLS),
        "rms [mm]",
        "time [s]",
    )
    lines = []
    for fit in fits:
        cells = [
            f"{100 * error:+.3g}{'*' if bound else ''}"
            for error, bound in zip(fit.errors, fit.at_bound, strict=True)
        ]
        name = fit.scheme if fit.converged else f"{fit.scheme} (not converged)"
        rest = (f"{1e3 * fit.rms_m:.2g}", f"{fit.time_s:.1f}")
        lines.append((name, f"{1e3 * fit.step_s:g}", *cells, *rest))
    return markdown(heads, lines)


def order_table(fits: Sequence[Fit]) -> str:
    """Orders over all steps, and over the two finest, as Markdown."""
    lines = []
    for scheme in dict.fromkeys(fit.scheme for fit in fits):
        common = sorted(
            (f for f in fits if f.scheme == scheme), key=lambda fit: fit.step_s
        )
        for name, chosen in (("all steps", common), ("two finest", common[:2])):
            cells = ["–" if np.isnan(o) else f"{o:.2f}" for o in orders(chosen)]
            lines.append((f"{scheme}, {name}", *cells))
    return markdown(("order", *PARAMETER_SYMBOLS), lines)


if __name__ == "__main__":
    main()
