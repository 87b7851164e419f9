"""Signals at random moments of `solve`: what is left, and with which exit code it ends.

A small problem is solved once to measure its processor time. Then the command is started again and
again, as a fork of this process so that its imports take no time, and gets SIGINT or SIGTERM in
turn after a random part of that time, whatever else the machine does (on Linux). Right is the exit
code 130 after SIGINT and 143 after SIGTERM (0 if the command had ended before the signal), no
traceback, and a run folder that is complete or absent, with nothing beside it.

    python scripts interrupts --problem problem.toml --count 60
"""

from __future__ import annotations

import contextlib
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from script_arguments import make_parser

from collocation_sysid import cli
from collocation_sysid.result.replay import read_run


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--problem", type=Path, required=True, help="problem file of a short solve")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    draw = random.Random(options.seed)
    # A shell ignores SIGINT in what it runs in the background, and so would the forks.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        with contextlib.suppress(SystemExit):  # imports all, and compiles the kernels
            solve(options.problem, place / "first")
        wait_for(start_solve(options.problem, place / "timed"))
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        duration_s = usage.ru_utime + usage.ru_stime
        print(f"one solve takes {duration_s:.1f} s")
        for k in range(options.count):
            folder = place / str(k)
            folder.mkdir()
            process = start_solve(options.problem, folder)
            number = (signal.SIGINT, signal.SIGTERM)[k % 2]
            moment_s = draw.uniform(0.0, duration_s)
            ended = wait_until(moment_s, process)
            os.kill(process, number)
            code = wait_for(process)
            outcome = describe(code, folder, right_code=0 if ended else 128 + number)
            counts[outcome] += 1
            if not outcome.endswith(", right"):
                print(f"{k}: {number.name} after {moment_s:.2f} s: {outcome}")
                print((folder / "output.txt").read_text())
    for outcome, count in counts.most_common():
        print(f"{count:4d}  {outcome}")


def solve(problem: Path, folder: Path) -> None:
    """Run the command `solve`; the process or this function ends with `SystemExit`."""
    sys.argv = ["collocation-sysid", "solve", str(problem), "--out", str(folder / "run")]
    cli.main()


def start_solve(problem: Path, folder: Path) -> int:
    """Start `solve` as a fork, whose output goes to output.txt; return the id of its process."""
    folder.mkdir(exist_ok=True)
    process = os.fork()
    if process == 0:
        code = 1
        try:
            with (folder / "output.txt").open("w") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            solve(problem, folder)
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
            os._exit(code)
    return process


def wait_until(moment_s: float, process: int) -> bool:
    """Wait until a process has used a processor time, or has ended; return whether it has ended."""
    while os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        if int(words[11]) + int(words[12]) >= moment_s * os.sysconf("SC_CLK_TCK"):
            return False
        time.sleep(0.01)
    return True


def wait_for(process: int) -> int:
    """Return the exit code of a process when it has ended, 128 more than a signal that ended it."""
    _, status = os.waitpid(process, 0)
    return 128 + os.WTERMSIG(status) if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)


def describe(code: int, folder: Path, right_code: int) -> str:
    """Return what a command has left: its exit code, folder and whether this is right, with
    `right_code` as the right exit code.
    """
    output = (folder / "output.txt").read_text()
    names = {each.name for each in folder.iterdir()} - {"output.txt"}
    kept = "no run"
    if names:
        kept = "complete run"
        try:
            read_run(folder / "run")
        except Exception as error:
            kept = f"damaged run ({error})"
        if names != {"run"}:
            kept = f"leftovers: {sorted(names)}"
    words = [f"exit code {code}", kept]
    if "Traceback" in output or "Exception ignored" in output:
        words.append("traceback")
    if code == right_code and kept in ("no run", "complete run") and len(words) == 2:
        words.append("right")
    return ", ".join(words)


if __name__ == "__main__":
    main()
