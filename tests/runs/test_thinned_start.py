"""Start with thinned clouds: selected points, same answer, all points fitted, fallback,
interruption."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from kit.depth import MATRIX, NOISE_M, TRUTH, camera_residuals, hanging, moved, noisy

import collocation_sysid as cs
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Status
from collocation_sysid.program.depth.surface_correspondences import SurfaceCorrespondences
from collocation_sysid.runs import searches, smaller_problem
from collocation_sysid.runs.smaller_problem import NoStartError, ThinnedStart

# Finer than the pixels, so that no point is left out.
SPACING_M = 2e-4
UNKNOWN = cs.Parameters.from_mapping({**TRUTH, "young_pa": cs.Unknown()})


@cache
def depth() -> cs.Depth:
    """An image of the bar by a camera whose stated pose is off by some degrees."""
    pose = moved(np.array([0.05, -0.03, 0.02]), np.array([0.004, 0.002, -0.003]))
    return cs.Depth.of_images(
        "front",
        noisy(np.random.default_rng(3)),
        cs.DepthCamera(MATRIX, pose=pose),
        NOISE_M,
        spacing_m=SPACING_M,
    )


def problem() -> cs.Problem:
    return cs.Problem([hanging((depth(),))], UNKNOWN)


def thinned() -> ThinnedStart:
    start = ThinnedStart.of(problem(), ReducedSpace())
    assert start is not None
    return start


@pytest.fixture
def many(monkeypatch):
    """The points of the image count as many."""
    monkeypatch.setattr(smaller_problem, "MANY_POINTS", 1000)
    monkeypatch.setattr(smaller_problem, "THINNED_POINTS", 400)


def compared(solution: cs.Solution) -> int:
    """Number of points that are compared with the surface, or left out for a stated reason."""
    (transcription,) = solution.collocation.transcriptions
    (correspondences,) = transcription.association.correspondences
    excluded = sum(correspondences.excluded_counts.values())
    return int(correspondences.is_compared.sum()) + excluded


def standard_error(solution: cs.Solution) -> float:
    """Standard error of the logarithm of Young's modulus."""
    collocation = solution.collocation
    p, positions = collocation.unpack(solution.z)
    rows = [each.grid_times for each in collocation.transcriptions]
    fit = Horizon(collocation, rows).evaluate(p, positions).fit
    return float(fit.standard_errors[0])


def test_thinned_points_are_a_few_of_the_measured_points(many):
    few = depth().thinned(400)
    (cloud,) = few.clouds
    (given,) = depth().clouds
    assert len(given) > 1000
    assert 100 < len(cloud) <= 400
    rows = {row.tobytes() for row in given}
    assert all(row.tobytes() in rows for row in cloud)
    assert few.sigma_m == depth().sigma_m


def test_few_points_are_not_thinned():
    assert ThinnedStart.of(problem(), ReducedSpace()) is None


def test_the_optimum_is_that_of_the_search_with_all_points(monkeypatch):
    direct = cs.solve(problem())
    assert not any("searched with" in note for note in direct.notes)
    monkeypatch.setattr(smaller_problem, "MANY_POINTS", 1000)
    monkeypatch.setattr(smaller_problem, "THINNED_POINTS", 400)
    solution = cs.solve(problem())
    (note,) = (each for each in solution.notes if "searched with" in each)
    (given,) = depth().clouds
    assert f"then with {len(given):,} depth points" in note
    assert compared(solution) == compared(direct) == len(given)
    assert solution.status.converged
    assert solution.scan is not None
    difference = np.log(solution.parameters["young_pa"] / direct.parameters["young_pa"])
    error = standard_error(direct)
    # Points that change to other triangles leave some per cent of a standard error open.
    assert abs(difference) < 0.03 * error
    assert standard_error(solution) == pytest.approx(error, rel=1e-3)
    # So do up to 5 of the loss, at any tolerance of the search: here 3.4.
    assert solution.history[-1].loss == pytest.approx(
        direct.history[-1].loss, abs=searches.SAME_LOSS / 2
    )
    # The note on the fit is that of all points, and the only one.
    (fit,) = (each for each in solution.notes if "deviate from the surf" in each)
    count = solution.collocation.transcriptions[0].association.correspondences
    assert f" {int(count[0].is_compared.sum())} points of" in fit


@pytest.mark.long
def test_a_thinned_start_that_fails_is_replaced_by_the_complete_search(many, monkeypatch):
    def fail(*_):
        raise NoStartError("300 depth points fail")

    monkeypatch.setattr(ThinnedStart, "start", fail)
    solution = cs.solve(problem())
    assert "no smaller problem was solved first: 300 depth points fail" in (solution.notes)
    assert solution.status.converged
    assert compared(solution) == len(depth().clouds[0])


@pytest.mark.long
def test_thinned_points_that_do_not_determine_a_parameter_are_no_start(many, monkeypatch):
    smaller = thinned()
    rough = cs.solve(smaller.problem)
    smaller.start(problem(), rough)
    monkeypatch.setattr(smaller_problem, "undetermined_names", lambda _: ("young_pa",))
    with pytest.raises(NoStartError, match="determine E"):
        smaller.start(problem(), rough)


def test_an_interrupt_keeps_the_point_and_compares_all_points(many):
    lines = []

    def interrupt(line):
        lines.append(line)
        if len(lines) == 2:
            raise KeyboardInterrupt

    guess = cs.Parameters.from_mapping({**TRUTH, "young_pa": cs.Unknown(1.6e5)})
    solution = cs.solve(cs.Problem([hanging((depth(),))], guess), watch=interrupt)
    assert solution.status is Status.INTERRUPTED
    assert compared(solution) == len(depth().clouds[0])
    assert any("do not fit all points best" in each for each in solution.notes)
    assert solution.parameters["young_pa"] == pytest.approx(lines[-1].parameters["young_pa"])


def test_unchanged_correspondences_end_the_search_after_one_solve():
    calls = []

    def counted(collocation, watch=None, start=None):
        calls.append(start)
        return ReducedSpace()(collocation, watch, start)

    guess = cs.Parameters.from_mapping({**TRUTH, "young_pa": cs.Unknown(1.6e5)})
    solution = cs.solve(cs.Problem([hanging((depth(),))], guess), counted)
    assert solution.status.converged
    assert len(calls) == 1
    p, positions = solution.collocation.unpack(solution.z)
    again, _ = solution.collocation.follow_estimates(p, positions)
    assert again is solution.collocation


def test_associations_are_kept_with_other_guesses():
    collocation = problem().collocation()
    other = collocation.with_parameters(collocation.parameters.with_guess({"young_pa": 2e5}))
    before = collocation.transcriptions[0].association
    assert other.transcriptions[0].association is before
    assert other.parameters.guesses["young_pa"] == pytest.approx(2e5)


def test_an_alignment_with_the_same_shape_is_not_repeated():
    guess = UNKNOWN.with_guess({"young_pa": 1.6e5})
    collocation = cs.Problem([hanging((depth(),))], guess).collocation()
    (transcription,) = collocation.transcriptions
    (reading,) = camera_residuals(transcription)
    rest = transcription.experiment.rigid_positions([0.0]).reshape(1, -1)
    phi = np.zeros(transcription.nuisance.size)
    assert reading.aligned_correspondences(rest, phi) is reading.correspondences
    sagging = rest + 0.5 * NOISE_M
    moved_body = reading.aligned_correspondences(sagging, phi)
    assert moved_body is not reading.correspondences
    scaled = phi.copy()
    scaled[reading.correspondences.camera.parameter_indices[-1]] = 0.5
    again = reading.aligned_correspondences(rest, scaled)
    assert again is not reading.correspondences
    # Only the pose: the same correspondences, for the values of another alignment.
    pose = reading.aligned_correspondences(sagging, phi, only_pose=True)
    assert pose.nodes is reading.correspondences.nodes
    assert pose.start_values == moved_body.start_values
    assert not pose.is_aligned


def test_a_search_at_a_known_minimum_ends():
    known = cs.solve(cs.Problem([hanging((depth(),))], UNKNOWN.with_guess({"young_pa": 1.6e5})))
    last = known.history[-1]
    is_at = partial(searches.is_at, solution=known)
    highest = max(line.loss for line in known.history)
    assert all(is_at(line) for line in known.history)
    assert not is_at(replace(last, share=0.5))
    assert not is_at(replace(last, loss=1.1 * highest + 11.0))
    assert not is_at(replace(last, parameters={"young_pa": 1.11 * known.parameters["young_pa"]}))


def test_all_points_have_the_correspondences_of_the_thinned_solution(many):
    rough = cs.solve(thinned().problem)
    collocation = smaller_problem.collocation_with_all_points(problem(), rough)
    (transcription,) = collocation.transcriptions
    (found,) = transcription.association.correspondences
    assert isinstance(found, SurfaceCorrespondences)
    assert found.camera.depth is depth()
    (before,) = rough.collocation.transcriptions[0].association.correspondences
    assert found.gate_m == before.gate_m
    assert found.is_compared.sum() > 2 * before.is_compared.sum()
    assert len(rough.z) == collocation.variable_count
    # All points fit the shape of the thinned ones up to the noise.
    p, positions = collocation.unpack(rough.z)
    distances_m = found.signed_distances_m(
        found.shapes_m, collocation.iterates_at(p, positions)[0].phi
    )
    assert np.sqrt(np.nanmean(distances_m**2)) < 1.5 * NOISE_M
