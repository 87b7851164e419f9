from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import write_problem
from kit.problems import uneven_box

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.recording import experiment as experiments
from collocation_sysid.result import run_record, solve_progress

BodyFactory = Callable[..., Body]

# Tests are independent of the terminal in which they are started. A background command of a shell
# ignores SIGINT, and its children inherit that.
os.environ["TERM"] = "xterm-256color"
for name in ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES"):
    os.environ.pop(name, None)
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGTERM, signal.SIG_DFL)


@pytest.fixture(scope="session", autouse=True)
def _runs_without_pictures() -> Iterator[None]:
    """Pictures take most of the time of a small run; `problem_files.pictures_drawn` has them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_record, "write_pictures", lambda *_, **__: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_lines_of_slow_machines() -> Iterator[None]:
    """What runs leave on stderr does not depend on how busy the machine is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solve_progress, "FIRST_LINE_S", 1e6)
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_air() -> Iterator[None]:
    """Bodies of tests are in a vacuum unless they say otherwise: most tests compare with theory."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiments, "USUAL_KG_M3", 0.0)
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def small_mesh() -> TetMesh:
    """A box of 27 nodes and 48 elements, of which no two are alike."""
    return uneven_box(2)


@pytest.fixture(scope="session")
def make_body(small_mesh: TetMesh) -> BodyFactory:
    """``make_body(material, evaluator)`` on the small mesh; kernels are built once a session.

    It has the paper's damping, whose slopes are symmetric; see `test_kelvin_voigt` for the other.
    """

    @cache
    def make(material: str = "neo-hookean", evaluator: str = "auto") -> Body:
        return Body(small_mesh, material, 30.0, damping="rayleigh", evaluator=evaluator)

    return make


@pytest.fixture(scope="session")
def tiny_problem(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a tiny problem with one experiment, not to be changed."""
    folder = tmp_path_factory.mktemp("tiny")
    write_problem(folder, {"swing": 8})
    return folder


@pytest.fixture
def tiny(tiny_problem: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the tiny problem's folder, which is the working directory."""
    folder = tmp_path / "tiny"
    shutil.copytree(tiny_problem, folder)
    monkeypatch.chdir(folder)
    return folder
