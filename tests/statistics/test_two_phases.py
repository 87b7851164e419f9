"""Two materials with a sharp boundary: phases, contrast, and bodies without a boundary."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
from kit.checks import assert_derivative
from kit.problems import IDEAL, point_markers, smooth_poses, times

import collocation_sysid as cs
from collocation_sysid.extras.live.estimator import LiveEstimator
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.refinement import refine_body
from collocation_sysid.fem.two_phase import (
    ElementLogarithms,
    PhaseSummary,
    TwoPhaseModes,
)
from collocation_sysid.runs.two_phases import solve_two_phases
from collocation_sysid.statistics.field_estimates import (
    FieldEstimate,
    field_estimates,
    phase_concerns,
)
from collocation_sysid.statistics.phase_sampling import (
    ElementInformation,
    InternalFaces,
    SamplerSettings,
    initial_phases,
    sample_phases,
)
from collocation_sysid.statistics.uncertainty import uncertainty_at

SIZE_M, SIGMA_M, YOUNG_PA = (0.04, 0.04, 0.12), 1e-4, 4e3
KNOWN = {"poisson": 0.3, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.1}
TWO_PHASES = cs.Field(0.05, modes=12, prior="two-phase")


def bar(field: cs.Field | None = None, stiff: np.ndarray | None = None) -> Body:
    regions = [] if stiff is None else [cs.Region("stiff", stiff)]
    mesh = cs.box_mesh(SIZE_M, (1, 1, 6))
    return Body(mesh, density_kg_m3=100.0, field=field, regions=regions)


def lower_half() -> np.ndarray:
    body = bar()
    return body.mesh.points_m[body.mesh.tetrahedra].mean(axis=1)[:, 2] < 0.06


def swung(body: Body, steps: int = 12) -> cs.Experiment:
    """The bar, held at its top, with markers at all nodes of its surface."""
    t_s = times(steps)
    x = body.nodes_m
    places = x[x[:, 2] < 0.119]
    grasp = cs.Grasp(np.flatnonzero(x[:, 2] > 0.119), smooth_poses(t_s))
    markers = replace(
        point_markers(body, places, t_s), sigma_m=np.full(len(places), SIGMA_M)
    )
    return cs.Experiment(body, t_s, [grasp], markers, nuisance=IDEAL)


@cache
def problem(ratio: float) -> cs.Problem:
    """A bar whose lower half is stiffer, which no description tells."""
    values = {**KNOWN, "young_pa": YOUNG_PA, "stiff.young_pa": ratio * YOUNG_PA}
    tracks = cs.simulate(
        swung(bar(stiff=lower_half())), values, "midpoint", substeps=1
    ).markers_m
    noise = SIGMA_M * np.random.default_rng(5).normal(size=tracks.shape)
    measured = cs.with_markers(swung(bar(TWO_PHASES)), tracks + noise)
    return cs.Problem(
        [measured],
        {**KNOWN, "young_pa": cs.Unknown(0.7 * YOUNG_PA)},
        substeps=1,
    )


@cache
def answer(ratio: float) -> cs.Solution:
    solution = cs.solve(problem(ratio))
    assert solution.status.converged
    return solution


def field_of(solution: cs.Solution) -> FieldEstimate:
    known = uncertainty_at(solution.collocation, solution.z)
    body = solution.collocation.transcriptions[0].body
    (field,) = field_estimates(
        body, solution.collocation.parameters, solution.q, known
    )
    return field


@pytest.mark.long
def test_a_stiff_half_has_its_boundary_and_its_contrast():
    solution = answer(3.0)
    field = field_of(solution)
    assert isinstance(field.modes, TwoPhaseModes)
    estimate = uncertainty_at(solution.collocation, solution.z).estimates[
        "contrast"
    ]
    low, high = estimate.statistical95
    assert low < 3.0 < high
    assert high / low < 2.0
    truth = np.log(YOUNG_PA * np.where(lower_half(), 3.0, 1.0))
    lower, upper = np.log(field.statistical95)
    held = (lower < truth) & (truth < upper)
    assert held[lower_half()].mean() >= 0.9
    assert (field.modes.phase == lower_half()).mean() >= 0.9
    # The half of a coarse mesh has too few elements to rely on intervals.
    codes = [concern.code for concern in field.concerns]
    assert codes == ["field/narrow", "field/few"]
    assert any(
        "two phases of young_pa: started from a smooth field" in n
        for n in solution.notes
    )


@pytest.mark.long
def test_an_even_body_shows_no_second_material():
    field = field_of(answer(1.0))
    assert "field/one-phase" in [concern.code for concern in field.concerns]
    low, high = np.log(field.statistical95)
    assert np.mean((low < np.log(YOUNG_PA)) & (np.log(YOUNG_PA) < high)) >= 0.9


@pytest.mark.parametrize("method", [cs.InteriorPoint()], ids=type)
def test_other_methods_find_the_same_contrast(method):
    body = answer(3.0).collocation.transcriptions[0].body
    (field,) = (part.field for part in body.parts)
    known = problem(3.0).with_fields({"young_pa": field})
    solution = cs.solve(known, method)
    assert solution.status.converged
    for name, value in answer(3.0).parameters.items():
        assert solution.parameters[name] == pytest.approx(value, rel=1e-3)


def test_unknown_phases_widen_the_interval_of_the_contrast():
    solution = answer(3.0)
    body = solution.collocation.transcriptions[0].body
    (samples,) = body.phase_samples
    more = replace(
        samples,
        deviations=samples.deviations + 0.04 * np.eye(len(samples.names)),
    )
    (field,) = (part.field for part in body.parts)
    wider = body.with_fields({"young_pa": replace(field, samples=more)})
    experiments = [
        replace(e, body=wider) for e in solution.collocation.experiments
    ]
    collocation = replace(solution.collocation, experiments=experiments)
    before, after = (
        uncertainty_at(each, solution.z).covariance
        for each in (solution.collocation, collocation)
    )
    place = [item.name for item in collocation.parameters.free].index(
        "contrast"
    )
    assert after[place, place] - before[place, place] == pytest.approx(
        0.04, rel=1e-6
    )


@pytest.mark.parametrize("by_elements", [False, True])
def test_slopes_by_the_contrast_and_by_elements_are_those_of_differences(
    by_elements: bool, rng
):
    body = bar(TWO_PHASES)
    field = replace(body.parts[0].field, phase=lower_half().astype(float))
    if by_elements:
        field = ElementLogarithms.relative_to(
            field, rng.normal(size=len(field.phase))
        )
    own = body.with_fields({"young_pa": field})
    count = len(field.constants)
    x = body.nodes_m + 1e-3 * rng.normal(size=body.nodes_m.shape)
    v = rng.normal(size=x.shape)
    w = rng.normal(size=x.shape)
    theta = own.theta_from_values({**KNOWN, "young_pa": YOUNG_PA})
    theta[-count:] = 1 + 0.3 * rng.normal(size=count)
    steps = 0.1 * (np.arange(len(theta)) >= len(theta) - count)
    by_theta = own.linearise(x, v, theta).by_theta[0]
    by_both = own.second_derivatives(x, v, w, theta).theta_theta[0]

    def force(at: np.ndarray) -> np.ndarray:
        return own.force(x, v, at)[0]

    def slope(at: np.ndarray) -> np.ndarray:
        return own.second_derivatives(x, v, w, at).theta[0]

    assert_derivative(force, lambda d: by_theta @ d, theta, rng, scale=steps)
    assert_derivative(slope, lambda d: by_both @ d, theta, rng, scale=steps)


def small_posterior(rng) -> tuple[ElementInformation, InternalFaces]:
    """Six elements in a row, and two parameters."""
    slopes = rng.normal(size=(12, 8))
    slopes[:, 2:] *= 0.6
    residual = rng.normal(size=12)
    of_p = slopes[:, :2]
    of_z = slopes[:, 2:]
    data = ElementInformation(
        of_p=of_p.T @ of_p,
        mixed=of_z.T @ of_p,
        of_z=of_z.T @ of_z,
        score_p=of_p.T @ residual,
        score_z=of_z.T @ residual,
        base=0.2 * rng.normal(size=6),
        deviation=1.0,
    )
    row = np.arange(5)
    return data, InternalFaces(np.column_stack([row, row + 1]), np.ones(5), 6)


@pytest.mark.long
def test_samples_are_of_the_posterior_that_enumeration_gives(rng):
    data, faces = small_posterior(rng)
    settings = SamplerSettings(
        face_nats=0.5, least_steps=6000, steps_per_sample=5
    )
    draws = sample_phases(data, faces, np.array([1.0, 1, 0, 0, 0, 0]), settings)
    logarithms, means, labels = [], [], []
    constant = data.score_z - data.of_z @ data.base
    for label in product([0.0, 1.0], repeat=6):
        h = np.array(label)
        coupling = data.mixed.T @ h
        own = h @ data.of_z @ h + 1 / data.deviation**2
        information = np.block(
            [[data.of_p, coupling[:, None]], [coupling, np.array([[own]])]]
        )
        score = np.r_[data.score_p - data.mixed.T @ data.base, h @ constant]
        mean = -np.linalg.solve(information, score)
        jumps = np.abs(np.diff(h)).sum()
        logarithms.append(
            -(score @ mean + np.linalg.slogdet(information)[1]) / 2
            - 0.5 * jumps
        )
        means.append(mean[-1])
        labels.append(h)
    weights = np.exp(np.array(logarithms) - max(logarithms))
    weights /= weights.sum()
    np.testing.assert_allclose(
        draws.probability, weights @ np.array(labels), atol=0.09
    )
    assert draws.contrasts.mean() == pytest.approx(
        weights @ np.array(means), abs=0.12
    )


def test_the_start_finds_a_block_in_values_that_are_measured_one_by_one(rng):
    mesh = cs.box_mesh((0.04, 0.04, 0.04), (4, 4, 4))
    faces = InternalFaces.from_mesh(mesh, np.arange(len(mesh.tetrahedra)))
    assert 2 * len(faces.pairs) + len(mesh.surface) == 4 * len(mesh.tetrahedra)
    block = (mesh.points_m[mesh.tetrahedra].mean(axis=1) < 0.02).all(axis=1)
    count = len(block)
    measured = np.log(3.0) * block + 0.2 * rng.normal(size=count)
    data = ElementInformation(
        of_p=np.array([[count / 0.04]]),
        mixed=np.full((count, 1), 1 / 0.04),
        of_z=np.eye(count) / 0.04,
        score_p=np.array([-measured.sum() / 0.04]),
        score_z=-measured / 0.04,
        base=np.zeros(count),
        deviation=1.0,
    )
    found = initial_phases(data, faces, mesh.volumes_m3)
    assert (found == block).mean() > 0.98


def test_a_third_material_is_a_concern():
    phases = PhaseSummary(
        (2.0, 2.5, 3.0), (1e-6, 2e-6, 3e-6), 0.5, 1.6, 1.01, 80
    )
    _, concern = phase_concerns(phases, "young_pa")
    assert concern.code == "field/phases"
    assert "more than two materials" in concern.message


def test_intervals_of_two_phases_are_always_a_concern():
    phases = PhaseSummary(
        (2.0, 2.5, 3.0), (1e-6, 2e-6, 3e-6), 0.5, 1.05, 1.01, 80
    )
    (concern,) = phase_concerns(phases, "young_pa")
    assert concern.code == "field/narrow"


def test_an_inclusion_of_few_elements_is_a_concern():
    phases = PhaseSummary(
        (1.7, 1.9, 2.1), (1e-6, 2e-6, 3e-6), 0.3, 1.0, 1.0, 12
    )
    _, concern = phase_concerns(phases, "young_pa")
    assert concern.code == "field/few"
    assert "only 12 elements" in concern.message


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        (
            {"parameter": "density_kg_m3"},
            "expected 'smooth', or regions with densities",
        ),
        (
            {"length_m": (0.02, 0.05)},
            "length_m of a two-phase field has 2 values; expected one",
        ),
        ({"prior": "three-phase"}, "prior of a field is 'three-phase'"),
    ],
)
def test_a_two_phase_field_that_cannot_be_is_refused(
    stated: dict, message: str
):
    with pytest.raises(cs.InputError, match=message):
        bar(
            cs.Field(
                **(
                    {"length_m": 0.05, "modes": 4, "prior": "two-phase"}
                    | stated
                )
            )
        )


def test_two_fields_of_two_phases_are_refused():
    few = cs.Field(0.05, modes=3, prior="two-phase")
    core = cs.Region("core", np.arange(12), field=few)
    body = Body(
        bar().mesh, density_kg_m3=100.0, field=TWO_PHASES, regions=[core]
    )
    both = cs.Problem(
        [swung(body)], {**KNOWN, "young_pa": cs.Unknown(YOUNG_PA)}, substeps=1
    )
    with pytest.raises(
        cs.InputError, match=r"2 two-phase fields \(young_pa, core.young_pa\)"
    ):
        solve_two_phases(both, None, lambda *_, **__: pytest.fail("solved"))


def test_live_refuses_phases_that_nobody_knows_yet():
    with pytest.raises(cs.InputError, match="phases of young_pa are unknown"):
        LiveEstimator(problem(3.0))


def test_a_contrast_that_is_not_stated_has_the_prior_of_its_field():
    (contrast,) = (
        i for i in problem(3.0).parameters.free if i.name == "contrast"
    )
    assert contrast.prior == (1.0, 1.0)
    stated = {**KNOWN, "young_pa": 1e4, "contrast": cs.Unknown(2.0, lower=1.0)}
    given = cs.Problem([swung(bar(TWO_PHASES))], stated, substeps=1).parameters
    (contrast,) = (i for i in given.free if i.name == "contrast")
    assert (contrast.guess, contrast.lower, contrast.prior) == (
        2.0,
        1.0,
        (1.0, 1.0),
    )


def test_a_finer_mesh_has_the_same_phases():
    field = replace(
        bar(TWO_PHASES).parts[0].field, phase=lower_half().astype(float)
    )
    finer = refine_body(bar(TWO_PHASES).with_fields({"young_pa": field}))
    np.testing.assert_array_equal(
        finer.parts[0].field.phase, np.repeat(field.phase, 8)
    )


@pytest.mark.long
def test_a_run_reports_the_contrast_with_its_intervals(tmp_path):
    run = cs.run(problem(3.0), seek_causes=False)
    assert "two phases, contrast" in str(run)
    assert "contrast" in run.estimates
    run.save(tmp_path / "run", frames=False)
    result = type(run.result).read(tmp_path / "run")
    phases = result.fields["young_pa"].phases
    assert phases is not None
    assert phases.contrast[0] < 3.0 < phases.contrast[2]
