"""Draw the thumbnails of the gallery: one large deformed body of each script.

Scripts are run up to their first simulation, so that nothing is solved. Scripts with measured data
simulate a recording of their problem file, for which the data must have been fetched. Scripts of
published material tests are run as a whole, and their figure is the thumbnail.
"""

from __future__ import annotations

import argparse
import os
import runpy
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import collocation_sysid as cs
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.result.element_fields import ElementFields
from collocation_sysid.result.pictures.projection import ParallelCamera
from collocation_sysid.result.pictures.scene import BodyDrawing, SheetView, sheet
from collocation_sysid.result.pictures.shapes import FIELD_COLOURS
from collocation_sysid.result.replay import MotionRecord

ROOT = Path(__file__).parents[2]
GALLERY = ROOT / "docs" / "gallery"
PICTURES = ROOT / "docs" / "pictures"
# Size of the drawing [mm], with the ratio of the gallery's thumbnails, 400 × 280 pixels.
WIDTH_MM = 60.0
HEIGHT_MM = 42.0
# Margin around the body [mm].
MARGIN_MM = 3.0
# Resolution [1/inch]: twice the size of a thumbnail, for screens with a high resolution.
RESOLUTION_DPI = 339
FIELD = "von_mises_pa"
# Problem file, index of the experiment and overrides of the scripts with measured data.
MEASURED = {
    "measured_beam": ("srl_beam/gravity.toml", 0, ("object.mesh=beam.vtu",)),
    "measured_cylinders": ("phantom_compression/problem.toml", 0, ()),
    "measured_tentacle": ("soft_tentacle/problem.toml", 3, ()),
}
# Script without a mesh: a cube with the measured equibiaxial stretches is drawn.
WITHOUT_MESH = "3_rubber_tests"
EQUIBIAXIAL_STRETCH = 1.6
# Scripts whose own figure is the thumbnail, at this resolution [1/inch].
FIGURES = ("measured_brain", "measured_silicone")
FIGURE_DPI = 100


class _FirstSimulation(Exception):
    """End of a script at its first simulation; contains the experiment and the motion."""

    def __init__(self, experiment: cs.Experiment, motion: Any, values: dict[str, float]) -> None:
        super().__init__()
        self.experiment = experiment
        self.motion = motion
        self.values = values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="scripts; all by default")
    chosen = parser.parse_args().names
    for script in sorted(GALLERY.glob("*/*.py")):
        if chosen and script.stem not in chosen:
            continue
        figure = thumbnail(script)
        resolution_dpi = FIGURE_DPI if script.stem in FIGURES else RESOLUTION_DPI
        figure.savefig(PICTURES / f"{script.stem}.png", dpi=resolution_dpi)
        print(PICTURES / f"{script.stem}.png")


def thumbnail(script: Path) -> Figure:
    """Return the thumbnail of a script of the gallery."""
    if script.stem == WITHOUT_MESH:
        return stretched_cube()
    if script.stem in FIGURES:
        with patch.object(plt, "show"):
            runpy.run_path(str(script))
        return plt.gcf()
    if script.stem in MEASURED:
        file, index, overrides = MEASURED[script.stem]
        problem = cs.Problem.read(ROOT / "problems" / file, overrides)
        experiment = problem.experiments[index]
        motion = cs.simulate(experiment, problem.parameters)
        return draw_body(experiment, motion, problem.parameters.guesses)
    first = first_simulation(script)
    return draw_body(first.experiment, first.motion, first.values)


def first_simulation(script: Path) -> _FirstSimulation:
    """Run a script up to its first simulation, in a temporary folder."""
    simulate = cs.simulate

    def interrupting(experiment: cs.Experiment, values: Any, *options: Any, **named: Any) -> Any:
        motion = simulate(experiment, values, *options, **named)
        raise _FirstSimulation(experiment, motion, dict(values))

    home = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            with patch.object(cs, "simulate", interrupting):
                runpy.run_path(str(script))
        except _FirstSimulation as first:
            return first
        finally:
            os.chdir(home)
    raise SystemExit(f"{script}: no simulation before its end")


def draw_body(experiment: cs.Experiment, motion: Any, values: Mapping[str, float]) -> Figure:
    """Draw the body at the sample of its largest deflection, coloured by the von Mises stress."""
    replay = MotionRecord.from_experiment(experiment, (motion.positions_m, motion.markers_m))
    shapes_m = replay.shapes_m
    assert shapes_m is not None
    rigid_m = experiment.rigid_positions(experiment.t_s)[:, : shapes_m.shape[1]]
    deflections_m = np.linalg.norm(shapes_m - rigid_m, axis=2).max(axis=1)
    sample = int(deflections_m.argmax())
    body = experiment.body
    fields = ElementFields.from_body(body, body.theta_from_values(values))
    stress_pa = fields.evaluate_at(shapes_m[[sample]])[FIELD][0]
    shares = stress_pa[body.mesh.surface_cells] / max(stress_pa.max(), 1e-12)
    surface_m = shapes_m[:, np.unique(replay.surface)]
    is_grasped = experiment.is_prescribed(experiment.t_s[[sample]])[0]
    # Planes of symmetry and nodes in the middle of edges are not marked.
    is_grasped = is_grasped[: shapes_m.shape[1]].all(axis=1)
    is_grasped[len(body.mesh.points_m) :] = False
    return draw_shape(
        ParallelCamera.facing_motion(surface_m, replay.up),
        replay,
        positions_m=shapes_m[sample],
        markers_m=motion.markers_m[sample],
        is_grasped=is_grasped,
        shares=shares,
    )


def draw_shape(
    camera: ParallelCamera,
    replay: MotionRecord,
    *,
    positions_m: np.ndarray,
    markers_m: np.ndarray,
    is_grasped: np.ndarray,
    shares: np.ndarray,
) -> Figure:
    """Draw one shape as large as possible.

    Parameters
    ----------
    camera : ParallelCamera
    replay : MotionRecord
        Provides the surface of the body.
    positions_m : (n, 3) array
        Positions of the nodes.
    markers_m : (M, 3) array
        Positions of the markers.
    is_grasped : (n,) bool array
        Whether a node is grasped.
    shares : (F,) array
        Colours of the boundary triangles, from 0 to 1.
    """
    figure, axes = sheet(WIDTH_MM, HEIGHT_MM)
    view = SheetView.fit_points(
        camera,
        np.vstack([positions_m, markers_m]),
        room_mm=(WIDTH_MM - 2 * MARGIN_MM, HEIGHT_MM - 2 * MARGIN_MM),
        corner_mm=(MARGIN_MM, MARGIN_MM),
    )
    drawing = BodyDrawing(
        axes, view, surface=replay.surface, parts=replay.surface_parts, nodes=replay.surface_nodes
    )
    drawing.update(positions_m, is_grasped, markers_m, FIELD_COLOURS(shares)[:, :3])
    return figure


def stretched_cube() -> Figure:
    """Draw a cube under equibiaxial stretch, and the outline of the undeformed cube."""
    figure, axes = sheet(WIDTH_MM, HEIGHT_MM)
    mesh = box_mesh((1.0, 1.0, 1.0), (3, 3, 3), (-0.5, -0.5, -0.5))
    stretch = EQUIBIAXIAL_STRETCH
    stretched_m = mesh.points_m * (stretch, stretch, 1 / stretch**2)
    camera = ParallelCamera.facing_motion(
        np.stack([mesh.points_m, stretched_m]), np.array([0.0, 0.0, 1.0])
    )
    view = SheetView.fit_points(
        camera,
        np.vstack([mesh.points_m, stretched_m]),
        room_mm=(WIDTH_MM - 2 * MARGIN_MM, HEIGHT_MM - 2 * MARGIN_MM),
        corner_mm=(MARGIN_MM, MARGIN_MM),
    )
    nothing = np.zeros(len(mesh.points_m), dtype=bool)
    colours = np.tile(FIELD_COLOURS(0.5)[:3], (len(mesh.surface), 1))
    drawing = BodyDrawing(axes, view, surface=mesh.surface)
    drawing.update(stretched_m, nothing, np.empty((0, 3)), colours)
    outline = BodyDrawing(axes, view, surface=mesh.surface, edge_colour="0.6")
    outline.update(mesh.points_m, nothing, np.empty((0, 3)))
    return figure


if __name__ == "__main__":
    main()
