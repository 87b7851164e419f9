"""Precision that `check` expects of the stated cameras, of each alone, and of another one."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
from kit.filmed import NAMES, TRUTH, filming, swung, tracks_of, unknown_young

import collocation_sysid as cs
from collocation_sysid.errors import SimulationError
from collocation_sysid.methods.solve_recorder import initial_variables
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.runs import check
from collocation_sysid.runs.expected_precision import expected_deviations, views_note
from collocation_sysid.statistics.pose_noise import uncertainty_at

VISIBLE = {"front": [0, 3, 5], "top": [2, 4, 6]}


def at_truth(*names: str) -> tuple[Collocation, np.ndarray]:
    views = []
    for name in names:
        every = tracks_of(name)
        seen = VISIBLE[name]
        assert every.pixels is not None
        views.append(
            cs.ImageTracks(
                name,
                filming(name),
                every.t_s,
                every.pixels[:, seen],
                [NAMES[k] for k in seen],
                places_m=every.known_places_m[seen],
                sigma_px=0.5,
            )
        )
    parameters = unknown_young(TRUTH["young_pa"])
    collocation = cs.Problem([swung(views)], parameters=parameters).collocation()
    z, _ = initial_variables(collocation)
    return collocation, z


def expected_percent(note: str, words: str) -> float:
    found = re.search(rf"{words} E ±([\d.]+) %", note)
    assert found is not None, note
    return float(found[1])


@pytest.mark.long
def test_the_expected_interval_is_that_of_a_solve() -> None:
    collocation, z = at_truth("front")
    expected = expected_deviations(collocation, z)["young_pa"]
    (tracks,) = collocation.experiments[0].readings
    rng = np.random.default_rng(2)
    noisy = tracks.with_samples(
        tracks.t_s, tracks.measured_values + 0.5 * rng.normal(size=tracks.measured_values.shape)
    )
    solution = cs.solve(cs.Problem([swung([noisy])], parameters=unknown_young(1e5)))
    found = uncertainty_at(solution.collocation, solution.z).estimates["young_pa"]
    assert found.statistical95 is not None
    low, high = found.statistical95
    assert 1.96 * expected == pytest.approx((high - low) / 2 / found.value, rel=0.15)


@pytest.mark.long
def test_a_check_compares_one_camera_two_and_a_third_at_the_best_place() -> None:
    note = views_note(*at_truth("front", "top"))
    stated = expected_percent(note, "as stated")
    alone = [expected_percent(note, f"with '{name}' alone") for name in ("front", "top")]
    another = expected_percent(note, "around the body")
    assert another < stated < min(alone)
    assert "other systematic effects come in addition" in note


def test_markers_alone_have_no_other_views() -> None:
    parameters = unknown_young(TRUTH["young_pa"])
    collocation = cs.Problem([swung()], parameters=parameters).collocation()
    assert views_note(collocation, np.zeros(0)) == ""


def test_check_goes_on_if_what_other_views_promise_cannot_be_computed(monkeypatch):
    def singular(*_):
        raise SimulationError("singular", 0.0)

    problem, collocation = SimpleNamespace(assumed_deviations={}), SimpleNamespace(nq=1)
    known = SimpleNamespace(combinations=tuple)
    monkeypatch.setattr(check, "expected_precision", lambda *_: known)
    monkeypatch.setattr(check, "views_note", singular)
    assert check._expected_precision(problem, collocation, np.zeros(1)) == ((), [])
    monkeypatch.setattr(check, "views_note", lambda *_: "expected")
    assert check._expected_precision(problem, collocation, np.zeros(1)) == ((), ["expected"])
