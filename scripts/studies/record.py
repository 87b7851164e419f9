"""Record of the codes of likely mistakes: in how many cases of the studies each is named first,
rightly and wrongly.

`study_mistakes` and `study_trust` append their cases to the file of their option `--json`. This
script writes the table of all cases into docs/studies/mistakes.md.

    python scripts record FILES
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from script_arguments import make_parser
from studies import markdown

from collocation_sysid.statistics.assessment import OPEN_CAUSES
from collocation_sysid.statistics.description_texts import MESSAGES

PAGE = Path(__file__).parents[2] / "docs" / "studies" / "mistakes.md"
BEGIN, END = "<!-- record -->\n", "<!-- end of the record -->\n"
# Cases of a code that the table names.
SHOWN = 3
# Codes that no study names, with the tests whose simulated mistakes they name.
TESTED = {
    "frames": "problem/test_recording_frames.py",
    "clock/slow": "judge/test_first_reasons.py",
    "clock": "statistics/test_wrong_descriptions.py",
    "markers-exchanged/later": "statistics/test_wrong_descriptions.py",
    "hysteresis": "problem/test_bench_files.py",
    "law": "statistics/test_body_causes.py",
    "law/both": "statistics/test_body_causes.py",
    "mesh-section": "judge/test_first_reasons.py",
    "mesh-mirrored": "judge/test_first_reasons.py",
    "rest-shape": "statistics/test_body_causes.py",
    "tracks-filtered": "statistics/test_body_causes.py",
    "sensor-filtered": "runs/test_every_measurement.py",
    "markers-same": "statistics/test_body_causes.py",
    "sensor-sign": "statistics/test_sensor_causes.py",
    "sensor-unit": "statistics/test_sensor_causes.py",
    "sensor-axes": "statistics/test_sensor_causes.py",
    "sensor-zero": "statistics/test_sensor_causes.py",
    "sensor-clock": "statistics/test_sensor_causes.py",
    "marker-held": "statistics/test_wrong_descriptions.py",
    "marker-slip": "statistics/test_wrong_descriptions.py",
    "marker-slip/alone": "statistics/test_wrong_descriptions.py",
    "grasp-layer": "statistics/test_wrong_descriptions.py",
    "not-at-rest": "statistics/test_initial_motion.py",
    "specimen-true-stress": "recording/test_specimen.py",
    "specimen-compression": "recording/test_specimen.py",
    "specimen-compression/widening": "statistics/test_specimen_misspecifications.py",
    "specimen-percent": "recording/test_specimen.py",
    "specimen-kind": "statistics/test_specimen_misspecifications.py",
    "specimen-kind/likelier": "judge/test_first_reasons.py",
    "specimen-moduli": "recording/test_harmonic.py",
    "specimen-placeholder": "statistics/test_specimen_misspecifications.py",
    "specimen-area": "recording/test_specimen.py",
    "specimen-unit": "recording/test_specimen.py",
    "wrench-offset": "statistics/test_wrench_at_guess.py",
    "camera-matrix/centre": "statistics/test_wrong_depth_images.py",
    "image-tracks": "statistics/test_wrong_tracks.py",
    "image-tracks/likely": "statistics/test_wrong_tracks.py",
    "image-tracks/hidden": "statistics/test_wrong_tracks.py",
    "image-tracks/missing": "statistics/test_wrong_tracks.py",
    "image-tracks/motion": "statistics/test_wrong_tracks.py",
    "image-track/exchanged": "statistics/test_wrong_tracks.py",
    "image-track/stuck": "statistics/test_wrong_tracks.py",
    "image-track/jumps": "statistics/test_wrong_tracks.py",
    "image-track/off-body": "statistics/test_wrong_tracks.py",
    "outlines": "program/test_outlines.py",
}


def append(
    file: Path, case: str, right: Sequence[str], named: Sequence[str], **more: object
) -> None:
    """Append a case to a file of results, with its right causes and the codes that are named first."""
    with file.open("a", encoding="utf-8") as results:
        line = {"case": case, "right": right, "named": named, **more}
        results.write(json.dumps(line) + "\n")


def rows(files: Sequence[Path]) -> Iterator[tuple[str, str, str, str]]:
    """Yield code, numbers of cases in which it is right and wrong, and the cases."""
    lines = [json.loads(line) for file in files for line in file.read_text().splitlines()]
    by_code: dict[str, dict[bool, list[str]]] = defaultdict(lambda: {True: [], False: []})
    for each in lines:
        for code in dict.fromkeys(each["named"]):
            cause = code.partition("/")[0]
            is_right = any(
                cause == right or cause.startswith(f"{right}-") for right in each["right"]
            )
            by_code[code][is_right].append(each["case"])
    for code in MESSAGES:
        right, wrong = by_code[code][True], by_code[code][False]
        if f"description/{code}" in OPEN_CAUSES:
            continue
        cases = _listed(right) or (f"`tests/{TESTED[code]}`" if code in TESTED else "none")
        if wrong:
            cases += f"; wrong: {_listed(wrong)}"
        yield code, str(len(right)), str(len(wrong)), cases


def _listed(cases: Sequence[str]) -> str:
    """Return the first cases as text, and how many others there are."""
    first, others = cases[:SHOWN], len(cases) - SHOWN
    more = [f"{others} more"] if others > 0 else []
    return "; ".join([*dict.fromkeys(first), *more])


def main() -> None:
    """Write the table of the cases of some files into the page."""
    parser = make_parser(__doc__)
    parser.add_argument("files", nargs="+", type=Path, help="results of the studies")
    files = parser.parse_args().files
    table = markdown(("code", "right", "wrong", "cases"), [*rows(files)])
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n{table}\n\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
