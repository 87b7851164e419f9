"""Wrenches that are described wrongly are recognised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from problems_small import GUESS
from test_wrench_fit import swung

from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.recording import Wrench
from collocation_sysid.statistics.causes import likely_causes


def changed(change: Callable[[Wrench], Wrench]) -> Collocation:
    experiment = swung()
    (grasp,) = experiment.grasps
    assert grasp.wrench is not None
    wrong = replace(grasp, wrench=change(grasp.wrench))
    return Collocation([replace(experiment, grasps=[wrong])], GUESS)


def in_kilograms(wrench: Wrench) -> Wrench:
    values = np.array(wrench.values)
    values[:, :3] /= 9.80665
    return replace(wrench, values=values)


MISTAKES = {
    "wrench-sign": lambda w: replace(w, values=-w.values),
    "wrench-frame": lambda w: replace(w, frame="world"),
    "wrench-unit": in_kilograms,
    "wrench-clock": lambda w: replace(w, t_s=w.t_s + 0.04),
}


@pytest.mark.long
@pytest.mark.parametrize(("cause", "change"), MISTAKES.items(), ids=MISTAKES)
def test_a_mistake_is_the_likeliest_cause(cause: str, change: Callable[[Wrench], Wrench]):
    collocation = changed(change)
    found = likely_causes(ReducedSpace()(collocation), budget=0)
    assert found[0].cause == cause
    assert found[0].strength > 2


def test_a_wrench_that_fits_has_no_cause():
    assert not likely_causes(ReducedSpace()(changed(lambda w: w)), budget=0)
