"""Refined meshes: positions, volumes and transferred selections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import EDGE_M, bar_let_go, box, cube_with_gaps, driven_bar, hung_cube

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.refinement import refine_body, split_in_eight
from collocation_sysid.fem.meshes.selection import Box, Indices
from collocation_sysid.fem.meshes.structured import box_mesh, cylinder_mesh
from collocation_sysid.fem.node_force import NodeForce
from collocation_sysid.fem.regions import Region
from collocation_sysid.kinds.rod.element import CrossSection, rod_mesh
from collocation_sysid.recording import Grasp
from collocation_sysid.recording.experiment_refinement import (
    refined_experiment as refined_experiment,
)

TOP = Box((-1.0, -1.0, 0.6 * EDGE_M), (1.0, 1.0, 1.0))


@pytest.mark.parametrize("mesh", [box_mesh((0.1, 0.2, 0.3), (1, 2, 2)), cylinder_mesh(1, 2, 2, 1)])
def test_eight_elements_fill_each_and_fit_their_neighbours(mesh):
    finer = split_in_eight(mesh)
    assert finer.notes == ()
    of_parents = finer.volumes_m3.reshape(-1, 8)
    np.testing.assert_allclose(of_parents, mesh.volumes_m3[:, None] / 8 * np.ones(8), rtol=1e-9)
    assert len(finer.surface) == 4 * len(mesh.surface)
    np.testing.assert_array_equal(finer.points_m[: len(mesh.points_m)], mesh.points_m)
    assert len(finer.points_m) == len(mesh.points_m) + len(mesh.edges)


def test_splitting_again_and_again_does_not_make_elements_worse():
    once = split_in_eight(cylinder_mesh(1, 2, 1, 2))
    thrice = split_in_eight(split_in_eight(once))
    assert thrice.quality().quality_min >= 0.99 * once.quality().quality_min


def test_masks_of_nodes_and_arrays_of_cells_are_kept():
    coarse = box_mesh((1, 1, 1), (2, 1, 1))
    end = (coarse.points_m[:, 0] == 0).astype(float)
    core = np.arange(len(coarse.tetrahedra)) % 2
    numbers = np.arange(len(coarse.points_m)) + 0.5
    marked = TetMesh(coarse.points_m, coarse.tetrahedra, {"end": end, "x": numbers}, {"core": core})
    finer = split_in_eight(marked)
    np.testing.assert_array_equal(finer.point_arrays["end"], finer.points_m[:, 0] == 0)
    assert [*finer.point_arrays] == ["end"]
    np.testing.assert_array_equal(finer.cell_arrays["core"].reshape(-1, 8)[:, 0], core)


@pytest.mark.parametrize("element", ["tet4", "tet10", "tet10-p0"])
def test_a_refined_body_has_the_same_mass_and_energy(element):
    core = Region("core", np.arange(3), density_kg_m3=100.0)
    body = Body(box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), "yeoh", 30.0, element, regions=[core])
    finer = refine_body(body)
    assert [part.name for part in finer.parts] == ["", "core"]
    assert finer.mass_kg == pytest.approx(body.mass_kg)
    stretch = np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.2], [0.1, 0.0, 1.1]])
    constants = {name: 1e3 * (1 + k) for k, name in enumerate(body.constants)}
    energies = [b.energy(b.nodes_m @ stretch.T, **constants) for b in (body, finer)]
    assert energies[1] == pytest.approx(energies[0])


def test_a_refined_body_keeps_its_terms():
    core = Region("core", np.arange(3), "yeoh", prony=["slow"], damping="rayleigh")
    body = Body(box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), density_kg_m3=30.0, regions=[core])
    assert [*refine_body(body).constants] == [*body.constants]
    assert [part.damping for part in refine_body(body).parts] == [
        part.damping for part in body.parts
    ]


@pytest.mark.parametrize("stated", [{"mass_kg": 0.2}, {"density_kg_m3": 30.0}])
def test_a_refined_body_has_a_declared_mass_if_the_body_has(stated):
    """The effect of the body's size depends on it, see `systematic_effects`."""
    body = Body(box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), **stated)
    finer = refine_body(body)
    assert finer.has_declared_mass == ("mass_kg" in stated)
    assert finer.mass_kg == pytest.approx(body.mass_kg)


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_a_grasp_holds_the_same_faces_on_the_finer_mesh(element):
    hung = hung_cube(4)
    body = box(element=element)
    face = np.flatnonzero(body.nodes_m[:, 2] > EDGE_M - 1e-9)
    poses = hung.grasps[0].poses
    markers = replace(
        hung.markers, placement=None, places_m=hung.markers.predict_positions(box().nodes_m)
    )
    experiment = replace(hung, body=body, grasps=[Grasp(face, poses)], markers=markers)
    finer = refined_experiment(experiment, refine_body(body))
    held = finer.body.nodes_m[:, 2] > EDGE_M - 1e-9
    np.testing.assert_array_equal(finer.grasps[0].nodes, np.flatnonzero(held))


def test_boxes_select_anew():
    hung = hung_cube(4)
    experiment = replace(hung, grasps=[Grasp(TOP, hung.grasps[0].poses)])
    coarse, fine = (experiment, refined_experiment(experiment, refine_body(hung.body)))
    assert coarse.body.nodes_m[coarse.grasps[0].nodes, 2].min() == pytest.approx(EDGE_M)
    assert fine.body.nodes_m[fine.grasps[0].nodes, 2].min() == pytest.approx(0.75 * EDGE_M)


def test_markers_stay_at_their_material_points():
    for experiment in (cube_with_gaps(4), bar_let_go(6)):
        finer = refined_experiment(experiment, refine_body(experiment.body))
        before, after = (e.markers.predict_positions(e.body.nodes_m) for e in (experiment, finer))
        np.testing.assert_allclose(after, before, atol=1e-12)


def test_loads_keep_their_size():
    bar = bar_let_go(6)
    finer = refined_experiment(bar, refine_body(bar.body))
    for t_s in bar.t_s:
        assert finer.moving_node_mass_kg([t_s]).sum() == pytest.approx(
            bar.moving_node_mass_kg([t_s]).sum()
        )
        np.testing.assert_allclose(
            finer.declared_node_forces_n([t_s]).sum(axis=1),
            bar.declared_node_forces_n([t_s]).sum(axis=1),
        )


def test_a_given_start_is_carried_over():
    hung = hung_cube(4)
    bent = hung.body.nodes_m * [1.0, 1.0, 1.1]
    given = replace(hung, start="given", start_positions_m=bent, start_velocities_m_s=0.1 * bent)
    finer = refined_experiment(given, refine_body(hung.body))
    np.testing.assert_allclose(
        finer.start_positions_m, finer.body.nodes_m * [1.0, 1.0, 1.1], atol=1e-12
    )
    np.testing.assert_allclose(finer.start_velocities_m_s, 0.1 * finer.start_positions_m)


@pytest.mark.parametrize("faces", ["selected", "numbered"])
def test_tendons_and_pressures_drive_the_finer_body_alike(faces: str):
    bar = driven_bar()
    if faces == "numbered":
        (pressure,) = bar.pressures
        numbers = pressure.on_body(bar.body).require_measure().faces[:, :3]
        bar = replace(bar, pressures=[replace(pressure, faces=numbers, body_measure=None)])
    finer = refined_experiment(bar, refine_body(bar.body))
    stretch = np.array([[1.1, 0.1, 0.0], [0.0, 0.9, 0.2], [0.1, 0.0, 1.0]])
    for coarse, fine in zip(
        (*bar.tendons, *bar.pressures), (*finer.tendons, *finer.pressures), strict=True
    ):
        at = [(e.body.nodes_m @ stretch.T).reshape(1, -1) for e in (bar, finer)]
        values = (coarse.require_measure().evaluate(at[0]), fine.require_measure().evaluate(at[1]))
        np.testing.assert_allclose(values[1], values[0], rtol=1e-9)
        assert values[0] != pytest.approx(
            coarse.require_measure().evaluate(bar.body.nodes_m.reshape(1, -1))
        )
        np.testing.assert_array_equal(
            fine.energy_amplitude_at(bar.t_s), coarse.energy_amplitude_at(bar.t_s)
        )


def test_forces_on_sections_of_a_rod_are_on_those_between_them_too():
    mesh = rod_mesh([[0, 0, 0], [1, 0, 0]], CrossSection.round(0.002), 11)
    near = np.flatnonzero(mesh.points_m[:, 0] < 0.25)
    push = NodeForce.from_law(lambda x, v, at: -x, nodes=Indices(near.tolist()))
    finer = refine_body(Body(mesh, density_kg_m3=1e3, forces=[push]))
    (placed,) = finer.placed_forces
    loaded = np.unique(finer.mesh.points_m[placed.points.nodes, 0])
    np.testing.assert_allclose(loaded, np.linspace(0, 0.2, 5), atol=1e-9)
