"""Command that checks the installation."""

from __future__ import annotations

import typer

from ..common.display import Line, Shown, Table, labelled, number
from ..installation_check import Dependency, InstallationReport, check_installation
from .command_options import OutputOptions, command
from .common import EXIT_BAD_INPUT, error_console

commands = typer.Typer()


@command(commands, "doctor", "doctor --json")
def doctor(*, output: OutputOptions) -> None:
    """Check the installation and run a self test.

    The command lists the versions of the required packages, the solvers, the cache of compiled
    kernels, the threads and the extras. The self test identifies the stiffness of a small simulated
    block.

    The exit code is 0 if all required packages are installed in suitable versions and the self test
    passes, and 2 otherwise. Extras are optional and do not change the exit code.
    """
    with error_console.status("checking the installation"):
        report = check_installation()
    output.print_result(report, installation_sections(report))
    raise typer.Exit(0 if report.is_working else EXIT_BAD_INPUT)


def installation_sections(report: InstallationReport) -> list[Shown]:
    """Return the state of an installation for display: tables of the installation, the required
    packages and the extras, and a conclusion.
    """
    return [
        labelled(
            "Installation",
            {
                "collocation_sysid": f"{report.version}, {report.location}",
                "Python": f"{report.python}, {report.platform}",
                **_solver_rows(report),
                **_kernel_rows(report),
                **_thread_rows(report),
            },
        ),
        Table(
            "Required packages",
            (),
            rows=tuple(
                (f"  {each.name} ", each.installed or "missing", _requirement_text(each))
                for each in report.dependencies
            ),
            names=2,
            texts=1,
        ),
        labelled(
            "Extras",
            {
                each.name: f"missing: {', '.join(each.missing)}; {each.install}"
                if each.missing
                else "installed"
                for each in report.extras
            },
        ),
        _conclusion(report),
    ]


def _requirement_text(dependency: Dependency) -> str:
    if dependency.is_suitable:
        return dependency.required
    package = f"{dependency.name}{dependency.required}"
    return f'needed: {dependency.required or "any version"}; pip install "{package}"'


def _solver_rows(report: InstallationReport) -> dict[str, str]:
    if report.solvers is None:
        return {"solvers": "unknown, because CasADi cannot be imported"}
    linear = ", ".join(report.solvers.ipopt_linear) or "none that works"
    mkl = "available" if report.solvers.supernodal else "not available (extra: large)"
    return {
        "nonlinear solvers": ", ".join(report.solvers.nonlinear) or "none",
        "IPOPT's linear solvers": linear,
        "supernodal factorisation": mkl,
    }


def _kernel_rows(report: InstallationReport) -> dict[str, str]:
    kernels = report.kernels
    if kernels is None:
        return {
            "compiler": "none, because llvmlite cannot be imported; CasADi evaluates the elements, "
            "which is slower"
        }
    stored = f"{kernels.count} kernels, {number(kernels.size_mb, 3)} MB"
    state = "writable" if kernels.fault is None else f"not used: {kernels.fault}"
    return {
        "compiler": kernels.compiler,
        "C compiler": f"{kernels.c_compiler or 'none'} (not needed)",
        "kernel cache": f"{kernels.folder}: {stored}, {state}",
    }


def _thread_rows(report: InstallationReport) -> dict[str, str]:
    threads = report.threads
    memory = number(threads.memory_mb and threads.memory_mb / 1e3, 3)
    return {
        "threads": f"{threads.count} of {threads.cores} cores ({threads.source})",
        "memory": f"{memory} GB",
    }


def _conclusion(report: InstallationReport) -> Line:
    test = report.self_test
    outcome = "passed" if test.is_passed else "FAILED"
    text = f"Self test {outcome} in {test.time_s:.1f} s: {test.message}."
    if report.is_working:
        return Line(f"{text} The installation works.", "good")
    unsuitable = [each.name for each in report.dependencies if not each.is_suitable]
    remedy = f" Install {', '.join(unsuitable)}." if unsuitable else ""
    return Line(f"{text} The installation does not work.{remedy}", "doubtful")
