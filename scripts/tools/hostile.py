"""Outcomes of the command line for damaged and hostile input, counted by kind of input.

    nice -n 19 python scripts hostile [--count 100] [--seed 0] [--only toml urdf] [--keep FOLDER]

A case is a small problem with one damaged file, and a command that reads this file. The damage is
drawn at random from the seed, the kind and the number of the case: files are truncated, some of
their bytes are replaced, repeated or exchanged, and values with a special meaning in the format are
inserted. In files that are "changed", the format stays valid: keys, values, cells, columns, shapes
and types of arrays are exchanged, for each kind of problem. `--quick` leaves out the simulations of
`check` and the searches of `plan`, which then only read the files. Each case is run in a separate process
with limits of time and memory. Its outcome is

    refused     exit code 2, one message of one line, and nothing written
    accepted    exit code 0 or 1
    traceback   an exception of Python reached the user
    unclear     any other message, or files that a refusal left
    hang        more time of the processor than the limit, by default 30 s, or ten times as long
    crash       killed by a signal

Further kinds are not damaged files: names that other formats could take for their own, a folder
that an ordinary user cannot write in, a full disk, the compiled kernels of another user, two solves
with one output, UDP frames, and interrupts at random times. Some need to be started by root.
Only interrupted solves and those on a full disk draw pictures, which take most of the time.
`--keep` stores the input of all cases but the first two outcomes.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import io
import json
import os
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock
from xml.etree import ElementTree

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from kit import logs, problem_files, silhouettes
from studies import markdown

from collocation_sysid import cli
from collocation_sysid.cli import problem_commands
from collocation_sysid.errors import InputError
from collocation_sysid.extras.export import TARGETS
from collocation_sysid.extras.planning import motion_plan
from collocation_sysid.features.image_tracks.files import TrackFile, read_tracks
from collocation_sysid.fem.kernels import jit
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.recording import read_markers, read_poses
from collocation_sysid.recording.sources import topics  # noqa: F401
from collocation_sysid.result import check_sections, run_record, solve_progress  # noqa: F401
from collocation_sysid.result.pictures import all_pictures  # noqa: F401
from collocation_sysid.runs.check import quick_check

Rng = np.random.Generator
OUTCOMES = ("refused", "accepted", "traceback", "unclear", "hang", "crash")
# Largest address space of a case [bytes]; a reader that needs more trusts a forged size.
MEMORY_LIMIT_BYTES = 8 << 30
# Wall time over the limit of processor time after which a case is stopped: the machine does other
# work.
WAITING_FACTOR = 10
# User id for cases without privileges, if the script is started by root.
NOBODY = 65534
PROGRAM = "from collocation_sysid.cli import main; main()"
MARKERS = "swing_markers.csv"
POSES = "swing_motion.csv"
REDUCED = ("--set", "solver.method=reduced-space")
COUNTS = (b"-1", b"0", b"4294967295", b"1e308", b"nan", b"99999999999999999999")


@dataclass(frozen=True)
class CommandEnd:
    """End of a process: exit code, negative signal number or None after the time limit, and its
    output.
    """

    code: int | None
    out: str
    err: str

    def outcome(self, is_clean: bool = True) -> str:
        """Return one of `OUTCOMES`; `is_clean` states whether the command left the folder
        unchanged.
        """
        if self.code is None or -self.code == signal.SIGXCPU:
            return "hang"
        if self.code < 0:
            return "crash"
        if "Traceback (most recent call last)" in self.err:
            return "traceback"
        lines = self.err.strip().splitlines()
        output_text = [line for line in lines if not line.endswith(" so far)")]  # of a slow machine
        if self.code == 2 and len(output_text) == 1 and is_clean and _is_printable(self.err):
            return "refused"
        both = self.err + self.out
        return "accepted" if self.code in (0, 1) and _is_printable(both) else "unclear"


def _is_printable(text: str) -> bool:
    return all(mark.isprintable() or mark in "\n\t" for mark in text)


# Running ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RunningCommand:
    """Command line in a fork of this process: its process id, and the files of its output."""

    process: int
    out: Any
    err: Any

    def finish(self, limit_s: float) -> CommandEnd:
        """Wait until the command ends; kill it at `WAITING_FACTOR` times the limit [s]."""
        code = _wait(self.process, limit_s)
        return CommandEnd(code, self.output_text(self.out), self.output_text(self.err))

    def output_text(self, stream: Any) -> str:
        """Return all text written to a stream so far, without moving the position that forks share."""
        size = os.fstat(stream.fileno()).st_size
        return os.pread(stream.fileno(), size, 0).decode("utf-8", "replace")


def start(
    words: Sequence[object],
    folder: Path,
    limit_s: float,
    before: Callable[[], object] | None = None,
) -> RunningCommand:
    """Start the command line in a fork of this process, whose modules are imported already.

    Parameters
    ----------
    words : sequence
        Arguments of the command line, without the program.
    folder : Path
        Working directory.
    limit_s : float
        Limit of processor time [s].
    before : callable, optional
        Called in the fork, before the command.
    """
    running = RunningCommand(0, *(tempfile.TemporaryFile() for _ in range(2)))  # noqa: SIM115
    sys.stdout.flush()
    if child := os.fork():
        return replace(running, process=child)
    files = running.out.fileno(), running.err.fileno()
    seconds = int(np.ceil(limit_s))
    resource_limits = {resource.RLIMIT_AS: MEMORY_LIMIT_BYTES, resource.RLIMIT_CORE: 0}
    resource_limits[resource.RLIMIT_CPU] = seconds
    _run_command_in_fork([str(word) for word in words], folder, files, resource_limits, before)
    raise AssertionError("the fork has ended")


def run(
    words: Sequence[object],
    folder: Path,
    limit_s: float,
    before: Callable[[], object] | None = None,
) -> CommandEnd:
    """Run the command line to its end or the limit; for the arguments see `start`."""
    return start(words, folder, limit_s, before).finish(limit_s)


def _run_command_in_fork(
    words: list[str],
    folder: Path,
    files: tuple[int, int],
    limits: Mapping[int, int],
    before: Callable[[], object] | None,
) -> None:
    """Run the command line in this process, with limits by resource, and exit; never returns."""
    code = 1
    try:
        os.setpgid(0, 0)
        os.chdir(folder)
        for number, stream in enumerate(files, 1):
            os.dup2(stream, number)
        sys.stdout = io.TextIOWrapper(io.FileIO(1, "w", closefd=False), "utf-8", "surrogateescape")
        sys.stderr = io.TextIOWrapper(
            io.FileIO(2, "w", closefd=False), "utf-8", "backslashreplace", line_buffering=True
        )
        for kind, limit in limits.items():
            resource.setrlimit(kind, (limit, limit + 1))
        if before is not None:
            before()
        sys.argv = ["collocation-sysid", *words]
        cli.main()
        code = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except OSError:
                code = 2
        os._exit(code)


def _wait(child: int, limit_s: float) -> int | None:
    """Return the exit code of a child process; None if it was killed at the limit [s]."""
    until = time.monotonic() + WAITING_FACTOR * limit_s
    while time.monotonic() < until:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def in_fork(work: Callable[[], object]) -> None:
    """Call a function in a fork, so that its threads do not exist in this process.

    Raises
    ------
    RuntimeError
        If the function fails.
    """
    child = os.fork()
    if child == 0:
        try:
            work()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
        raise RuntimeError("an input that is to be damaged could not be made")


# Damage -------------------------------------------------------------------------------------------


def damaged(rng: Rng, content: bytes, words: Sequence[bytes]) -> bytes:
    """Return a content with one to four damages; `words` have a special meaning in its format."""
    for _ in range(rng.integers(1, 5)):
        content = DAMAGES[rng.integers(len(DAMAGES))](rng, content, words)
    return content


def _place(rng: Rng, content: bytes) -> int:
    """Return a random position; half of them are in the first 256 bytes, where headers are."""
    end = len(content) if rng.random() < 0.5 else min(len(content), 256)
    return int(rng.integers(end + 1))


def _truncated(rng: Rng, content: bytes, words: Sequence[bytes]) -> bytes:
    return content[: int(rng.integers(len(content) + 1))]


def _replaced(rng: Rng, content: bytes, words: Sequence[bytes]) -> bytes:
    mutated = bytearray(content)
    for _ in range(rng.integers(1, 9) if mutated else 0):
        mutated[min(_place(rng, content), len(mutated) - 1)] = rng.integers(256)
    return bytes(mutated)


def _with_gap(rng: Rng, content: bytes, words: Sequence[bytes]) -> bytes:
    at = _place(rng, content)
    return content[:at] + content[at + int(rng.integers(1, 200)) :]


def _repeated(rng: Rng, content: bytes, words: Sequence[bytes]) -> bytes:
    at = _place(rng, content)
    return content[:at] + content[at : at + int(rng.integers(1, 200))] * 3 + content[at:]


def _zeros(rng: Rng, content: bytes, words: Sequence[bytes]) -> bytes:
    at = _place(rng, content)
    length = int(rng.integers(1, 64))
    return content[:at] + bytes(length) + content[at + length :]


def _largest(rng: Rng, content: bytes, words: Sequence[bytes]) -> bytes:
    at = _place(rng, content)
    length = int(rng.choice([2, 4, 8]))
    return content[:at] + b"\xff" * (length - 1) + b"\x7f" + content[at + length :]


def _with_word(rng: Rng, content: bytes, words: Sequence[bytes]) -> bytes:
    """Insert a word at a position, or replace another word by it."""
    if not words:
        return _replaced(rng, content, words)
    word = words[int(rng.integers(len(words)))]
    at = _place(rng, content)
    if rng.random() < 0.5:
        return content[:at] + word + content[at:]
    parts = [k for k in range(len(content)) if content[k : k + 1] in b' ,"<>=\n[]']
    if len(parts) < 2:
        return content[:at] + word + content[at:]
    number = int(rng.integers(len(parts) - 1))
    return content[: parts[number] + 1] + word + content[parts[number + 1] :]


DAMAGES = (_truncated, _replaced, _with_gap, _repeated, _zeros, _largest, _with_word, _with_word)


# Changes within the format ------------------------------------------------------------------------

# Values in place of those of a TOML file, cells in place of those of a table, and JSON values.
TOML_VALUES = (
    "true",
    "-1",
    "0",
    "1e300",
    "1e-300",
    "nan",
    "inf",
    "-0.5",
    "3.7",
    "10",
    "1000000000",
)
TOML_VALUES += ('""', '"x"', '"none"', '"../x.csv"', '"\\u0000"', "[]", "[1]", "[nan, 0, 0]", "{}")
TOML_VALUES += ("[[1, 2], [3]]", "{ a = 1 }", '["a", 1]', "2024-01-01", "99999999999999999999")
CELLS = (
    "",
    "x",
    "nan",
    "inf",
    "-inf",
    "1e300",
    "-1",
    "0",
    "1e-300",
    "1,5",
    '"',
    "0x10",
    "1 2",
    "é",
)
JSON_VALUES: tuple[Any, ...] = (None, True, -1, 0, 1e308, float("nan"), "", "x", [], {}, [[[]]])
JSON_VALUES += ({"a": 1}, [1, "a"], 10**30, "../x", [0.0] * 1000)
_TOKEN = re.compile(
    r'"[^"\n]*"|\[[^\[\]\n]*\]|(?<![\w.])[-+]?\d[\w.+-]*|\btrue\b|\bfalse\b|[\w-]+(?=\s*=)'
)


def changed_toml(rng: Rng, content: bytes) -> bytes:
    """Replace values and keys, and remove, repeat or exchange lines."""
    lines = content.decode().splitlines()
    for _ in range(rng.integers(1, 3)):
        stated = [k for k, line in enumerate(lines) if line.strip() and line.strip()[0] != "#"]
        k = int(rng.choice(stated or [0]))
        tokens = [*_TOKEN.finditer(lines[k])]
        action = rng.random()
        if action < 0.8 and tokens:
            token = tokens[int(rng.integers(len(tokens)))]
            new = str(rng.choice(TOML_VALUES))
            if token[0][0].isalpha() and token[0] not in ("true", "false"):
                new = str(rng.choice(["x", token[0] + "s", token[0][:-1] or "y", "name", "file"]))
            lines[k] = lines[k][: token.start()] + new + lines[k][token.end() :]
        elif action < 0.9:
            del lines[k]
        elif action < 0.95:
            lines.insert(k, lines[k])
        else:
            other = int(rng.choice(stated))
            lines[k], lines[other] = lines[other], lines[k]
    return "\n".join(lines).encode()


def changed_table(rng: Rng, content: bytes) -> bytes:
    """Replace cells, columns and rows of a table of text."""
    rows = [line.split(",") for line in content.decode().splitlines()]
    k, column = int(rng.integers(len(rows))), int(rng.integers(len(rows[-1])))
    kind = rng.integers(9)
    if kind < 3:
        for row in rows[k : k + int(rng.integers(1, 4))]:
            row[min(column, len(row) - 1)] = str(rng.choice(CELLS))
    elif kind == 3:
        rows = [[cell for c, cell in enumerate(row) if c != column] for row in rows]
    elif kind == 4:
        rows = rows[:k] + rows[k + int(rng.integers(1, 20)) :]
    elif kind == 5:
        rows[k:k] = rows[k : k + int(rng.integers(1, 20))]
    elif kind == 6:
        rows[k:] = rows[k:][::-1]
    elif kind == 7:
        names = ("t_s", "x", "x_m", "tip_x_m", "t_ms", "qw", "force_n", "", "9", rows[-1][column])
        rows[0][min(column, len(rows[0]) - 1)] = str(rng.choice(names))
    else:
        factor = float(rng.choice([0.0, -1.0, 1e3, 1e-3, 1e6, 1e20, np.nan]))
        for row in rows[1:]:
            with contextlib.suppress(ValueError, IndexError):
                row[column] = repr(factor * float(row[column]))
    return "\n".join(",".join(row) for row in rows).encode()


def changed_arrays(rng: Rng, content: bytes) -> bytes:
    """Change the shape, the type or the values of an array of an .npz, or its name."""
    with np.load(io.BytesIO(content)) as archive:
        arrays: dict[str, Any] = dict(archive)
    name = str(rng.choice(sorted(arrays)))
    array = arrays[name]
    kinds = [np.complex128, np.str_, bool, np.int8, np.float16, "datetime64[s]", "V8"]
    actions: list[Callable[[], Any]] = [
        lambda: array.reshape(-1),
        lambda: array[None],
        lambda: array[..., None],
        lambda: array.T,
        lambda: array.ravel()[:1].reshape(()),
        lambda: array[:0],
        lambda: array[: int(rng.integers(len(array) + 1))],
        lambda: array[::-1],
        lambda: array * float(rng.choice([0.0, -1.0, 1e3, 1e30, np.nan, np.inf])),
        lambda: array.astype(float).astype(int).astype(kinds[int(rng.integers(len(kinds)))]),
        lambda: np.zeros(rng.integers(0, 4, size=int(rng.integers(0, 5)))),
    ]
    if array.dtype.kind not in "biuf":  # texts have no products
        actions = [each for k, each in enumerate(actions) if k not in (8, 9)]
    action = int(rng.integers(len(actions) + 1))
    if action == len(actions):
        arrays[str(rng.choice(["x", "t_s", "points_m", "depth_m"]))] = arrays.pop(name)
    else:
        with np.errstate(all="ignore"):
            arrays[name] = actions[action]()
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def changed_json(rng: Rng, content: bytes) -> bytes:
    """Replace or remove a value of a JSON file, at any depth."""
    root = json.loads(content)
    node: Any = root
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        key = keys[int(rng.integers(len(keys)))]
        if not isinstance(node[key], dict | list) or not node[key] or rng.random() < 0.15:
            break
        node = node[key]
    if rng.random() < 0.2:
        del node[key]
    else:
        node[key] = JSON_VALUES[int(rng.integers(len(JSON_VALUES)))]
    return json.dumps(root).encode()


# Damaged files ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FileKind:
    """Files of one kind, and the commands that read them.

    Attributes
    ----------
    name : str
        Name of the kind in the table.
    make : callable
        Function that adds the files to the folder of a problem.
    file : str
        Pattern of the file that is damaged; one is drawn if there are several.
    commands : tuple of command lines
        One of them is drawn for each case.
    words : tuple of bytes
        Words with a special meaning in the format.
    replacements : tuple of bytes
        Contents that replace the complete file in 20 % of the cases.
    change : callable, optional
        Change within the format, in place of damaged bytes.
    """

    name: str
    make: Callable[[Path], object]
    file: str
    commands: tuple[tuple[str, ...], ...] = (("check", "problem.toml"),)
    words: tuple[bytes, ...] = ()
    replacements: tuple[bytes, ...] = ()
    change: Callable[[Rng, bytes], bytes] | None = None

    def run(self, cases: CaseSettings) -> Counter[str]:
        """Run all cases and count the outcomes; no case if the package that reads the format is
        missing.

        Raises
        ------
        RuntimeError
            If a command refuses the undamaged file.
        """
        base = cases.folder / f"base_{self.name.replace(' ', '_')}"
        counts = Counter[str]()
        shutil.copytree(cases.problem, base)
        in_fork(lambda: self.make(base))
        for words in self.commands:
            if (ended := run(words, base, cases.limit_s)).code not in (0, 1):
                if "No module named" in ended.err or "not installed" in ended.err:
                    return counts
                raise RuntimeError(f"{self.name} is refused before it is damaged: {ended.err}")
        with contextlib.suppress(InputError):  # validators are made here, not in each fork
            quick_check(Problem.read(base / "problem.toml"))
        files = sorted(base.glob(self.file))
        for number in range(cases.count):
            rng = cases.rng(self.name, number)
            file = files[rng.integers(len(files))] if len(files) > 1 else files[0]
            valid = file.read_bytes()
            folder = cases.folder / "case"
            shutil.copytree(base, folder)
            is_replaced = self.replacements and rng.random() < 0.2
            content = (
                self.replacements[rng.integers(len(self.replacements))] if is_replaced else None
            )
            target = folder / file.relative_to(base)
            if content is None and self.change is not None:
                content = self.change(rng, valid)
            target.write_bytes(damaged(rng, valid, self.words) if content is None else content)
            before = problem_files.contents(folder)
            words = self.commands[rng.integers(len(self.commands))]
            ended = run(words, folder, cases.limit_s)
            outcome = ended.outcome(problem_files.contents(folder) == before)
            counts[outcome] += 1
            cases.keep(self.name, number, folder, outcome, ended)
            shutil.rmtree(folder)
        return counts


def _shipped(place: Path) -> Callable[[Path], object]:
    """Return a function that replaces the problem by that of a folder of the package or of
    `problems`.
    """

    def make(folder: Path) -> None:
        for each in folder.iterdir():
            each.unlink()
        shutil.copytree(place, folder, dirs_exist_ok=True)

    return make


def _with_run(folder: Path) -> None:
    problem_files.run_command(
        "solve", folder / "problem.toml", *REDUCED, "-q", "--out", folder / "run"
    )


def _with_xdmf(folder: Path) -> None:
    """State the mesh of the body by an XDMF file that contains its numbers."""
    mesh = box_mesh(problem_files.SIZE_M, problem_files.DIVISIONS)
    points = " ".join(map(repr, mesh.points_m.ravel().tolist()))
    cells = " ".join(map(str, mesh.tetrahedra.ravel().tolist()))
    grid = (
        '<Geometry GeometryType="XYZ"><DataItem DataType="Float" '
        f'Dimensions="{len(mesh.points_m)} 3" Format="XML" Precision="8">{points}'
        "</DataItem></Geometry>"
        f'<Topology TopologyType="Tetrahedron" NumberOfElements="{len(mesh.tetrahedra)}">'
        f'<DataItem DataType="Int" Dimensions="{len(mesh.tetrahedra)} 4" Format="XML" '
        f'Precision="8">{cells}</DataItem></Topology>'
    )
    text = f'<Xdmf Version="3.0"><Domain><Grid Name="Grid">{grid}</Grid></Domain></Xdmf>'
    (folder / "body.xdmf").write_text(text)
    _state(folder, 'mesh = "body.vtu"', 'mesh = "body.xdmf"')


def _state(folder: Path, old: str, new: str) -> None:
    problem_files.replace_text(old, new)(folder)


def _with_bag(kind: str) -> Callable[[Path], object]:
    """Return a function that states poses and tracks by topics of a log of a kind (ros1, …)."""

    def make(folder: Path) -> None:
        poses = read_poses(folder / POSES)
        table = read_markers(folder / MARKERS)
        log = logs.bag(folder / "log", logs.recorded(poses, table, kind), kind)
        if log.is_dir():
            log = next(log.glob("*.db3"))
        place = folder / f"trial{log.suffix}"
        log.rename(place)
        shutil.rmtree(folder / "log", ignore_errors=True)
        _state(folder, POSES, f"{place.name}#/gripper")
        _state(folder, MARKERS, f"{place.name}#/markers")

    return make


def _with_dataset(folder: Path) -> None:
    """State the poses by joints of a dataset in Parquet, with the description of the robot."""
    joints = {"turn": 20 * [0.0], "slide": 20 * [0.0]}
    logs.dataset(folder / "robot", joints, episodes=1)
    at_rest = logs.URDF.replace("0 0 0.5", "0 0 0").replace("0.2 0 0", "0 0 0")
    (folder / "arm.urdf").write_text(at_rest)
    address = "robot#observation.state#arm.urdf#rad#base>tool"
    _state(folder, POSES, address)


def _with_depth(file: str, write: Callable[[Path], object]) -> Callable[[Path], object]:
    """Return a function that adds a depth camera with images of a plane or clouds, or with an .npz."""

    def make(folder: Path) -> None:
        place = folder / file
        place.parent.mkdir(exist_ok=True)
        write(place)
        if place.parent == folder:
            data_keys = f'file = "{file}"\n'
        else:
            data_keys = f'file = "{place.parent.name}"\nt_s = [0.0, 0.04, 0.08]\n'
            for number in (1, 2):
                shutil.copy(place, place.with_stem(str(number)))
        camera = "camera = { matrix = [[100, 0, 16], [0, 100, 12], [0, 0, 1]] }"
        with (folder / "problem.toml").open("a") as problem:
            problem.write(f"\n[[experiment.depth]]\nsigma_m = 0.001\n{data_keys}{camera}\n")

    return make


DEPTH_M = np.full((24, 32), 0.4, dtype=np.float32)
CLOUD_M = np.random.default_rng(0).normal(0.0, 0.05, (50, 3))


def _exr(file: Path) -> None:
    import OpenEXR  # pyright: ignore[reportMissingImports]

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": DEPTH_M}) as image:
        image.write(str(file))


def _png(file: Path) -> None:
    from PIL import Image

    Image.fromarray((1000 * DEPTH_M).astype(np.uint16)).save(file)


def _npz(file: Path) -> None:
    np.savez(file, depth_m=np.stack(3 * [DEPTH_M]), t_s=np.array([0.0, 0.04, 0.08]))


def _pcd(file: Path) -> None:
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 50\nHEIGHT 1\nPOINTS 50\n"
    file.write_bytes(f"{head}DATA binary\n".encode() + CLOUD_M.astype("<f4").tobytes())


def _laughs(root: str, inner: str) -> bytes:
    """Return an XML file of 3 kB that expands to 10⁹ words."""
    levels = "".join(
        f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">\n' if k else '<!ENTITY a0 "word">\n'
        for k in range(10)
    )
    head = f'<?xml version="1.0"?>\n<!DOCTYPE x [\n{levels}]>\n'
    return f'{head}<{root} name="arm">{inner}</{root}>'.encode()


def _outside(root: str, inner: str) -> bytes:
    """Return an XML file with an entity that is another file."""
    entity = '<!DOCTYPE x [<!ENTITY a9 SYSTEM "file:///etc/passwd">]>'
    return f'<?xml version="1.0"?>\n{entity}\n<{root} name="arm">{inner}</{root}>'.encode()


_LINK = '<link name="&a9;"/><link name="base"/><link name="tool"/>'
_CYCLIC_JOINTS = "".join(
    f'<joint name="{n}" type="fixed"><parent link="{a}"/><child link="{b}"/></joint>'
    for n, a, b in (("turn", "base", "tool"), ("slide", "tool", "base"))
)
URDFS = (
    _laughs("robot", _LINK),
    _outside("robot", _LINK),
    f'<robot name="arm"><link name="base"/><link name="tool"/>{_CYCLIC_JOINTS}</robot>'.encode(),
    b'<robot name="arm">' + b"<link>" * 20_000,
    b'<robot name="arm"/>',
)
_GRID = "<Domain><Grid>&a9;</Grid></Domain>"
XDMFS = (
    _laughs("Xdmf", _GRID),
    _outside("Xdmf", _GRID),
    b'<Xdmf Version="3.0"><Domain><Grid><Geometry><DataItem Dimensions="9999999999 3" '
    b'Format="XML">0 0 0</DataItem></Geometry></Grid></Domain></Xdmf>',
    b'<Xdmf Version="3.0"><Domain><Grid><Topology TopologyType="Tetrahedron">'
    b'<DataItem Format="HDF" Dimensions="1 4">/etc/passwd:/a</DataItem></Topology></Grid>'
    b"</Domain></Xdmf>",
)
# Definitions of messages are text in ROS 1 bags, from which readers generate code.
DEFINITIONS = (
    b"float64 a\nfloat64 a\n",
    b"geometry_msgs/PoseStamped again\n",
    b"float64[99999999999] a\n",
    b"int8 A=__import__('os').system('touch owned')\n",
    b"float64 __class__\n",
    b"string<=-1 a\n",
    b"\n" + b"=" * 80 + b"\nMSG: geometry_msgs/PoseStamped\nfloat64 x\n",
    b"unknown_msgs/Thing[] things\n",
)
BOTH: tuple[tuple[str, ...], ...] = (("check", "problem.toml"),)
TOML = (b"[[[[", b"]", b'"', b"'''", b"{", b"= nan", b"= -inf", b"[a.b]", b"[[experiment]]")
TOML += (b'"\\u001b[2J"', b"\xff", b"_", b"1e400", b"true", b'"../../etc/passwd"')
CSV = (
    b"\x00",
    b"1e308",
    b"nan",
    b"-inf",
    b'"',
    b";",
    b"\t",
    b"\r",
    b",,,,",
    b"=1+1",
    b"\xef\xbb\xbf",
)
XML = (b"&a9;", b"<!--", b"-->", b"]]>", b"<![CDATA[", b"<a>", b"</a>", b'"', *COUNTS)


def _log_commands(name: str) -> tuple[tuple[str, ...], ...]:
    return (*BOTH, ("log", name))


FILES = (
    FileKind("problem file", lambda _: None, "problem.toml", words=(*TOML, *COUNTS)),
    FileKind("tracks, CSV", lambda _: None, MARKERS, words=(*CSV, *COUNTS)),
    FileKind("poses, CSV", lambda _: None, POSES, words=(*CSV, *COUNTS)),
    FileKind("mesh, VTU", lambda _: None, "body.vtu", words=XML),
    FileKind("mesh, XDMF", _with_xdmf, "body.xdmf", words=XML, replacements=XDMFS),
    FileKind(
        "bag, ROS 1",
        _with_bag("ros1"),
        "trial.bag",
        _log_commands("trial.bag"),
        (*DEFINITIONS, *COUNTS, b"message_definition=", b"md5sum=*", b"op=\x07"),
    ),
    FileKind("bag, SQLite", _with_bag("sqlite3"), "trial.db3", _log_commands("trial.db3"), COUNTS),
    FileKind(
        "log, MCAP",
        _with_bag("mcap file"),
        "trial.mcap",
        _log_commands("trial.mcap"),
        (*DEFINITIONS, *COUNTS, b"\x89MCAP0\r\n"),
    ),
    FileKind(
        "data set, Parquet",
        _with_dataset,
        "robot/data/chunk-000/file-000.parquet",
        _log_commands("robot"),
        (b"PAR1", *COUNTS),
    ),
    FileKind(
        "data set, JSON",
        _with_dataset,
        "robot/meta/info.json",
        _log_commands("robot"),
        (b"{", b"[", b"null", b'"', b"NaN", b"1e999", b"[" * 5000, *COUNTS),
    ),
    FileKind("robot, URDF", _with_dataset, "arm.urdf", words=XML, replacements=URDFS),
    FileKind("depth, EXR", _with_depth("frames/0.exr", _exr), "frames/0.exr", words=COUNTS),
    FileKind(
        "depth, PNG", _with_depth("frames/0.png", _png), "frames/0.png", words=(b"IHDR", b"IDAT")
    ),
    FileKind(
        "depth, NPZ",
        _with_depth("frame.npz", _npz),
        "frame.npz",
        words=(b"'|O'", b"(99999999, 99999999)", b"True", *COUNTS),
    ),
    FileKind(
        "cloud, PCD",
        _with_depth("frames/0.pcd", _pcd),
        "frames/0.pcd",
        words=(b"ascii", b"binary_compressed", b"FIELDS", b"F", *COUNTS),
    ),
)


# Image tracks ----------------------------------------------------------------------------------


def _with_tracks(file: str, write: Callable[[Path, TrackFile], object]) -> Callable[[Path], object]:
    """Return a function that makes the problem that of the video, with its tracks in a file of
    another program.
    """

    def make(folder: Path) -> None:
        _shipped(_TEMPLATES / "video")(folder)
        tracks = read_tracks(folder / "front.csv")
        write(folder / file, tracks)
        has_times = file.endswith((".csv", ".npz")) and "dlc" not in file
        rate = "" if has_times else "frame_rate_hz = 60\n"
        _state(folder, 'file = "front.csv"', f'{rate}file = "{file}"')

    return make


def _long_csv(file: Path, tracks: TrackFile) -> None:
    assert tracks.t_s is not None
    rows = ["t_s,point,u,v,likelihood"]
    for k, t in enumerate(tracks.t_s):
        for n, name in enumerate(tracks.names):
            u, v = tracks.pixels[k, n]
            rows.append(f"{t},{name},{u},{v},1.0")
    file.write_text("\n".join(rows))


def _deeplabcut(file: Path, tracks: TrackFile) -> None:
    import pandas as pd

    parts = [["net"], list(tracks.names), ["x", "y", "likelihood"]]
    columns = pd.MultiIndex.from_product(parts, names=["scorer", "bodyparts", "coords"])
    scores = np.ones((*tracks.pixels.shape[:2], 1))
    values = np.concatenate([tracks.pixels, scores], axis=2).reshape(len(scores), -1)
    table = pd.DataFrame(values, columns=columns)
    if file.suffix == ".csv":
        table.to_csv(file)
    else:
        table.to_hdf(file, key="df_with_missing", format="table", mode="w")


def _sleap(file: Path, tracks: TrackFile) -> None:
    import h5py

    with h5py.File(file, "w") as content:
        content["tracks"] = tracks.pixels.transpose(2, 1, 0)[None]
        content["node_names"] = np.array(tracks.names, dtype="S")
        content["track_names"] = np.array(["bar"], dtype="S")


def _sleap_labels(file: Path, tracks: TrackFile) -> None:
    import h5py

    count = len(tracks.names)
    images = range(len(tracks.pixels))
    numbers = [("x", "f8"), ("y", "f8"), ("visible", "?"), ("complete", "?"), ("score", "f8")]
    points = [(*xy, True, False, 1.0) for row in tracks.pixels for xy in row]
    owner = ["instance_id", "instance_type", "frame_id", "track", "point_id_start", "point_id_end"]
    frame = ["frame_id", "video", "frame_idx", "instance_id_start", "instance_id_end"]
    nodes = [{"name": name} for name in tracks.names]
    stated = {"nodes": nodes, "skeletons": [{"nodes": [{"id": k} for k in range(count)]}]}
    with h5py.File(file, "w") as content:
        content.create_group("metadata").attrs["format_id"] = 1.3
        content["metadata"].attrs["json"] = np.bytes_(json.dumps(stated))
        content["pred_points"] = np.array(points, dtype=numbers)
        content["points"] = np.array([], dtype=numbers[:4])
        content["instances"] = np.array(
            [(k, 1, k, -1, count * k, count * (k + 1)) for k in images],
            dtype=[(name, "u1" if name == "instance_type" else "i8") for name in owner],
        )
        content["frames"] = np.array(
            [(k, 0, k, k, k + 1) for k in images], dtype=[(name, "i8") for name in frame]
        )


def _with_masks(folder: Path) -> None:
    """Make the problem that of a hanging bar in one photograph, with its mask in a file."""
    from PIL import Image

    Image.fromarray(np.uint8(255) * silhouettes.photograph()).save(folder / "front.png")
    silhouettes.folder_with(folder, "front.png")


def _cotracker(file: Path, tracks: TrackFile) -> None:
    seen = np.asarray(np.isfinite(tracks.pixels).all(axis=2))[None]
    assert tracks.t_s is not None
    names = np.array(tracks.names)
    np.savez(
        file, pred_tracks=tracks.pixels[None], pred_visibility=seen, names=names, t_s=tracks.t_s
    )


_MATRIX = "[1096.96, 0, 637.93, 0, 1096.96, 361, 0, 0, 1]"
_ROWS = "[[1096.96, 0, 637.93], [0, 1096.96, 361], [0, 0, 1]]"
CALIBRATIONS = {
    "OpenCV": ("front.yaml", ""),
    "ROS": (
        "info.yaml",
        "image_width: 1280\nimage_height: 720\ncamera_name: front\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {_MATRIX}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients:\n  data: [0.1, 0, 0, 0, 0]\n",
    ),
    "Kalibr": (
        "chain.yaml",
        "cam0:\n  camera_model: pinhole\n  intrinsics: [1096.96, 1096.96, 637.93, 361]\n"
        "  distortion_model: radtan\n  distortion_coeffs: [0.1, 0, 0, 0]\n"
        "  resolution: [1280, 720]\n",
    ),
    "Anipose": (
        "calibration.toml",
        f'[cam_0]\nname = "front"\nsize = [1280, 720]\nmatrix = {_ROWS}\n'
        "distortions = [0.1, 0.0, 0.0, 0.0, 0.0]\nrotation = [0.1, 0.2, 0.3]\n"
        "translation = [0.0, 0.1, 0.5]\n\n[metadata]\nadjusted = true\n",
    ),
    "COLMAP": (
        "cameras.txt",
        "# cameras\n1 OPENCV 1280 720 1096.96 1096.96 638.4 361.5 0.1 0 0 0\n",
    ),
}


def _with_calibration(file: str, text: str) -> Callable[[Path], object]:
    def make(folder: Path) -> None:
        _shipped(_TEMPLATES / "video")(folder)
        if text:
            (folder / file).write_text(text)
            _state(folder, 'file = "front.yaml"', f'file = "{file}"')

    return make


def _with_reference(folder: Path) -> None:
    """Make the problem that of a plan, with a reference in a file."""
    _shipped(ROOT / "problems/foam_cylinder")(folder)
    rows = "\n".join(f"{0.1 * k:.1f},{0.01 * k:.3f},,0.0" for k in range(13))
    (folder / "tip.csv").write_text(f"t_s,x_m,y_m,z_m\n{rows}\n")
    task = (folder / "task.toml").read_text()
    values = "t_s = [1.2]\nposition_m = [[0.1, 0.0, 0.0]]\n"
    (folder / "task.toml").write_text(task.replace(values, 'file = "tip.csv"\n'))


ROOT = Path(__file__).resolve().parents[2]
_TEMPLATES = ROOT / "collocation_sysid/problem/templates"
_SHIPPED = {
    "swing": _TEMPLATES / "swing",
    "bench": _TEMPLATES / "compression",
    "tensile test": _TEMPLATES / "tension",
    "specimen": _TEMPLATES / "specimen",
    "obstacle": ROOT / "problems/laid_block",
    "wrench": ROOT / "problems/wrist_sensor",
}
_CHANGES = {".toml": changed_toml, ".csv": changed_table}
FILES += tuple(
    FileKind(f"{name}, changed {suffix}", _shipped(place), f"*{suffix}", change=change)
    for name, place in _SHIPPED.items()
    for suffix, change in _CHANGES.items()
)
FILES += (
    FileKind(
        "depth, changed NPZ", _with_depth("frame.npz", _npz), "frame.npz", change=changed_arrays
    ),
    FileKind("depth, changed .toml", _with_depth("frame.npz", _npz), "*.toml", change=changed_toml),
    FileKind(
        "run, changed JSON",
        _with_run,
        "run/result.json",
        (("report", "run"), ("plot", "run"), ("export", "run", "--to", "json")),
        change=changed_json,
    ),
    FileKind(
        "run, changed NPZ",
        _with_run,
        "run/trajectory.npz",
        (("plot", "run"), ("export", "run", "--to", "json")),
        change=changed_arrays,
    ),
)

_BENCH, _SPECIMEN = _shipped(_SHIPPED["bench"]), _shipped(_SHIPPED["specimen"])
_VIDEO = _shipped(_TEMPLATES / "video")
_PLAN = (("plan", "problem.toml", "task.toml", "--limits", "limits.toml", "--out", "planned"),)
YAML = (b"!!python/name:os.system ", b"&a ", b"*a ", b"!!timestamp x", b"- ", b"{", b"|\n", b": ")
YAML += (b"!!int x", b"!!bool x", b"%YAML", b"\t", b".nan", b".inf", b"9" * 5000, *COUNTS)
FILES += (
    FileKind("bench, CSV", _BENCH, "run_1.csv", words=(*CSV, *COUNTS)),
    FileKind("specimen, CSV", _SPECIMEN, "pull.csv", words=(*CSV, *COUNTS)),
    FileKind("video, changed .toml", _VIDEO, "*.toml", change=changed_toml),
    FileKind("image tracks, CSV", _VIDEO, "front.csv", words=(*CSV, *COUNTS)),
    FileKind("image tracks, changed .csv", _VIDEO, "front.csv", change=changed_table),
    FileKind(
        "image tracks, long CSV", _with_tracks("l.csv", _long_csv), "l.csv", change=changed_table
    ),
    FileKind(
        "DeepLabCut, CSV", _with_tracks("dlc.csv", _deeplabcut), "dlc.csv", change=changed_table
    ),
    FileKind("DeepLabCut, HDF5", _with_tracks("d.h5", _deeplabcut), "d.h5", words=COUNTS),
    FileKind("SLEAP, HDF5", _with_tracks("s.h5", _sleap), "s.h5", words=COUNTS),
    FileKind("SLEAP, labels", _with_tracks("s.slp", _sleap_labels), "s.slp", words=COUNTS),
    FileKind("mask, PNG", _with_masks, "front.png", words=(b"IHDR", b"IDAT", b"PLTE", *COUNTS)),
    FileKind("mask, changed .toml", _with_masks, "*.toml", change=changed_toml),
    FileKind(
        "CoTracker, NPZ", _with_tracks("c.npz", _cotracker), "c.npz", words=(b"'|O'", *COUNTS)
    ),
    FileKind(
        "CoTracker, changed NPZ", _with_tracks("c.npz", _cotracker), "c.npz", change=changed_arrays
    ),
    *(
        FileKind(f"calibration of {name}", _with_calibration(file, text), file, words=YAML)
        for name, (file, text) in CALIBRATIONS.items()
    ),
    FileKind("plan, task", _with_reference, "task.toml", _PLAN, change=changed_toml),
    FileKind("plan, limits", _with_reference, "limits.toml", _PLAN, change=changed_toml),
    FileKind("plan, reference", _with_reference, "tip.csv", _PLAN, change=changed_table),
)

# Other kinds --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CaseSettings:
    """Settings of all kinds of cases.

    Attributes
    ----------
    folder : Path
        Folder for temporary files.
    problem, solved : Path
        Folders of a small problem, and of the same with a run in it.
    count, seed : int
        Number of cases of a kind, and seed of the random damage.
    limit_s : float
    kept : Path or None
        Folder for the input of cases that are neither refused nor accepted.
    """

    folder: Path
    problem: Path
    solved: Path
    count: int
    seed: int
    limit_s: float
    failure_folder: Path | None = None

    def rng(self, kind: str, number: int) -> Rng:
        """Return the random generator of a case, independent of the other cases that are run."""
        return np.random.default_rng([self.seed, number, *kind.encode()])

    def keep(self, kind: str, number: int, folder: Path, outcome: str, ended: CommandEnd) -> None:
        """Print a case that is neither refused nor accepted, and store its input and output."""
        if outcome in ("refused", "accepted"):
            return
        output_text = (ended.err.strip().splitlines() or ["no output"])[-1]
        print(
            f"{kind} {number}: {outcome}, code {ended.code}: {output_text[:300]}", file=sys.stderr
        )
        if self.failure_folder is not None:
            place = self.failure_folder / f"{kind.replace(' ', '_')}_{number}"
            shutil.copytree(folder, place, symlinks=True, dirs_exist_ok=True)
            (place / "said.txt").write_text(ended.out + ended.err, encoding="utf-8")


@dataclass(frozen=True)
class OtherKind:
    """Cases that are not damaged files.

    Attributes
    ----------
    name : str
    case : callable
        Function of a random generator, a folder and a time limit [s]; returns outcome and end.
    share : float
        Share of the number of cases, for slow kinds.
    needs_root : bool
    solved : bool
        Whether the folder has a run.
    """

    name: str
    case: Callable[[Rng, Path, float], tuple[str, CommandEnd]]
    share: float = 1.0
    needs_root: bool = False
    solved: bool = False

    def run(self, cases: CaseSettings) -> Counter[str]:
        """Run all cases and count the outcomes; no case if root is needed and the user is another
        one.
        """
        counts = Counter[str]()
        if self.needs_root and os.getuid() != 0:
            return counts
        for number in range(max(1, round(self.share * cases.count))):
            folder = cases.folder / "case"
            shutil.copytree(cases.solved if self.solved else cases.problem, folder)
            outcome, ended = self.case(cases.rng(self.name, number), folder, cases.limit_s)
            counts[outcome] += 1
            cases.keep(self.name, number, folder, outcome, ended)
            shutil.rmtree(folder)
        return counts


# Parts of names with a meaning in Markdown, HTML, XML, Python, terminals or paths.
NAMES = (
    "<script>",
    "</script>",
    "<!--",
    "-->",
    "---",
    "&amp;",
    '"',
    "'",
    "`",
    "```",
    "|",
    "[a](b:c)",
)
NAMES += ("\n", "\n\n## Verdict\n", "\x1b[2J", "\x00", "\x07", "\ufffe", "\u202e", "\\", "@DATA@")
NAMES += (
    "{0}",
    "%s",
    "${HOME}",
    "../",
    "/",
    "CON",
    "a",
    "E",
    " ",
    "#",
    "*",
    "_",
    "]]>",
    "{{",
    "\x85",
)


def _hostile_names(rng: Rng, folder: Path, limit_s: float) -> tuple[str, CommandEnd]:
    """Write reports and exports of a run whose title has special characters of other formats."""
    name = "".join(rng.choice(NAMES, rng.integers(1, 8)))
    problem = folder / "run" / "problem.toml"
    result = folder / "run" / "result.json"
    problem.write_text(problem.read_text().replace('"A tiny foam bar"', _quoted(name)))
    result_data = json.loads(result.read_text())
    result.write_text(json.dumps({**result_data, "title": name}))
    commands = [("report", "run", "--to", f"out/report{end}") for end in (".md", ".html")]
    commands += [("export", "run", "--to", to, "--out", f"out/{to}") for to in TARGETS]
    ended = run(commands[rng.integers(len(commands))], folder, limit_s)
    outcome = ended.outcome()
    try:
        in_fork(lambda: _require_well_formed(folder / "out"))
    except RuntimeError:
        outcome = "unclear"
    return outcome, ended


def _quoted(text: str) -> str:
    """Return a text as a string of TOML."""
    return (
        json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f").replace("\x85", "\\u0085")
    )


def _require_well_formed(folder: Path) -> None:
    """Read the written files by readers of their formats.

    Raises
    ------
    Exception
        If a file is malformed, or has control characters or a script.
    """
    for file in folder.rglob("*"):
        if not file.is_file():
            continue
        text = file.read_text(encoding="utf-8")
        if file.suffix != ".json" and not _is_printable(text):
            raise ValueError(f"{file.name} has control characters")
        if file.suffix in (".xml", ".feb", ".scn"):
            ElementTree.fromstring(text)
        elif file.suffix in (".html", ".md"):
            if "<script" in text.lower().replace("\\<script", ""):
                raise ValueError(f"{file.name} has a script")
        elif file.suffix == ".py":
            compile(text, file, "exec")
        elif file.suffix == ".usda":
            import pxr.Usd  # pyright: ignore[reportMissingImports]

            pxr.Usd.Stage.Open(str(file))  # pyright: ignore[reportAttributeAccessIssue]


def _without_privileges() -> None:
    """Drop the capabilities of root; files of root stay readable."""

    class Header(ctypes.Structure):
        _fields_ = [("version", ctypes.c_uint32), ("process", ctypes.c_int)]

    header = Header(0x20080522, 0)
    none = (ctypes.c_uint32 * 6)()
    if ctypes.CDLL(None).capset(ctypes.byref(header), none):
        raise OSError("the privileges cannot be given up")


def _change_owner(folder: Path) -> None:
    """Make another user the owner of a folder and its contents."""
    for each in (folder, *folder.rglob("*")):
        os.chown(each, NOBODY, NOBODY)


WRITING = (
    ("solve", "problem.toml", *REDUCED, "-q", "--out", "out/new"),
    ("solve", "problem.toml", *REDUCED, "-q", "--out", "run"),
    ("simulate", "problem.toml", "--out", "out"),
    ("report", "run"),
    ("report", "run", "--to", "out/page.html"),
    ("plot", "run"),
    ("export", "run", "--to", "json"),
    ("export", "run", "--to", "out/body.inp"),
    ("new", "out/mine"),
)


def _read_only(rng: Rng, folder: Path, limit_s: float) -> tuple[str, CommandEnd]:
    """Write into folders that the user may only read."""
    (folder / "out").mkdir()
    _change_owner(folder)
    before = problem_files.contents(folder)
    words = WRITING[rng.integers(len(WRITING))]
    ended = run(words, folder, limit_s, _without_privileges)
    return ended.outcome(problem_files.contents(folder) == before), ended


def _full(rng: Rng, folder: Path, limit_s: float) -> tuple[str, CommandEnd]:
    """Write to a disk of 4 to 400 kB, which is mounted only for this process."""
    words = list(WRITING[rng.integers(len(WRITING))])
    (folder / "out").mkdir()
    if "run" in words:  # the run fills the disk
        size = sum(f.stat().st_size + 4096 for f in (folder / "run").rglob("*") if f.is_file())
        size += int(rng.integers(4, 60)) * 1024
        prepared_command = (
            'cp -r run out && cd out && cp ../*.csv ../*.toml ../*.vtu . 2>/dev/null; exec "$@"'
        )
        size += sum(f.stat().st_size + 4096 for f in folder.glob("*.*"))
    else:
        size = int(rng.integers(4, 400)) * 1024
        prepared_command = 'exec "$@"'
    mount_command = f"mount -t tmpfs -o size={size} tmpfs out && {prepared_command}"
    program = [sys.executable, "-c", PROGRAM, *words]
    ended = _run_program(
        ["unshare", "-m", "sh", "-c", mount_command, "sh", *program], folder, limit_s
    )
    return ended.outcome(), ended


def _run_program(words: Sequence[str], folder: Path, limit_s: float) -> CommandEnd:
    """Run a program to its end; kill it at `WAITING_FACTOR` times the limit [s]."""
    process = subprocess.Popen(
        words,
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        out, err = process.communicate(timeout=WAITING_FACTOR * limit_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate()
        return CommandEnd(None, out.decode("utf-8", "replace"), err.decode("utf-8", "replace"))
    return CommandEnd(
        process.returncode, out.decode("utf-8", "replace"), err.decode("utf-8", "replace")
    )


def _kernels(rng: Rng, folder: Path, limit_s: float) -> tuple[str, CommandEnd]:
    """Solve with compiled kernels that were damaged, exchanged, linked or made by another user."""
    cache = folder / "cache"
    words = ("solve", "problem.toml", *REDUCED, "-q", "--out", "out")

    def with_cache() -> None:
        os.environ["COLLOCATION_SYSID_CACHE"] = str(cache)
        # Kernels in memory, which a fork inherits, would be used without any file.
        jit.compile_function.cache_clear()
        _without_privileges()

    first = run(words, folder, limit_s, with_cache)
    files = sorted(cache.glob("*.o"))
    kind = rng.integers(4)
    if first.code not in (0, 1) or not files:
        return "unclear", first
    file, other = (files[k] for k in rng.integers(len(files), size=2))
    if kind == 0:
        file.write_bytes(damaged(rng, file.read_bytes(), ()))
    elif kind == 1:
        file.write_bytes(other.read_bytes())
    elif kind == 2:
        file.rename(folder / "elsewhere")
        file.symlink_to(folder / "elsewhere")
    else:
        _change_owner(cache)
    ended = run(words, folder, limit_s, with_cache)
    return ended.outcome(), ended


def _two_solves(rng: Rng, folder: Path, limit_s: float) -> tuple[str, CommandEnd]:
    """Solve twice at a time into one folder; the last one must leave a complete run."""
    words = ("solve", "problem.toml", *REDUCED, "-q", "--out", "out")
    first = start(words, folder, limit_s)
    time.sleep(float(rng.exponential(0.3)))
    both = [start(words, folder, limit_s).finish(limit_s), first.finish(limit_s)]
    outcomes = [each.outcome() for each in both]
    worst = max(range(2), key=lambda k: OUTCOMES.index(outcomes[k]))
    shown = run(("report", "out"), folder, limit_s)
    is_complete = shown.code == 0 and not list(folder.glob(".*.partial*"))
    if outcomes[worst] in ("refused", "accepted") and not is_complete:
        return "unclear", replace(
            both[worst], err=f"{[p.name for p in folder.glob('.*.partial*')]} {shown.err}"
        )
    return outcomes[worst], both[worst]


FRAME = (
    b'{"t_s": %.3f, "pose": {"position_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}, '
    b'"markers": {"low": [0.0, 0.0, 0.0], "mid": [0.03, 0.02, 0.03]}}\n'
)
JSON = (
    b"NaN",
    b"Infinity",
    b"-1e400",
    b"null",
    b"{}",
    b"[",
    b"]" * 2000,
    b"[" * 2000,
    b'"\\u001b[2J"',
)
JSON += (b'"\\ud800"', b"\xff", b"\x00", b'"t_s"', b'"markers"', b"true", b"9" * 5000, b"\x1b[2J")


def _datagrams(rng: Rng, folder: Path, limit_s: float) -> tuple[str, CommandEnd]:
    """Send frames to a UDP port, most of them damaged, then the empty frame that ends the command."""
    running = start(("live", "problem.toml", "--udp", "0"), folder, limit_s)
    until = time.monotonic() + WAITING_FACTOR * limit_s
    while "port " not in running.output_text(running.err) and time.monotonic() < until:
        if os.waitid(os.P_PID, running.process, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            break
        time.sleep(0.02)
    _, port_label, rest = running.output_text(running.err).partition("port ")
    if not port_label:
        return "unclear", running.finish(0.1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        address = "127.0.0.1", int(rest.split()[0])
        for number in range(int(rng.integers(1, 40))):
            frame = FRAME % (0.01 * number)
            sent = frame if rng.random() < 0.3 else damaged(rng, frame, JSON)
            sender.sendto((sent or b" ")[:60_000], address)
        for _ in range(100):  # a datagram may be lost
            sender.sendto(b"", address)
            time.sleep(0.05)
            if os.waitid(os.P_PID, running.process, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                break
    ended = running.finish(limit_s)
    _, *errors = ended.err.splitlines() or [""]
    one_each = all(line.startswith("error: ") for line in errors)
    if ended.code == 2 and errors and one_each and _is_printable(ended.err):
        return "refused", ended
    return ended.outcome(), ended


SCRIPT = "import sys\nfrom collocation_sysid.cli import main\nsys.exit(main())\n"
# Interrupts come within this time after the start [s]; the small solve takes less.
INTERRUPTED_WITHIN_S = 8.0


def _interrupted(rng: Rng, folder: Path, limit_s: float) -> tuple[str, CommandEnd]:
    """Interrupt a solve once or twice; its exit code is 130 or 143, and it leaves no run or a complete
    one.
    """
    script = folder / "collocation-sysid"
    script.write_text(SCRIPT)
    words = [sys.executable, str(script), "solve", "problem.toml", *REDUCED, "--out", "out"]
    signals = [
        int(each) for each in rng.choice([signal.SIGINT, signal.SIGTERM], rng.integers(1, 3))
    ]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        running = RunningCommand(0, out, err)
        process = subprocess.Popen(
            words, cwd=folder, stdout=out, stderr=err, start_new_session=True
        )
        time.sleep(float(rng.uniform(0.0, INTERRUPTED_WITHIN_S)))
        for number in signals:
            process.send_signal(number)
            time.sleep(float(rng.uniform(0.0, 0.5)))
        try:
            code = process.wait(WAITING_FACTOR * limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            code = process.wait() and None
        ended = CommandEnd(code, running.output_text(out), running.output_text(err))
    outcome = ended.outcome()
    if outcome == "crash" and -(code or 0) in signals:  # before the signal handlers are installed
        outcome = "refused"
    if outcome == "unclear" and code in (130, 143):
        outcome = "refused"
    is_complete = not (folder / "out").exists() or (folder / "out" / "result.json").is_file()
    if outcome in ("refused", "accepted") and not (is_complete and not list(folder.glob(".out.*"))):
        outcome = "unclear"
    return outcome, ended


OTHERS = (
    OtherKind("names in outputs", _hostile_names, solved=True),
    OtherKind("read-only folder", _read_only, share=0.5, needs_root=True, solved=True),
    OtherKind("full disk", _full, share=0.2, needs_root=True, solved=True),
    OtherKind("compiled kernels", _kernels, share=0.2, needs_root=True),
    OtherKind("two solves, one output", _two_solves, share=0.2),
    OtherKind("UDP frames", _datagrams, share=0.5),
    OtherKind("interrupts", _interrupted, share=0.4),
)
KINDS: dict[str, FileKind | OtherKind] = {each.name: each for each in (*FILES, *OTHERS)}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--count", type=int, default=100, help="number of cases of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=list(KINDS), default=list(KINDS))
    parser.add_argument(
        "--limit-s",
        type=float,
        default=30.0,
        help="processor time after which a case counts as a hang [s]",
    )
    parser.add_argument("--quick", action="store_true", help="only read and describe the problems")
    parser.add_argument("--keep", type=Path, help="store the input of failures in this folder")
    arguments = parser.parse_args()
    print(
        table(
            arguments.count,
            arguments.seed,
            arguments.only,
            arguments.limit_s,
            arguments.keep,
            quick=arguments.quick,
        )
    )


def _end(*_: object, **__: object) -> None:
    sys.exit(0)


def table(
    count: int,
    seed: int,
    only: Sequence[str],
    limit_s: float,
    failure_folder: Path | None = None,
    quick: bool = False,
) -> str:
    """Run the cases, and return a table with the number of each outcome by kind.

    For the arguments see the options of the command line.
    """
    rows = []
    os.environ["COLLOCATION_SYSID_THREADS"] = "1"  # forks have no threads
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        problem = folder / "problem"
        solved = folder / "solved"
        problem.mkdir()
        in_fork(lambda: problem_files.write_problem(problem, {"swing": 8}))
        shutil.copytree(problem, solved)
        if any(KINDS[name] in OTHERS for name in only):
            words = ("solve", "problem.toml", *REDUCED, "-q", "--out", "run")
            if (ended := run(words, solved, 10 * limit_s)).code not in (0, 1):
                raise RuntimeError(f"the small problem is not solved: {ended.err}")
        checked = _end if quick else problem_commands.check_problem
        with (
            mock.patch.object(run_record, "write_pictures"),
            mock.patch.object(problem_commands, "check_problem", checked),
            mock.patch.object(
                motion_plan, "solve_reduced", _end if quick else motion_plan.solve_reduced
            ),
        ):
            cases = CaseSettings(folder, problem, solved, count, seed, limit_s, failure_folder)
            for name in only:
                began = time.monotonic()
                counts = KINDS[name].run(cases)
                took = f"{time.monotonic() - began:.0f}"
                cells = (str(counts[outcome]) for outcome in OUTCOMES)
                rows.append((name, str(counts.total()), *cells, took))
                print(*rows[-1], sep=", ", file=sys.stderr, flush=True)
    return markdown(("input", "cases", *OUTCOMES, "time [s]"), rows)


if __name__ == "__main__":
    main()
