"""A search that ends at a default bound continues within what is physically possible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import hung_cube

import collocation_sysid as cs
from collocation_sysid.fem.laws.constants import KNOWN, constant_named
from collocation_sysid.methods.solution import Status
from collocation_sysid.methods.starts.stiffness_scan import ScanState, TrialSimulation
from collocation_sysid.model.parameters import (
    Parameter,
    Parameters,
    can_be_widened,
    is_default_bound,
    with_widest_bounds,
)
from collocation_sysid.runs.searches import Searches
from collocation_sysid.runs.several_starts import BEYOND_BOUNDS, start_beyond_bounds
from collocation_sysid.statistics.assessment import Assessment
from collocation_sysid.statistics.concerns import Concern

UNDAMPED = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


def metal_wire(upper: float | None = None) -> cs.Solution:
    """Solution of a tensile test of a wire of 70 GPa."""
    strain = np.linspace(1e-4, 2e-3, 12)
    noise = np.random.default_rng(1).standard_normal(len(strain))
    specimen = cs.Specimen("uniaxial", strain, 70e9 * strain + 1e5 * noise, 1e5)
    return cs.solve(
        cs.Problem(
            [specimen.experiment("neo-hookean", "wire")],
            {"young_pa": cs.Unknown(upper=upper), "poisson": 0.33, **UNDAMPED},
        )
    )


def test_the_modulus_of_a_metal_is_found_beyond_the_default_bound():
    solution = metal_wire()
    assert solution.status.converged
    assert solution.parameters["young_pa"] == pytest.approx(70e9, rel=0.01)
    assert any("beyond the default bound of 1e+09 Pa" in note for note in solution.notes)


def test_a_stated_bound_is_kept():
    solution = metal_wire(upper=5e8)
    assert solution.parameters["young_pa"] == pytest.approx(5e8)
    assert start_beyond_bounds(solution) is None


def test_a_search_beyond_a_bound_that_does_not_converge_is_made_and_reported_once():
    at_bound = replace(metal_wire(upper=1e9), notes=())
    parameters = at_bound.collocation.parameters
    free = parameters.map_components(lambda item: replace(item, stated_bounds=(False, False)))
    at_bound = replace(at_bound, collocation=at_bound.collocation.with_parameters(free))
    searches = []

    def diverging(collocation, watch, start):
        searches.append(collocation.parameters.guesses["young_pa"])
        better = replace(at_bound.history[-1], loss=0.5 * at_bound.history[-1].loss)
        return replace(at_bound, status=Status.STALLED, history=(better,))

    kept = Searches(diverging).continued(at_bound, BEYOND_BOUNDS)
    assert len(searches) == 1
    assert len(kept.notes) == 1
    assert "did not converge" in kept.notes[0]


def test_the_ratio_of_an_auxetic_foam_is_found_below_the_default_bound():
    strain = np.linspace(0.01, 0.1, 10)
    random = np.random.default_rng(2)
    specimen = cs.Specimen(
        "uniaxial",
        strain,
        2e4 * strain + 5 * random.standard_normal(10),
        5.0,
        lateral_stretch=1 + 0.2 * strain + 1e-4 * random.standard_normal(10),
        lateral_sigma=1e-4,
    )
    solution = cs.solve(
        cs.Problem(
            [specimen.experiment("neo-hookean", "foam")],
            {"young_pa": cs.Unknown(), "poisson": cs.Unknown(), **UNDAMPED},
        )
    )
    assert solution.status.converged
    assert solution.parameters["poisson"] == pytest.approx(-0.2, abs=0.03)


def test_a_physical_limit_is_no_default_bound():
    share = Parameter("b.share", 0.1, 0.0, 20.0, scale="linear", unit=0.1)
    assert is_default_bound(share, 20.0)
    assert not is_default_bound(share, 0.0)


def test_a_stated_bound_that_equals_the_default_is_no_default_bound():
    (least, most) = constant_named("poisson").bounds
    for lower, upper, expected in ((None, None, True), (least, None, False), (None, most, True)):
        stated = cs.Unknown(0.2, lower, upper)
        (item,) = Parameters.from_mapping({"poisson": stated}).scalars
        assert is_default_bound(item, least) is expected


def test_elements_that_lock_keep_the_upper_bound_of_the_ratio():
    cube = hung_cube()
    truth = {"young_pa": 600.0, "poisson": 0.495, "gamma_r_s": 0.01, "gamma_m_1_s": 1.0}
    tracks_m = cs.simulate(cube, truth, "midpoint", substeps=1).markers_m
    statements = {**truth, "poisson": cs.Unknown(0.49499)}
    solution = cs.solve(cs.Problem([cs.with_markers(cube, tracks_m)], statements))
    assert solution.parameters["poisson"] == pytest.approx(0.495, abs=1e-4)
    assert start_beyond_bounds(solution) is None


def test_a_default_bound_is_the_first_reason_with_the_gravest_grade():
    concerns = Assessment.from_concerns(
        [
            Concern("solve/acceptable"),
            Concern("solve/no-error-bars", "doubtful"),
            Concern("information/default-bound", data={"names": ["young_pa"]}),
        ]
    ).concerns
    assert [each.code for each in concerns] == [
        "information/default-bound",
        "solve/no-error-bars",
        "solve/acceptable",
    ]
    assert concerns[0].grade == "doubtful"


def shaken_beam(young_pa: float) -> cs.Experiment:
    """Beam of 0.2 m and 4 mm with a density of 2700 kg/m³ that is shaken at its end at 60 Hz; the
    first mode of aluminium has 80 Hz.
    """
    body = cs.Body(
        cs.box_mesh((0.2, 0.02, 0.004), (4, 1, 1)), density_kg_m3=2700.0, element="tet10"
    )
    t_s = 1e-3 * np.arange(40)
    shift_m = 1e-3 * (1 - np.cos(2 * np.pi * 60 * t_s))
    hand = cs.PoseSequence(t_s, np.outer(shift_m, [0, 0, 1.0]), np.tile([0, 0, 0, 1.0], (40, 1)))
    grasp = cs.Grasp(cs.Box((-1, -1, -1), (1e-6, 1, 1)), hand)
    places_m = [[0.2, 0.01, 0.0], [0.1, 0.01, 0.0]]
    unseen = cs.Markers(t_s, np.zeros((40, 2, 3)), 2e-5, places_m=places_m)
    beam = cs.Experiment(
        body, t_s, [grasp], unseen, nuisance=cs.Nuisance.none(), air_density_kg_m3="none"
    )
    truth = {"young_pa": young_pa, "poisson": 0.3, "gamma_r_s": 1e-5, "gamma_m_1_s": 1.0}
    tracks_m = cs.simulate(beam, truth, "midpoint", substeps=1).markers_m
    noise_m = 2e-5 * np.random.default_rng(3).standard_normal(tracks_m.shape)
    return cs.with_markers(beam, tracks_m + noise_m)


BEAM = {"poisson": 0.3, "gamma_r_s": 1e-5, "gamma_m_1_s": 1.0}


@pytest.mark.long
@pytest.mark.parametrize("young_pa", [7e10, 2e10])
@pytest.mark.parametrize("guess", [None, 3e10])
def test_a_metal_beam_is_found_from_its_frequency(young_pa, guess):
    problem = cs.Problem(
        [shaken_beam(young_pa)], BEAM | {"young_pa": cs.Unknown(guess)}, substeps=1
    )
    solution = cs.solve(problem)
    assert solution.status.converged
    assert solution.parameters["young_pa"] == pytest.approx(young_pa, rel=0.01)


@pytest.mark.parametrize(
    ("misfit", "least", "most"),
    [
        (lambda young: 2 + 1e4 / young, 1e7, 3e7),  # moves ever more like a rigid body
        (lambda young: 60 - 1e-10 * young, 5e10, 5e11),  # metal: soft ones move alike
        (lambda young: 1.2 - 1e-10 * young, 1e7, 1e7),  # nothing is left to explain
    ],
)
def test_a_scan_continues_where_stiffer_bodies_fit_ever_better(misfit, least, most):
    class Trial:
        def evaluate_at(self, young_pa, _):
            return (misfit(young_pa), []) if young_pa < 2e11 else (np.nan, None)

        bounds_pa = (0.0, np.inf)

    state = ScanState(Trial())  # pyright: ignore[reportArgumentType]
    for young_pa in (2.5e6, 5e6, 1e7):
        state.misfits[young_pa] = misfit(young_pa)
    state.extend_range(1e7, 2.0)
    assert least <= max(state.misfits) <= most


@pytest.mark.parametrize(("rigid_pa", "stiffest"), [(1e14, 1e12), (3e9, 7.2e9)])
def test_a_scan_passes_local_minima_while_stiffer_bodies_move_otherwise(rigid_pa, stiffest):
    # Misfit of a vibrating steel ruler.
    misfits = {
        1.39e9: 50.4, 3.16e9: 50.0, 7.2e9: 53.0, 1.64e10: 59.5, 3.73e10: 52.0, 8.48e10: 26.5,
        1.93e11: 2.4, 4.39e11: 37.5, 1e12: np.nan,
    }  # fmt: skip

    class Ruler:
        bounds_pa = (0.0, np.inf)

        def evaluate_at(self, young_pa, _):
            nearest = min(misfits, key=lambda each: abs(np.log(each / young_pa)))
            return misfits[nearest], [np.array([young_pa])]

        def differ(self, positions, others):
            return min(*positions[0], *others[0]) < rigid_pa

    state = ScanState(Ruler())  # pyright: ignore[reportArgumentType]
    factor = 10 ** (5 / 14)
    for young_pa in (1.39e9 / factor, 1.39e9):
        state.misfits[young_pa] = 51.6 if young_pa < 1e9 else 50.4
        state.last_trajectories = [np.array([young_pa])]
    state.extend_range(1.39e9, factor)
    assert max(state.misfits) == pytest.approx(stiffest, rel=0.02)


@pytest.mark.long
def test_motions_differ_by_more_than_the_noise():
    unknown = {"young_pa": cs.Unknown(lower=1.0, upper=1e13)}
    problem = cs.Problem([shaken_beam(7e10)], BEAM | unknown, substeps=1)
    trial = TrialSimulation(problem.collocation())
    flexible, metal, rigid, more_rigid = (
        trial.evaluate_at(young_pa, None)[1] or [] for young_pa in (1e10, 2e10, 4e12, 8e12)
    )
    assert trial.differ(flexible, metal)
    assert not trial.differ(rigid, more_rigid)


@pytest.mark.parametrize("guess", [2e11, 0.01])
def test_a_guess_beyond_a_default_bound_replaces_the_bound(guess):
    (item,) = Parameters.from_mapping({"young_pa": cs.Unknown(guess)}).scalars
    assert item.lower < guess < item.upper
    with pytest.raises(cs.InputError, match="expected a value within"):
        Parameters.from_mapping({"young_pa": cs.Unknown(2e11, upper=1e10)})


def relaxing(material: str, branches: dict[str, tuple[float, float]]) -> cs.Run:
    """Run of a specimen that is stretched by 2 % in 0.2 s and relaxes to zero, with the moduli [Pa]
    and times [s] of its branches.
    """
    times_s = np.linspace(0.0, 6.0, 61)
    strain = np.minimum(times_s / 0.2, 1) * 0.02
    stress_pa = 0.5 * np.random.default_rng(4).standard_normal(len(times_s))
    for modulus_pa, tau_s in branches.values():
        since_s = np.clip(times_s - 0.2, 0.0, None)
        ramp = 1 - np.exp(-np.minimum(times_s, 0.2) / tau_s)
        stress_pa += modulus_pa * 0.1 * tau_s * ramp * np.exp(-since_s / tau_s)
    specimen = cs.Specimen("uniaxial", strain, stress_pa, 0.5, t_s=times_s)
    unknown = {f"{n}.{key}": cs.Unknown() for n in branches for key in ("share", "tau_s")}
    if len(branches) > 1:
        unknown |= {f"{n}.tau_s": cs.Unknown(1.3 * tau_s) for n, (_, tau_s) in branches.items()}
    problem = cs.Problem(
        [specimen.experiment(material, "hold", prony=tuple(branches))],
        {"young_pa": cs.Unknown(), "poisson": 0.4999, **unknown, **UNDAMPED},
    )
    return cs.run(problem)


@pytest.mark.slow
def test_the_instantaneous_modulus_of_a_liquid_has_an_interval():
    run = relaxing("linear", {"b": (1e5, 1.0)})
    low, high = run.interval("instantaneous_young_pa")
    assert low < 1e5 < high < 1.2 * low
    assert run.parameters["b.tau_s"] == pytest.approx(1.0, rel=0.01)
    assert "as that of a liquid" in run.trust.reasons[0]
    assert run.estimates["young_pa"].combined95 is None
    assert not any("young_pa is not determined" in note for note in run.all_notes)
    assert "E₀" in str(run)


@pytest.mark.slow
def test_a_liquid_with_two_relaxation_times():
    run = relaxing("linear", {"a": (6e4, 0.5), "b": (4e4, 3.0)})
    low, high = run.interval("instantaneous_young_pa")
    assert low < 1e5 < high < 1.3 * low
    assert run.parameters["young_pa"] < 100  # of which the noise leaves some Pa


# Bounds of other constants ------------------------------------------------------------------------

STRAIN = np.linspace(-0.25, 0.4, 14)


def noise_pa(values_pa, share=1e-3):
    random = np.random.default_rng(5).standard_normal(len(values_pa))
    sigma_pa = share * np.abs(values_pa).max()
    return values_pa + sigma_pa * random, sigma_pa


def fitted(law, tests, unknown, **keys) -> cs.Solution:
    """Solution of tests, each a kind with strains and stresses, without other mistakes."""
    experiments = []
    for test, (strain, stress_pa) in tests.items():
        measured_pa, sigma_pa = noise_pa(stress_pa)
        specimen = cs.Specimen(
            test, strain, measured_pa, sigma_pa, strain_zero=0.0, area_error=0.0, **keys
        )
        prony = ("b",) if "b.tau_s" in unknown else ()
        experiments.append(specimen.experiment(law, test, prony=prony))
    return cs.solve(cs.Problem(experiments, unknown | UNDAMPED))


def assert_continued(solution, **truth):
    assert solution.status.converged
    assert any("beyond the default bound" in n or "default bound" in n for n in solution.notes)
    for name, value in truth.items():
        assert solution.parameters[name] == pytest.approx(value, rel=0.03), name


def test_the_bulk_modulus_of_glass_is_found_beyond_the_default_bound():
    strain = np.linspace(-2e-3, -1e-4, 12)  # of lengths, a third of that of the volume
    tests = {"volumetric": (strain, 3 * 5e10 * strain)}
    solution = fitted("neo-hookean", tests, {"kappa_pa": cs.Unknown(), "mu_pa": 3e10})
    assert_continued(solution, kappa_pa=5e10)


def test_a_negative_factor_of_the_second_invariant_is_found():
    stretch = 1 + STRAIN
    c10_pa, c01_pa = 2e5, -2e4
    tests = {
        "uniaxial": (STRAIN, 2 * (stretch - stretch**-2) * (c10_pa + c01_pa / stretch)),
        "equibiaxial": (
            STRAIN[6:],
            2 * (stretch - stretch**-5)[6:] * (c10_pa + c01_pa * stretch[6:] ** 2),
        ),
    }
    unknown = {"c10_pa": cs.Unknown(), "c01_pa": cs.Unknown(), "kappa_pa": 1e9}
    assert_continued(fitted("mooney-rivlin", tests, unknown), c10_pa=c10_pa, c01_pa=c01_pa)


@pytest.mark.long
@pytest.mark.parametrize("alpha", [45.0, -38.0])
def test_a_large_exponent_is_found_beyond_the_default_bound(alpha):
    """Ogden's law of a soft tissue that stiffens within a tenth of its length."""
    stretch = np.linspace(0.9, 1.12, 30)
    mu_pa = 2e3 / alpha
    stress_pa = mu_pa * (stretch ** (alpha - 1) - stretch ** (-alpha / 2 - 1))
    unknown = {"mu_1_pa": cs.Unknown(), "alpha_1": cs.Unknown(), "poisson": 0.4999}
    solution = fitted("ogden-1", {"uniaxial": (stretch - 1, stress_pa)}, unknown)
    assert solution.status.converged
    assert solution.parameters["alpha_1"] == pytest.approx(alpha, rel=0.02)
    assert solution.parameters["mu_1_pa"] == pytest.approx(mu_pa, rel=0.05)


@pytest.mark.long
def test_a_negative_first_exponent_is_found_where_the_closed_forms_are_not():
    """Ogden's law of brain, with a branch of memory that is known."""
    stretch = 1 + STRAIN
    alpha, mu_pa = -8.0, -250.0
    stress_pa = mu_pa * (stretch ** (alpha - 1) - stretch ** (-alpha / 2 - 1))
    unknown = {"mu_1_pa": cs.Unknown(), "alpha_1": cs.Unknown(), "kappa_pa": 1e7}
    unknown |= {"b.share": 1e-9, "b.tau_s": 1.0}
    solution = fitted("ogden-1", {"uniaxial": (STRAIN, stress_pa)}, unknown)
    assert_continued(solution, alpha_1=alpha, mu_1_pa=mu_pa)


@pytest.mark.long
def test_a_long_relaxation_time_is_found_beyond_the_default_bound():
    times_s = np.linspace(0.0, 2e4, 60)
    strain = np.minimum(times_s / 340.0, 1) * 0.02
    since_s = np.clip(times_s - 340.0, 0.0, None)
    ramp = 6e3 / 340.0 * (1 - np.exp(-np.minimum(times_s, 340.0) / 6e3))
    stress_pa = 1e5 * strain + 1e5 * 0.02 * ramp * np.exp(-since_s / 6e3)
    unknown = {"young_pa": cs.Unknown(), "poisson": 0.4999}
    unknown |= {"b.share": cs.Unknown(), "b.tau_s": cs.Unknown()}
    solution = fitted("linear", {"uniaxial": (strain, stress_pa)}, unknown, t_s=times_s)
    assert_continued(solution, young_pa=1e5, **{"b.tau_s": 6e3, "b.share": 1.0})


@pytest.mark.parametrize("name", sorted(KNOWN))
def test_a_bound_that_nobody_stated_is_widened_or_named_first(name):
    constant = KNOWN[name]
    item = Parameter(
        name,
        constant.usual or 1.0,
        *constant.bounds,
        scale=constant.scale,
        unit=constant.typical or 1.0,
    )
    for side in (0, 1):
        value = constant.bounds[side]
        is_limit = constant.widest is not None and constant.widest[side] == value
        assert is_default_bound(item, value) is not is_limit
        if constant.widest is not None and not is_limit:
            assert can_be_widened(item, value)
            assert not can_be_widened(with_widest_bounds(item), constant.widest[side])
            assert is_default_bound(with_widest_bounds(item), constant.widest[side])


@pytest.mark.parametrize("name", ["c01_pa", "lambda_pa", "mu_1_pa"])
def test_a_negative_guess_is_possible_where_the_constant_may_be_negative(name):
    (item,) = Parameters.from_mapping({name: cs.Unknown(-2e4)}).scalars
    assert item.scale == "linear"
    assert item.lower < -2e4
    with pytest.raises(cs.InputError):
        Parameters.from_mapping({"c10_pa": cs.Unknown(-2e4)})
