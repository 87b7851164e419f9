"""Draw the README's picture: the foam cylinder's shapes over time, with measured markers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from collocation_sysid import load_problem, simulate

ROOT = Path(__file__).parents[1]
SHOWN = 6
TRUTH = {"lambda_pa": 800.0, "mu_pa": 600.0, "gamma_r_s": 0.006, "gamma_m_1_s": 1.5}


def main() -> None:
    problem = load_problem(ROOT / "problems" / "foam_cylinder" / "problem.toml")
    experiment, surface = problem.experiments[0], problem.body.mesh.surface
    trajectory = simulate(experiment, TRUTH)
    figure = Figure(figsize=(9, 2.0), layout="constrained")
    positions, measured = trajectory.positions_m, experiment.markers.positions_m
    low, high = positions.min(axis=(0, 1)), positions.max(axis=(0, 1))
    for place, t in enumerate(np.linspace(0, len(positions) - 1, SHOWN).astype(int)):
        axes = figure.add_subplot(1, SHOWN, place + 1, projection="3d", computed_zorder=False)
        skin = Poly3DCollection(positions[t][surface], linewidths=0.3, edgecolors="#4a4a4a")
        skin.set_facecolor("#a9c8e8")
        axes.add_collection3d(skin)
        held = positions[t][experiment.held_nodes]
        axes.scatter(*held.T, s=9, color="#000000", depthshade=False)
        axes.scatter(*measured[t].T, s=14, color="#d55e00", depthshade=False)
        axes.set(**{f"{axis}lim": ends for axis, *ends in zip("xyz", low, high, strict=True)})
        axes.set_box_aspect(high - low, zoom=1.25)  # pyright: ignore[reportArgumentType]
        axes.view_init(elev=12, azim=-60)
        axes.set_axis_off()
        axes.set_title(f"{experiment.t_s[t] - experiment.t_s[0]:.2f} s", y=-0.05, fontsize=9)
    figure.savefig(ROOT / "docs" / "swing.png", dpi=130)


if __name__ == "__main__":
    main()
