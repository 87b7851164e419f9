"""Table I of the paper with every method, for problems/table1 with data of the scheme of the fit.

All methods start from the same guess. The paper uses a penalty for the equations of motion; its
estimates are 734.3, 182.8, 0.021 and 0.91, and in a simulation with these the error of the tip is
15 cm.

    python scripts study_table1
    python scripts study_table1 --methods interior-point --time-s 600
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from script_arguments import make_parser
from studies import PARAMETER_SYMBOLS, TRUTH, Variant, markdown, number, run_variants

from collocation_sysid.extras.studies.rows import Row

PROBLEM = Path(__file__).parents[2] / "problems" / "table1" / "problem_scheme.toml"
# Options of methods: inner Levenberg–Marquardt solver.
LM = {"inner": "levenberg-marquardt"}
VARIANTS = (
    Variant("reduced-space", "reduced-space"),
    Variant("shooting", "shooting"),
    Variant("augmented-lagrangian, LM, first ρ = 1e5", "augmented-lagrangian"),
    Variant("augmented-lagrangian, LM, first ρ = 1e2", "augmented-lagrangian", {"rho": 1e2}),
    # Constant weights: that of the first stage of the schedule, and a large one.
    Variant("penalty, CG, ρ = 1e2", "penalty", {"schedule": "constant", "inner_iterations": 10000}),
    Variant(
        "penalty, CG, ρ = 1e6",
        "penalty",
        {"schedule": "constant", "rho": 1e6, "inner_iterations": 10000},
    ),
    Variant("penalty, LM", "penalty", LM),
    # Initial trajectories are simulated at the guess, not taken from a coarse solution by reduced
    # space.
    Variant("interior-point", "interior-point", {"initial": "simulation"}),
)
# Row of the paper, with the heads of `table`.
PAPER_ROW = (
    *("paper, penalty and CG", "734.3", "182.8", "0.021", "0.91"),
    *("1 (mean)", "–", "–", "–", "–", "–"),
)


def main() -> None:
    parser = make_parser(__doc__)
    names = [variant.name for variant in VARIANTS]
    parser.add_argument("--methods", nargs="*", choices=names, default=names[:-1])
    parser.add_argument("--time-s", type=float, default=180.0, help="time limit of a run [s]")
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    rows = run_variants(
        PROBLEM,
        [variant for variant in VARIANTS if variant.name in arguments.methods],
        time_s=arguments.time_s,
        workers=arguments.workers,
    )
    print(table(rows))


def table(rows: Mapping[str, Row]) -> str:
    """Return a Markdown table of the estimates, misfits and constraint violations."""
    heads = (
        *(
            "method",
            *PARAMETER_SYMBOLS,
            "RMS marker residual [mm]",
            "constraint violation [N]",
            "relative violation",
        ),
        *("iterations", "time [s]", "status"),
    )
    truth = ("truth", *(f"{value:g}" for value in TRUTH.values()), *("0",) * 3, *"–––")
    lines = [truth, PAPER_ROW]
    for name, row in rows.items():
        lines.append(
            (
                name,
                *(number(row[f"value_{key}"], digits=4) for key in TRUTH),
                number(row["rms_m"], 1e3),
                number(row["violation_n"], digits=2),
                number(row["violation_relative"], digits=2),
                number(row["iterations"], digits=6),
                number(row["total_s"]),
                row["status"],
            )
        )
    return markdown(heads, lines)


if __name__ == "__main__":
    main()
