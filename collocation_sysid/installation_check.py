"""Check of an installation: dependencies, solvers, kernel cache, extras, and a tiny identification.

The modules of the package that need dependencies are imported within functions, so that a missing
dependency is reported instead of raised.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from .common.installation import (
    PACKAGE,
    extra_names,
    package_version,
    python_command,
    stated_requirements,
)

if TYPE_CHECKING:
    from packaging.requirements import Requirement  # which may be missing

# Extras for work on the package itself, and the collection of the others.
DEVELOPMENT_EXTRAS = ("all", "dev", "docs", "test")
# Values of the option linear_solver of IPOPT.
IPOPT_LINEAR_SOLVERS = (
    "mumps",
    "spral",
    "ma27",
    "ma57",
    "ma77",
    "ma86",
    "ma97",
    "pardiso",
    "pardisomkl",
    "wsmp",
)
# Nonlinear solvers of CasADi that methods of this package use.
NONLINEAR_SOLVERS = ("ipopt", "sleqp", "sqpmethod")
C_COMPILERS = ("cc", "gcc", "clang", "cl")
# Longest time of one attempt to solve with a linear solver [s]; it takes a fraction of a second.
SOLVER_TIME_S = 60.0
# Program that minimises a quartic function with each linear solver named in its arguments.
SOLVER_PROGRAM = """
import sys, casadi
x = casadi.SX.sym("x")
for name in sys.argv[1:]:
    options = {"ipopt.linear_solver": name, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    options["ipopt.option_file_name"] = ""
    program = {"x": x, "f": (x - 1) ** 2 + x ** 4, "g": x}
    try:
        solver = casadi.nlpsol("f", "ipopt", program, options | {"print_time": False})
        solver(x0=0, lbg=-1, ubg=2)
        status = solver.stats()["return_status"]
    except Exception:
        status = "failed"
    print(name, status, flush=True)
"""
# Largest relative deviation of the parameters identified from exact data.
SELF_TEST_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Dependency:
    """Required package."""

    name: str
    installed: str | None  # installed version; None if the package is missing
    required: str  # range of versions, such as ">=2"; empty for any
    is_suitable: bool  # whether the package is installed in a version of that range


@dataclass(frozen=True)
class Extra:
    """Optional part of the installation."""

    name: str
    missing: tuple[str, ...]  # packages that are missing or too old; empty if the extra is complete
    install: str  # command that installs the extra


@dataclass(frozen=True)
class Solvers:
    """Solvers that work."""

    nonlinear: tuple[str, ...]  # nonlinear solvers of CasADi
    ipopt_linear: tuple[str, ...]  # linear solvers with which IPOPT solved a small problem
    supernodal: bool  # whether the factorisation "supernodal" (MKL's PARDISO) is available


@dataclass(frozen=True)
class Kernels:
    """Compilation of element expressions.

    Attributes
    ----------
    compiler : str
        LLVM's version, which is part of llvmlite.
    c_compiler : str or None
        Path of a C compiler; not needed.
    folder : str
        Folder of compiled kernels.
    fault : str or None
        Reason why kernels are not stored; None if they are.
    size_mb : float
        Size of the stored kernels.
    count : int
        Number of stored kernels.
    """

    SERIALISED_PROPERTIES = ("is_writable",)

    compiler: str
    c_compiler: str | None
    folder: str
    fault: str | None
    size_mb: float
    count: int

    @property
    def is_writable(self) -> bool:
        """Whether kernels are stored in the folder."""
        return self.fault is None


@dataclass(frozen=True)
class Threads:
    """Threads of evaluations."""

    count: int
    cores: int  # cores of the machine
    source: str  # what determines the number: an environment variable, or the cores of this process
    memory_mb: float | None  # memory that this process may have; None if unknown


@dataclass(frozen=True)
class SelfTest:
    """Identification of a small body from exact data."""

    is_passed: bool
    message: str  # largest deviation of a parameter, or why the test failed
    time_s: float  # duration, including the compilation of kernels that were not stored


@dataclass(frozen=True)
class InstallationReport:
    """State of an installation."""

    SERIALISED_PROPERTIES = ("is_working",)

    version: str  # version of this package
    python: str  # version of Python
    platform: str
    location: str  # folder of this package
    dependencies: tuple[Dependency, ...]  # required packages
    solvers: Solvers | None  # none if CasADi cannot be imported
    kernels: Kernels | None  # none if llvmlite or numpy cannot be imported
    threads: Threads
    extras: tuple[Extra, ...]
    self_test: SelfTest

    @property
    def is_working(self) -> bool:
        """Whether all required packages are suitable and the self test passed."""
        return self.self_test.is_passed and all(each.is_suitable for each in self.dependencies)


def check_installation() -> InstallationReport:
    """Return the state of this installation, with the result of a self test.

    It takes seconds: kernels of the self test are compiled and stored, and other processes try the
    linear solvers.
    """
    dependencies = tuple(required_packages())
    self_test = _self_test_unless_missing(dependencies)
    return InstallationReport(
        version=package_version(),
        python=platform.python_version(),
        platform=platform.platform(),
        location=str(Path(__file__).parent),
        dependencies=dependencies,
        solvers=available_solvers(),
        kernels=kernel_state(),
        threads=thread_state(),
        extras=tuple(optional_packages()),
        self_test=self_test,
    )


def required_packages() -> Iterator[Dependency]:
    """Yield the required packages of this platform in the order of the alphabet.

    Without the library that compares versions, only that library is yielded, as unsuitable.
    """
    try:
        requirements = sorted(_requirements(""), key=lambda each: each.name)
    except ImportError:
        yield Dependency("packaging", None, required="", is_suitable=False)
        return
    yield from map(_dependency, requirements)


def optional_packages() -> Iterator[Extra]:
    """Yield the extras in the order of the alphabet, without `DEVELOPMENT_EXTRAS`.

    Nothing is yielded without the library that compares versions.
    """
    if not _finds_packaging():
        return
    for name in sorted(set(extra_names()) - set(DEVELOPMENT_EXTRAS)):
        packages = map(_dependency, _requirements(name))
        missing = sorted(each.name for each in packages if not each.is_suitable)
        yield Extra(name, tuple(missing), install=f'pip install "{PACKAGE}[{name}]"')


def _requirements(extra: str) -> Iterator[Requirement]:
    """Yield the requirements of an extra on this platform; those of the package itself for ""."""
    from packaging.requirements import Requirement

    for text in stated_requirements():
        requirement = Requirement(text)
        marker = requirement.marker
        if marker is None:
            if not extra:
                yield requirement
            continue
        is_general = marker.evaluate({"extra": ""})
        if (is_general and not extra) or (
            extra and not is_general and marker.evaluate({"extra": extra})
        ):
            yield requirement


def _finds_packaging() -> bool:
    """Return false also if the module is blocked in `sys.modules`."""
    try:
        return importlib.util.find_spec("packaging") is not None
    except ValueError:
        return False


def _dependency(requirement: Requirement) -> Dependency:
    try:
        installed = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        installed = None
    return Dependency(
        name=requirement.name,
        installed=installed,
        required=str(requirement.specifier),
        is_suitable=installed is not None
        and requirement.specifier.contains(installed, prereleases=True),
    )


def available_solvers() -> Solvers | None:
    """Return the solvers that work; None if CasADi cannot be imported."""
    try:
        import casadi as ca

        from .program.linear_algebra.supernodal import load_mkl
    except ImportError:
        return None
    return Solvers(
        nonlinear=tuple(name for name in NONLINEAR_SOLVERS if ca.has_nlpsol(name)),
        ipopt_linear=tuple(_working_linear_solvers(IPOPT_LINEAR_SOLVERS)),
        supernodal=load_mkl() is not None,
    )


def _working_linear_solvers(names: Sequence[str]) -> Iterator[str]:
    """Solve in other processes, because IPOPT crashes with some libraries that are missing."""
    remaining = list(names)
    while remaining:
        try:
            done = subprocess.run(
                python_command(SOLVER_PROGRAM, *remaining),
                capture_output=True,
                text=True,
                errors="replace",
                timeout=SOLVER_TIME_S,
            )
        except subprocess.TimeoutExpired:
            return
        statuses = dict(
            line.split(maxsplit=1) for line in done.stdout.splitlines() if len(line.split()) == 2
        )
        yield from (name for name in remaining if statuses.get(name) == "Solve_Succeeded")
        tried = [name for name in remaining if name in statuses]
        remaining = remaining[len(tried) + 1 :]


def kernel_state() -> Kernels | None:
    """Return the compiler and the cache of kernels; None if they cannot be imported.

    The folder of the cache is created if necessary.
    """
    try:
        import llvmlite
        import llvmlite.binding as llvm

        from .fem.kernels.jit import cache_fault, cache_folder
    except ImportError:
        return None
    folder = cache_folder()
    files = [file.stat() for file in folder.glob("*.o")] if folder.is_dir() else []
    llvm_version = ".".join(map(str, llvm.llvm_version_info))
    compilers = (shutil.which(name) for name in C_COMPILERS)
    return Kernels(
        compiler=f"LLVM {llvm_version} of llvmlite {llvmlite.__version__}",
        c_compiler=next((path for path in compilers if path), None),
        folder=str(folder),
        fault=cache_fault(),
        size_mb=sum(each.st_size for each in files) / 1e6,
        count=len(files),
    )


def thread_state() -> Threads:
    """Return the number of threads and what determines it; 1 if the environment variable is not a
    whole number.
    """
    from .common.limits import machine_memory_mb

    variable = "COLLOCATION_SYSID_THREADS"
    override = os.environ.get(variable, "")
    try:
        from .fem.kernels.threads import available_threads

        count = available_threads()
        source = variable if override else "cores of this process"
    except ImportError:
        count = os.cpu_count() or 1
        source = "cores of the machine"
    except ValueError as error:
        count = 1
        source = str(error)
    return Threads(
        count=count, cores=os.cpu_count() or 1, source=source, memory_mb=machine_memory_mb()
    )


def _self_test_unless_missing(dependencies: Sequence[Dependency]) -> SelfTest:
    """Fail without an attempt if packages are missing; an exception is the outcome."""
    missing = [each.name for each in dependencies if each.installed is None]
    if missing:
        return SelfTest(False, f"not attempted: {', '.join(missing)} missing", time_s=0.0)
    began_s = time.perf_counter()
    try:
        message, is_passed = identify_small_body()
    except Exception as error:  # any failure is a finding of this report
        message = f"{type(error).__name__}: {error}"
        is_passed = False
    return SelfTest(is_passed, message, time_s=time.perf_counter() - began_s)


def identify_small_body() -> tuple[str, bool]:
    """Identify the shear modulus of a small swinging block from exact tracks of its markers.

    Returns
    -------
    message : str
        Relative error of the modulus, or why the search did not converge.
    is_passed : bool
        Whether it converged with an error below `SELF_TEST_TOLERANCE`.
    """
    import numpy as np

    from .fem.body import Body
    from .fem.meshes.selection import Box
    from .fem.meshes.structured import box_mesh
    from .model.parameters import Unknown
    from .pipeline import solve
    from .problem import Problem
    from .program.simulation import simulate, with_markers
    from .recording import Experiment, Grasp, Markers, Nuisance

    t_s = 0.01 * np.arange(12)
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    poses[:, 0, 3] = 0.03 * (1 - np.cos(25 * t_s))
    hand = Grasp(Box((-1, -1, 0.079), (1, 1, 1)), poses)
    places_m = [(0.0, 0.0, 0.0), (0.04, 0.04, 0.0)]
    markers = Markers(t_s, np.zeros((len(t_s), 2, 3)), sigma_m=1e-3, places_m=places_m)
    body = Body(box_mesh((0.04, 0.04, 0.08), (1, 1, 2)), density_kg_m3=100.0)
    swing = Experiment(
        body,
        t_s,
        grasps=[hand],
        markers=markers,
        nuisance=Nuisance.none(),
        air_density_kg_m3="none",
    )
    fixed = {"poisson": 0.3, "gamma_r_s": 0.006, "gamma_m_1_s": 1.5}
    truth_pa = 2000.0
    tracks_m = simulate(
        swing, {**fixed, "mu_pa": truth_pa}, integrator="midpoint", substeps=1
    ).markers_m
    problem = Problem(
        [with_markers(swing, tracks_m)],
        {**fixed, "mu_pa": Unknown(1000.0)},
        scheme="midpoint",
        substeps=1,
    )
    solution = solve(problem, "reduced-space")
    if not solution.status.converged:
        return (f"the search did not converge ({solution.status.value}: {solution.message})", False)
    deviation = abs(solution.parameters["mu_pa"] / truth_pa - 1)
    message = f"relative error of an identified shear modulus {deviation:.1e}"
    return message, deviation < SELF_TEST_TOLERANCE
