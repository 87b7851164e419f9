"""Outlines of the body in masks of ordinary cameras."""

from __future__ import annotations

import json
import pickle
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kit.filmed import T_S, filming, swung, tracks_of, unknown_young
from kit.problem_files import run_command
from kit.silhouettes import (
    POSE,
    SIZE_PX,
    TRUTH,
    bar,
    camera,
    folder_with,
    hanging,
    hanging_m,
    outlines_of,
    photograph,
    rasterised,
)
from PIL import Image
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.common import array_files
from collocation_sysid.kinds.outlines.masks import decoded, encoded, read_masks
from collocation_sysid.kinds.outlines.outlines import edge_pixels, mask_of
from collocation_sysid.kinds.outlines.residual import OutlinesResidual
from collocation_sysid.methods.solution import Solution, Status
from collocation_sysid.program.observables import ObservableDerivatives
from collocation_sysid.result.pictures.album import experiment_pictures
from collocation_sysid.result.replay import read_run
from collocation_sysid.statistics.pose_noise import uncertainty_at


def residual_of(experiment: cs.Experiment) -> OutlinesResidual:
    program = cs.Problem([experiment], parameters=unknown_young()).collocation()
    return program.transcriptions[0].residuals_of(OutlinesResidual)[-1]


def solved(outlines: cs.Outlines, guess_pa: float) -> Solution:
    parameters = {**TRUTH, "young_pa": cs.Unknown(guess_pa)}
    return cs.solve(cs.Problem([hanging([outlines])], parameters=parameters))


def test_the_distance_is_that_of_a_shifted_outline() -> None:
    residual = residual_of(hanging([outlines_of()]))
    x, phi = hanging_m().reshape(1, -1), np.zeros(residual.nuisance.size)
    for shift in ([0.0, 0.0], [0.0, 3.0]):
        mask = np.roll(photograph(), np.array(shift, dtype=int)[::-1], axis=(0, 1))
        residual = residual_of(hanging([outlines_of(mask)]))
        pairs = residual.reassociated(x, phi)
        here = residual_of_pairs(residual, pairs)
        off = here.predict(here.observable.evaluate_positions(x, phi), phi)[0, :, 0]
        used = pairs.is_compared[0]
        expected = -pairs.outwards[0] @ shift
        assert used.sum() > 50
        assert np.sqrt(np.mean((off - expected)[used] ** 2)) < 0.3


def residual_of_pairs(residual: OutlinesResidual, pairs: Any) -> OutlinesResidual:

    from collocation_sysid.kinds.outlines.residual import compared

    return replace(
        residual, correspondences=pairs, is_compared=compared(pairs, residual.observable_s)
    )


def test_the_contour_of_the_body_is_at_the_edge_of_its_mask() -> None:
    residual = residual_of(hanging([outlines_of()]))
    x, phi = hanging_m().reshape(1, -1), np.zeros(residual.nuisance.size)
    here = residual_of_pairs(residual, residual.reassociated(x, phi))
    (contour,) = here.contours_px(x, phi)
    edge = edge_pixels(photograph())
    assert len(contour) > 50
    away = np.linalg.norm(contour[:, None] - edge, axis=2).min(axis=1)
    assert away.max() < 1.5
    assert photograph()[tuple(edge.astype(int).T[::-1])].all()


@pytest.mark.long
def test_a_run_draws_masks_and_the_fitted_contour(tmp_path: Path) -> None:
    parameters = {**TRUTH, "young_pa": cs.Unknown(1.5e5)}
    problem = cs.Problem([hanging([outlines_of()])], parameters=parameters)
    cs.run(problem, seek_causes=False).save(tmp_path / "run", frames=False, pictures=False)
    (shown,) = read_run(tmp_path / "run")[1]
    assert "outline_hung_front" in dict(experiment_pictures(shown))
    rows = shown.outlines["front"]
    contour, edge = (rows[rows[:, 1] == kind, 2:] for kind in (1, 0))
    away = np.linalg.norm(contour[:, None] - edge, axis=2).min(axis=1)
    assert np.sqrt(np.mean(away**2)) < 1.0


def test_an_unknown_pose_of_outlines_is_refused_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(cs.InputError, match="same outline from several sides; expected the pose"):
        outlines_of(has_known_pose=False)
    file = folder_with(tmp_path, "front.png")
    text = file.read_text().replace(f"pose = {camera().pose.tolist()}", 'pose = "unknown"')
    file.write_text(text)
    Image.fromarray(photograph()).save(tmp_path / "front.png")
    with pytest.raises(cs.InputError, match="image_tracks of at least four points with places_m"):
        cs.Problem.read(file)


FREE: dict[str, Any] = {"clock_rate_sigma": 1e-3, "line_delay_s": 2e-5, "line_delay_sigma_s": 5e-6}


def test_derivatives_agree_with_differences() -> None:
    mask = rasterised(hanging_m(), camera())
    film = cs.Outlines("front", camera(), T_S[:3] + 0.004, [mask] * 3, **FREE)
    residual = residual_of(swung([film]))
    rng = np.random.default_rng(3)
    x = np.tile(hanging_m().ravel(), (len(T_S), 1)) + 1e-3 * rng.normal(size=(len(T_S), 1))
    phi = 0.01 * rng.normal(size=residual.nuisance.size)
    residual = residual_of_pairs(residual, residual.reassociated(x, phi))
    direction = 1e-3 * rng.normal(size=x.shape)

    def at(step: float, step_phi: np.ndarray) -> np.ndarray:
        values = residual.observable.evaluate_positions(x + step * direction, phi + step_phi)
        return residual.residuals(values, phi + step_phi)

    still, step = np.zeros_like(phi), 1e-5
    points = residual.observable
    by_x = (points.operator(phi) @ direction.T).T[..., None]
    slopes: ObservableDerivatives = points.derivatives_from(
        x, points.shape_functions(phi), np.array([0]), by_x
    )
    found, by = residual.linearise(points.evaluate_positions(x, phi), slopes, phi, 1 + len(phi))
    np.testing.assert_allclose(found, at(0.0, still), atol=1e-10)
    differences = (at(step, still) - at(-step, still)) / (2 * step)
    np.testing.assert_allclose(by[..., 0], differences, rtol=1e-5, atol=1e-5)
    assert np.abs(differences).max() > 0.1
    for k in range(len(phi)):
        unit = np.where(np.arange(len(phi)) == k, step, 0.0)
        differences = (at(0.0, unit) - at(0.0, -unit)) / (2 * step)
        np.testing.assert_allclose(by[..., 1 + k], differences, rtol=1e-4, atol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("guess_pa", [3e4, 3e5])
def test_the_modulus_of_a_hanging_bar_follows_from_one_photograph(guess_pa: float) -> None:
    solution = solved(outlines_of(), guess_pa)
    estimate = uncertainty_at(solution.collocation, solution.z).estimates["young_pa"]
    low, high = estimate.statistical95 or (0.0, np.inf)
    assert low < TRUTH["young_pa"] < high
    assert (high - low) / 2 < 0.1 * TRUTH["young_pa"]
    assert abs(estimate.value / TRUTH["young_pa"] - 1) < 0.05


@pytest.mark.parametrize("seed", [0, 3])
def test_a_contour_of_other_points_does_not_end_the_search(seed: int) -> None:
    rng, pose = np.random.default_rng(seed), POSE.copy()
    pose[:3, :3] @= Rotation.from_rotvec(np.deg2rad(rng.normal(size=3))).as_matrix()
    pose[:3, 3] += 0.005 * rng.normal(size=3)
    mask = rasterised(hanging_m(), camera(pose=pose))
    solution = solved(outlines_of(mask, pose_sigma=cs.PoseSigma()), 1.6e5)
    assert solution.status is Status.CONVERGED
    assert abs(solution.parameters["young_pa"] / TRUTH["young_pa"] - 1) < 0.1


@pytest.mark.long
def test_masks_that_are_too_large_all_around_are_estimated() -> None:
    from scipy.ndimage import binary_dilation

    cross = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=bool)
    wide = binary_dilation(photograph(), cross, iterations=2)
    solution = solved(outlines_of(wide), 1.5e5)
    assert solution.nuisance("edge_px") == pytest.approx(-2.0, abs=0.3)
    assert abs(solution.parameters["young_pa"] / TRUTH["young_pa"] - 1) < 0.05


def test_tracks_and_outlines_of_one_camera_share_its_errors() -> None:
    mask = rasterised(bar().nodes_m, filming("front", size_px=SIZE_PX))
    view = filming("front", size_px=SIZE_PX)
    film = cs.Outlines("masks", view, [0.1, 0.2, 0.3], [mask] * 3, same_camera_as="front")
    one = cs.Problem([swung([tracks_of("front")])], unknown_young()).collocation()
    both = cs.Problem([swung([tracks_of("front"), film])], unknown_young()).collocation()
    sizes = [each.transcriptions[0].nuisance.size for each in (one, both)]
    assert sizes[1] - sizes[0] == 1  # the edge


def test_own_masks_are_those_of_another_program() -> None:
    mask = mask_of(outlines_of(), hanging(), hanging_m(), 0.0)
    assert np.sum(mask != photograph()) < 0.005 * photograph().sum()


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.zeros(SIZE_PX[::-1], dtype=bool), "mask 1 of the outlines 'front' is empty"),
        (np.ones(SIZE_PX[::-1], dtype=bool), "contains the whole image"),
        (
            np.zeros((10, 20), dtype=bool),
            "has 20 x 10 pixels, but the calibration is for 640 x 480",
        ),
        (~photograph(), "seems to be inverted"),
        (np.zeros((2, 3, 4)), "expected .rows, columns. of bool"),
    ],
)
def test_impossible_masks_are_refused(mask: np.ndarray, message: str) -> None:
    with pytest.raises(cs.InputError, match=message):
        outlines_of(mask)


def test_outlines_can_be_pickled_and_shortened() -> None:
    film = cs.Outlines("front", camera(), [0.0, 0.1], [photograph()] * 2)
    half = pickle.loads(pickle.dumps(film)).without_later_values(0.05)
    assert [mask is None for mask in half.all_masks] == [False, True]


# Files ------------------------------------------------------------------------------------------


def test_run_lengths_are_those_of_coco() -> None:
    mask = np.zeros((3, 4), dtype=bool)
    mask[1:, 1] = mask[0, 2] = True
    assert encoded(mask) == {"size": [3, 4], "counts": [4, 3, 5]}
    np.testing.assert_array_equal(decoded(encoded(mask)), mask)
    np.testing.assert_array_equal(decoded(encoded(photograph())), photograph())
    # The text of pycocotools for the counts [4, 3, 5], and for [100, 7, 3] (of 10 x 11 pixels).
    np.testing.assert_array_equal(decoded({"size": [3, 4], "counts": "435"}), mask)
    long = decoded({"size": [10, 11], "counts": "T373"}).T.ravel()
    assert np.flatnonzero(long).tolist() == [*range(100, 107)]


def test_masks_of_a_problem_file_are_read_in_all_formats(tmp_path: Path) -> None:
    image = Image.fromarray(np.where(photograph(), 255, 0).astype(np.uint8))
    image.save(tmp_path / "front.png")
    (tmp_path / "front.json").write_text(json.dumps([{"segmentation": encoded(photograph())}]))
    (tmp_path / "front").mkdir()
    image.save(tmp_path / "front" / "0001.png")
    for file in ("front.png", "front.json", "front"):
        problem = cs.Problem.read(folder_with(tmp_path, file))
        (film,) = problem.experiments[0].readings
        assert isinstance(film, cs.Outlines)
        np.testing.assert_array_equal(film.all_masks[0], photograph())


def test_masks_of_a_folder_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 1, 2):
        mask = np.zeros((4, 12), dtype=np.uint8)
        mask[1:3, 1 : 1 + number] = 255
        Image.fromarray(mask).save(tmp_path / f"frame_{number}.png")
    assert [int(mask.sum()) // 2 for mask in read_masks(tmp_path)] == [1, 2, 10]


def run_lengths(size: Any, counts: Any) -> str:
    return json.dumps({"size": size, "counts": counts})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "cannot be read"),
        ('{"size": [2, 2], "counts": [1, 2]}', "the counts have 3 pixels for 2 x 2"),
        ('{"mask": 1}', "found no run lengths"),
        ("[]", "0 masks|no mask|empty"),
        ("[" * 100_000, "cannot be read"),
        ("9" * 5000, "cannot be read"),
        (run_lengths([2, 2], [2**62, 2**62, 2**62, 2**62 + 4]), "the count 4611686018427387904 "),
        (run_lengths([2, 2], [5, -1]), "found the count 5 after 0 of 2 x 2 pixels"),
        (run_lengths([2, 2], [1, -1, 4]), "found the count -1 after 1 of 2 x 2"),
        (run_lengths([2, 2], [1e30]), "the count 1e"),
        (run_lengths([2, 2], [float("inf")]), "the count inf"),
        (run_lengths([2, 2], [1, float("nan")]), "the count nan"),
        (run_lengths([2, 2], [True, 3]), "the count True"),
        (run_lengths([2, 2], [[[4]]]), r"the count \[\[4\]\]"),
        (run_lengths([2, 2], 4), "the counts have 0 pixels"),
        (run_lengths([2, 2], "P" * 1_000_000), "a text of counts"),
        (run_lengths([2, 2], "0P"), "ends within a number"),
        (run_lengths([2, 2], "0\u0431"), "a text of counts"),
        (run_lengths([2, -2], [1]), "no run lengths"),
        (run_lengths([1e10, 1], [1]), "no run lengths"),
        (run_lengths([10**10, 1], [10**10]), "mask of 10000000000 x 1 pixels; expected at most"),
        (f"[{', '.join([run_lengths([9000, 9000], [81_000_000])] * 500)}]", "takes .* GB"),
    ],
)
def test_files_that_are_no_masks_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str, message: str
) -> None:
    monkeypatch.setattr(array_files, "machine_memory_mb", lambda: 1000.0)
    (tmp_path / "front.json").write_text(content)
    with pytest.raises(cs.InputError, match=message):
        cs.Problem.read(folder_with(tmp_path, "front.json"))


def test_a_sparse_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    with (tmp_path / "front.json").open("wb") as file:
        file.truncate(100_000_000_000)
    with pytest.raises(cs.InputError, match="this file has 100,000 MB"):
        read_masks(tmp_path / "front.json")


def test_long_compressed_counts_are_decoded() -> None:
    text = "111" + "0" * 999_997  # counts of one; from the fourth on differences
    assert decoded({"size": [1000, 1000], "counts": text}).sum() == 500_000


def png(size_px: tuple[int, int], second_chunk: bytes) -> bytes:
    """A PNG file of a stated size with any second chunk."""
    header = struct.pack(">IIBBBBB", *size_px, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (second_chunk, zlib.compress(bytes(64))), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )


@pytest.mark.parametrize(
    "content",
    [
        png((8, 7), b"+\xb4\xd89"),
        png((10_000, 10_000), b"IDAT"),
        png((50_000, 50_000), b"IDAT"),
        b"",
    ],
    ids=["a wrong chunk", "100 million pixels", "more than memory", "empty"],
)
def test_damaged_png_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "front.png").write_bytes(content)
    with pytest.raises(cs.InputError, match=r"front\.png: cannot be read"):
        read_masks(tmp_path / "front.png")


def test_a_photograph_is_no_mask(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    Image.fromarray(rng.integers(0, 255, (48, 64), dtype=np.uint8)).save(tmp_path / "front.png")
    with pytest.raises(cs.InputError, match="found a photograph"):
        read_masks(tmp_path / "front.png")


@pytest.mark.long
def test_a_simulation_writes_masks_that_are_identified(tmp_path: Path) -> None:
    file = folder_with(tmp_path, "hung_reading_front.json")
    simulated = run_command(
        "simulate", str(file), "--out", str(tmp_path), "--set", "parameters.young_pa=1e5"
    )
    assert simulated.code == 0, simulated.err
    assert (tmp_path / "hung_reading_front.json").exists()
    run = cs.run(cs.Problem.read(file))
    low, high = run.interval("young_pa")
    assert low < 1e5 < high
    assert any("points of the outline in 1 masks of 'front'" in each for each in run.result.notes)
