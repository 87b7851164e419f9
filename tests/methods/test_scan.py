"""Solves without a guess: the stiffness scan, and replacement of a useless guess."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.filmed import TRUTH as FILMED
from kit.filmed import filming, swung, tracks_of
from kit.problems import (
    GUESS,
    TRUTH,
    hung_cube,
    measured,
    measured_with,
    point_markers,
    relative_errors,
)
from kit.static import block
from kit.wrenches import sensed, sensing, wristed_cube
from rendered_video import TRUTH as VIDEO
from scipy.spatial.transform import Rotation

from collocation_sysid import (
    Body,
    CrossSection,
    Experiment,
    Grasp,
    InputError,
    Markers,
    Nuisance,
    Obstacle,
    Plane,
    PointMass,
    PoseSequence,
    Problem,
    ReducedSpace,
    Region,
    Solution,
    Specimen,
    Status,
    Tied,
    Unknown,
    rod_mesh,
    run,
    simulate,
    solve,
)
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.methods.starts.initial_trajectories import associated_at_guess
from collocation_sysid.methods.starts.start import Start
from collocation_sysid.methods.starts.stiffness_scan import (
    CLEARLY_BETTER,
    SOFT_PA,
    ScanState,
    TrialSimulation,
    scan_stiffness,
    start_problem,
    typical_parameters,
    without_guesses,
)
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.problem.new import create_problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import with_markers, with_wrenches
from collocation_sysid.runs.searches import Searches
from collocation_sysid.runs.several_starts import of_scan

NOTHING = {name: Unknown() for name in TRUTH}
# Of λ = 200 Pa and μ = 300 Pa.
YOUNG_PA = 300.0 * (3 * 200.0 + 2 * 300.0) / (200.0 + 300.0)


@cache
def swung_cube():
    return measured(hung_cube(30))


def cube(given=NOTHING, **options) -> Problem:
    return Problem([swung_cube()], given, **options)


def guessed(**changes: float) -> Parameters:
    """The usual guesses of the tests, some of them changed, in wide bounds."""
    items = (replace(item, lower=1e-5, upper=1e6) for item in GUESS.items)
    return Parameters(tuple(items)).with_guess(changes)


# The scan


@cache
def scanned():
    return scan_stiffness(cube().collocation())


def test_the_scan_finds_the_stiffness():
    assert YOUNG_PA / 3 < scanned().young_pa[scanned().best] < 3 * YOUNG_PA
    assert scanned().misfit[scanned().best] == np.nanmin(scanned().misfit)
    assert scanned().misfit[-1] > 3 * scanned().misfit[scanned().best]


def test_the_scan_goes_from_stiff_to_soft_and_ends_where_the_body_is_lost():
    young_pa, misfit = scanned().young_pa, scanned().misfit
    assert (np.diff(young_pa) > 0).all()
    assert young_pa[-1] == pytest.approx(1e7)
    lost = ~(misfit[:2] <= 3 * np.nanmin(misfit))
    assert lost.all() or young_pa[0] == pytest.approx(1e2)


def test_the_scan_starts_from_usual_values():
    values = scanned().parameters.guesses
    young_pa = scanned().young_pa[scanned().best]
    assert values["mu_pa"] == pytest.approx(young_pa / 2.6)
    assert values["lambda_pa"] == pytest.approx(1.5 * values["mu_pa"])
    assert (values["gamma_r_s"], values["gamma_m_1_s"]) == pytest.approx((0.003, 0.3))


def test_a_guess_that_is_given_is_used():
    given = {**NOTHING, "lambda_pa": Unknown(333.0), "gamma_r_s": 0.009}
    found = scan_stiffness(cube(given).collocation()).parameters
    assert found.guesses["lambda_pa"] == 333.0
    assert found.guesses["gamma_r_s"] == 0.009
    assert [item.name for item in found.free] == ["lambda_pa", "mu_pa", "gamma_m_1_s"]


def test_the_scan_stays_within_bounds():
    given = {name: Unknown(lower=200.0, upper=2e3) for name in ("lambda_pa", "mu_pa")}
    found = scan_stiffness(cube({**NOTHING, **given}).collocation())
    for value in (found.parameters.guesses["lambda_pa"], found.parameters.guesses["mu_pa"]):
        assert 200.0 <= value <= 2e3
    assert 2 <= len(found.young_pa) < 8  # of 15
    assert 500.0 < found.young_pa[0] < found.young_pa[-1] < 5.3e3
    narrow = {name: Unknown(lower=290.0, upper=310.0) for name in ("lambda_pa", "mu_pa")}
    (start_pa,) = scan_stiffness(cube({**NOTHING, **narrow}).collocation()).young_pa
    assert start_pa == pytest.approx(2.6 * 300.0, rel=0.3)


def test_a_stated_bound_is_no_start():
    for item in (
        Parameter("mu_pa", None, 1e3, 1e6),
        Parameter("mu_pa", None, 1e3, 2e3),
        Parameter("offset_n", None, 1e3, 1e6, scale="linear", unit=1e2),
    ):
        for value in (10.0, 1e9):
            assert item.lower * 1.05 < item.within_bounds(value) < item.upper / 1.00005
        middle = (item.lower * item.upper) ** 0.5
        assert item.within_bounds(middle) == middle


def test_an_error_of_the_pose_is_not_fitted_by_a_soft_body():
    wrong = filming("front").pose.copy()
    wrong[:3, :3] = wrong[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, 0.02]).as_matrix()
    wrong[:3, 3] += [0.0, 0.0, 0.005]
    tracks = tracks_of(rng=np.random.default_rng(1), camera=filming("front", pose=wrong))
    film = swung([tracks])
    found = scan_stiffness(Problem([film], FILMED | {"young_pa": Unknown()}).collocation())
    assert FILMED["young_pa"] / 2 < found.young_pa[found.best] < 2 * FILMED["young_pa"]
    assert found.misfit[found.best] < 2.0


def test_two_cameras_may_have_different_points():
    rng = np.random.default_rng(1)
    films = []
    for name, seen in (("front", slice(4)), ("top", slice(4, None))):
        tracks = tracks_of(name, rng, known=False)
        assert tracks.pixels is not None
        pixels = np.array(tracks.pixels)[:, seen]
        films.append(replace(tracks, names=tracks.names[seen], pixels=pixels, places_m=None))
    guessed_at = Problem([swung(films)], {**FILMED, "young_pa": Unknown(1.5e5)}).collocation()
    (placed,) = associated_at_guess(guessed_at).transcriptions
    assert [len(each.names) for each in placed.residuals if each.names] == [4, 3]


@pytest.mark.long
def test_the_scan_of_the_video_example_finds_its_stiffness(tmp_path):
    file, *_ = create_problem(tmp_path / "bar", "video")
    found = scan_stiffness(Problem.read(file).collocation())
    assert VIDEO["young_pa"] / 2 < found.young_pa[found.best] < 2 * VIDEO["young_pa"]
    soft = found.misfit[found.young_pa < VIDEO["young_pa"] / 4]
    assert (np.isnan(soft) | (soft > 2 * found.misfit[found.best])).all()


def test_an_answer_with_an_unlikely_error_is_none_while_other_starts_are_not_searched():
    turned = measured(hung_cube(30, nuisance=Nuisance.none(hand_eye_rad=0.05)))
    collocation = Problem([turned], TRUTH | {"mu_pa": Unknown()}).collocation()
    scan = scan_stiffness(collocation)
    other = scan.best + 1
    starts = {**scan.starts, other: scan.parameters.with_guess({"mu_pa": 200.0})}
    scan = replace(scan, others=(other,), starts=starts)
    start = Start(collocation.with_parameters(scan.parameters), scan=scan)
    likely = ReducedSpace()(associated_at_guess(start.collocation))
    p, positions_m = likely.collocation.unpack(likely.z)
    unlikely_p = np.where(np.arange(len(p)) == collocation.nq, 5.0, p)
    unlikely = replace(likely, z=likely.collocation.pack(unlikely_p, positions_m))
    better = replace(likely, history=(replace(likely.history[-1], loss=-1.0),))
    answers = [unlikely, better]

    def answer(*_: object) -> Solution:
        return answers.pop(0)

    searches = Searches(answer)
    solution = searches.continued(searches.once(start), of_scan(start))
    assert not answers
    assert solution.z is likely.z
    assert solution.scan is not None
    assert solution.scan.best == other
    answers = [likely]
    solution = searches.continued(searches.once(start), of_scan(start))
    assert solution.z is likely.z


def test_an_error_of_the_pose_in_the_grasp_is_not_fitted_by_the_stiffness():
    cube = hung_cube(30, nuisance=Nuisance.none(hand_eye_rad=0.05, hand_eye_m=0.01))
    made = measured(cube)
    turn = Rotation.from_rotvec([0.05, 0.0, 0.0])
    turned = turn.apply(np.array(made.markers.positions_m).reshape(-1, 3)) + np.array(
        [0.0, 0.01, 0.0]
    )
    off = with_markers(made, turned.reshape(made.markers.positions_m.shape))
    trial = TrialSimulation(Problem([off], guessed(**TRUTH)).collocation())
    right, _ = trial.evaluate_guess(is_complete=False)
    stated = replace(off, nuisance=Nuisance.none())
    exact = TrialSimulation(Problem([stated], guessed(**TRUTH)).collocation())
    assert right < 0.1 * exact.evaluate_guess(is_complete=False)[0]


def test_a_prior_is_the_start():
    given = {**NOTHING, "gamma_r_s": Unknown(prior=(0.02, 0.5))}
    assert typical_parameters(Parameters.from_mapping(given), 1e3).guesses["gamma_r_s"] == 0.02


def test_several_regions_are_scaled_together():
    body = Body(
        box_mesh((0.1, 0.1, 0.1), (2, 2, 2)),
        "mooney-rivlin",
        density_kg_m3=30.0,
        regions=[Region("core", Box((0, 0, 0), (0.1, 0.1, 0.05)), "yeoh")],
    )
    names = ("c10_pa", "c01_pa", "kappa_pa", "core.c10_pa", "core.c20_pa", "core.c30_pa")
    parameters = Parameters.from_mapping(
        {name: Unknown() for name in (*names, "core.poisson", "gamma_r_s")}
        | {"gamma_m_1_s": 1.0, "core.gamma_r_s": Tied("gamma_r_s", 2.0)}
    )
    soft, stiff = (typical_parameters(parameters, young) for young in (1e3, 1e5))
    for name in ("c10_pa", "c01_pa", "kappa_pa", "core.c10_pa"):
        assert stiff.guesses[name] == pytest.approx(100 * soft.guesses[name])
    assert stiff.guesses["core.c20_pa"] == 0.0
    assert stiff.guesses["core.poisson"] == 0.3
    assert stiff.guesses["core.gamma_r_s"] == 2 * stiff.guesses["gamma_r_s"]
    shear_pa = 1e3 / 2.6
    material = body.parts[0].material
    values = [soft.guesses[c.name] for c in material.constants]
    assert float(material.lame(values)[1]) == pytest.approx(1.2 * shear_pa)
    (size,) = (item.unit for item in stiff.items if item.name == "core.c20_pa")
    assert size == pytest.approx(1e4)


def test_a_constant_of_which_nothing_is_known_needs_a_guess():
    with pytest.raises(
        InputError, match="stiffening: this parameter has no guess, and no usual value"
    ):
        Parameters.from_mapping({"stiffening": Unknown()})
    assert Parameters.from_mapping({"bulk_pa": Unknown()}).names_without_guess == ("bulk_pa",)


def test_without_a_guess_values_are_refused_by_name():
    with pytest.raises(
        InputError, match="lambda_pa: this parameter has no guess; expected guess = "
    ):
        _ = Parameters.from_mapping(NOTHING).guesses


class Known:
    """A trial whose misfit is known at every stiffness."""

    def __init__(self, misfit) -> None:
        self.misfit = misfit

    bounds_pa = (0.0, np.inf)

    def evaluate_at(self, young_pa: float, initial_trajectories):
        return self.misfit(young_pa), None


def walked(misfit, step: float = 10.0) -> ScanState:
    tried = ScanState(Known(misfit))  # type: ignore[arg-type]
    tried.try_sequence([1e7 / step**k for k in range(6)])
    return tried


def test_the_scan_ends_after_two_that_are_worse():
    tried = walked(lambda young: 1.0 if young > 1e5 else 4.0)
    assert [*tried.misfits] == pytest.approx([1e7, 1e6, 1e5, 1e4])
    assert not tried.is_best_at_end(softest=True)


def test_the_scan_ends_after_two_that_cannot_be_simulated():
    tried = walked(lambda young: young if young > 1e4 else np.nan)
    assert [*tried.misfits] == pytest.approx([1e7, 1e6, 1e5, 1e4, 1e3])


def test_the_scan_does_not_end_at_a_resonance():
    tried = walked(lambda young: {5: 9.0, 3: 0.1}.get(round(np.log10(young)), 1.0))
    assert min(tried.misfits) == pytest.approx(1e2)


@pytest.mark.parametrize(("truth", "softest"), [(3.0, True), (1e9, False)])
def test_the_scan_goes_on_beyond_an_end_that_is_best(truth, softest):
    tried = walked(lambda young: 1.0 + abs(np.log10(young / truth)))
    assert tried.is_best_at_end(softest)
    tried.extend_range(
        min(tried.misfits) if softest else max(tried.misfits), 0.1 if softest else 10.0
    )
    best = min(tried.misfits, key=lambda young: tried.misfits[young])
    assert 0.1 < best / truth < 10


# Of what is felt


def unseen(experiment, **changes):
    """The experiment without markers, its sensors measured, and off by what `changes` say."""
    felt = sensed(sensing(experiment))
    nobody = point_markers(felt.body, np.zeros((0, 3)), felt.t_s)
    return replace(felt, markers=nobody, **changes)


def felt_offsets(experiment, offset_n):
    readings = [g.wrench.values + offset_n for g in experiment.grasps if g.wrench is not None]
    return with_wrenches(experiment, readings)


def misfits(experiment):
    found = scan_stiffness(Problem([experiment], NOTHING).collocation())
    return found.young_pa[found.best], found.misfit


def test_a_test_bench_without_markers_starts_near_its_stiffness():
    young_pa, misfit = misfits(unseen(block("z")))
    assert YOUNG_PA / 2 < young_pa < 2 * YOUNG_PA
    assert misfit[-1] > 1e3 * misfit.min()


def test_forces_on_a_hand_determine_the_stiffness_as_markers_do():
    young_pa, _ = misfits(unseen(wristed_cube(30)))
    assert YOUNG_PA / 3 < young_pa < 3 * YOUNG_PA


def test_markers_and_forces_count_alike():
    both = sensed(wristed_cube(30))
    seen = replace(both, grasps=[replace(g, wrench=None) for g in both.grasps])
    trials = [
        TrialSimulation(Problem([each], GUESS).collocation()) for each in (both, seen, unseen(both))
    ]
    together, of_markers, of_forces = (
        trial.evaluate_guess(is_complete=False)[0] for trial in trials
    )
    counts = [trial.collocation.measurement_count for trial in trials]
    assert min(of_markers, of_forces) < together < max(of_markers, of_forces)
    assert counts[0] == counts[1] + counts[2]


def test_an_unknown_tare_hides_no_stiffness():
    zeroed = felt_offsets(unseen(block("z"), nuisance=Nuisance(tare=100.0)), 0.05)
    young_pa, _ = misfits(zeroed)
    assert YOUNG_PA / 2 < young_pa < 2 * YOUNG_PA


@pytest.mark.long
def test_a_force_that_is_felt_late_is_waited_for():
    bench = unseen(block("z", t_s=np.arange(40.0), z_m=-0.001 * np.arange(40.0)))
    later = np.where(bench.t_s[:, None] < 30, np.nan, 0.0)
    young_pa, _ = misfits(felt_offsets(bench, later))
    assert YOUNG_PA / 2 < young_pa < 2 * YOUNG_PA


def test_a_guess_that_gives_more_force_than_there_is_is_not_searched_alone():
    bench = unseen(block("z"))
    start = start_problem(Problem([bench], guessed(mu_pa=9e3)).collocation())
    collocation, found = start.collocation, start.scan
    assert found is not None
    assert "larger than that of a rigid body" in found.sentence
    assert collocation.parameters.guesses["mu_pa"] < 2 * TRUTH["mu_pa"]


# Solves


@pytest.mark.long
@pytest.mark.parametrize("method", ["reduced-space", "shooting", "interior-point"])
def test_a_problem_is_solved_without_a_guess(method):
    solution = solve(cube(), method)
    assert solution.status.converged
    assert np.abs(relative_errors(solution)).max() < 1e-5
    assert solution.scan is not None
    assert solution.notes[0].startswith("no guess: started from E = ")
    assert f"after a scan of {len(solution.scan.young_pa)} stiffnesses in" in solution.notes[0]


def require_kept(collocation):
    start = start_problem(collocation)
    assert start.collocation is collocation
    assert start.scan is None
    assert start.note == ""


def test_a_guess_that_can_be_simulated_is_kept():
    collocation = cube(GUESS).collocation()
    require_kept(collocation)


def test_damping_alone_needs_no_scan():
    given = {**{name: TRUTH[name] for name in ("lambda_pa", "mu_pa")}, "gamma_m_1_s": 1.0}
    start = start_problem(cube({**given, "gamma_r_s": Unknown()}).collocation())
    assert start.scan is None
    assert start.collocation.parameters.guesses["gamma_r_s"] == pytest.approx(0.003)


def test_a_guess_that_cannot_be_simulated_is_rescued_with_a_note():
    solution = solve(cube(guessed(lambda_pa=4.0, mu_pa=1.5)))
    assert solution.status is Status.CONVERGED
    assert np.abs(relative_errors(solution)).max() < 1e-6
    assert solution.notes[0].startswith("the body cannot be simulated at the guess (")
    assert "started from E = " in solution.notes[0]


def test_a_guess_that_fits_worse_than_a_rigid_body_is_searched_with_the_start_of_a_scan():
    problem = cube(guessed(lambda_pa=20.0, mu_pa=30.0))
    collocation = problem.collocation()
    start = start_problem(collocation)
    assert start.stated is collocation
    assert start.scan is not None
    assert start.scan.sentence.startswith(
        "the stated guess and the best stiffness of a scan were both searched"
    )
    solution = solve(problem)
    assert solution.status.converged
    assert np.abs(relative_errors(solution)).max() < 1e-5


def test_the_search_from_the_stated_guess_is_reported_if_it_fits_better(monkeypatch):
    problem = cube(GUESS)
    worse = Parameters.from_mapping({**TRUTH, "mu_pa": Unknown(900.0, 800.0, 1e3)})

    def both(collocation, *_):
        scan = replace(scanned(), reason="both", parameters=worse)
        return Start(collocation.with_parameters(worse), scan=scan, stated=collocation)

    monkeypatch.setattr("collocation_sysid.runs.solving.start_problem", both)
    solution = solve(problem)
    assert np.abs(relative_errors(solution)).max() < 1e-5
    assert solution.scan is None
    assert solution.notes[0].startswith("the search from the stated guess")


def test_a_better_guess_than_the_scans_best_stays(monkeypatch):
    monkeypatch.setattr(
        "collocation_sysid.methods.starts.stiffness_scan.TrialSimulation.rigid_misfit", 0.0
    )
    collocation = cube(guessed(**{**TRUTH, "mu_pa": 301.0})).collocation()
    require_kept(collocation)


@pytest.mark.long
def test_a_guess_is_kept_if_the_scan_fits_hardly_better(monkeypatch):
    """As where a tare, which is not estimated in a scan, makes most of the misfit."""
    monkeypatch.setattr(
        "collocation_sysid.methods.starts.stiffness_scan.TrialSimulation.rigid_misfit", 0.0
    )
    problem = cube(guessed(mu_pa=600.0))
    (experiment,) = problem.experiments
    markers = experiment.markers
    moved = replace(
        markers,
        positions_m=markers.positions_m
        + np.random.default_rng(1).normal(scale=0.3, size=markers.positions_m.shape),
    )
    blurred = replace(problem, experiments=[replace(experiment, markers=moved)]).collocation()
    result = scan_stiffness(without_guesses(blurred))
    misfit, failure = TrialSimulation(blurred, result.share).evaluate_guess(False)
    assert failure is None
    # The scan is better, but hardly.
    assert 1.0 < misfit / result.misfit[result.best] < CLEARLY_BETTER
    require_kept(blurred)


def too_soft() -> dict[str, Unknown | float]:
    return {**NOTHING, **{n: Unknown(lower=2e-3, upper=4e-3) for n in ("lambda_pa", "mu_pa")}}


def test_a_body_that_can_never_be_simulated_is_refused():
    with pytest.raises(InputError) as caught:
        solve(cube(too_soft()))
    for part in (
        "no initial values were found",
        "check grasp, mass and units, or give guesses",
        "t = 0 s",
    ):
        assert part in str(caught.value)


@pytest.mark.long
def test_a_problem_with_a_guess_is_not_scanned():
    given = too_soft() | {n: Unknown(3e-3, 2e-3, 4e-3) for n in ("lambda_pa", "mu_pa")}
    solution = solve(cube(given | {"gamma_r_s": 1e-3, "gamma_m_1_s": 1.0}))
    assert solution.status is Status.NOT_SIMULABLE
    assert solution.scan is None


def test_a_method_that_simulates_everything_gets_a_start_that_can_be(monkeypatch):
    best = scanned().young_pa[scanned().best]
    monkeypatch.setattr(
        "collocation_sysid.methods.starts.stiffness_scan.TrialSimulation.is_simulable",
        lambda _, young: young > 1.5 * best,
    )
    found = scan_stiffness(cube().collocation(), is_complete=True)
    assert found.young_pa[found.best] == pytest.approx(scanned().young_pa[scanned().best + 1])


def test_several_experiments_are_scanned_together():
    experiments = [swung_cube(), replace(swung_cube(), name="again")]
    found = scan_stiffness(Collocation(experiments, Parameters.from_mapping(NOTHING)))
    assert found.samples == 2 * scanned().samples
    np.testing.assert_allclose(found.misfit, scanned().misfit, rtol=1e-9)


@pytest.mark.parametrize(("second", "scanned"), [(Status.CONVERGED, True), (Status.STALLED, False)])
def test_a_search_that_is_lost_begins_again_from_a_scan(second, scanned):
    ends, starts = [Status.STALLED, second], []

    def method(collocation, watch=None, start=None):
        starts.append(collocation.parameters.guesses["mu_pa"])
        return replace(ReducedSpace()(collocation, watch, start), status=ends[len(starts) - 1])

    solution = solve(cube(GUESS), method)
    assert starts[0] == GUESS.guesses["mu_pa"] != starts[1]
    assert (solution.status is Status.CONVERGED, solution.scan is not None) == (scanned, scanned)
    said = "the search from the guess failed (stalled): started from E = "
    assert any(said in note for note in solution.notes) is scanned
    assert solution.collocation.parameters.guesses["mu_pa"] == starts[scanned]


def test_a_linear_constant_without_a_guess_gets_an_error_bar():
    bench = unseen(block("z"))
    given = {"lambda_pa": 200.0, "mu_pa": Unknown(scale="linear", lower=1.0, upper=1e6)}
    still = given | {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    found = run(Problem([bench], still), seek_causes=False)
    estimate = found.estimates["mu_pa"]
    assert estimate.value == pytest.approx(300.0, rel=1e-6)
    assert estimate.statistical_std_error is not None
    assert 0 < estimate.statistical_std_error < 10.0


def falling_block() -> Experiment:
    """A block that falls freely for more than half of its recording, then lands on a plane."""
    body = Body(box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), density_kg_m3=1000.0)
    t_s = np.arange(25) / 120
    floor = Obstacle(shape=Plane((0.0, 0.0, 1.0), (0.0, 0.0, -0.08)), friction=0.0)
    markers = point_markers(body, body.nodes_m, t_s)
    falling = Experiment(
        body,
        t_s,
        [floor],
        markers,
        start="undeformed",
        air_density_kg_m3="none",
        nuisance=Nuisance.none(),
    )
    return measured_with(falling, FALLEN, "bdf2")


FALLEN = {"young_pa": 1e5, "poisson": 0.3, "gamma_r_s": 4e-3, "gamma_m_1_s": 0.1}


def test_the_scan_looks_beyond_the_free_fall_of_a_body():
    given = FALLEN | {"young_pa": Unknown(), "gamma_r_s": Unknown()}
    problem = Problem([falling_block()], given, scheme="bdf2", substeps=1)
    scan = scan_stiffness(problem.collocation())
    best_pa = scan.young_pa[scan.best]
    assert FALLEN["young_pa"] / 3 < best_pa < FALLEN["young_pa"] * 3
    assert scan.samples > 13


def test_specimens_start_from_the_initial_slope_of_their_stresses_without_a_scan():
    strain = np.linspace(0.0, 0.1, 11)
    known = {"poisson": 0.49}
    tests = [
        Specimen(test, strain, slope_pa * strain, 300.0).experiment(name=test)
        for test, slope_pa in (("uniaxial", 60e3), ("equibiaxial", 120e3), ("planar", 80e3))
    ]
    start = start_problem(Problem(tests, known | {"young_pa": Unknown()}).collocation())
    assert start.scan is None
    assert start.collocation.parameters.guesses["young_pa"] == pytest.approx(60e3)
    assert "E = 6e+04 Pa of the initial slope" in start.note
    lateral = Specimen(
        "uniaxial", strain, np.full(11, np.nan), 300.0, lateral_stretch=1 - 0.4 * strain
    ).experiment()
    unloaded = start_problem(Problem([lateral], known | {"young_pa": Unknown()}).collocation())
    assert unloaded.collocation.parameters.guesses["young_pa"] == pytest.approx(SOFT_PA)


def test_a_stiff_rod_without_a_guess_does_not_start_as_a_thin_cable():
    """The search from the usual stiffness of a cable ended at the lower bound."""
    mesh = rod_mesh([[0, 0, 0], [0, 0, -0.6]], CrossSection.round(0.01), 13)
    body = Body(mesh, "cable", density_kg_m3=1200.0)
    t_s = np.linspace(0.0, 0.6, 61)
    shift_m = np.outer(0.05 * (1 - np.cos(10 * t_s)), [1, 0, 0])
    hand = PoseSequence(t_s, shift_m, np.tile([0, 0, 0, 1.0], (61, 1)))
    places_m = [[0, 0, -0.3], [0, 0, -0.6]]
    markers = Markers(t_s, np.zeros((61, 2, 3)), 5e-4, places_m=places_m)
    grasp = Grasp(np.flatnonzero(body.nodes_m[:, 2] > -0.001), hand)
    swing = Experiment(body, t_s, [grasp], markers, air_density_kg_m3="none")
    known = {"torsion_n_m2": 0.7, "axial_n": 1e4, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.2}
    seen = with_markers(swing, simulate(swing, known | {"bending_n_m2": 1.0}).markers_m)
    problem = Problem([seen], known | {"bending_n_m2": Unknown()})
    found = solve(problem).parameters["bending_n_m2"]
    assert found == pytest.approx(1.0, rel=0.02)


def test_a_steel_wire_without_a_guess_is_simulated_at_the_stiffness_of_metals():
    """At the moduli of soft bodies the equilibrium of the horizontal wire was not found."""
    mesh = rod_mesh([[0, 0, 0], [0.7, 0, 0]], CrossSection.round(0.0015), 36, stations_m=[0.05])
    body = Body(mesh, "rod", density_kg_m3=7850.0)
    still = PoseSequence([0.0], np.zeros((1, 3)), [[0, 0, 0, 1.0]])
    grasp = Grasp(np.flatnonzero(body.nodes_m[:, 0] < 0.051), still)
    markers = Markers([0.0], np.zeros((1, 2, 3)), 5e-4, places_m=[[0.4, 0, 0], [0.7, 0, 0]])
    tip = PointMass(np.flatnonzero(body.nodes_m[:, 0] > 0.699), 0.01)
    hung = Experiment(
        body, [0.0], [grasp], markers, kind="static", masses=[tip], air_density_kg_m3="none"
    )
    known = {"poisson": 0.3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    seen = with_markers(hung, simulate(hung, known | {"young_pa": 2e11}).markers_m)
    found = solve(Problem([seen], known | {"young_pa": Unknown()})).parameters["young_pa"]
    assert found == pytest.approx(2e11, rel=0.02)
