"""Viscoelastic memory that a model lacks: its effect on the markers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from kit.problems import EDGE_M, box, nodes_where, smooth_poses, times, vertex_markers
from kit.static import block

from collocation_sysid import (
    Body,
    Collocation,
    Experiment,
    Grasp,
    Nuisance,
    Region,
    Unknown,
    simulate,
)
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.statistics.budget.consider_analysis import changed_residuals
from collocation_sysid.statistics.budget.memory_effect import is_distinguishable, supports_memory
from collocation_sysid.statistics.budget.systematic_effects import (
    ASSUMPTIONS,
    Assumptions,
    source_label,
)

VALUES = {"young_pa": 8e3, "poisson": 0.3, "gamma_r_s": 6e-3, "gamma_m_1_s": 1.0}
TAU_S = 0.1
NAME = f"memory_share τ={TAU_S:g}s"
(ROW,) = (row for row in ASSUMPTIONS if row.name == "memory_share")
# Share of the simulated memory, small enough for a linear effect.
SMALL_SHARE = 1e-4
SMALL_MEMORY = {"b.share": SMALL_SHARE, "b.tau_s": TAU_S}


def swung(samples: int = 24, **options) -> Experiment:
    """A cube hung from its top face, swayed and turned from rest; options are those of `Body`."""
    body = Body(box().mesh, density_kg_m3=60.0, **options)
    t_s = times(samples)
    grasp = Grasp(nodes_where(body, 2, EDGE_M), smooth_poses(t_s))
    markers = vertex_markers(body, nodes_where(body, 2, 0.0), t_s)
    return Experiment(body, t_s, [grasp], markers, name="cube", nuisance=Nuisance.none())


def tracks_m(experiment: Experiment, values: Mapping[str, float], scheme: str) -> np.ndarray:
    """Simulated markers (T, M, 3) [m]."""
    return simulate(experiment, values, scheme, substeps=1).markers_m


def effect_m(
    experiment: Experiment, values: Mapping[str, float] = VALUES, scheme: str = "midpoint"
) -> np.ndarray:
    """Change of the markers (T, M, 3) by a branch with the share one, to first order [m]."""
    first = next(iter(values))
    collocation = Collocation(
        [experiment], Parameters.from_mapping({**values, first: Unknown(values[first])}), scheme
    )
    x = simulate(experiment, values, scheme, substeps=1).positions_m
    z = collocation.pack(collocation.guess_p, [x.reshape(len(x), -1)])
    names, (changes,) = changed_residuals(collocation, z, [(ROW, 1.0)])
    return changes[..., names.index(NAME)] * experiment.markers.sigma_m[:, None]


YEOH = {
    "c10_pa": 1500.0,
    "c20_pa": 300.0,
    "c30_pa": 50.0,
    "kappa_pa": 6e3,
    "gamma_r_s": 6e-3,
    "gamma_m_1_s": 1.0,
}


@pytest.mark.parametrize(
    ("scheme", "changes", "options", "values"),
    [
        ("midpoint", {}, {}, VALUES),
        ("backward-euler", {}, {"element": "tet10"}, VALUES),
        ("midpoint", {}, {"material": "yeoh"}, YEOH),
        ("bdf2", {"start": "undeformed"}, {}, VALUES),
        ("bdf2", {"loaded_since_s": 0.05}, {}, VALUES),
    ],
    ids=["cube", "tet10", "yeoh", "undeformed", "loaded-before"],
)
def test_the_effect_is_that_of_a_small_share_in_a_simulation(changes, options, values, scheme):
    plain = replace(swung(**options), **changes)
    remembering = replace(swung(prony=["b"], **options), **changes)
    simulated_m = (
        tracks_m(remembering, values | SMALL_MEMORY, scheme) - tracks_m(plain, values, scheme)
    ) / SMALL_SHARE
    np.testing.assert_allclose(
        effect_m(plain, values, scheme), simulated_m, atol=2e-3 * np.abs(simulated_m).max()
    )


def test_all_regions_of_a_body_have_the_branch():
    def two_halves(**options) -> Experiment:
        mesh = box().mesh
        upper = np.flatnonzero(
            mesh.points_m[mesh.tetrahedra, 2].mean(axis=1) > mesh.points_m[:, 2].mean()
        )
        return swung(regions=[Region("upper", upper)], **options)

    simulated_m = (
        tracks_m(two_halves(prony=["b"]), VALUES | SMALL_MEMORY, "midpoint")
        - tracks_m(two_halves(), VALUES, "midpoint")
    ) / SMALL_SHARE
    np.testing.assert_allclose(
        effect_m(two_halves()), simulated_m, atol=2e-3 * np.abs(simulated_m).max()
    )


def test_memory_is_not_added_to_statics_to_memory_or_to_averaged_elements():
    assert supports_memory(swung().body, is_static=False)
    assert not supports_memory(block(), is_static=True)
    assert not supports_memory(swung(prony=["a"]).body, is_static=False)
    averaged = Body(box().mesh, element="tet10-p0", density_kg_m3=60.0)
    assert not supports_memory(averaged, is_static=False)


@pytest.mark.parametrize(
    ("tau_s", "is_shown"), [(0.005, False), (0.01, True), (0.8, True), (1.0, False)]
)
def test_a_recording_shows_times_between_its_sampling_and_its_duration(tau_s, is_shown):
    assert is_distinguishable(tau_s, 0.01, 0.8) is is_shown


def test_memory_is_in_the_budget_only_if_stated():
    assert Assumptions().memory_share == "none"
    assert source_label(NAME) == "memory share (τ = 0.1 s)"
