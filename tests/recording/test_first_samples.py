"""Experiments with their first samples."""

from __future__ import annotations

import numpy as np
from kit.problems import bar_let_go, hung_cube, measured

from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording import Experiment
from collocation_sysid.recording.measurement_selection import first_samples


def blind(experiment: Experiment, samples: int) -> Experiment:
    """No marker is seen at first."""
    tracks = experiment.markers.positions_m.copy()
    tracks[:samples] = np.nan
    return with_markers(experiment, tracks)


def test_the_first_samples_keep_everything_but_later_measurements():
    whole = measured(bar_let_go())
    cut = first_samples(whole, 6)
    np.testing.assert_array_equal(cut.t_s, whole.t_s[:6])
    np.testing.assert_array_equal(cut.markers.t_s, whole.t_s[:6])
    np.testing.assert_array_equal(cut.markers.positions_m, whole.markers.positions_m[:6])
    for name in ("name", "body", "grasps", "masses", "forces", "nuisance", "start"):
        assert getattr(cut, name) == getattr(whole, name)
    assert len(first_samples(whole, 99).t_s) == len(whole.t_s)


def test_samples_are_added_until_a_marker_is_seen():
    assert len(first_samples(blind(measured(hung_cube()), 7), 3).t_s) == 8
