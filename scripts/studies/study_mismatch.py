"""Effect of the time step of each scheme on the estimates, for data without noise.

A swung cylinder is simulated by Newmark's scheme with a step so fine that its error is negligible,
sampled every 20 ms, and identified with each scheme at steps of 20, 10 … 1.25 ms. The observed
order is the slope of log |relative error| against log Δt. A star marks an estimate at a bound; the
other estimates of that row are then biased, and the row is not used for the order.

    python scripts study_mismatch
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
# Sampling interval [s].
SAMPLE_S = 0.02
# Initial guesses of λ [Pa], μ [Pa], γ_r [s] and γ_m [1/s].
GUESS = (400.0, 150.0, 0.02, 0.5)
# An estimate is at a bound if their logarithms differ by less than this.
AT_BOUND_LOG = 1e-3


@dataclass(frozen=True, eq=False)
class SchemeFit:
    """Identification with one scheme and one time step.

    Attributes
    ----------
    scheme : str
    step_s : float
        Time step [s].
    converged : bool
    errors : (4,)
        Relative errors of the estimates.
    at_bound : (4,) bool
        Whether an estimate is at a bound.
    rms_m : float
        Root mean square of the marker residuals [m].
    time_s : float
        Time of the solve [s].
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
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--schemes", nargs="*", choices=SCHEMES, default=list(SCHEMES))
    parser.add_argument("--substeps", nargs="*", type=int, default=[1, 2, 4, 8, 16])
    parser.add_argument("--layers", type=int, default=7, help="7 (layers + 1) nodes")
    parser.add_argument("--samples", type=int, default=50)
    parser.add_argument("--fine-s", type=float, default=1.25e-4, help="Newmark's step")
    parser.add_argument("--out", type=Path, default=Path("results/study_mismatch"))
    arguments = parser.parse_args()
    experiment = exact_recording(arguments.layers, arguments.samples, arguments.fine_s)
    fits = [
        identify(experiment, scheme, substeps)
        for scheme in arguments.schemes
        for substeps in arguments.substeps
    ]
    save(arguments.out, "study_mismatch", f"{table(fits)}\n\n{order_table(fits)}")


def exact_recording(layers: int, samples: int, fine_s: float) -> Experiment:
    """Return the cylinder with tracks of Newmark's scheme.

    The poses are known at each time step `fine_s` [s] of this scheme.
    """
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
    return with_markers(experiment, simulate(experiment, TRUTH, timestep_s=fine_s).markers_m)


def identify(experiment: Experiment, scheme: str, substeps: int) -> SchemeFit:
    """Identify the parameters with a scheme and a number of time steps per sample."""
    parameters = Parameters(
        tuple(
            Parameter(name, guess, *BOUNDS[name]) for name, guess in zip(TRUTH, GUESS, strict=True)
        )
    )
    began = time.perf_counter()
    solution = ReducedSpace()(Collocation([experiment], parameters, scheme, substeps))
    estimates = solution.theta
    bounds = np.array([BOUNDS[name] for name in TRUTH])
    return SchemeFit(
        scheme,
        experiment.timestep_s / substeps,
        solution.status.converged,
        estimates / list(TRUTH.values()) - 1,
        np.abs(np.log(estimates[:, None] / bounds)).min(axis=1) < AT_BOUND_LOG,
        solution.rms_m,
        time.perf_counter() - began,
    )


def orders(fits: Sequence[SchemeFit]) -> Array:
    """Return the slopes (4,) of log |error| against log Δt; NaN with fewer than two usable fits.

    Fits that did not converge or have an estimate at a bound are not used.
    """
    usable_fits = [fit for fit in fits if fit.converged and not fit.at_bound.any()]
    if len(usable_fits) < 2:
        return np.full(len(TRUTH), np.nan)
    steps = np.log([fit.step_s for fit in usable_fits])
    return np.polyfit(steps, np.log(np.abs([fit.errors for fit in usable_fits])), 1)[0]


def table(fits: Sequence[SchemeFit]) -> str:
    """Return a Markdown table of the relative errors."""
    heads = (
        "scheme",
        "Δt [ms]",
        *(f"error of {name} [%]" for name in PARAMETER_SYMBOLS),
        "RMS residual [mm]",
        "time [s]",
    )
    lines = []
    for fit in fits:
        cells = [
            f"{100 * error:+.3g}{'*' if bound else ''}"
            for error, bound in zip(fit.errors, fit.at_bound, strict=True)
        ]
        name = fit.scheme if fit.converged else f"{fit.scheme} (not converged)"
        lines.append(
            (name, f"{1e3 * fit.step_s:g}", *cells, f"{1e3 * fit.rms_m:.2g}", f"{fit.time_s:.1f}")
        )
    return markdown(heads, lines)


def order_table(fits: Sequence[SchemeFit]) -> str:
    """Return a Markdown table of the orders over all steps, and over the two finest."""
    lines = []
    for scheme in dict.fromkeys(fit.scheme for fit in fits):
        scheme_fits = sorted((f for f in fits if f.scheme == scheme), key=lambda fit: fit.step_s)
        for name, chosen in (("all steps", scheme_fits), ("two finest", scheme_fits[:2])):
            cells = ["–" if np.isnan(o) else f"{o:.2f}" for o in orders(chosen)]
            lines.append((f"{scheme}, {name}", *cells))
    return markdown(("observed order", *PARAMETER_SYMBOLS), lines)


if __name__ == "__main__":
    main()
