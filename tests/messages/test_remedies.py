"""The remedies of messages about tables of material tests, followed mechanically: the next answer is
right, or the next message leads to it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.recording.specimen_files import specimen_strains

STRAIN = np.linspace(0.05, 0.8, 12)
PA = 1e5 * (1 + STRAIN - (1 + STRAIN) ** -2)
AREA_M2 = 4e-5
LENGTH_M = 0.02
# What a person knows who follows a remedy that asks for it.
KNOWN = {"area_m2": AREA_M2, "length_m": LENGTH_M}
TEXT = """[object]
material = "neo-hookean"
[parameters]
mu_pa = {}
kappa_pa = 1e9
[[experiment]]
name = "pull"
kind = "specimen"
file = "pull.csv"
"""
MOST_STEPS = 3


@dataclass(frozen=True)
class Table:
    """Table of a test with its keys, as a person may have written them."""

    header: tuple[str, ...]
    columns: tuple[np.ndarray, ...]
    keys: tuple[str, ...] = ('test = "uniaxial"', "sigma_pa = 500")
    factor: float = 1.0  # to the SI unit that a message asks for

    def read(self, folder) -> cs.Experiment:
        rows = np.column_stack(self.columns)
        lines = [",".join(self.header), *(",".join(f"{x:.12g}" for x in row) for row in rows)]
        (folder / "pull.csv").write_text("\n".join(lines))
        (folder / "problem.toml").write_text(TEXT + "\n".join(self.keys))
        (experiment,) = cs.Problem.read(folder / "problem.toml").experiments
        return experiment

    def with_key(self, key: str) -> Table:
        name = key.partition(" =")[0]
        return replace(self, keys=(*(k for k in self.keys if k.partition(" =")[0] != name), key))

    def renamed(self, column: str, name: str, factor: float = 1.0) -> Table:
        place = self.header.index(column)
        header = [name if k == place else each for k, each in enumerate(self.header)]
        columns = [factor * c if k == place else c for k, c in enumerate(self.columns)]
        return replace(self, header=tuple(header), columns=tuple(columns))


def remedied(table: Table, message: str) -> Iterator[Table]:
    """The table after each remedy that a message offers."""
    if found := re.search(
        r"column (.+?) has the unit .*convert its values, then call it (\S+)", message
    ):
        yield table.renamed(found[1], found[2], factor=table.factor)
    elif found := re.search(r"column (.+?) names no unit; .*for example (.+)$", message):
        yield table.renamed(found[1], found[2])
    elif found := re.search(r'call the column "?([^",]+)"?', message):
        word = found[1].split()[0]
        like = [each for each in table.header if each.startswith(("strain", "stretch"))]
        assert len(like) == 1, word
        yield table.renamed(like[0], found[1])
    elif found := re.search(r"(\w+): unknown key; did you mean '(\w+)'", message):
        keys = (each.replace(f"{found[1]} =", f"{found[2]} =") for each in table.keys)
        yield replace(table, keys=tuple(keys))
    elif found := re.search(r"columns has the key '(\w+)'.*did you mean '(\w+)'", message):
        yield replace(
            table, keys=tuple(k.replace(f"{found[1]} =", f"{found[2]} =") for k in table.keys)
        )
    elif found := re.search(
        r"columns.\w+ is '(.+?)', which does not exist.*did you mean '(.+?)'", message
    ):
        yield replace(table, keys=tuple(each.replace(found[1], found[2]) for each in table.keys))
    elif statements := re.findall(r"(columns = \{[^}]*\})(?: with (\w+))?", message):
        for statement, size in statements:
            stated = table.with_key(statement)
            yield stated.with_key(f"{size} = {KNOWN[size]}") if size else stated
    elif both := re.findall(r"(\w+_sign = -1) and (\w+_sign = -1)", message):
        yield table.with_key(both[0][0]).with_key(both[0][1])
    elif found := re.search(r"but not (\w+); expected \1", message):
        yield table.with_key(f"{found[1]} = {KNOWN[found[1]]}")
    elif found := re.search(r'or (stress = "true")', message):
        yield table.with_key(found[1])
    elif found := re.search(r"expected exactly one of (\w+), (\w+)", message):
        for name in found.groups():
            yield replace(table, keys=tuple(k for k in table.keys if not k.startswith(name)))


def assert_remedies_lead_to_the_truth(table: Table, folder, strain, stress_pa, steps=MOST_STEPS):
    """Follow every remedy of every message; what is read is right."""
    message = ""
    try:
        experiment = table.read(folder)
    except cs.InputError as fault:
        message = str(fault)
    if message:
        offered = list(remedied(table, message))
        assert steps, f"after {MOST_STEPS} remedies: {message}"
        assert offered, f"no remedy in: {message}"
        for each in offered:
            assert_remedies_lead_to_the_truth(each, folder, strain, stress_pa, steps - 1)
        return
    np.testing.assert_allclose(specimen_strains(experiment)[0], strain, rtol=1e-6)
    measured_pa = experiment.readings[0].measured_values[:, 0]
    np.testing.assert_allclose(measured_pa, stress_pa, rtol=1e-6)


PERCENT = 100 * STRAIN
CASES = {
    "percent as a ratio": Table(("strain (-)", "stress (kPa)"), (PERCENT, PA / 1e3)),
    "percent without unit": Table(("strain", "stress (kPa)"), (PERCENT, PA / 1e3)),
    "ratio without unit": Table(("strain", "stress (kPa)"), (STRAIN, PA / 1e3)),
    "stress without unit": Table(("strain (%)", "stress"), (PERCENT, PA)),
    "neither has a unit": Table(("strain", "stress"), (STRAIN, PA)),
    "stress per square inch": Table(
        ("strain (%)", "stress (N/in2)"), (PERCENT, PA * 0.0254**2), factor=0.0254**-2
    ),
    "kilograms": Table(
        ("strain (%)", "force (kg)"),
        (PERCENT, PA * AREA_M2 / 9.80665),
        factor=9.80665,
        keys=('test = "uniaxial"', "sigma_pa = 500", f"area_m2 = {AREA_M2}"),
    ),
    "kilograms without area": Table(
        ("strain (%)", "force (kg)"), (PERCENT, PA * AREA_M2 / 9.80665), factor=9.80665
    ),
    "miles": Table(
        ("extension (mile)", "stress (kPa)"),
        (LENGTH_M * STRAIN / 1609.344, PA / 1e3),
        factor=1609.344,
    ),
    "force without area": Table(("strain (%)", "force (N)"), (PERCENT, PA * AREA_M2)),
    "displacement without length": Table(
        ("extension (mm)", "stress (kPa)"), (1e3 * LENGTH_M * STRAIN, PA / 1e3)
    ),
    "neither length nor area": Table(
        ("extension (mm)", "force (N)"), (1e3 * LENGTH_M * STRAIN, PA * AREA_M2)
    ),
    "true stress": Table(("strain (%)", "true stress (kPa)"), (PERCENT, PA * (1 + STRAIN) / 1e3)),
    "two strains": Table(
        ("crosshead (mm)", "strain (%)", "stress (kPa)"),
        (1e3 * LENGTH_M * STRAIN, PERCENT, PA / 1e3),
    ),
    "unknown key": Table(
        ("strain (%)", "stress (kPa)"),
        (PERCENT, PA / 1e3),
        keys=('test = "uniaxial"', "sigma_pa = 500", "strainsign = 1"),
    ),
    "unknown quantity": Table(
        ("strain (%)", "stress (kPa)"),
        (PERCENT, PA / 1e3),
        keys=(
            'test = "uniaxial"',
            "sigma_pa = 500",
            'columns = { stres = "stress (kPa)", strain = "strain (%)" }',
        ),
    ),
    "column that is not there": Table(
        ("strain (%)", "Load cell (kPa)"),
        (PERCENT, PA / 1e3),
        keys=(
            'test = "uniaxial"',
            "sigma_pa = 500",
            'columns = { stress = "Load cel (kPa)", strain = "strain (%)" }',
        ),
    ),
    "two noises": Table(
        ("strain (%)", "stress (kPa)"),
        (PERCENT, PA / 1e3),
        keys=('test = "uniaxial"', "sigma_pa = 500", "sigma_n = 0.02", f"area_m2 = {AREA_M2}"),
    ),
}


@pytest.mark.parametrize("table", CASES.values(), ids=CASES)
def test_followed_remedies_lead_to_the_truth(tmp_path, table):
    with pytest.raises(cs.InputError):
        table.read(tmp_path)
    assert_remedies_lead_to_the_truth(table, tmp_path, STRAIN, PA)


def test_signs_of_a_confined_test_are_corrected_by_the_remedy(tmp_path):
    keys = ('test = "confined"', "sigma_pa = 500")
    table = Table(("strain (%)", "stress (kPa)"), (PERCENT / 4, PA / 1e3), keys=keys)
    assert_remedies_lead_to_the_truth(table, tmp_path, -STRAIN / 4, -PA)


def test_strains_that_are_stretches_are_corrected_by_the_remedy(tmp_path):
    strain, stress_pa = np.append(0.0, STRAIN), np.append(0.0, PA)
    table = Table(("strain (-)", "stress (kPa)"), (1 + strain, stress_pa / 1e3))
    assert_remedies_lead_to_the_truth(table, tmp_path, strain, stress_pa)


def test_columns_that_are_not_read_are_noted(tmp_path):
    header = ("strain (%)", "stress (kPa)", "second stress (kPa)", "cycle")
    Table(header, (PERCENT, PA / 1e3, PA / 1e3, 0 * PA)).read(tmp_path)
    (note,) = cs.Problem.read(tmp_path / "problem.toml").notes
    assert "this column is not read: second stress (kPa)" in note
