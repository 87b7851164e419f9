"""Coverage and width of the combined interval of γ_m of a light body with air drag.

Twins of a foam cylinder of 30 kg/m³ that hangs from a swung hand in air of 1.2 kg/m³, with white
noise on its markers. Drag, added mass and buoyancy of each twin differ from those of the model by
shares drawn from their standard deviations in `statistics.budget.systematic_effects`; the fit has
the air of the model, the default nuisance parameters, and a budget of these three rows (or of all
assumptions that `study_faults` draws, with --all). With --vacuum the fit neglects the air, like a
problem file that states a vacuum.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import binom
from study_coverage import truth
from study_faults import ASSUMED, ROWS, draw_assumption_errors, exact_recording, fit_from_truth

from collocation_sysid.program.simulation import with_markers

GAMMA_M = "gamma_m_1_s"


@dataclass(frozen=True)
class DampingEstimate:
    """Estimate of γ_m and its intervals for one twin [1/s]."""

    estimate: float
    statistical: tuple[float, float]
    combined: tuple[float, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--all", action="store_true", help="draw every assumption")
    parser.add_argument("--vacuum", action="store_true", help="fit without air")
    parser.add_argument("--list", action="store_true", help="print every twin")
    arguments = parser.parse_args()
    began = time.perf_counter()
    twins = [
        one_twin((arguments.seed, number), everything=arguments.all, in_vacuum=arguments.vacuum)
        for number in range(arguments.twins)
    ]
    if arguments.list:
        for twin in twins:
            print(twin)
    print(summary([twin for twin in twins if twin is not None], arguments.twins))
    print(f"{time.perf_counter() - began:.0f} s")


def one_twin(seed: tuple[int, int], everything: bool, in_vacuum: bool) -> DampingEstimate | None:
    """Draw a twin and fit it; None if the fit does not converge."""
    rng = np.random.default_rng(seed)
    fault = "assumed: all of these" if everything else "assumed: air"
    true_recording, described = draw_assumption_errors(ASSUMED[fault])(exact_recording(), rng)
    tracks = true_recording.markers.positions_m
    tracks = tracks + true_recording.markers.sigma_m[:, None] * rng.standard_normal(tracks.shape)
    if in_vacuum:
        described = replace(described, air_density_kg_m3="none")
    fit = fit_from_truth(with_markers(described, tracks), ROWS[fault])
    line = fit.lines.get(GAMMA_M)
    interval = fit.uncertainty.estimates[GAMMA_M].statistical95
    if not fit.converged or line is None or interval is None:
        return None
    return DampingEstimate(fit.uncertainty.estimates[GAMMA_M].value, interval, line.combined95)


def summary(twins: list[DampingEstimate], count: int) -> str:
    """Return the table of coverage and median half widths, in percent of the true γ_m."""
    true_value = truth()[GAMMA_M]
    low, high = binom.interval(0.95, len(twins), 0.95)
    rows = [
        f"{len(twins)} of {count} twins have an interval of γ_m; of {len(twins)} exact intervals "
        f"{low:.0f} to {high:.0f} contain the truth with a probability of 95 %",
        f"γ_m: truth {true_value:g} 1/s, median {np.median([t.estimate for t in twins]):.4g} 1/s",
        "| interval | contains the truth | median half width, % of γ_m |",
        "|---|---|---|",
    ]
    for kind in ("statistical", "combined"):
        interval_ends_1_s = np.array([getattr(twin, kind) for twin in twins])
        contained = int(
            (
                (interval_ends_1_s[:, 0] <= true_value) & (true_value <= interval_ends_1_s[:, 1])
            ).sum()
        )
        width = (
            100
            * float(np.median(interval_ends_1_s[:, 1] - interval_ends_1_s[:, 0]))
            / 2
            / true_value
        )
        share = f"{contained} ({100 * contained / len(twins):.1f} %)"
        rows.append(f"| {kind} | {share} | {width:.1f} |")
    return "\n".join(rows)


if __name__ == "__main__":
    main()
