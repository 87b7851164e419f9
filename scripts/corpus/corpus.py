"""The corpus: recordings with known truth, faultless and with hidden mistakes, solved by one process on
one core, with the table of their answers, verdicts, first reasons and processor times.

    python scripts corpus [--quick] [--only PATTERN] [--part 2/4] [--out FILE] [--against FILE]
    python scripts corpus --page TABLE …

Each answer is appended to the table FILE, one line of JSON each; what this code has solved there
already is kept, so that an interrupted run continues, and parts can run side by side. `--against`
compares with a stored table; with `--judge` the command then fails if more is good and outside, less is
inside, a first reason became wrong, or more fails. `--page` writes docs/studies/corpus.md from stored
tables, the oldest first.
"""

from __future__ import annotations

import os

if __name__ == "__main__":  # libraries read these variables when they are imported
    threads = "COLLOCATION_SYSID_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"
    os.environ |= dict.fromkeys(threads, "1")

import datetime
import hashlib
import json
import re
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from recordings import ROOT, Recording, recordings
from script_arguments import make_parser
from studies import markdown

import collocation_sysid as cs

Row = dict[str, Any]
Table = dict[str, Row]
PAGE = ROOT / "docs" / "studies" / "corpus.md"
TEMPLATE = Path(__file__).with_name("page.md")
# Topics and codes that state a misfit, or that something is not determined, without a cause.
OPEN = re.compile(
    r"(noise|residuals|solve|roll-out|information|scheme|mesh|scale|prediction)/|nuisance/large|effect/impossible|"
    r"description/(several|insufficient)|specimen/(persist|stress|stresses|none|outlier)$"
)
# A changed answer is more than this share of its standard uncertainty away.
MOVED = 0.1


def main() -> None:
    """Solve the recordings that the command line selects, and print their table."""
    parser = make_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="a third of the recordings")
    parser.add_argument("--only", default="", metavar="PATTERN", help="names that contain this")
    parser.add_argument("--part", default="1/1", help="2/4 is the second of four parts")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "corpus.jsonl")
    parser.add_argument("--against", type=Path, help="a stored table")
    parser.add_argument("--judge", action="store_true", help="fail if worse than --against")
    parser.add_argument("--page", type=Path, nargs="+", metavar="TABLE")
    options = parser.parse_args()
    if options.page:
        PAGE.write_text(page({file.stem: read(file) for file in options.page}), encoding="utf-8")
        return
    number, _, parts = options.part.partition("/")
    chosen = [
        each
        for each in recordings()
        if re.search(options.only, each.name) and (each.quick or not options.quick)
    ][int(number) - 1 :: int(parts)]
    code = fingerprint()
    known = {name: row for name, row in read(options.out).items() if row["code"] == code}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    table: Table = {}
    for recording in chosen:
        row = known.get(recording.name) or {"code": code, **solved(recording)}
        if recording.name not in known:
            with options.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
        table[recording.name] = row
        print(line(row), flush=True)
    for row in table.values():
        compare_repeats(row, table)
    print("\n" + summary({"now": table}))
    if options.against:
        before = {n: row for n, row in read(options.against).items() if n in table}
        print("\n" + changes(before, table))
        worse = judged(before, table)
        print("\n".join(["", *(f"WORSE: {each}" for each in worse)]))
        sys.exit(bool(worse) and options.judge)


def fingerprint() -> str:
    """Return the commit of the package, with a digest of what is not committed."""
    folder = Path(cs.__file__).parents[1]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout

    changed = git("diff", "HEAD", "--", "collocation_sysid")
    digest = hashlib.sha256(changed.encode()).hexdigest()[:6] if changed else ""
    return "+".join(filter(None, [git("rev-parse", "--short=8", "HEAD").strip(), digest]))


def read(file: Path) -> Table:
    """Return the rows of a stored table by name; of several, the last one."""
    if not file.is_file():
        return {}
    rows = map(json.loads, file.read_text(encoding="utf-8").splitlines())
    table = {row["name"]: row for row in rows}
    for row in table.values():
        compare_repeats(row, table)
    return table


# One recording ------------------------------------------------------------------------------------


def solved(recording: Recording) -> Row:
    """Solve a recording, and return its row. What is refused or fails is an answer, too."""
    row: Row = {
        "name": recording.name,
        "mistake": recording.mistake,
        "repeats": recording.repeats,
        "causes": recording.causes,
        "quick": recording.quick,
        "date": datetime.date.today().isoformat(),
        "reason": "",
        "constants": {},
    }
    began_s = time.process_time()
    try:
        problem = recording.make()
        row["made_s"] = round(time.process_time() - began_s, 2)
        began_s = time.process_time()
        run = cs.run(problem)
    except cs.InputError as error:
        return row | {"status": "refused", "verdict": "refused", "message": str(error)}
    except Exception as error:
        return row | {"status": "failed", "verdict": "failed", "message": repr(error)[:300]}
    spent_s = time.process_time() - began_s
    elapsed = run.elapsed_s
    share = elapsed.search / max(elapsed.search + elapsed.checks, 1e-9)
    row |= {
        "status": run.solution.status.value,
        "verdict": run.trust.verdict,
        "iterations": len(run.solution.history),
        "search_s": round(share * spent_s, 2),
        "judgement_s": round((1 - share) * spent_s, 2),
    }
    for concern in run.trust.concerns[:1]:
        row |= {"reason": concern.code, "message": concern.message}
    for name, true in recording.truth.items():
        estimate = run.estimates.get(name)
        if estimate is None or estimate.fixed:
            continue
        low, high = run.interval(name) or (np.nan, np.nan)
        found = {"value": estimate.value, "low": low, "high": high}
        if np.isfinite(true):
            found |= {"true": true}
        row["constants"][name] = {key: float(value) for key, value in found.items()}
    return row


def compare_repeats(row: Row, table: Table) -> None:
    """Set the truth of a repeat, which is the median of the others of its name."""
    others = [e for e in table.values() if e["repeats"] == row["repeats"] and e is not row]
    for name, found in row["constants"].items() if row["repeats"] else ():
        values = [each["constants"][name]["value"] for each in others if name in each["constants"]]
        if values:
            found["true"] = float(np.median(values))


def is_inside(found: Mapping[str, float]) -> bool | None:
    """Whether the interval of a constant contains its truth; None without either."""
    if "true" not in found or not found["low"] < found["high"]:
        return None
    return bool(found["low"] <= found["true"] <= found["high"])


def is_outside(row: Row) -> bool:
    """Whether an interval does not contain its truth."""
    return any(is_inside(found) is False for found in row["constants"].values())


def is_wrong(row: Row) -> bool:
    """Whether the first reason names a cause that is not right: for a faultless recording, any."""
    code = row["reason"]
    if not code or OPEN.match(code):
        return False
    # Without the name of the recording, and without what else the message mentions.
    stated = re.sub(r"^(likely: )?((?!the )[^:;]*: )?", "", row["message"])
    subject = re.split(r"[;:(]", stated)[0]
    return not any(re.search(each, f"{code} {subject}", re.I) for each in row["causes"])


def half_width(found: Mapping[str, float]) -> float:
    """Return half of the interval of a constant over its value."""
    return (found["high"] - found["low"]) / 2 / abs(found.get("true", found["value"]))


def line(row: Row) -> str:
    """Return one recording as a line."""
    cells = [f"{row['name']:48s} {row['verdict']:8s}"]
    if row["verdict"] not in ("refused", "failed"):
        times = f"{row['search_s']:.1f} + {row['judgement_s']:.1f} s"
        cells.append(f"{row['status']}, {row['iterations']} iterations, {times}")
    for name, found in row["constants"].items():
        text = f"{name} {found['value']:.4g} ± {100 * half_width(found):.0f} %"
        if "true" in found:
            text += f" (true {found['true']:.4g}{', OUTSIDE' * (is_inside(found) is False)})"
        cells.append(text)
    said = row["reason"] or row.get("message", "")
    cells.append(f"{'WRONG: ' * is_wrong(row)}{said}"[:100] if said else "")
    return " | ".join(cells)


# Tables -------------------------------------------------------------------------------------------


def counts(table: Table) -> dict[str, str]:
    """Return the rows of the summary of a table, by their heads."""
    rows = [*table.values()]
    faultless = [row for row in rows if not row["mistake"]]
    mistakes = [row for row in rows if row["mistake"]]
    lines = {
        "recordings, faultless and with a mistake": f"{len(faultless)} + {len(mistakes)}",
        "faultless and good": f"{sum(row['verdict'] == 'good' for row in faultless)}",
        "good and outside": f"{len(good_and_outside(table))}",
        "mistakes with a wrong first reason": f"{len(wrong_reasons(table))}",
        "faultless with a cause named": f"{sum(map(is_wrong, faultless))}",
        "failures": f"{sum(map(is_failure, rows))}",
    }
    known = {name for row in faultless for name in row["constants"]}
    for name in [*(each for each in NAMES if each in known), *sorted(known - NAMES.keys())]:
        found = [
            row["constants"][name]
            for row in faultless
            if name in row["constants"] and is_inside(row["constants"][name]) is not None
        ]
        if found:
            inside = sum(is_inside(each) is True for each in found)
            width = np.median([half_width(each) for each in found])
            head = f"{NAMES.get(name, name)} inside, median half width"
            lines[head] = f"{inside} of {len(found)}, {100 * width:.0f} %"
    for key, head in (("search_s", "search"), ("judgement_s", "judgement")):
        lines[f"{head}, processor time"] = f"{sum(row.get(key, 0.0) for row in rows):.0f} s"
    return lines


NAMES = {
    "young_pa": "E",
    "poisson": "ν",
    "gamma_r_s": "γ_r",
    "gamma_m_1_s": "γ_m",
    "lambda_pa": "λ",
    "mu_pa": "μ",
    "bending_n_m2": "EI",
    "density_kg_m3": "ρ",
}


def is_failure(row: Row) -> bool:
    """Whether there is no answer: an exception, or a search without an end and a named mistake."""
    has_ended = row["status"] in ("converged", "acceptable", "refused")
    is_named = row["mistake"] and row["reason"] and not OPEN.match(row["reason"])
    return row["verdict"] == "failed" or not (has_ended or is_named)


def good_and_outside(table: Table) -> list[str]:
    """Return the names of recordings rated "good" with an interval that misses its truth."""
    return [n for n, row in table.items() if row["verdict"] == "good" and is_outside(row)]


def wrong_reasons(table: Table) -> list[str]:
    """Return the names of recordings with a mistake whose first reason names another cause."""
    return [name for name, row in table.items() if row["mistake"] and is_wrong(row)]


def summary(tables: Mapping[str, Table]) -> str:
    """Return shares, counts and sums of tables side by side, and the lists of the last one."""
    columns = {head: counts(table) for head, table in tables.items()}
    heads = [*dict.fromkeys(key for column in columns.values() for key in column)]
    rows = [[head, *(column.get(head, "–") for column in columns.values())] for head in heads]
    parts = [markdown(["", *columns], rows)]
    *_, table = tables.values()
    for text, names in (
        ("Good and outside", good_and_outside(table)),
        ("Wrong first reasons", wrong_reasons(table)),
        ("Failures", [name for name, row in table.items() if is_failure(row)]),
    ):
        listed = [f"- {name}: {_said(table[name])}" for name in names] or ["- none"]
        parts.append("\n".join([f"{text}:", "", *listed]))
    return "\n\n".join(parts)


def _said(row: Row) -> str:
    """Return the mistake and the first reason of a row, or what its intervals miss, in a line."""
    parts = [row["mistake"] or "faultless"]
    for name, found in row["constants"].items():
        if is_inside(found) is False:
            parts.append(f"{NAMES.get(name, name)} {found['value'] / found['true'] - 1:+.0%}")
    said = row.get("message", "") if row["verdict"] != "good" else ""
    parts += [f"“{said[:90]}{'…' * (len(said) > 90)}”"] if said else []
    return ", ".join(parts).replace("\n", " ")


def changes(before: Table, now: Table) -> str:
    """Return what changed between two tables of the same recordings."""
    lines = []
    for name in before.keys() & now.keys():
        old, new = before[name], now[name]
        for key in ("verdict", "reason"):
            if old[key] != new[key]:
                lines.append(f"{name}: {key} {old[key] or 'none'} -> {new[key] or 'none'}")
        for constant in old["constants"].keys() & new["constants"].keys():
            was, found = old["constants"][constant], new["constants"][constant]
            unit = (was["high"] - was["low"]) / 3.92
            if abs(found["value"] - was["value"]) > MOVED * unit:
                moved = (found["value"] - was["value"]) / unit
                lines.append(f"{name}: {constant} by {moved:+.2f} standard uncertainties")
            if is_inside(was) != is_inside(found):
                lines.append(f"{name}: {constant} inside {is_inside(was)} -> {is_inside(found)}")
    both = [(name, total(before[name]), total(now[name])) for name in before.keys() & now.keys()]
    sums = np.sum([each[1:] for each in both], axis=0) if both else np.zeros(2)
    lines = [*sorted(lines), f"processor time {sums[0]:.0f} s -> {sums[1]:.0f} s"]
    for name, old_s, new_s in sorted(both, key=lambda e: -abs(e[2] - e[1]))[:5]:
        lines.append(f"  {name}: {old_s:.1f} s -> {new_s:.1f} s")
    return "\n".join(lines)


def total(row: Row) -> float:
    """Return the processor time of search and judgement [s]."""
    return row.get("search_s", 0.0) + row.get("judgement_s", 0.0)


def judged(before: Table, now: Table) -> list[str]:
    """Return what is worse than before: names, and the number of intervals with their truth."""
    worse = [
        f"good and outside: {n}" for n in good_and_outside(now) if n not in good_and_outside(before)
    ]
    worse += [
        f"wrong first reason: {n}"
        for n in now
        if is_wrong(now[n]) and n in before and not is_wrong(before[n])
    ]
    worse += [
        f"failure: {n}"
        for n in now
        if is_failure(now[n]) and n in before and not is_failure(before[n])
    ]
    inside = [
        _inside(row for name, row in table.items() if name in before) for table in (before, now)
    ]
    if inside[1] < inside[0]:
        worse.append(f"inside: {inside[1]} in place of {inside[0]}")
    return worse


def _inside(rows: Iterable[Row]) -> int:
    return sum(is_inside(each) is True for row in rows for each in row["constants"].values())


# Page ---------------------------------------------------------------------------------------------


def page(tables: Mapping[str, Table]) -> str:
    """Return the page of stored tables, whose names are those of the versions."""
    (*_, (version, table)) = tables.items()
    row = next(iter(table.values()))
    columns: dict[str, Table] = {}
    for name, other in tables.items():  # older versions cannot read some recordings
        columns[name] = other
        if other.keys() != table.keys():
            columns[f"{version}, those of {name}"] = {n: table[n] for n in other if n in table}
    columns[version] = columns.pop(version)
    by_kind: dict[str, list[Row]] = defaultdict(list)
    for each in table.values():
        by_kind["/".join(each["name"].split("/")[:-1])].append(each)
    kinds = [
        [
            kind,
            *(str(sum(bool(e["mistake"]) is m for e in rows)) for m in (False, True)),
            *(_share(rows, m) for m in (False, True)),
            f"{np.median([total(e) for e in rows]):.1f}",
        ]
        for kind, rows in by_kind.items()
    ]
    heads = [
        "kind",
        "faultless",
        "mistakes",
        "faultless: good",
        "mistakes: not good",
        "median CPU s",
    ]
    return TEMPLATE.read_text(encoding="utf-8").format(
        code=row["code"],
        date=max(each["date"] for each in table.values()),
        summary=summary(columns),
        kinds=markdown(heads, kinds),
        recordings=markdown(
            [
                "recording",
                "hidden mistake",
                "verdict",
                "first reason",
                "constants over their truths",
            ],
            [_cells(each) for each in table.values()],
        ),
    )


def _share(rows: Sequence[Row], with_mistake: bool) -> str:
    chosen = [each for each in rows if bool(each["mistake"]) is with_mistake]
    good = sum(each["verdict"] == "good" for each in chosen)
    return f"{len(chosen) - good if with_mistake else good} of {len(chosen)}" if chosen else "–"


def _cells(row: Row) -> list[str]:
    found = [
        f"{NAMES.get(name, name)} {each['value'] / each['true']:.3g} ± {half_width(each):.2g}"
        + "**" * (is_inside(each) is False)
        for name, each in row["constants"].items()
        if "true" in each
    ]
    reason = f"{row['reason']}{' (wrong)' * is_wrong(row)}"
    return [row["name"], row["mistake"] or "–", row["verdict"], reason or "–", "; ".join(found)]


if __name__ == "__main__":
    main()
