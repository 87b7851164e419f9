"""Outcomes of the command line for damaged input, counted by kind of input.

    nice -n 19 python scripts hostile [--count 100] [--seed 0] [--only "problem file"] [--keep FOLDER]

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

`--keep` stores the input of all cases but the first two outcomes.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from script_arguments import make_parser

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from kit import logs, problem_files
from studies import markdown

from collocation_sysid import cli
from collocation_sysid.cli import problem_commands
from collocation_sysid.errors import InputError
from collocation_sysid.extras.planning import motion_plan
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


def run(
    words: Sequence[object],
    folder: Path,
    limit_s: float,
    before: Callable[[], object] | None = None,
) -> CommandEnd:
    """Run the command line to its end or the limit in a fork of this process, whose modules are
    imported already; it is killed at `WAITING_FACTOR` times the limit.
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        sys.stdout.flush()
        child = os.fork()
        if not child:
            limits = {resource.RLIMIT_AS: MEMORY_LIMIT_BYTES, resource.RLIMIT_CORE: 0}
            limits[resource.RLIMIT_CPU] = int(np.ceil(limit_s))
            files = out.fileno(), err.fileno()
            _run_command_in_fork([str(word) for word in words], folder, files, limits, before)
        code = _wait(child, limit_s)
        for stream in (out, err):
            stream.seek(0)
        texts = (stream.read().decode("utf-8", "replace") for stream in (out, err))
        return CommandEnd(code, *texts)


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
    """Call a function in a fork, so that its threads do not exist in this process."""
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
TOML_VALUES = ("true", "-1", "0", "1e300", "1e-300", "nan", "inf", "-0.5", "3.7", "10")
TOML_VALUES += ("1000000000",)
TOML_VALUES += ('""', '"x"', '"none"', '"../x.csv"', '"\\u0000"', "[]", "[1]", "[nan, 0, 0]", "{}")
TOML_VALUES += ("[[1, 2], [3]]", "{ a = 1 }", '["a", 1]', "2024-01-01", "99999999999999999999")
CELLS = ("", "x", "nan", "inf", "-inf", "1e300", "-1", "0", "1e-300", "1,5", '"', "0x10")
CELLS += ("1 2", "é")
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
    """Files of one kind, and the commands that read them."""

    name: str  # name of the kind in the table
    make: Callable[[Path], object]  # function that adds the files to the folder of a problem
    file: str  # pattern of the file that is damaged; one is drawn if there are several
    # One of them is drawn for each case.
    commands: tuple[tuple[str, ...], ...] = (("check", "problem.toml"),)
    words: tuple[bytes, ...] = ()  # words with a special meaning in the format
    # Change within the format, in place of damaged bytes.
    change: Callable[[Rng, bytes], bytes] | None = None

    def run(self, cases: CaseSettings) -> Counter[str]:
        """Run all cases and count the outcomes; no case if the package that reads the format is
        missing.
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
            target = folder / file.relative_to(base)
            change = self.change or (lambda rng, valid: damaged(rng, valid, self.words))
            target.write_bytes(change(rng, valid))
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


def _png(file: Path) -> None:
    from PIL import Image

    Image.fromarray((1000 * DEPTH_M).astype(np.uint16)).save(file)


def _npz(file: Path) -> None:
    np.savez(file, depth_m=np.stack(3 * [DEPTH_M]), t_s=np.array([0.0, 0.04, 0.08]))


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
CSV = (b"\x00", b"1e308", b"nan", b"-inf", b'"', b";", b"\t", b"\r", b",,,,", b"=1+1")
CSV += (b"\xef\xbb\xbf",)
XML = (b"&a9;", b"<!--", b"-->", b"]]>", b"<![CDATA[", b"<a>", b"</a>", b'"', *COUNTS)


def _log_commands(name: str) -> tuple[tuple[str, ...], ...]:
    return (*BOTH, ("log", name))


FILES = (
    FileKind("problem file", lambda _: None, "problem.toml", words=(*TOML, *COUNTS)),
    FileKind("tracks, CSV", lambda _: None, MARKERS, words=(*CSV, *COUNTS)),
    FileKind("poses, CSV", lambda _: None, POSES, words=(*CSV, *COUNTS)),
    FileKind("mesh, VTU", lambda _: None, "body.vtu", words=XML),
    FileKind(
        "bag, ROS 1",
        _with_bag("ros1"),
        "trial.bag",
        _log_commands("trial.bag"),
        (*DEFINITIONS, *COUNTS, b"message_definition=", b"md5sum=*", b"op=\x07"),
    ),
    FileKind(
        "log, MCAP",
        _with_bag("mcap file"),
        "trial.mcap",
        _log_commands("trial.mcap"),
        (*DEFINITIONS, *COUNTS, b"\x89MCAP0\r\n"),
    ),
    FileKind(
        "depth, PNG", _with_depth("frames/0.png", _png), "frames/0.png", words=(b"IHDR", b"IDAT")
    ),
    FileKind(
        "depth, NPZ",
        _with_depth("frame.npz", _npz),
        "frame.npz",
        words=(b"'|O'", b"(99999999, 99999999)", b"True", *COUNTS),
    ),
)


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
    FileKind("calibration of OpenCV", _VIDEO, "front.yaml", words=YAML),
    FileKind("plan, task", _with_reference, "task.toml", _PLAN, change=changed_toml),
    FileKind("plan, limits", _with_reference, "limits.toml", _PLAN, change=changed_toml),
    FileKind("plan, reference", _with_reference, "tip.csv", _PLAN, change=changed_table),
)

# Cases --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CaseSettings:
    """Settings of all kinds of cases."""

    folder: Path  # folder for temporary files
    problem: Path  # folder of a small problem
    # Number of cases of a kind, and seed of the random damage.
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


KINDS = {each.name: each for each in FILES}


def main() -> None:
    parser = make_parser(__doc__)
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
        problem.mkdir()
        in_fork(lambda: problem_files.write_problem(problem, {"swing": 8}))
        checked = _end if quick else problem_commands.check_problem
        with (
            mock.patch.object(run_record, "write_pictures"),
            mock.patch.object(problem_commands, "check_problem", checked),
            mock.patch.object(
                motion_plan, "solve_reduced", _end if quick else motion_plan.solve_reduced
            ),
        ):
            cases = CaseSettings(folder, problem, count, seed, limit_s, failure_folder)
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
