"""Statistical intervals where the loss is not quadratic, towards incompressibility."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.statistics.curved_intervals import uncertainty_at, with_curved_intervals
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.probes import profile_likelihood
from collocation_sysid.statistics.uncertainty import ErrorModel, uncertainty_from_fit

T_S = 0.01 * np.arange(31)
GIVEN = ErrorModel(noise="given", errors="independent")


def swung_bar(poisson: float) -> tuple[cs.Experiment, dict]:
    """Return a swung bar of linear elements, which lock as ν approaches ½, with markers whose places
    are known to 1 mm, and its constants. Without noise, the loss at other constants is that of
    their motion alone.
    """
    body = cs.Body(cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1)), density_kg_m3=1070.0)
    share = 0.5 * (1 - np.cos(np.pi * np.clip(T_S / 0.08, 0, 1)))
    poses = np.tile(np.eye(4), (len(T_S), 1, 1))
    poses[:, 1, 3], poses[:, 2, 3] = 0.015 * share, 0.01 * share
    places_m = np.array([[0.12, 0.016, 0.008], [0.108, 0.012, 0.02], [0.07, 0.0, 0.006]])
    tracks_m = np.zeros((len(T_S), len(places_m), 3))
    markers = cs.Markers(T_S, tracks_m, 7e-4, places_m=places_m, places_sigma_m=1e-3)
    held = cs.Grasp(np.flatnonzero(body.nodes_m[:, 0] < 1e-9), poses)
    swung = cs.Experiment(body, T_S, [held], markers, nuisance=cs.Nuisance.none())
    truth = {"young_pa": 1.5e5, "poisson": poisson, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.1}
    seen_m = cs.simulate(swung, truth, "midpoint", substeps=1).markers_m
    return cs.with_markers(swung, seen_m), truth


def fit(seen: cs.Experiment, constants: dict) -> cs.Solution:
    return cs.solve(cs.Problem([seen], constants))


@pytest.mark.long
def test_intervals_towards_incompressibility_end_where_the_loss_has_risen():
    """The loss at both ends of the interval of ν, with E fitted, is that of a 95 % interval, and E
    there is at the ends of its own.
    """
    seen, truth = swung_bar(0.46)
    start = truth | {"young_pa": cs.Unknown(1.45e5), "poisson": cs.Unknown(0.455)}
    best = fit(seen, start)
    estimates = uncertainty_at(best.collocation, best.z, GIVEN).estimates
    ends = estimates["poisson"].statistical95
    of_young = estimates["young_pa"].statistical95
    assert ends
    assert of_young
    for end, other in zip(ends, reversed(of_young), strict=True):
        fixed = fit(seen, truth | {"young_pa": cs.Unknown(1.5e5), "poisson": end})
        loss = fixed.collocation.objective(fixed.z) / fixed.collocation.loss_scale
        assert np.sqrt(loss) == pytest.approx(1.96, rel=0.05)
        moved = np.log(fixed.parameters["young_pa"] / 1.5e5)
        assert np.log(other / 1.5e5) == pytest.approx(moved, rel=0.06)


def test_nothing_is_fitted_again_where_most_of_an_uncertainty_is_systematic(monkeypatch):
    seen, truth = swung_bar(0.46)
    best = fit(seen, truth | {"young_pa": cs.Unknown(1.5e5), "poisson": cs.Unknown(0.455)})
    linear = linearise_fit(best.collocation, best.z)
    known = uncertainty_from_fit(linear, best.collocation.parameters, best.q, GIVEN)
    error = known.estimates["poisson"].statistical_std_error
    assert error

    def refits(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(profile_likelihood, "Refits", refits)
    for combined in (None, {"poisson": error}):
        with pytest.raises(AssertionError):
            with_curved_intervals(known, linear, best.collocation, best.z, combined)
    same = with_curved_intervals(known, linear, best.collocation, best.z, {"poisson": 2 * error})
    assert same is known
