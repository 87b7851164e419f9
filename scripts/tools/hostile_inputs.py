"""Damage files of all kinds at random, and run the commands that read them.

Each input is one file of a small problem or run with one kind of damage. A command has to end with
exit code 0, 1 or 2, without a traceback, with one line of error, within the limits of time and
memory. Prints what did not, and a table. The same seed makes the same inputs.

    python scripts hostile_inputs [--inputs 500] [--seed 0] [--only calibration]
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image
from script_arguments import make_parser

from collocation_sysid import cli
from collocation_sysid.kinds.outlines.masks import encoded
from collocation_sysid.problem.new import create_problem

Generator = np.random.Generator
LONGEST_S = 60
MOST_BYTES = 3_000_000_000
NUMBER = re.compile(rb"(?<![\w.])-?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w.])")
NUMBERS = (
    *(b"nan", b"inf", b"-inf", b"1e400", b"-1e308", b"1e30", b"1e-320", b"-1", b"0", b"-0.0"),
    *(
        b"9" * 5000,
        b"10000000000",
        b"9223372036854775808",
        b"true",
        b"null",
        b"''",
        b"1,5",
        b"0x10",
    ),
    *("٣".encode(), b"1_0", b"[]", b"{}", b'"a"', b"1e5e5", b"--1"),
)

# Damage -------------------------------------------------------------------------------------------


def change_numbers(content: bytes, rng: Generator) -> bytes:
    places = [each.span() for each in NUMBER.finditer(content)]
    for k in sorted(rng.choice(len(places), min(len(places), rng.integers(1, 4)), False))[::-1]:
        start, end = places[k]
        content = content[:start] + NUMBERS[rng.integers(len(NUMBERS))] + content[end:]
    return content


def flip_bytes(content: bytes, rng: Generator) -> bytes:
    changed = bytearray(content or b"x")
    for place in rng.integers(len(changed), size=rng.integers(1, 20)):
        changed[place] = rng.integers(256)
    return bytes(changed)


def cut(content: bytes, rng: Generator) -> bytes:
    return content[: rng.integers(len(content) + 1)]


def insert(content: bytes, rng: Generator) -> bytes:
    pieces = (
        *(
            b"\0",
            b"\xff\xfe",
            b"\x1b[2J",
            "\u202e\u200b".encode(),
            b"\r",
            b'"',
            b"'",
            b"[",
            b"]]",
            b"{",
        ),
        *(b"[" * 50_000, b"{" * 3000, b"<!--" * 20_000, b"&a " * 9, b"a." * 3000, b"1," * 100_000),
        *(
            b"\n" * 100_000,
            b"x" * 1_000_000,
            b"*" * 300,
            b"<!DOCTYPE a>",
            b"!!python/object:os.system",
        ),
    )
    place = int(rng.integers(len(content) + 1))
    return content[:place] + pieces[rng.integers(len(pieces))] + content[place:]


def move_lines(content: bytes, rng: Generator) -> bytes:
    lines = content.splitlines(keepends=True) or [b""]
    k, other = rng.integers(len(lines), size=2)
    what = rng.integers(4)
    if what == 0:
        del lines[k : k + int(rng.integers(1, 5))]
    elif what == 1:
        lines.insert(other, lines[k])
    elif what == 2:
        lines[k], lines[other] = lines[other], lines[k]
    else:
        lines[k] = b",".join(lines[k].split(b",")[: rng.integers(3)]) + b"\n"
    return b"".join(lines)


def change_words(content: bytes, rng: Generator) -> bytes:
    words = sorted(set(re.findall(rb"[A-Za-z_]{3,}", content))) or [b"abc"]
    word, other = (words[k] for k in rng.integers(len(words), size=2))
    return content.replace(word, [other, b"", b"\xc3\xa9", word.upper()][rng.integers(4)], 1)


def replace_all(content: bytes, rng: Generator) -> bytes:
    contents = (
        *(
            b"",
            b"\n",
            b"\0" * 1000,
            rng.bytes(3000),
            b"[]",
            b"{}",
            b"null",
            b"1",
            b"<a/>",
            b"a: *a",
        ),
        *(
            b"PK\x03\x04" + rng.bytes(100),
            b"\x89HDF\r\n\x1a\n" + rng.bytes(200),
            b"\x93NUMPY\x01\0",
        ),
        *(content.decode("utf-8", "replace").encode("utf-16"), content * 3, content[::-1]),
        *(b"\xef\xbb\xbf" + content, content.replace(b"\n", b"\r\n"), content.replace(b".", b",")),
    )
    return contents[rng.integers(len(contents))]


DAMAGES = (change_numbers, flip_bytes, cut, insert, move_lines, change_words, replace_all)

# Files --------------------------------------------------------------------------------------------

CALIBRATIONS = {
    "c.yaml": "%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720\ncamera_matrix: !!opencv-matrix\n"
    "   rows: 3\n   cols: 3\n   dt: d\n   data: [900, 0, 640, 0, 900, 360, 0, 0, 1]\n"
    "distortion_coefficients: [0.1, 0.0, 0.0, 0.0]\n",
    "c.xml": "<?xml version='1.0'?><opencv_storage><camera_matrix type_id='opencv-matrix'><rows>3</rows>"
    "<cols>3</cols><data>900 0 640 0 900 360 0 0 1</data></camera_matrix></opencv_storage>",
    "c.json": '{"camera_matrix": [[900, 0, 640], [0, 900, 360], [0, 0, 1]], "dist": [0, 0, 0, 0]}',
    "c.toml": "[cam_0]\nname = 'a'\nmatrix = [[900.0, 0, 640], [0, 900, 360], [0, 0, 1.0]]\n"
    "distortions = [0.1, 0.0, 0.0, 0.0, 0.0]\nrotation = [0, 0, 0]\ntranslation = [0, 0, 0]\n",
    "c.txt": "# cameras\n1 OPENCV 1280 720 900 900 640 360 0.1 0 0 0\n",
    "k.yaml": "cam0:\n  camera_model: pinhole\n  intrinsics: [900, 900, 640, 360]\n"
    "  distortion_model: radtan\n  distortion_coeffs: [0.1, 0, 0, 0]\n  resolution: [1280, 720]\n",
}
TASK = """duration_s = 0.3
[[reference]]
point = "end_1"
t_s = [0.3]
position_m = [[0.01, 0.0, 0.0]]
relative = true
"""
LIMITS = """workspace_m = [[-0.3, -0.3, -0.3], [0.3, 0.3, 0.3]]
speed_m_s = 1.5
acceleration_m_s2 = 15.0
rotation_deg = 90.0
angular_speed_deg_s = 360.0
angular_acceleration_deg_s2 = 3000.0
"""
FRAME = '{"t_s": 0.01, "pose": {"position_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}, "markers": {}}\n'
MASKS = """
[[experiment.outlines]]
name = "masks"
file = "masks.json"
camera = { file = "front.yaml", pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -1], [0, 0, 0, 1]] }
t_s = [0.0]
"""
CLOUD = """
[[experiment.depth]]
name = "cloud"
file = "cloud{}"
sigma_m = 0.001
t_s = [0.0]
"""


def make_folders(folder: Path) -> list[tuple[str, str, str, tuple[str, ...]]]:
    """Return kind, folder, file and command of each file that is damaged."""
    kinds: list[tuple[str, str, str, tuple[str, ...]]] = []
    check = ("check", "problem.toml")
    for kind in ("swing", "specimen", "compression", "video"):
        create_problem(folder / kind, kind)
        for file in sorted((folder / kind).iterdir()):
            if file.suffix in (".csv", ".vtu", ".yaml", ".toml"):
                kinds.append((f"{kind}/{file.name}", kind, file.name, check))
    for name, text in CALIBRATIONS.items():
        made = folder / f"calibration_{name}"
        shutil.copytree(folder / "video", made)
        (made / name).write_text(text)
        problem = (made / "problem.toml").read_text().replace('"front.yaml"', f'"{name}"')
        (made / "problem.toml").write_text(problem)
        kinds.append((f"calibration {name}", made.name, name, check))
    masks = folder / "masks"
    shutil.copytree(folder / "video", masks)
    mask = np.zeros((720, 1280), dtype=bool)
    mask[300:400, 500:700] = True
    (masks / "masks.json").write_text(json.dumps([encoded(mask)]))
    Image.fromarray(255 * mask.astype(np.uint8)).save(masks / "masks.png")
    problem = (
        (masks / "problem.toml").read_text().replace("[transcription]", MASKS + "[transcription]")
    )
    (masks / "problem.toml").write_text(problem)
    kinds.append(("masks json", "masks", "masks.json", check))
    shutil.copytree(masks, folder / "masks_png")
    (folder / "masks_png/problem.toml").write_text(problem.replace("masks.json", "masks.png"))
    kinds.append(("masks png", "masks_png", "masks.png", check))
    points = np.random.default_rng(0).normal(scale=0.02, size=(40, 3))
    for suffix in (".xyz", ".npz", ".ply"):
        made = folder / f"depth_{suffix[1:]}"
        shutil.copytree(folder / "swing", made)
        table = CLOUD.format(suffix)
        problem = (made / "problem.toml").read_text()
        (made / "problem.toml").write_text(
            problem.replace("[transcription]", table + "[transcription]")
        )
        cloud = made / f"cloud{suffix}"
        if suffix == ".npz":
            np.savez(cloud, points_m=points)
        else:
            text = "\n".join(" ".join(f"{x:.5f}" for x in point) for point in points)
            names = "\n".join(f"property float {axis}" for axis in "xyz")
            head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{names}\nend_header\n"
            cloud.write_text((head if suffix == ".ply" else "") + text + "\n")
        kinds.append((f"depth {suffix}", made.name, cloud.name, check))
    run = folder / "run"
    shutil.copytree(folder / "swing", run)
    (run / "task.toml").write_text(TASK)
    (run / "limits.toml").write_text(LIMITS)
    (run / "frames.jsonl").write_text(FRAME * 5)
    solve = ("solve", "problem.toml", "--no-pictures", "-q", "--out", "run")
    with in_folder(run):
        assert run_in_child(solve, folder / "log").code == 0
    plan = ("plan", "run", "task.toml", "--limits", "limits.toml", "--no-film", "-q", "--out", "p")
    for file in ("run/result.json", "task.toml", "limits.toml"):
        kinds.append((f"plan {file}", "run", file, plan))
    for words in (
        ("plot", "run"),
        ("report", "run", "-q"),
        ("export", "run", "--to", "calculix", "-q"),
    ):
        for file in sorted(each.name for each in (run / "run").iterdir() if each.is_file()):
            if file.endswith((".json", ".npz", ".toml")):
                kinds.append((f"{words[0]} {file}", "run", f"run/{file}", words))
    film = folder / "film"
    film.mkdir()
    rng = np.random.default_rng(0)
    images = (Image.fromarray(rng.integers(256, size=(90, 120), dtype=np.uint8)) for _ in range(3))
    for k, image in enumerate(images):
        image.save(film / f"{k}.png")
    track = ("track", ".", "--rate-hz", "30", "--out", "tracks.csv", "-q")
    kinds.append(("track image", "film", "1.png", track))
    kinds.append(("live frames", "run", "frames.jsonl", ("live", "problem.toml", "<frames.jsonl")))
    return kinds


# Commands -----------------------------------------------------------------------------------------


class Outcome:
    """How a command ended."""

    def __init__(self, status: int, text: str, time_s: float) -> None:
        self.code = os.waitstatus_to_exitcode(status)
        self.text = text
        self.time_s = time_s

    def fault(self) -> str:
        """Return what is wrong with the end of a command; empty if nothing is."""
        if self.code == -signal.SIGALRM:
            return "hang"
        if self.code < 0:
            return f"crash {signal.Signals(-self.code).name}"
        if "Traceback" in self.text or self.code not in (0, 1, 2):
            return "traceback"
        lines = [each for each in self.text.splitlines() if each.startswith("error: ")]
        return "more than a line" if self.code == 2 and len(lines) > 1 else ""


def run_in_child(words: tuple[str, ...], log: Path) -> Outcome:
    """Run a command in a copy of this process, which has imported everything."""
    began = time.monotonic()
    child = os.fork()
    if not child:
        given = next((each[1:] for each in words if each.startswith("<")), os.devnull)
        os.dup2(os.open(given, os.O_RDONLY), 0)
        for stream in (1, 2):
            os.dup2(
                os.open(log, os.O_WRONLY | os.O_CREAT | (os.O_TRUNC, os.O_APPEND)[stream - 1]),
                stream,
            )
        resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(LONGEST_S)
        sys.argv = ["collocation-sysid", *(each for each in words if not each.startswith("<"))]
        code = 1
        try:
            cli.main()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1
        except BaseException as error:
            sys.excepthook(type(error), error, error.__traceback__)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    _, status = os.waitpid(child, 0)
    return Outcome(status, log.read_text(errors="replace"), time.monotonic() - began)


@contextmanager
def in_folder(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--inputs", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    faults = 0
    with tempfile.TemporaryDirectory(prefix="hostile-") as place:
        folder = Path(place)
        kinds = [each for each in make_folders(folder) if options.only in each[0]]
        for number in range(options.inputs):
            rng = np.random.default_rng([options.seed, number])
            kind, name, file, words = kinds[number % len(kinds)]
            damage: Callable[[bytes, Generator], bytes] = DAMAGES[rng.integers(len(DAMAGES))]
            work = folder / "work"
            shutil.rmtree(work, ignore_errors=True)
            shutil.copytree(folder / name, work)
            content = (work / file).read_bytes()
            (work / file).write_bytes(damage(content, rng))
            with in_folder(work):
                outcome = run_in_child(words, folder / "log")
            fault = outcome.fault()
            counts[kind.split()[0], fault or f"exit {outcome.code}"] += 1
            if fault:
                faults += 1
                last = outcome.text.strip().splitlines()[-1:] or [""]
                print(
                    f"{number}: {kind}, {damage.__name__}: {fault} {outcome.time_s:.0f} s: {last[0][:200]}"
                )
    for (kind, end), count in sorted(counts.items()):
        print(f"{kind:32}{end:20}{count:5}")
    print(f"{options.inputs} inputs, {faults} faults")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
