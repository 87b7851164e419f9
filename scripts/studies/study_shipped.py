"""Answers of the shipped problems, with this version and with an earlier one.

Each problem file is solved by the command `solve` of both versions, with the earlier version's own
copy of the file. The table has the verdict, the parameters with their combined 95 % intervals, and
the processor time of the command without pictures. A version that takes longer than the limit has
the entry "not done". Measured data that are not in the repository are fetched before by the scripts
`get_...`; the folders `problems` of both versions need them.

    python scripts study_shipped --only foam_cylinder/recording.toml
    python scripts study_shipped --before ../earlier    # a clone with .venv
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from script_arguments import make_parser

from collocation_sysid.common.display import readable_stress, rounded

ROOT = Path(__file__).parents[2]
QUANTITIES = {"young_pa": "E", "poisson": "ν", "gamma_r_s": "γ_r [s]", "gamma_m_1_s": "γ_m [1/s]"}
# Files beside the problem files that are no problems.
OTHERS = ("limits.toml", "task.toml")
ONE_THREAD = {"COLLOCATION_SYSID_THREADS": "1", "OMP_NUM_THREADS": "1"}


def main() -> None:
    """Print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--before", type=Path, help="clone with .venv of an earlier version")
    parser.add_argument("--only", nargs="*", help="problem files below problems/")
    parser.add_argument("--limit-s", type=float, default=120.0, help="processor time of a solve")
    options = parser.parse_args()
    found = sorted(str(f.relative_to(ROOT / "problems")) for f in ROOT.glob("problems/*/*.toml"))
    files = options.only or [name for name in found if Path(name).name not in OTHERS]
    versions = {"now": (ROOT, Path(sys.executable))}
    if options.before is not None:
        earlier = options.before.absolute()
        versions = {"before": (earlier, earlier / ".venv" / "bin" / "python")} | versions
    print("| problem | version | verdict | " + " | ".join(QUANTITIES.values()) + " | CPU s |")
    print("|---" * (4 + len(QUANTITIES)) + "|")
    for name in files:
        for version, (clone, python) in versions.items():
            cells = solved(python, clone / "problems" / name, options.limit_s)
            print(f"| {' | '.join([name, version, *cells])} |", flush=True)


def solved(python: Path, file: Path, limit_s: float) -> list[str]:
    """Return the cells of one solve with the version that `python` imports: verdict, estimates, and
    processor time.
    """
    limits = int(limit_s), int(limit_s)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        words = ["solve", file, "--no-pictures", "-q", "--allow-code", "--out", f"{folder}/run"]
        ended = subprocess.run(
            [python, "-P", "-m", "collocation_sysid", *words],
            env=os.environ | ONE_THREAD,
            capture_output=True,
            text=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, limits),
        )
        result_file = Path(folder) / "run" / "result.json"
        result = json.loads(result_file.read_text()) if result_file.exists() else None
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if result is None:
        last = ended.stderr.strip().splitlines()[-1:] if ended.returncode > 0 else []
        reason = "no data" if "does not exist" in "".join(last) else "".join(last)[:80]
        return [reason or "not done", *("" for _ in QUANTITIES), f"{used_s:.0f}"]
    return [result["trust"]["verdict"], *estimates(result), f"{used_s:.0f}"]


def estimates(result: dict[str, Any]) -> Iterator[str]:
    """Yield a cell for each of `QUANTITIES`: value and combined interval, "" if it was not
    estimated; of several regions the first.
    """
    every = result["parameters"] | result["derived"]
    for name in QUANTITIES:
        each = next((every[k] for k in every if k == name or k.endswith(f".{name}")), None)
        if each is None or each.get("fixed"):
            yield ""
            continue
        factor, unit = readable_stress([each["value"]]) if name.endswith("_pa") else (1.0, "")
        size = each["combined_std_error"]
        value = rounded(factor * each["value"], size and factor * size)
        if each["combined95"] is None:
            yield f"{value} {unit} (no interval)"
            continue
        low, high = (rounded(factor * end, size and factor * size) for end in each["combined95"])
        yield f"{value} ({low} … {high}) {unit}".rstrip()


if __name__ == "__main__":
    main()
