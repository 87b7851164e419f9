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
from collocation_sysid.fem.two_phase import ElementLogarithms, PhaseSummary, TwoPhaseModes
from collocation_sysid.runs.phase_posterior import ContrastPrior, ElementSurrogate
from collocation_sysid.runs.two_phases import (
    _linearise_at,
    _representative_phases,
    _two_phase_search,
    solve_two_phases,
)
from collocation_sysid.statistics.curved_intervals import uncertainty_at
from collocation_sysid.statistics.field_estimates import (
    FieldEstimate,
    field_estimates,
    phase_concerns,
)
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.phase_sampling import (
    ElementInformation,
    InternalFaces,
    SamplerSettings,
    initial_phases,
    sample_phases,
)
from collocation_sysid.statistics.potts_prior import PottsConstants, PottsHyperprior

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
    markers = replace(point_markers(body, places, t_s), sigma_m=np.full(len(places), SIGMA_M))
    return cs.Experiment(body, t_s, [grasp], markers, nuisance=IDEAL)


@cache
def problem(ratio: float, seed: int = 5) -> cs.Problem:
    """A bar whose lower half is stiffer, which no description tells; noise by its seed."""
    values = {**KNOWN, "young_pa": YOUNG_PA, "stiff.young_pa": ratio * YOUNG_PA}
    tracks = cs.simulate(swung(bar(stiff=lower_half())), values, "midpoint", substeps=1).markers_m
    noise = SIGMA_M * np.random.default_rng(seed).normal(size=tracks.shape)
    measured = cs.with_markers(swung(bar(TWO_PHASES)), tracks + noise)
    return cs.Problem([measured], {**KNOWN, "young_pa": cs.Unknown(0.7 * YOUNG_PA)}, substeps=1)


@cache
def answer(ratio: float) -> cs.Solution:
    solution = cs.solve(problem(ratio))
    assert solution.status.converged
    return solution


def field_of(solution: cs.Solution) -> FieldEstimate:
    known = uncertainty_at(solution.collocation, solution.z)
    body = solution.collocation.transcriptions[0].body
    (field,) = field_estimates(body, solution.collocation.parameters, solution.q, known)
    return field


@pytest.mark.long
def test_a_stiff_half_has_its_boundary_and_its_contrast():
    solution = answer(3.0)
    field = field_of(solution)
    assert isinstance(field.modes, TwoPhaseModes)
    estimate = uncertainty_at(solution.collocation, solution.z).estimates["contrast"]
    low, high = estimate.statistical95
    assert low < 3.0 < high
    assert high / low < 2.0
    truth = np.log(YOUNG_PA * np.where(lower_half(), 3.0, 1.0))
    lower, upper = np.log(field.statistical95)
    held = (lower < truth) & (truth < upper)
    assert held[lower_half()].mean() >= 0.9
    assert (field.modes.phase == lower_half()).mean() >= 0.9
    # The half of a coarse mesh has too few elements to rely on intervals.
    codes = [concern.code for concern in field.list_concerns()]
    assert codes == ["field/few"]
    assert any("two phases of young_pa: started from a smooth field" in n for n in solution.notes)


@pytest.mark.long
def test_intervals_of_several_recordings_contain_the_truth():
    covered_inside = []
    covered = []
    contrasts = []
    truth = np.log(YOUNG_PA * np.where(lower_half(), 3.0, 1.0))
    for seed in range(4):
        solution = cs.solve(problem(3.0, seed))
        known = uncertainty_at(solution.collocation, solution.z)
        low, high = known.estimates["contrast"].statistical95
        contrasts.append(low < 3.0 < high)
        lower, upper = np.log(field_of(solution).statistical95)
        is_covered = (lower < truth) & (truth < upper)
        covered_inside.append(is_covered[lower_half()].mean())
        covered.append(is_covered.mean())
    assert sum(contrasts) >= 3
    assert np.mean(covered_inside) >= 0.9
    assert np.mean(covered) >= 0.9


@pytest.mark.long
def test_a_given_contrast_determines_the_phases():
    given = cs.Problem(
        problem(3.0).experiments,
        {**KNOWN, "young_pa": cs.Unknown(0.7 * YOUNG_PA), "contrast": 3.0},
        substeps=1,
    )
    solution = cs.solve(given)
    assert solution.status.converged
    field = field_of(solution)
    assert field.phases is not None
    np.testing.assert_allclose(field.phases.contrast, 3.0, rtol=1e-4)
    assert (field.modes.phase == lower_half()).mean() >= 0.9
    lower, upper = np.log(field.statistical95)
    truth = np.log(YOUNG_PA * np.where(lower_half(), 3.0, 1.0))
    assert np.mean((lower < truth) & (truth < upper)) >= 0.9


@pytest.mark.long
def test_an_even_body_shows_no_second_material():
    field = field_of(answer(1.0))
    assert "field/one-phase" in [concern.code for concern in field.list_concerns()]
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
    (samples,) = body.list_phase_samples()
    more = replace(samples, deviations=samples.deviations + 0.04 * np.eye(len(samples.names)))
    (field,) = (part.field for part in body.parts)
    wider = body.with_fields({"young_pa": replace(field, samples=more)})
    experiments = [replace(e, body=wider) for e in solution.collocation.experiments]
    collocation = replace(solution.collocation, experiments=experiments)
    before, after = (
        uncertainty_at(each, solution.z).covariance for each in (solution.collocation, collocation)
    )
    place = [item.name for item in collocation.parameters.free].index("contrast")
    assert after[place, place] - before[place, place] == pytest.approx(0.04, rel=1e-6)


@pytest.mark.parametrize("by_elements", [False, True])
def test_slopes_by_the_contrast_and_by_elements_are_those_of_differences(by_elements: bool, rng):
    body = bar(TWO_PHASES)
    field = replace(body.parts[0].field, phase=lower_half().astype(float))
    if by_elements:
        field = ElementLogarithms.relative_to(field, rng.normal(size=len(field.phase)))
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
        mean=0.3,
    )
    row = np.arange(5)
    return data, InternalFaces(np.column_stack([row, row + 1]), np.ones(5), 6)


def test_samples_are_of_the_posterior_that_enumeration_gives(rng):
    data, faces = small_posterior(rng)
    settings = SamplerSettings(least_steps=3000, steps_per_sample=5)
    strength = np.full(settings.chains, 0.5)
    field = np.full(settings.chains, 0.2)
    draws = sample_phases(
        data,
        faces,
        np.array([1.0, 1, 0, 0, 0, 0]),
        settings=settings,
        constants=PottsConstants(strength, element_nats=field),
    )
    logarithms, means, labels = [], [], []
    constant = data.score_z - data.of_z @ data.base
    for label in product([0.0, 1.0], repeat=6):
        h = np.array(label)
        coupling = data.mixed.T @ h
        own = h @ data.of_z @ h + 1 / data.deviation**2
        information = np.block([[data.of_p, coupling[:, None]], [coupling, np.array([[own]])]])
        of_s = h @ constant - data.mean / data.deviation**2
        score = np.r_[data.score_p - data.mixed.T @ data.base, of_s]
        mean = -np.linalg.solve(information, score)
        jumps = np.abs(np.diff(h)).sum()
        logarithms.append(
            -(score @ mean + np.linalg.slogdet(information)[1]) / 2 - 0.5 * jumps + 0.2 * h.sum()
        )
        means.append(mean[-1])
        labels.append(h)
    weights = np.exp(np.array(logarithms) - max(logarithms))
    weights /= weights.sum()
    np.testing.assert_allclose(draws.probability, weights @ np.array(labels), atol=0.03)
    expected = weights @ np.array(means)
    assert draws.means.mean() == pytest.approx(expected, abs=0.05)
    assert draws.contrasts.mean() == pytest.approx(expected, abs=0.08)
    assert draws.scale_reduction < 1.1


def surrogate_at(ratio: float, phase: np.ndarray, exponent: float) -> ElementSurrogate:
    """The bar's residuals, linearised at given phases and the true parameters."""
    modes = problem(3.0).find_two_phase_fields()["young_pa"]
    base = np.log(ratio) * phase
    known = problem(3.0).with_fields({"young_pa": ElementLogarithms.relative_to(modes, base)})
    collocation = known.collocation()
    values = {"young_pa": np.log(YOUNG_PA)}
    p = [values.get(item.name, 0.0) for item in collocation.parameters.free]
    body = bar()
    return ElementSurrogate.linearise(
        collocation,
        np.array(p),
        element_names=[f"field_{k + 1}" for k in range(len(phase))],
        base=base,
        faces=InternalFaces.from_mesh(body.mesh, np.arange(len(phase))),
        prior=ContrastPrior(0.0, deviation=1.0),
        exponent=exponent,
    )


def test_simulated_samples_correct_the_linearised_residuals():
    truth = lower_half().astype(float)
    surrogate = surrogate_at(2.0, truth, exponent=0.0)
    at_base = surrogate.simulate_errors(surrogate.base[None], changes=np.zeros((1, 1)))
    assert np.abs(at_base.errors(0.5)).max() < 1e-6
    assert at_base.corrected_surrogate() is surrogate
    phases = np.tile(truth, (5, 1))
    phases[np.arange(5), np.flatnonzero(truth)[:5]] = 0.0
    samples = surrogate.simulate_errors(np.log(3.5) * phases, changes=np.zeros((5, 1)))
    corrected = samples.corrected_surrogate()
    before = (samples.errors(0.0) ** 2).sum()
    errors = samples.errors(corrected.exponent)
    assert (errors**2).sum() < 0.3 * before
    model = corrected.errors
    np.testing.assert_allclose(model.mean, errors.mean(axis=0))
    np.testing.assert_allclose(
        model.roots @ model.roots.T @ errors[0],
        np.cov(errors.T, bias=False) @ errors[0],
        atol=1e-9 * np.abs(errors).max() ** 3,
    )
    # The errors' covariance reduces the information, their mean changes the score.
    plain = replace(corrected, errors=surrogate.errors).information()
    with_errors = corrected.information()
    lost = np.linalg.eigvalsh(plain.of_z - with_errors.of_z)
    assert lost[-1] > 1e-3 * np.abs(plain.of_z).max()
    assert lost[0] > -1e-8 * np.abs(plain.of_z).max()


def test_normal_equations_by_a_power_are_those_of_differences():
    truth = lower_half().astype(float)
    surrogate = surrogate_at(2.0, truth, exponent=0.6)
    information = surrogate.information()
    element = int(np.flatnonzero(truth)[3])
    step = 1e-5
    chi_squared = []
    for sign in (-1.0, 1.0):
        powers = information.base.copy()
        powers[element] += sign * step
        (residual,) = surrogate.simulate_errors(
            surrogate.to_logarithm(powers)[None], changes=np.zeros((1, 1))
        ).residuals
        chi_squared.append(residual @ residual)
    slope = (chi_squared[1] - chi_squared[0]) / (4 * step)
    assert information.score_z[element] == pytest.approx(slope, rel=1e-3)


def test_elements_are_linearised_at_the_smooth_field():
    search = _two_phase_search(problem(3.0))
    smooth = cs.solve(problem(3.0).with_fields({search.name: search.modes.to_smooth_field()}))
    surrogate = _linearise_at(problem(3.0), search, solution=smooth)
    fit = linearise_fit(smooth.collocation, smooth.z)
    assert surrogate.fit.chi_squared == pytest.approx(fit.chi_squared, rel=1e-6)
    assert np.abs(surrogate.base).max() > 0.1


def test_representative_phases_have_the_mean_volume():
    probability = np.array([0.9, 0.3, 0.8, 0.3, 0.3, 0.4, 0.0, 0.0])
    phase = _representative_phases(probability, np.ones(8))
    np.testing.assert_array_equal(phase, [1, 0, 1, 0, 0, 1, 0, 0])
    none = _representative_phases(np.zeros(8), np.ones(8))
    assert none.sum() == 2


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
    starts = initial_phases(data, faces, mesh.volumes_m3)
    assert (starts[0] == block).mean() > 0.98
    volumes_m3 = starts @ mesh.volumes_m3
    assert volumes_m3[1] == pytest.approx(volumes_m3[0] / 2, rel=0.1)
    assert volumes_m3[-1] == pytest.approx(2 * volumes_m3[0], rel=0.1)


def test_constants_of_the_potts_prior_follow_from_the_phases(rng):
    balance = rng.normal(size=(2, 20_000))
    face_nats = np.array([1.2, 0.4])
    element_nats = np.array([-0.7, 0.5])
    logits = face_nats[:, None] * balance + element_nats[:, None]
    phases = (rng.random(balance.shape) < 1 / (1 + np.exp(-logits))).astype(float)
    start = PottsConstants(np.full(2, 1.5), element_nats=np.zeros(2))
    drawn = PottsHyperprior().draw(phases, balance, start, rng=rng)
    np.testing.assert_allclose(drawn.face_nats, face_nats, atol=0.12)
    np.testing.assert_allclose(drawn.element_nats, element_nats, atol=0.12)


def summary(**changes) -> PhaseSummary:
    """A two-phase field that gives no concern, with changes."""
    fields = {
        "contrast": (2.0, 2.5, 3.0),
        "volume_m3": (1e-6, 2e-6, 3e-6),
        "deviation": 0.5,
        "misfit": 1.05,
        "smooth_misfit": 1.01,
        "elements": 80,
    }
    return PhaseSummary(**(fields | changes))


def test_two_phases_that_are_found_are_no_concern():
    assert not phase_concerns(summary(), "young_pa")


@pytest.mark.parametrize(
    ("changes", "code", "message"),
    [
        ({"misfit": 1.6}, "field/phases", "more than two materials"),
        ({"scale_reduction": 1.8}, "field/narrow", "scale reduction of the"),
        ({"is_simulated": False}, "field/linear", "could not be simulated"),
        ({"contrast": (0.8, 1.2, 1.6)}, "field/one-phase", "contains 1"),
    ],
)
def test_doubts_about_two_phases_are_concerns(changes: dict, code: str, message: str):
    (concern,) = phase_concerns(summary(**changes), "young_pa")
    assert concern.code == code
    assert message in concern.message


def test_an_inclusion_of_few_elements_is_a_concern():
    (concern,) = phase_concerns(summary(elements=12), "young_pa")
    assert concern.code == "field/few"
    assert "only 12 elements" in concern.message


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"parameter": "density_kg_m3"}, "expected prior = 'smooth', or regions with densities"),
        ({"length_m": (0.02, 0.05)}, "length_m of a two-phase field has 2 values; expected one"),
        ({"prior": "three-phase"}, "prior of a field is 'three-phase'"),
    ],
)
def test_a_two_phase_field_that_cannot_be_is_refused(stated: dict, message: str):
    with pytest.raises(cs.InputError, match=message):
        bar(cs.Field(**({"length_m": 0.05, "modes": 4, "prior": "two-phase"} | stated)))


def test_two_fields_of_two_phases_are_refused():
    few = cs.Field(0.05, modes=3, prior="two-phase")
    core = cs.Region("core", np.arange(12), field=few)
    body = Body(bar().mesh, density_kg_m3=100.0, field=TWO_PHASES, regions=[core])
    both = cs.Problem([swung(body)], {**KNOWN, "young_pa": cs.Unknown(YOUNG_PA)}, substeps=1)
    with pytest.raises(cs.InputError, match=r"2 two-phase fields \(young_pa, core.young_pa\)"):
        solve_two_phases(both, None, lambda *_, **__: pytest.fail("solved"))


def test_live_refuses_phases_that_nobody_knows_yet():
    with pytest.raises(cs.InputError, match="phases of young_pa are unknown"):
        LiveEstimator(problem(3.0))


def test_a_contrast_that_is_not_stated_has_the_prior_of_its_field():
    (contrast,) = (i for i in problem(3.0).parameters.free if i.name == "contrast")
    assert contrast.prior == (1.0, 1.0)
    stated = {**KNOWN, "young_pa": 1e4, "contrast": cs.Unknown(2.0, lower=1.0)}
    given = cs.Problem([swung(bar(TWO_PHASES))], stated, substeps=1).parameters
    (contrast,) = (i for i in given.free if i.name == "contrast")
    assert (contrast.guess, contrast.lower, contrast.prior) == (2.0, 1.0, (1.0, 1.0))


def test_a_finer_mesh_has_the_same_phases():
    field = replace(bar(TWO_PHASES).parts[0].field, phase=lower_half().astype(float))
    finer = refine_body(bar(TWO_PHASES).with_fields({"young_pa": field}))
    np.testing.assert_array_equal(finer.parts[0].field.phase, np.repeat(field.phase, 8))


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
