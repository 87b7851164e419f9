"""Orderings, scalings and BLAS threads of IPOPT's linear solvers, on the matrices of a problem.

Each setting runs IPOPT alone, from the simulation at the guess, for the same number of iterations,
in a separate process. Prints processor time and its ratio to the default of interior point, the
number of factorisations, and what MUMPS states about the last one: entries of the factor over
entries of the matrix (fill), operations of the elimination and delayed pivots. IPOPT may factorise
a matrix more than once in an iteration, so compare the time per factorisation as well.

    python scripts benchmark_orderings
    python scripts benchmark_orderings wrist_sensor --settings default scotch spral
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from benchmark_shipped import problem_file

from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.pipeline import solve
from collocation_sysid.problem import Problem

# Iterations of IPOPT per setting.
ITERATIONS = 10
# MUMPS's level of printing that includes the statistics of every factorisation.
STATISTICS_LEVEL = 2
# Line of a child process that begins its result.
RESULT = "RESULT "
# Number of the ordering that MUMPS states, by name.
ORDERINGS = {"0": "AMD", "2": "AMF", "3": "SCOTCH", "4": "PORD", "5": "METIS", "6": "QAMD"}


@dataclass(frozen=True)
class Setting:
    """Setting of IPOPT's linear solver that differs from the default of interior point.

    Attributes
    ----------
    ipopt : mapping
        Options of IPOPT by name.
    linear_solver : str
        IPOPT's linear solver.
    threads : int
        Threads of BLAS and OpenMP.
    """

    ipopt: Mapping[str, str | int | float] = field(default_factory=dict)
    linear_solver: str = "mumps"
    threads: int = 1


SETTINGS = {
    "default": Setting(),
    "amd": Setting({"mumps_pivot_order": 0}),
    "amf": Setting({"mumps_pivot_order": 2}),
    "scotch": Setting({"mumps_pivot_order": 3}),
    "pord": Setting({"mumps_pivot_order": 4}),
    "metis": Setting({"mumps_pivot_order": 5}),
    "qamd": Setting({"mumps_pivot_order": 6}),
    "automatic": Setting({"mumps_pivot_order": 7}),
    "no permutation": Setting({"mumps_permuting_scaling": 0}),
    "permutation of the diagonal's product": Setting({"mumps_permuting_scaling": 5}),
    "scaling by the diagonal": Setting({"mumps_scaling": 1}),
    "scaling by rows and columns, iterated": Setting({"mumps_scaling": 7}),
    "automatic scaling": Setting({"mumps_scaling": 77}),
    "IPOPT's defaults of MUMPS": Setting(
        {"mumps_pivot_order": 7, "mumps_scaling": 77, "mumps_pivtol": 1e-6}
    ),
    "two threads": Setting(threads=2),
    "spral": Setting(linear_solver="spral"),
    "spral, metis": Setting(
        {"spral_ordering": "metis", "spral_scaling": "none"}, linear_solver="spral"
    ),
}


@dataclass(frozen=True)
class Factorisations:
    """Statistics that MUMPS prints about its factorisations.

    Attributes
    ----------
    ordering : str
        Ordering that MUMPS used, which may differ from the one that was requested.
    count : int
        Number of factorisations.
    nonzeros : int
        Entries that IPOPT passes: those of the lower triangle, and the shifts of the diagonal.
    entries : int
        Entries of the last factor.
    operations : float
        Operations of the last elimination.
    delayed_pivots : int
        Pivots that the last factorisation delayed.
    """

    ordering: str
    count: int
    nonzeros: int
    entries: int
    operations: float
    delayed_pivots: int

    @property
    def fill(self) -> float:
        """Entries of the factor over those of the matrix."""
        return self.entries / self.nonzeros

    @classmethod
    def from_output(cls, output: str) -> Factorisations | None:
        """Return the statistics in the text that MUMPS prints at `STATISTICS_LEVEL`; None without a
        complete factorisation.
        """

        def last(pattern: str) -> str | None:
            """Return the first group of the pattern's last match; None without a match."""
            matches = re.findall(pattern, output)
            return matches[-1] if matches else None

        ordering = last(r"Ordering option effectively used\s*=\s*(\d+)")
        nonzeros = last(r"N, NNZ =\s*2\s+\d+\s+(\d+)")
        entries = last(r"INFOG \(29\) Number of entries in factors\s*=\s*(\d+)")
        operations = last(r"\(3\) Operations in node elimination\s*=\s*([\d.D+]+)")
        delayed = last(r"Number of delayed pivots\s*=\s*(\d+)")
        if None in (ordering, nonzeros, entries, operations, delayed):
            return None
        return cls(
            ordering=ORDERINGS.get(str(ordering), str(ordering)),
            count=len(re.findall(r"INFOG \(29\)", output)),
            nonzeros=int(str(nonzeros)),
            entries=int(str(entries)),
            operations=float(str(operations).replace("D", "e")),
            delayed_pivots=int(str(delayed)),
        )


@dataclass(frozen=True)
class SolveTimes:
    """Result of one run of IPOPT.

    Attributes
    ----------
    status : str
        Status of the solution.
    iterations : int
        Iterations of IPOPT.
    processor_s : float
        Processor time of the method [s].
    wall_s : float
        Wall time of the method [s].
    linear_algebra_share : float
        Share of the wall time that is neither set-up nor evaluation.
    loss : float
        Loss of the last iterate.
    """

    status: str
    iterations: int
    processor_s: float
    wall_s: float
    linear_algebra_share: float
    loss: float


def run_in_this_process(problem: str, setting: Setting, iterations: int) -> SolveTimes:
    """Run IPOPT with a setting in this process; MUMPS prints its statistics.

    The markers are associated by reduced space, whose time does not count.

    Parameters
    ----------
    problem : str
        Name of a shipped problem, see `problem_file`.
    setting : Setting
    iterations : int
        Largest number of iterations.
    """
    reference = solve(Problem.read(problem_file(problem)), ReducedSpace())
    options = dict(setting.ipopt)
    if setting.linear_solver == "mumps":
        options["mumps_print_level"] = STATISTICS_LEVEL
    method = InteriorPoint(
        initial="simulation",
        linear_solver=setting.linear_solver,
        max_iterations=iterations,
        ipopt=options,
    )
    began_wall_s = time.perf_counter()
    began_s = time.process_time()
    solution = method(reference.collocation)
    processor_s = time.process_time() - began_s
    wall_s = time.perf_counter() - began_wall_s
    return SolveTimes(
        status=solution.status.value,
        iterations=solution.iterations,
        processor_s=processor_s,
        wall_s=wall_s,
        linear_algebra_share=solution.timing.linear_algebra / wall_s,
        loss=solution.history[-1].loss,
    )


def run_in_own_process(
    problem: str, name: str, iterations: int
) -> tuple[SolveTimes | None, Factorisations | None]:
    """Run IPOPT with a setting in a separate process.

    Parameters
    ----------
    problem : str
        Name of a shipped problem.
    name : str
        Name of the setting among `SETTINGS`.
    iterations : int
        Largest number of iterations.

    Returns
    -------
    tuple of SolveTimes or None and Factorisations or None
        None where the process failed, or its linear solver prints no statistics.
    """
    threads = str(SETTINGS[name].threads)
    environment = os.environ | {
        "OMP_NUM_THREADS": threads,
        "OPENBLAS_NUM_THREADS": threads,
        "COLLOCATION_SYSID_THREADS": "1",
        # SPRAL requires both.
        "OMP_CANCELLATION": "TRUE",
        "OMP_PROC_BIND": "TRUE",
    }
    command = [sys.executable, __file__, problem, "--here", name]
    command += ["--iterations", str(iterations)]
    finished = subprocess.run(
        command, env=environment, capture_output=True, text=True, errors="replace", check=False
    )
    lines = finished.stdout.splitlines()
    results = [line for line in lines if line.startswith(RESULT)]
    times = SolveTimes(**json.loads(results[-1].removeprefix(RESULT))) if results else None
    return times, Factorisations.from_output(finished.stdout)


def measure(problem: str, names: list[str], iterations: int) -> None:
    """Measure the settings on a problem and print a line for each.

    Parameters
    ----------
    problem : str
        Name of a shipped problem.
    names : list of str
        Names of settings; the first one is the reference of the ratios.
    iterations : int
        Largest number of iterations.
    """
    print(f"{problem}, {iterations} iterations", flush=True)
    reference_s: float | None = None
    for name in names:
        times, factors = run_in_own_process(problem, name, iterations)
        if times is None:
            print(f"  {name}: the process failed", flush=True)
            continue
        reference_s = reference_s or times.processor_s
        parts = [
            f"{times.status}",
            f"{times.iterations} iterations",
            f"{times.processor_s:.1f} s of processor time",
            f"{times.processor_s / reference_s:.2f} times the time of the first setting",
            f"linear algebra {times.linear_algebra_share:.0%}",
            f"wall {times.wall_s:.1f} s",
            f"loss {times.loss:.6g}",
        ]
        if factors is not None:
            parts += [
                factors.ordering,
                f"{factors.count} factorisations",
                f"{times.processor_s / factors.count:.2f} s each",
                f"fill {factors.fill:.1f}",
                f"{factors.entries:,} entries",
                f"{factors.operations:.2e} operations",
                f"{factors.delayed_pivots} delayed pivots",
            ]
        print(f"  {name}: {'; '.join(parts)}", flush=True)


def main() -> None:
    """Measure the problems and settings that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("problems", nargs="*", default=["foam_cylinder"])
    parser.add_argument("--settings", nargs="*", default=list(SETTINGS), choices=list(SETTINGS))
    parser.add_argument("--iterations", type=int, default=ITERATIONS)
    parser.add_argument(
        "--here",
        choices=list(SETTINGS),
        help="run one setting in this process, and print its result as JSON",
    )
    options = parser.parse_args()
    for problem in options.problems:
        if options.here:
            times = run_in_this_process(problem, SETTINGS[options.here], options.iterations)
            print(f"\n{RESULT}{json.dumps(asdict(times))}", flush=True)
        else:
            measure(problem, options.settings, options.iterations)


if __name__ == "__main__":
    main()
