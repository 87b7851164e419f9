"""Extreme input: pipes, devices, endless numbers and tables, unbounded studies."""

from __future__ import annotations

import ast
import concurrent.futures.thread
import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
import warnings
import weakref
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import FrameType

import casadi as ca
import numpy as np
import pytest
from kit.problem_files import (
    REFERENCES,
    handlers_of_signals_kept,
    replace_cell,
    replace_text,
    run_command,
    settings,
)
from matplotlib.figure import Figure
from matplotlib.path import Path as Path2D
from matplotlib.transforms import Affine2D

from collocation_sysid import cli
from collocation_sysid.common import files, limits
from collocation_sysid.common.files import read_json
from collocation_sysid.common.isolated_process import Failed, ProcessLimits, run_isolated
from collocation_sysid.common.signal_handling import (
    INTERRUPTS,
    LOSING,
    heed_interrupts,
    ignore_interrupts,
)
from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import (
    box_of_edge,
    count_box_elements,
    count_cylinder_elements,
    cylinder_of_edge,
)
from collocation_sysid.problem import Problem, loading
from collocation_sysid.problem import size as problem_size
from collocation_sysid.recording import read_markers, read_poses, write_markers_csv
from collocation_sysid.recording.camera import Camera
from collocation_sysid.recording.depth_camera import points_from_image
from collocation_sysid.recording.sources.depth_files import read_depth
from collocation_sysid.recording.sources.source import open_source
from collocation_sysid.result import run_writers
from collocation_sysid.runs import cost as memory

COMMAND_LINE = "from collocation_sysid import cli; cli.main()"

pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes by name here")


def refused(*words: object) -> str:
    outcome = run_command(*words)
    assert outcome.code == 2, f"{outcome.code}: {outcome.out}{outcome.err}"
    assert len(outcome.err.strip().splitlines()) == 1
    assert len(outcome.err) < 2000
    return outcome.err


# Streams and memory -------------------------------------------------------------------------------

ASCII = {"LANG": "C", "LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}


@pytest.mark.long
def test_the_output_may_be_in_ascii(tiny: Path):
    for words in (("methods",), ("methods", "--json"), ("check", "problem.toml")):
        done = subprocess.run(
            [sys.executable, "-c", COMMAND_LINE, *words],
            cwd=tiny, env={**os.environ, **ASCII}, capture_output=True, timeout=300,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, b"")
        text = done.stdout.decode("ascii")
        if "--json" in words:
            assert json.loads(text)
        else:
            assert "\\x" in text or "\\u" in text


def test_too_little_memory_is_one_line(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cli, "machine_memory_mb", lambda: 700.0)
    assert "may have 700 MB of memory" in refused("methods")


@pytest.mark.parametrize(
    "failure", [MemoryError(), ImportError("libx.so: failed to map segment from shared object")]
)
def test_a_library_that_cannot_be_loaded_is_one_line(
    monkeypatch: pytest.MonkeyPatch, failure: Exception
):
    def command(**_: object) -> None:
        raise failure

    monkeypatch.setattr(cli, "_root_command", lambda: command)
    assert f"too little memory ({type(failure).__name__}:" in refused("methods")


@pytest.mark.parametrize("category", [UserWarning, FutureWarning, RuntimeWarning])
def test_warnings_of_libraries_are_not_shown_before_an_error(
    monkeypatch: pytest.MonkeyPatch, category: type[Warning]
):
    def command(**_: object) -> None:
        warnings.warn_explicit("no data", category, "library.py", 1)
        raise InputError("this is wrong")

    monkeypatch.setattr(cli, "_root_command", lambda: command)
    with warnings.catch_warnings(record=True) as shown:
        assert refused("methods") == "error: this is wrong\n"
    assert not shown


# Files --------------------------------------------------------------------------------------------


@pipes
@pytest.mark.parametrize(
    "file", ["problem.toml", "swing_markers.csv", "swing_motion.csv", "body.vtu"]
)
def test_a_pipe_is_refused_rather_than_waited_for(tiny: Path, file: str):
    (tiny / file).unlink()
    os.mkfifo(tiny / file)
    assert "is a pipe; expected a regular file" in refused("check", "problem.toml")
    assert "is a pipe" in refused("compare-models", "problem.toml", "--prony", "0,1")


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no such device here")
def test_a_device_is_refused_rather_than_read_to_its_end(tiny: Path):
    assert "expected a regular file" in refused("check", "/dev/zero")
    assert "expected a regular file" in refused(
        "check", "problem.toml", *settings('object.mesh="/dev/zero"')
    )


def test_a_c3d_of_random_blocks_is_refused(tiny: Path):
    pytest.importorskip("ezc3d")
    rng = np.random.default_rng(0)
    replace_text('"swing_markers.csv"', '"swing.c3d"')(tiny)
    for _ in range(20):
        blocks = bytearray(rng.bytes(512 * 8))
        blocks[:2] = b"\x02\x50"
        (tiny / "swing.c3d").write_bytes(blocks)
        assert "swing.c3d" in refused("check", "problem.toml")


# Meshes and points of which the readers of meshio do not find the end.
ENDLESS = {
    "comment.off": "OFF\n# C7",
    "comments.msh": "$Comments\nnever ended\n",
    "header.ply": "ply\nformat ascii 1.0\ncomment",
}
READ_ENDLESS = """
import sys
from collocation_sysid.common import isolated_process
from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.mesh import TetMesh
isolated_process.READING_S = 3
for name in sys.argv[1:]:
    try:
        TetMesh.read(name)
    except InputError as error:
        print(error)
"""


@pytest.mark.long
def test_readers_that_do_not_find_the_end_of_a_mesh_are_stopped(tmp_path: Path):
    for name, content in ENDLESS.items():
        (tmp_path / name).write_text(content)
    done = subprocess.run(
        [sys.executable, "-c", READ_ENDLESS, *ENDLESS],
        cwd=tmp_path, capture_output=True, text=True, timeout=300, check=True,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert len(lines) == len(ENDLESS)
    for line, name in zip(lines, ENDLESS, strict=True):
        assert line.startswith(f"{name}: the file cannot be read as a mesh (")
    assert "the process was not finished after 3 s of processor time" in lines[0]
    assert done.stderr == ""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="limits of Linux")
def test_readers_have_a_limit_of_memory():
    take = "found = {'a': numpy.ones(int(sys.argv[1]))}"
    limits = ProcessLimits(time_s=60, memory_mb=300)
    assert len(run_isolated(take, "1000", limits=limits)["a"]) == 1000
    with pytest.raises(Failed, match="MemoryError"):
        run_isolated(take, "100000000", limits=limits)


@pytest.mark.parametrize("content", ["ply\nformat ascii 1.0\nelement vertex 3\n", "ply\n", "x"])
def test_a_damaged_cloud_is_refused_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], content: str
):
    (tmp_path / "a.ply").write_text(content)
    with pytest.raises(InputError, match=r"a\.ply: .*expected a (complete|valid) \.ply") as refusal:
        read_depth(tmp_path / "a.ply", None, 1.0)
    assert "SystemExit" not in str(refusal.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["cloud.xyz", "cloud.npz", "image.npz"])
def test_a_depth_file_with_a_length_beyond_all_measures_is_refused(tmp_path: Path, name: str):
    points_m = np.full((4, 3), 0.5)
    points_m[2, 1] = 1e30
    if name == "cloud.xyz":
        np.savetxt(tmp_path / name, points_m)
    else:
        key = "points_m" if name == "cloud.npz" else "depth_m"
        np.savez(tmp_path / name, **{key: points_m})
    with pytest.raises(
        InputError, match=rf"{name}: the largest length in the file is 1e\+30 m; expected at"
    ):
        read_depth(tmp_path / name, None, 1.0)


def test_lengths_in_a_depth_file_that_are_not_finite_are_missing_values(tmp_path: Path):
    np.savez(tmp_path / "image.npz", depth_m=np.array([[0.5, np.nan], [np.inf, 0.6]]))
    (image,) = read_depth(tmp_path / "image.npz", None, 1.0).images_m
    assert np.isfinite(image).sum() == 2


@pytest.mark.long
def test_an_array_that_its_header_states_too_large_is_refused(tmp_path: Path):
    array = np.zeros((20_000, 100, 100), dtype="u1")
    np.savez_compressed(tmp_path / "zeros.npz", depth_m=array)
    np.savez_compressed(tmp_path / "poses.npz", t_s=np.zeros(3), matrices=array)
    head = io.BytesIO()
    stated = {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)}
    np.lib.format.write_array_header_1_0(head, stated)
    (tmp_path / "cut.npy").write_bytes(head.getvalue() + bytes(1000))
    with zipfile.ZipFile(tmp_path / "cut.npz", "w") as archive:
        archive.writestr("points_m.npy", head.getvalue() + bytes(1000))
    tracemalloc.start()
    for name in ("zeros.npz", "cut.npy", "cut.npz"):
        with pytest.raises(InputError, match=rf"{name}: the array .* takes .* GB"):
            read_depth(tmp_path / name, None, 1.0)
    with pytest.raises(InputError, match=r"poses\.npz: the array matrices"):
        read_poses(tmp_path / "poses.npz")
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


@pytest.mark.long
@pipes
@pytest.mark.parametrize("name", ["log.bag", "log.db3", "log.mcap", "bag/part.db3"])
def test_a_log_that_is_a_pipe_is_refused(tiny: Path, name: str):
    (tiny / name).parent.mkdir(exist_ok=True)
    (tiny / "bag").mkdir(exist_ok=True)
    (tiny / "bag" / "metadata.yaml").write_text("")
    os.mkfifo(tiny / name)
    words = ["log", name.partition("/")[0]]
    done = subprocess.run(
        [sys.executable, "-c", COMMAND_LINE, *words], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 2, done
    assert "is a pipe; expected a regular file" in done.stderr


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="descriptors of POSIX")
def test_a_closed_standard_input_is_refused(tiny: Path):
    done = subprocess.run(
        [sys.executable, "-c", COMMAND_LINE, "live", "problem.toml"],
        capture_output=True, text=True, timeout=300, preexec_fn=partial(os.close, 0),
    )  # fmt: skip
    assert done.returncode == 2, done
    assert done.stderr.startswith("error: standard input: is closed; expected frames")
    assert done.stderr.count("\n") == 1


# Numbers ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", ["1e308", "-1e300", "9" * 5000])
@pytest.mark.parametrize("file", ["swing_markers.csv", "swing_motion.csv"])
def test_a_cell_beyond_all_measures_is_refused(tiny: Path, file: str, number: str):
    replace_cell(file, 3, 1, number)(tiny)
    assert "expected a number" in refused("check", "problem.toml")


@pytest.mark.parametrize("number", ["1e308", "5e-324", "9" * 5000, "1" + 400 * "0"])
@pytest.mark.parametrize(
    "key", ["parameters.mu_pa.guess", "object.density_kg_m3", "experiment.swing.markers.sigma_m"]
)
def test_a_number_beyond_all_measures_ends_in_a_message(tiny: Path, key: str, number: str):
    outcome = run_command("check", "problem.toml", *settings(f"{key}={number}"))
    assert outcome.code in (0, 1, 2)
    assert len(outcome.err.strip().splitlines()) <= 1


@pytest.mark.parametrize(
    "text",
    ["a = " + "[" * 5000 + "]" * 5000, "a = " + "{a = " * 3000 + "1" + "}" * 3000,
     "[" + "a." * 3000 + "b]", "a = " + "9" * 5000],
    ids=["lists", "tables", "keys", "digits"],
)  # fmt: skip
def test_a_file_of_depths_or_digits_without_end_is_refused(tiny: Path, text: str):
    with (tiny / "problem.toml").open("a") as file:
        file.write(f"\n{text}\n")
    refused("check", "problem.toml")
    refused("check", "problem.toml", *settings("title=x"))


@pytest.mark.parametrize("value", ["[" * 5000 + "]" * 5000, "9" * 5000])
def test_an_override_of_depths_or_digits_without_end_is_refused(tiny: Path, value: str):
    refused("check", "problem.toml", *settings(f"title={value}"))
    refused("check", "problem.toml", *settings("a." * 3000 + "b=1"))


# Studies ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (
            ("compare-methods", "--methods", "shooting", "--starts", "1000000"),
            "found 1,000,000 starts",
        ),
        (("compare-models", "--prony", "0,1000000"), "whole numbers up to 20"),
    ],
)
def test_a_study_without_end_is_refused_with_a_number(tiny: Path, words: tuple, found: str):
    command, *options = words
    assert found in refused(command, "problem.toml", *options)


# Memory -------------------------------------------------------------------------------------------


def test_a_solve_that_memory_cannot_hold_is_refused(tiny: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(memory, "SMALL_PROGRAM_VARIABLES", 0)
    monkeypatch.setattr(memory, "machine_memory_mb", lambda: 0.2)
    said = refused("solve", "problem.toml", "--method", "interior-point")
    assert "interior-point would take about" in said
    assert 'take method = "reduced-space"' in said or "coarser mesh" in said
    assert "reduced-space would take" in refused(
        "solve", "problem.toml", "--method", "reduced-space"
    )


@pytest.mark.parametrize(
    ("setting", "found"),
    [
        ("experiment.swing.resample_hz=1e8", "samples of a body of 36 nodes take about"),
        ("experiment.swing.resample_hz=1e12", "samples of a body of 36 nodes take about"),
        ("transcription.substeps=10000", "9 samples of 10,000 substeps of a body of 36"),
    ],
)
def test_a_problem_that_memory_cannot_hold_is_refused_by_the_reader(
    tiny: Path, monkeypatch: pytest.MonkeyPatch, setting: str, found: str
):
    monkeypatch.setattr(problem_size, "machine_memory_mb", lambda: 1e3)
    began = time.process_time()
    for command in (("check",), ("solve", "--out", "run")):
        assert found in refused(command[0], "problem.toml", *command[1:], *settings(setting))
    assert time.process_time() - began < 10
    assert not (tiny / "run").exists()


def test_unknown_positions_of_more_markers_than_memory_can_hold_are_refused(
    tiny: Path, monkeypatch: pytest.MonkeyPatch
):
    replace_text(f"reference_m = {REFERENCES}\n", "")(tiny)
    monkeypatch.setattr(problem_size, "MANY_MARKERS", 2)
    monkeypatch.setattr(problem_size, "machine_memory_mb", lambda: 0.7)
    message = refused("check", "problem.toml")
    assert "markers of unknown position take about" in message
    assert "expected fewer markers (markers.names), their positions (reference_m)" in message


def test_a_generated_mesh_that_memory_cannot_hold_is_refused_early(
    tiny: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(problem_size, "machine_memory_mb", lambda: 2e3)
    monkeypatch.setattr(loading, "box_of_edge", lambda *_, **__: pytest.fail("the mesh was made"))
    box = "box_m = [0.06, 0.06, 0.09]\nedge_length_m = 0.0015"
    replace_text('mesh = "body.vtu"', box)(tiny)
    assert "a body of 102,541 nodes take about" in refused("check", "problem.toml")


@pytest.mark.parametrize(
    ("made", "counts"),
    [
        (box_of_edge((0.06, 0.05, 0.09), 0.01), count_box_elements((0.06, 0.05, 0.09), 0.01)),
        (cylinder_of_edge(0.06, 0.09, 0.01), count_cylinder_elements(0.06, 0.09, 0.01)),
    ],
)
def test_generated_meshes_have_the_counts_that_were_expected(made: TetMesh, counts: tuple):
    assert (len(made.points_m), len(made.tetrahedra)) == counts


def test_long_work_is_announced_at_its_beginning(tiny: Path, monkeypatch: pytest.MonkeyPatch):
    replace_text("density_kg_m3 = 30.0", 'density_kg_m3 = 30.0\nelement = "tet10"')(tiny)
    announced: list[str] = []
    Problem.read("problem.toml", say=announced.append)
    assert announced == []
    Problem.read("problem.toml", ["transcription.substeps=1000"], say=announced.append)
    assert len(announced) == 1
    body = Problem.read("problem.toml").bodies[0]
    assert (
        f"9 samples of 1,000 substeps of a body of {len(body.nodes.points_m)} nodes" in announced[0]
    )
    assert "a solve may take more than a minute" in announced[0]
    monkeypatch.setattr(problem_size, "TEXT_MB_PER_S", 1e-6)
    Problem.read("problem.toml", say=announced.append)
    assert "MB of recordings, most of them in swing_markers.csv" in announced[1]


def test_long_work_is_announced_on_the_command_line(tiny: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(problem_size, "ANNOUNCED_SOLVE_S", 0.0)
    assert "a solve may take more than a minute" in run_command("check", "problem.toml").err
    assert "may take" not in run_command("check", "problem.toml", "--quiet").err


@pytest.mark.long
def test_ten_thousand_markers_are_read_in_time(tiny: Path):
    names = [f"m{k}" for k in range(10_000)]
    tracks_m = np.zeros((3, len(names), 3))
    write_markers_csv(tiny / "many.csv", np.arange(3) / 100, names, tracks_m)
    began = time.process_time()
    table = read_markers(tiny / "many.csv", names=names[::-1])
    assert time.process_time() - began < 5
    assert table.names == tuple(names[::-1])


def test_where_the_memory_is_not_known_nothing_is_refused(tiny: Path, monkeypatch):
    monkeypatch.setattr(memory, "SMALL_PROGRAM_VARIABLES", 0)
    monkeypatch.setattr(memory, "machine_memory_mb", lambda: None)
    problem = Problem.read("problem.toml")
    memory.require_memory(problem, problem.collocation(), problem.method)


def test_limits_of_containers_count_as_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(limits, "CGROUP_LIMITS", (limit,))
    whole_mb = limits.machine_memory_mb()
    limit.write_text("max\n")
    assert limits.machine_memory_mb() == whole_mb
    limit.write_text("5000000\n")
    assert limits.machine_memory_mb() == 5.0


# Interrupts ---------------------------------------------------------------------------------------

STARTED = """
import os, signal, sys
sys.argv = ["collocation-sysid"]
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            os.kill(os.getpid(), signal.SIGINT)
for name in [each for each in sys.modules if each.startswith("importlib.metadata")]:
    del sys.modules[name]
sys.meta_path.insert(0, Interrupting())
import collocation_sysid
collocation_sysid.run
"""
COMMANDED = """
import os, signal, sys
from collocation_sysid import cli
def interrupted(app):
    os.kill(os.getpid(), signal.SIGINT)
cli.get_command = interrupted
cli.main()
"""
# As a factorisation would that takes minutes, this solver hears of no signal.
DEAF = """
import os, signal, sys, threading, time
from collocation_sysid import cli
from collocation_sysid.methods import nlpsol
from collocation_sysid.result import run_record
run_record.write_pictures = lambda *_, **__: None
sys.argv = ["collocation-sysid", "solve", "problem.toml", "--out", "run", "-q"]
def end():
    for _ in range({times}):
        time.sleep(0.5)
        os.kill(os.getpid(), signal.{name})
def deaf(**_):
    threading.Thread(target=end).start()
    time.sleep(600)
nlpsol.create_solver = lambda *_, **__: deaf
nlpsol.GRACE_S = 0.2 if {times} == 1 else 600
cli.main()
"""
# Libraries do so with what is raised within their imports.
CONVERTING = """
import os, signal, sys, time
from collocation_sysid import cli
class Converting:
    def find_spec(self, name, path=None, target=None):
        if name == "matplotlib.figure":
            try:
                for _ in range({times}):
                    os.kill(os.getpid(), signal.SIGTERM)
                    time.sleep(0.5)
            except KeyboardInterrupt as error:
                {raised}
sys.meta_path.insert(0, Converting())
sys.argv = ["collocation-sysid", "solve", "problem.toml", "--out", "run", "-q"]
cli.main()
"""


def ended(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120
    )


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize(
    "name", [pytest.param("importlib.metadata", marks=pytest.mark.long), "casadi"]
)
def test_an_interrupt_during_imports_prints_nothing(name: str):
    done = ended(STARTED.format(name=name))
    assert done.returncode == 130
    assert done.stderr == ""


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_signals_are_handled_before_slow_modules_are_imported():
    new = "[name for name in sys.modules if name not in before]"
    done = ended(f"import sys; before = {{*sys.modules}}; import collocation_sysid; print({new})")
    names = ast.literal_eval(done.stdout)
    first = names[: names.index("collocation_sysid.common.starting")]
    assert {*first} <= {"collocation_sysid", "collocation_sysid.common", "__future__"}


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_an_interrupt_while_the_commands_are_built_prints_nothing():
    done = ended(COMMANDED)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_solver_that_hears_no_signal_is_left_behind(tiny: Path):
    done = ended(DEAF.format(name="SIGTERM", times=1))
    assert (done.returncode, done.stderr) == (143, "")
    result = json.loads((tiny / "run" / "result.json").read_text())
    assert result["status"] == "interrupted"


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_two_signals_end_a_solve_at_once(tiny: Path):
    done = ended(DEAF.format(name="SIGINT", times=2))
    assert (done.returncode, done.stderr) == (130, "")
    # Of the search for the initial point, which has ended.
    result = json.loads((tiny / "run" / "result.json").read_text())
    assert result["status"] == "interrupted"


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_signal_within_an_import_is_no_error_of_the_library(tiny: Path):
    done = ended(CONVERTING.format(times=1, raised="raise RuntimeError('no fonts') from error"))
    assert done.returncode == 143, done.stderr
    assert "Verdict" in done.stdout
    assert done.stderr == (
        "interrupted: the result is kept in run, but some pictures are missing; draw them with: "
        "collocation-sysid plot run\n"
    )
    assert json.loads((tiny / "run" / "result.json").read_text())["status"] == "converged"


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_second_signal_ends_an_import(tiny: Path):
    done = ended(CONVERTING.format(times=2, raised="os._exit(77)"))
    assert done.returncode == 77
    assert json.loads((tiny / "run" / "result.json").read_text())["status"] == "converged"


@contextlib.contextmanager
def heeded() -> Iterator[None]:
    with handlers_of_signals_kept():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        heed_interrupts()
        yield


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_deferred_signal_interrupts_at_the_end_of_the_block():
    kept = ""
    with heeded(), pytest.raises(KeyboardInterrupt), INTERRUPTS.deferred():  # noqa: PT012
        signal.raise_signal(signal.SIGTERM)
        time.sleep(0.2)
        kept = "whole"
    assert kept == "whole"


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_signal_within_a_weak_reference_callback_is_not_lost(capsys: pytest.CaptureFixture[str]):
    class Thing:
        pass

    with heeded(), pytest.raises(KeyboardInterrupt):  # noqa: PT012
        thing = Thing()
        callback = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGTERM))
        del thing
        assert callback() is None  # Python has ignored the exception
        time.sleep(30)
    assert not capsys.readouterr().err


def drawn(**style: str) -> None:
    figure = Figure()
    figure.add_subplot().plot([0, 1], **style)
    figure.savefig(io.BytesIO())


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("conversion", "call"),
    [
        ("DM_from_array", lambda: ca.SX.sym("x") * np.array([2.0])),
        ("__array__", drawn),
        ("__array__", partial(drawn, marker="o", ls="")),
        ("__array__", lambda: Path2D([(0, 0), (1, 0), (1, 1)]).contains_point((0, 0), Affine2D())),
    ],
)
def test_a_signal_within_a_conversion_of_a_library_is_not_lost(conversion, call):
    sent = []

    def send_once(frame: FrameType, event: str, _: object) -> None:
        if not sent and (event, frame.f_code.co_name) == ("call", conversion):
            sent.append(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)

    profiled = sys.getprofile()
    try:
        with heeded(), pytest.raises(KeyboardInterrupt):  # noqa: PT012
            sys.setprofile(send_once)
            call()  # in which the library ignores exceptions, or converts them
            sys.setprofile(profiled)
            time.sleep(5)
    finally:
        sys.setprofile(profiled)
    assert sent


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_signal_while_a_thread_of_a_pool_starts_leaves_no_thread_behind(
    monkeypatch: pytest.MonkeyPatch,
):
    start = threading.Thread.start

    def interrupted(thread: threading.Thread) -> None:
        start(thread)
        if thread.name.startswith("ThreadPool"):
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(threading.Thread, "start", interrupted)
    with ThreadPoolExecutor(1) as pool:
        with heeded(), pytest.raises(KeyboardInterrupt):  # noqa: PT012
            pool.submit(time.sleep, 0)
            (thread,) = pool._threads
            time.sleep(5)
        assert thread in concurrent.futures.thread._threads_queues


ENDED = """
import atexit, os, signal, time
from collocation_sysid import cli
atexit.register(lambda: (os.kill(os.getpid(), signal.SIGTERM), time.sleep(60)))
cli.main()
"""


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_signal_after_the_end_of_a_command_keeps_its_exit_code():
    done = subprocess.run(
        [sys.executable, "-c", ENDED, "--version"], capture_output=True, text=True, timeout=50
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == version("collocation-sysid")


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_signal_that_is_still_deferred_at_the_end_is_not_lost():
    code = compile("import signal; signal.raise_signal(signal.SIGINT)", LOSING[0], "exec")
    with heeded():
        exec(code)
        with pytest.raises(KeyboardInterrupt):
            ignore_interrupts()
        signal.raise_signal(signal.SIGINT)  # without effect


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("method", ["reduced-space", "interior-point"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_and_sigterm_leave_the_best_result(
    tiny: Path, monkeypatch: pytest.MonkeyPatch, method: str, number: int
):
    from collocation_sysid.methods.solve_recorder import Recorder

    add = Recorder.add

    def interrupted(self, line):
        add(self, line)
        if len(self.history) == 3:
            os.kill(os.getpid(), number)
            time.sleep(0.5)  # until it is heard, on the main thread

    monkeypatch.setattr(Recorder, "add", interrupted)
    outcome = run_command("solve", "problem.toml", "--method", method, "--out", "run", "-q")
    assert outcome.code == 128 + number
    assert '"status": "interrupted"' in (tiny / "run" / "result.json").read_text()
    assert "Traceback" not in outcome.err
    assert not list(tiny.glob(".*.partial"))


# Folders ------------------------------------------------------------------------------------------


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("host", ["bench", "bench.lab.example.org"])
def test_leftovers_of_a_killed_run_are_removed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, host: str
):
    monkeypatch.setattr(run_writers.platform, "node", lambda: host)
    child = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    stale = tmp_path / f".run.{host}-{child.stdout.strip()}-0a1b2c3d.partial"
    others = tmp_path / ".walk.elsewhere-1-0a1b2c3d.partial"
    going_on = tmp_path / f".run.{host}-{os.getpid()}-0a1b2c3d.partial"
    for folder in (stale, others, going_on):
        folder.mkdir()
    with run_writers.replaced_folder(tmp_path / "run") as place:
        (place / "result.json").write_text("{}")
    assert not stale.exists()
    assert others.exists()
    assert going_on.exists()


@pytest.mark.parametrize("shape", [(), (0,), (1,), (4,), (2, 2, 2, 2)])
def test_depth_archives_of_the_wrong_shape_are_refused(tmp_path: Path, shape: tuple[int, ...]):
    np.savez(tmp_path / "depth.npz", depth_m=np.ones(shape))
    with pytest.raises(InputError, match=r"depth_m has the shape .*; expected \(any, any\) or"):
        read_depth(tmp_path / "depth.npz", count_m=None, length_m=None)


@pytest.mark.parametrize("shape", [(), (3,), (50, 2), (2, 50, 50)])
def test_archives_of_clouds_of_the_wrong_shape_are_refused(tmp_path: Path, shape: tuple[int, ...]):
    np.savez(tmp_path / "cloud.npz", points_m=np.ones(shape))
    with pytest.raises(InputError, match=r"points_m has the shape .*; expected \(any, 3\) or"):
        read_depth(tmp_path / "cloud.npz", count_m=None, length_m=1.0)


@pytest.mark.parametrize("shape", [(0, 160), (120, 0), (1, 1), (2, 2)])
def test_an_image_without_inner_pixels_has_no_points(shape: tuple[int, int]):
    camera = Camera([[300.0, 0, 80], [0, 300.0, 60], [0, 0, 1]])
    assert points_from_image(np.ones(shape), camera).shape == (0, 3)


def test_text_that_no_memory_can_hold_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(files, "machine_memory_mb", lambda: 6000.0)
    for name, read in (("a.csv", open_source), ("result.json", lambda f: read_json(f, "a result"))):
        with (tmp_path / name).open("wb") as file:
            file.truncate(3_000_000_000)
        tracemalloc.start()
        with pytest.raises(InputError, match=r"has 3,000 MB; expected at most 240 MB of text"):
            read(tmp_path / name)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 1e6


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="limits of POSIX")
@pytest.mark.parametrize("damage", ["sparse table", "sparse result", "blank lines"])
def test_a_limit_of_the_address_space_ends_in_no_traceback(tiny: Path, damage: str):
    import resource

    words = ["check", "problem.toml"]
    if damage == "sparse table":
        os.truncate(tiny / "swing_markers.csv", 3_000_000_000)
    elif damage == "blank lines":
        with (tiny / "swing_markers.csv").open("a") as file:
            file.write(1_000_000 * "\n")
    else:
        words = ["report", "run"]
        (tiny / "run").mkdir()
        (tiny / "run" / "result.json").touch()
        os.truncate(tiny / "run" / "result.json", 3_000_000_000)
    program = "from collocation_sysid.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        cwd=tiny, capture_output=True, text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30)),
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    if damage == "blank lines":
        assert done.returncode in (0, 1), done.stderr
    else:
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert "has 3,000 MB; expected at most" in done.stderr
