"""Times of specimens whose law does not depend on them."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs

STRETCH = np.linspace(1.0, 1.5, 30)
MEMORY = '[object]\n[[object.prony]]\nname = "slow"\n'
TIMES = [f"{0.1 * k:.1f}" for k in range(30)]


def problem(folder, times, keys="", top="[object]", constants=""):
    rows = (
        f"{t},{stretch - 1:.5f},{2e4 * (stretch - stretch**-2.0):.3f}"
        for t, stretch in zip(times, STRETCH, strict=True)
    )
    (folder / "pull.csv").write_text("time (s),strain (-),stress (Pa)\n" + "\n".join(rows) + "\n")
    (folder / "problem.toml").write_text(
        f"{top}\n[parameters]\nyoung_pa = {{}}\npoisson = 0.499\n{constants}\n"
        '[[experiment]]\nname = "pull"\nkind = "specimen"\ntest = "uniaxial"\nfile = "pull.csv"\n'
        f"sigma_pa = 100.0\n{keys}\n"
    )
    return cs.Problem.read(folder / "problem.toml")


@pytest.mark.parametrize("wrong", ["2.0", "2.8O", "", "nan"])
def test_times_that_are_not_in_order_are_a_note(tmp_path, wrong):
    read = problem(tmp_path, [*TIMES[:28], wrong, "2.9"])
    (experiment,) = read.experiments
    np.testing.assert_array_equal(experiment.t_s, np.arange(30.0))
    assert any("times are not in order (line 30" in note for note in read.notes)


def test_a_window_ends_before_times_that_are_not_in_order(tmp_path):
    read = problem(tmp_path, [*TIMES[:28], "2.0", "2.1"], keys="window_s = [0.5, 2.05]")
    (experiment,) = read.experiments
    np.testing.assert_allclose(experiment.t_s, np.arange(5, 21) / 10)
    assert any("16 of 30 rows are used" in note for note in read.notes)


def test_times_of_a_material_with_memory_increase(tmp_path):
    constants = "slow.share = {}\nslow.tau_s = {}"
    with pytest.raises(cs.InputError, match=r"line 30: t_s = 2 follows 2\.7; time must increase"):
        problem(tmp_path, [*TIMES[:28], "2.0", "2.1"], top=MEMORY, constants=constants)
