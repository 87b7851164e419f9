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
from dataclasses import replace

import numpy as np
from coverage_runner import Intervals, count_coverage
from study_coverage import truth
from study_faults import ASSUMED, ROWS, draw_assumption_errors, exact_recording, fit_from_truth

from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording.experiment import Experiment

GAMMA_M = "gamma_m_1_s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--all", action="store_true", help="draw every assumption")
    parser.add_argument("--vacuum", action="store_true", help="fit without air")
    arguments = parser.parse_args()
    fault = "assumed: all of these" if arguments.all else "assumed: air"
    twins = (
        (recording(fault, (arguments.seed, number), in_vacuum=arguments.vacuum), truth())
        for number in range(arguments.twins)
    )
    print(count_coverage(twins, lambda described: intervals(described, fault)).table())


def recording(fault: str, seed: tuple[int, int], in_vacuum: bool) -> Experiment:
    """Return a recording with drawn errors of assumptions and noise, as it is described."""
    rng = np.random.default_rng(seed)
    true_recording, described = draw_assumption_errors(ASSUMED[fault])(exact_recording(), rng)
    tracks = true_recording.markers.positions_m
    tracks = tracks + true_recording.markers.sigma_m[:, None] * rng.standard_normal(tracks.shape)
    if in_vacuum:
        described = replace(described, air_density_kg_m3="none")
    return with_markers(described, tracks)


def intervals(described: Experiment, fault: str) -> Intervals | None:
    """Return the statistical and the combined interval of γ_m; None if the fit does not converge."""
    fit = fit_from_truth(described, ROWS[fault])
    line = fit.lines.get(GAMMA_M)
    if not fit.converged or line is None:
        return None
    statistical = fit.uncertainty.estimates[GAMMA_M].statistical95
    return {f"{GAMMA_M}, statistical": statistical, f"{GAMMA_M}, combined": line.combined95}


if __name__ == "__main__":
    main()
