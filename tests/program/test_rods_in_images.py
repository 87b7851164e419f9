"""Points drawn along a cable in one photograph, whose places on the cable are hardly known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.selection import Along
from collocation_sysid.kinds.image_tracks.residual import ImageTrackResidual
from collocation_sysid.kinds.image_tracks.table import ImageTracksSection
from collocation_sysid.kinds.rod.element import centres_of_sections
from collocation_sysid.problem.measurement_section import RecordingFolder
from collocation_sysid.program.observables import ObservableDerivatives

LENGTH_M, POINTS, SIGMA_PX, ALONG_M = 0.5, 15, 0.7, 0.03
MATRIX = np.array([[900.0, 0, 640], [0, 900, 480], [0, 0, 1]])
# The camera looks along y, with z of the world upwards.
POSE = np.eye(4)
POSE[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
POSE[:3, 3] = [0.2, -0.9, -0.15]
EXACT = {"focal_sigma": 0.0, "centre_sigma_px": 0.0, "clock_sigma_s": 0.0}
PLACES_M = np.linspace(0.05, LENGTH_M - 0.02, POINTS)
TRUTH = {
    "bending_n_m2": 1e-3,
    "torsion_n_m2": 8e-4,
    "axial_n": 200.0,
    "gamma_r_s": 0.0,
    "gamma_m_1_s": 0.0,
}


def body(sections: int) -> cs.Body:
    section = cs.CrossSection.round(0.006)
    mesh = cs.rod_mesh([[0, 0, 0], [LENGTH_M, 0, 0]], section, sections=sections)
    return cs.Body(mesh, "cable", mass_kg=0.03 * LENGTH_M)


def drawn(
    sections: int,
    pixels: np.ndarray | None = None,
    along_m: np.ndarray = PLACES_M,
    place_sigma_m: float = ALONG_M,
) -> cs.Experiment:
    """A cable that hangs from a horizontal clamp, in equilibrium."""
    cable = body(sections)
    assert isinstance(cable.mesh, cs.RodMesh)
    tracks = cs.ImageTracks(
        "front",
        cs.Camera(MATRIX, pose=POSE, size_px=(1280, 960)),
        [0.0],
        pixels,
        [f"p{k}" for k in range(POINTS)],
        places_m=[cable.mesh.place_m(s) for s in along_m],
        sigma_px=SIGMA_PX,
        place_sigma_m=place_sigma_m,
        pose_sigma=cs.PoseSigma(0.1, 1e-3),
        **EXACT,
    )
    clamp = cs.Grasp(Along(0.0, 0.0), np.eye(4)[None])
    return cs.Experiment(
        cable,
        [0.0],
        [clamp],
        readings=[tracks],
        kind="static",
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )


@cache
def photograph() -> tuple[cs.Problem, np.ndarray]:
    """EI from points whose stated arc lengths are off by 2 cm, and the pixels (POINTS, 2)."""
    seen = cs.simulate(drawn(81, place_sigma_m=0.0), TRUTH).custom_sensor_values[0]
    rng = np.random.default_rng(1)
    pixels = seen.reshape(1, POINTS, 2) + rng.normal(0, SIGMA_PX, (1, POINTS, 2))
    stated_m = np.clip(PLACES_M + rng.normal(0, 0.02, POINTS), 0.0, LENGTH_M)
    unknown = {"bending_n_m2": cs.Unknown(3e-3)}
    return cs.Problem([drawn(41, pixels, stated_m)], TRUTH | unknown), pixels[0]


@pytest.mark.long
def test_points_drawn_along_a_cable_in_an_image_give_its_bending_stiffness():
    problem, pixels = photograph()
    run = cs.run(problem)
    low, high = run.interval("bending_n_m2")
    assert run.trust.verdict == "good"
    assert low < 1e-3 < high
    assert high / low < 1.3
    # What is left is the distance from the drawn point to the smooth centreline in the image.
    (part,) = run.solution.parts
    (residual,) = part.transcription.residuals_of(ImageTrackResidual)
    s_m = np.linspace(0.0, LENGTH_M, 41)
    curve = CubicSpline(s_m, centres_of_sections(part.x.reshape(-1, 3)))
    centres_m = curve(np.linspace(0.0, LENGTH_M, 1001))
    pose = residual.estimated_pose(part.phi)
    own = (centres_m - pose[:3, 3]) @ pose[:3, :3]
    line = (own @ MATRIX.T)[:, :2] / own[:, 2:]
    steps = np.diff(line, axis=0)
    shares = np.einsum("psi,si->ps", pixels[:, None] - line[:-1], steps) / np.sum(steps**2, axis=1)
    nearest = line[:-1] + np.clip(shares, 0, 1)[..., None] * steps
    away_px = np.linalg.norm(nearest - pixels[:, None], axis=2).min(axis=1)
    left = residual.residuals(part.observables[0], part.phi).reshape(POINTS, -1)
    np.testing.assert_allclose(SIGMA_PX * np.linalg.norm(left, axis=1), away_px, atol=0.02)


def test_derivatives_by_places_along_the_cable_agree_with_differences():
    problem, _ = photograph()
    (transcription,) = problem.collocation().transcriptions
    (residual,) = transcription.residuals_of(ImageTrackResidual)
    assert residual.correspondences.coordinate_parameters.shape == (POINTS, 1)
    rng = np.random.default_rng(2)
    phi = 0.01 * rng.normal(size=residual.nuisance.size)
    x = problem.experiments[0].body.nodes_m.reshape(1, -1) + 1e-3 * rng.normal(size=(1, 41 * 9))

    def at(phi: np.ndarray) -> np.ndarray:
        return residual.residuals(residual.observable.evaluate_positions(x, phi), phi)

    points = residual.observable
    by_x = np.zeros((1, len(points.operator(phi) @ x.T), 0))
    slopes: ObservableDerivatives = points.derivatives_from(
        x, points.shape_functions(phi), np.arange(0), by_x
    )
    values = points.evaluate_positions(x, phi)
    _, by = residual.linearise(values, slopes, phi, len(phi))
    for k in range(len(phi)):
        unit = np.where(np.arange(len(phi)) == k, 1e-5, 0.0)
        differences = (at(phi + unit) - at(phi - unit)) / 2e-5
        np.testing.assert_allclose(by[..., k], differences, rtol=1e-4, atol=1e-4)
    assert np.abs(by).max(axis=(0, 1, 2)).min() > 0.1


def test_arc_lengths_in_a_problem_file_are_places_of_a_rod(tmp_path):
    camera = {"matrix": MATRIX.tolist(), "pose": POSE.tolist()}
    table = {"name": "front", "camera": camera, "s_m": {"middle": 0.25, "tip": LENGTH_M}}
    section = ImageTracksSection.model_validate(table)

    def read(of: cs.Body) -> cs.ImageTracks:
        folder = RecordingFolder(
            tmp_path, of, is_static=True, is_simulation=True, add_note=lambda note: None
        )
        return section.read(folder, "image_tracks.0", np.zeros(1))

    tracks = read(body(9))
    assert tracks.names == ("middle", "tip")
    np.testing.assert_allclose(tracks.known_places_m, [[0.25, 0, 0], [LENGTH_M, 0, 0]], atol=1e-12)
    solid = cs.Body(cs.box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), density_kg_m3=1000.0)
    with pytest.raises(InputError, match="found arc lengths for a body that is not a rod"):
        read(solid)
