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
# Tests whose simulated mistakes a code names, and how many these are.
TESTED = {
    "frames": ("problem/test_recording_frames.py", 2),
    "clock/slow": ("judge/test_first_reasons.py", 2),
    "image-tracks": ("statistics/test_wrong_tracks.py", 1),
    "law": ("statistics/test_body_causes.py", 1),
    "mesh-section": ("judge/test_first_reasons.py", 2),
    "sign": ("statistics/test_wrong_descriptions.py", 2),
    "sensor-sign": ("statistics/test_sensor_causes.py", 2),
    "sensor-unit": ("statistics/test_sensor_causes.py", 2),
    "sensor-axes": ("statistics/test_sensor_causes.py", 1),
    "specimen-true-stress": ("recording/test_specimen.py", 2),
    "specimen-compression": ("recording/test_specimen.py", 2),
    "specimen-percent": ("recording/test_specimen.py", 2),
    "specimen-area": ("recording/test_specimen.py", 3),
    "specimen-kind": ("statistics/test_specimen_misspecifications.py", 2),
    "specimen-kind/likelier": ("judge/test_first_reasons.py", 2),
    "specimen-placeholder": ("statistics/test_specimen_misspecifications.py", 2),
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
        file, count = TESTED.get(code, ("", 0))
        cases = "; ".join([*filter(None, [_listed(right)]), *[f"`tests/{file}`"] * bool(count)])
        if wrong:
            cases += f"; wrong: {_listed(wrong)}"
        yield code, str(len(right) + count), str(len(wrong)), cases


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
