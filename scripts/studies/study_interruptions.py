"""Solves that are interrupted at random moments: whether each keeps a result.

Solves of shipped problems, with and without guesses, with a coarse start and by interior point, run
as commands of their own. Each receives SIGINT or SIGTERM at a random moment between its first
simulation and its usual end, and a fifth of them before. After the first simulation a result must be
written, with the exit code 130 or 143; there must be no traceback, and no other exit code.

    python scripts study_interruptions [--solves 40] [--seed 0]
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from script_arguments import make_parser

PROBLEMS = Path(__file__).parents[2] / "problems"
REDUCED = ("--method", "reduced-space")
NO_GUESS = (*REDUCED, "--set", "parameters.mu_pa={}", "--set", "parameters.lambda_pa={}")
COARSE = (*REDUCED, "--set", "solver.reduced-space.coarse_start_nodes=40")
CASES = (
    ("foam_cylinder", NO_GUESS),
    ("foam_cylinder", COARSE),
    ("foam_cylinder", ("--method", "interior-point")),
    ("wrist_sensor", ()),
)
# The command, which writes the time of its first simulation into a file.
COMMAND = """
import sys, time
mark = open(sys.argv.pop(1), "w")
sys.argv[0] = "collocation-sysid"
from collocation_sysid import cli
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.methods.starts.stiffness_scan import TrialSimulation
from collocation_sysid.program import simulation
def noted(owner, name):
    function = getattr(owner, name)
    def call(*arguments, **options):
        found = function(*arguments, **options)
        print(time.time(), file=mark, flush=True)
        return found
    setattr(owner, name, call)
noted(TrialSimulation, "_evaluate")
noted(Horizon, "simulate")
cli.main()
"""


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--solves", type=int, default=40, help="number of interrupted solves")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random moments")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    usual_s = [solved(case, None)[2] for case in CASES]
    faults = 0
    print("| problem | options | signal | s | exit code | simulated | status | fault |")
    print("|---|---|---|---|---|---|---|---|")
    for number in range(arguments.solves):
        which = number % len(CASES)
        first_s, last_s = usual_s[which]
        is_early = number % 5 == 0
        after_s = rng.uniform(0.0, first_s if is_early else last_s - first_s)
        sent = (signal.SIGINT, signal.SIGTERM)[number // len(CASES) % 2]
        cells, fault, _ = solved(CASES[which], (is_early, after_s, sent))
        faults += bool(fault)
        print(f"| {' | '.join(cells)} | {fault} |", flush=True)
    print(f"\n{faults} of {arguments.solves} solves with a fault")
    sys.exit(faults > 0)


def solved(
    case: tuple[str, Sequence[str]], interruption: tuple[bool, float, signal.Signals] | None
) -> tuple[list[str], str, tuple[float, float]]:
    """Solve a case, and interrupt it a time [s] after its start (true) or its first simulation; return
    the cells of its row, the fault (empty for none), and the times of the first simulation and of the
    end [s].
    """
    name, options = case
    with tempfile.TemporaryDirectory() as folder:
        run, mark = Path(folder) / "run", Path(folder) / "mark"
        words = ["solve", str(PROBLEMS / name / "problem.toml"), *options, "--out", str(run)]
        began_s = time.time()
        process = subprocess.Popen(
            [sys.executable, "-c", COMMAND, str(mark), *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
            # A shell that starts a job in the background lets it ignore SIGINT.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        sent_s, expected = float("inf"), {0}
        if interruption is not None:
            is_early, after_s, number = interruption
            while not is_early and process.poll() is None and not _is_written(mark):
                time.sleep(0.01)
            time.sleep(after_s)
            sent_s = time.time()
            process.send_signal(number)
            expected = {0, 128 + number}
        out, err = process.communicate()
        ended_s = time.time()
        first = mark.read_text().split() if mark.exists() else []
        is_simulated = bool(first) and float(first[0]) < sent_s
        written = run / "result.json"
        status = json.loads(written.read_text())["status"] if written.exists() else "nothing"
    fault = ""
    if "Traceback" in out + err or process.returncode not in expected:
        fault = f"exit code {process.returncode}: {err[-300:]!r}"
    elif is_simulated and status not in ("interrupted", "converged"):
        fault = f"no result: {err[-300:]!r}"
    times_s = float(first[0]) - began_s if first else 0.0, ended_s - began_s
    if interruption is None:
        return [], fault, times_s
    is_early, after_s, number = interruption
    moment = f"{after_s:.2f} after {'start' if is_early else 'simulation'}"
    cells = [name, " ".join(options), number.name, moment]
    return [*cells, str(process.returncode), str(is_simulated), status], fault, times_s


def _is_written(file: Path) -> bool:
    return file.exists() and file.stat().st_size > 0


if __name__ == "__main__":
    main()
