"""The scripts of the gallery run, and their assertions hold."""

from __future__ import annotations

import runpy
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest
from kit.published_curves import FOLDER, write_curves

GALLERY = Path(__file__).parents[2] / "docs" / "gallery"
SCRIPTS = sorted(GALLERY.glob("*/[0-9]_*.py"))
# Their causes of a misfit take refits.
LONG = ("4_late_clock", "3_memory")


def test_the_gallery_opens_with_the_first_identification_and_its_picture():
    first = SCRIPTS[0].read_text()
    assert first.startswith('"""\nWhat is this block made of?\n')
    assert "\nrun.plot(" in first


@pytest.mark.long
@pytest.mark.parametrize(
    "script",
    [
        pytest.param(script, id=script.stem, marks=[pytest.mark.slow] * (script.stem in LONG))
        for script in SCRIPTS
    ],
)
def test_a_script_of_the_gallery_runs_and_draws_a_picture(script, tmp_path, monkeypatch):
    run_and_draw(script, tmp_path, monkeypatch)


@pytest.mark.long
@pytest.mark.skipif(FOLDER is None, reason="the curves are not present")
@pytest.mark.parametrize("name", ["measured_brain", "measured_silicone"])
def test_a_script_with_published_curves_runs_and_draws_a_picture(name, tmp_path, monkeypatch):
    monkeypatch.setenv("COLLOCATION_SYSID_DATA", str(tmp_path))
    write_curves(tmp_path / "hyperelastic_curves" / "data.h5")
    run_and_draw(GALLERY / "2_own_data" / f"{name}.py", tmp_path, monkeypatch)


def run_and_draw(script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    drawn = []
    monkeypatch.setattr(plt, "show", lambda: drawn.append(plt.gcf()))
    try:
        runpy.run_path(str(script))
    finally:
        plt.close("all")
    assert len(drawn) == 1
    assert drawn[0].axes
