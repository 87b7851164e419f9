"""Static paths that end because the body becomes unstable."""

from __future__ import annotations

import pickle
from functools import cache

import numpy as np
import pytest
from kit.rods import CABLE, UNDAMPED, CrossSection, cable, ends, straight
from kit.static import LAW, SIZE_M, compressed

import collocation_sysid as cs
from collocation_sysid.errors import SimulationError
from collocation_sysid.methods.solution import Status
from collocation_sysid.model.forces import Forces
from collocation_sysid.program.forward.loss_of_stability import (
    BIOT_RATIO,
    StabilityLoss,
    is_on_surface,
)
from collocation_sysid.program.modes.stability import growth_rate_1_s
from collocation_sysid.recording import Grasp, Markers, PoseSequence
from collocation_sysid.runs.check import check_problem


def test_a_straight_rod_between_grasps_that_are_too_near_is_advised_to_state_its_centreline():
    mesh = straight(0.8, CrossSection.round(0.006), 41)
    body = cable(mesh)
    t_s = np.arange(3) * 0.01
    upright = np.tile([0, 0, 0, 1.0], (3, 1))
    grasps = [
        Grasp(end, PoseSequence(t_s, np.tile([shift_m, 0, 0], (3, 1)), upright))
        for end, shift_m in zip(ends(body), (0.0, -0.1), strict=True)
    ]
    markers = Markers(t_s, np.zeros((3, 1, 3)), 5e-4, places_m=[mesh.place_m(0.4)])
    with pytest.raises(SimulationError, match=r"State object\.centreline") as failed:
        cs.simulate(cs.Experiment(body, t_s, grasps, markers), CABLE | UNDAMPED)
    assert "surface" not in str(failed.value)


@cache
def failure(divisions: tuple[int, int, int], size_m: tuple[float, float, float]) -> SimulationError:
    with pytest.raises(SimulationError) as failed:
        cs.simulate(compressed(divisions, size_m), LAW)
    return failed.value


def test_a_compressed_surface_that_wrinkles_is_named_with_its_stretch():
    error = failure((8, 1, 6), SIZE_M)
    lost = error.stability_loss
    assert isinstance(lost, StabilityLoss)
    assert lost.is_surface_instability
    assert lost.critical_stretch == pytest.approx(np.sqrt(BIOT_RATIO), rel=1e-6)
    assert 0.3 < lost.smaller_stretch < 0.56
    assert lost.larger_stretch == pytest.approx(1.0)
    # On top, where the block is free.
    assert lost.place_m[2] == pytest.approx(SIZE_M[2])
    assert "physical instability of the surface" in str(error)
    assert "smaller elements may help" not in str(error)


def test_check_and_solve_name_the_instability_of_the_surface():
    unknown = cs.Parameters.from_mapping({**LAW, "young_pa": cs.Unknown(2e4)})
    problem = cs.Problem([compressed((8, 1, 6), SIZE_M)], unknown)
    (note,) = (n for n in check_problem(problem).notes if "at the guess" in n)
    assert "physical instability of the surface" in note
    assert "command simulate draws the mode" in note
    solution = cs.solve(problem)
    assert solution.status is Status.NOT_SIMULABLE
    assert "physical instability of the surface" in solution.message
    assert "stretches of the surface are 0.36" in solution.message
    for text in (note, solution.message):
        assert "smaller elements may help" not in text
        assert "stiffer" not in text


def test_states_with_inverted_elements_have_no_growth_rate():
    experiment = compressed((2, 1, 2), SIZE_M)
    theta = experiment.body.theta_from_values(LAW)
    forces = Forces.from_experiment(experiment, 0.0, theta=theta)
    inverted_m = experiment.body.nodes_m * [-1.0, 1.0, 1.0]
    free = np.arange(12, inverted_m.size)
    assert growth_rate_1_s(forces, inverted_m.ravel(), free_dofs=free) == 0.0


def test_a_slender_body_buckles_and_does_not_wrinkle():
    error = failure((12, 1, 1), (0.12, 0.01, 0.01))
    assert error.stability_loss is not None
    assert not error.stability_loss.is_surface_instability
    assert "buckles" in str(error)


@pytest.mark.parametrize(
    ("stretch", "across", "critical"),
    [(0.544, 1.0, 0.544), (0.666, 0.666, 0.666), (0.444, 0.444**-0.5, 0.444)],
)
def test_critical_stretches_are_biots(stretch, across, critical):
    mesh = cs.box_mesh((0.1, 0.1, 0.1), (3, 3, 3))
    moved_m = mesh.points_m * [stretch, across, 1 / stretch / across]
    mode = np.zeros_like(moved_m)
    top = mesh.points_m[:, 2] > 0.0999
    mode[top, 2] = np.sin(40 * mesh.points_m[top, 0])
    lost = is_on_surface(mesh.points_m, moved_m, mode, mesh.surface)
    assert (lost.smaller_stretch, lost.larger_stretch) == pytest.approx(
        (stretch, max(across, stretch))
    )
    assert lost.critical_stretch == pytest.approx(critical, abs=1e-3)
    assert lost.is_surface_instability


@pytest.mark.long
def test_a_picture_shows_the_mode():
    from collocation_sysid.result.pictures.instability import instability_picture

    figure = instability_picture(failure((8, 1, 6), SIZE_M).stability_loss)
    assert "wavelength" in figure.axes[0].texts[0].get_text()


def test_an_error_of_another_process_keeps_its_message():
    error = failure((8, 1, 6), SIZE_M)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
