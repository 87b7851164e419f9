"""Accuracy of spatially varying stiffness, for twins whose stiffness is known.

A block with markers on its surface hangs from a swung hand. The problem does not state its stiff
half, or a stiff ball inside: one field of Young's modulus over the whole body is estimated. The
table has the share of elements whose 95 % interval contains the true value: of all elements, and of
those that the data determine, whose interval is less than half as wide as that of the prior. The
tracks are simulated with the scheme of the fit, each with its own noise, on a mesh that follows the
boundary between the materials.

    nice -n 15 python scripts study_field --twins 10
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from script_arguments import make_parser
from synthetic import swing

import collocation_sysid as cs
from collocation_sysid.fem.body import Body
from collocation_sysid.statistics.field_estimates import FieldEstimate, field_estimates
from collocation_sysid.statistics.pose_noise import uncertainty_at

Array = NDArray[np.float64]
# Edges of the block and of its elements [m].
SIZE_M = (0.04, 0.04, 0.12)
EDGE_M = 0.01
# Sampling interval [s], and standard deviation of each marker coordinate [m].
STEP_S = 1 / 60
SIGMA_M = 1e-4
# True Young's modulus of the surroundings [Pa], and the other true constants.
YOUNG_PA = 3e4
OTHER_TRUTHS = {"poisson": 0.45, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.1}
# Centre and radius of the stiff ball [m].
BALL_M = np.array([0.022, 0.02, 0.06])
RADIUS_M = 0.015


@dataclass(frozen=True)
class FieldTwin:
    """True stiffness of a block, and the prior of the estimated field."""

    name: str
    kind: str  # stiff part: "half", "ball" or "none"
    ratio: float  # stiffness of the stiff part over that of the rest
    # Correlation length of the prior [m]; of several lengths the data select one.
    length_m: float | tuple[float, ...] = 0.04
    modes: int = 40  # number of shapes of the field
    amplitude: float = 0.5  # standard deviation of the logarithm of stiffness in the prior
    # Numbers of markers and of samples.
    markers: int = 48
    steps: int = 40


def stiff_cells(kind: str, mesh: cs.TetMesh) -> NDArray[np.bool_]:
    """Return the mask (cells,) of the stiffer cells; `kind` as in the twin."""
    centres = mesh.points_m[mesh.tetrahedra].mean(axis=1)
    if kind == "half":
        return centres[:, 2] < SIZE_M[2] / 2
    if kind == "ball":
        return np.linalg.norm(centres - BALL_M, axis=1) < RADIUS_M
    return np.zeros(len(centres), dtype=bool)


def hanging_block(body: Body, count: int, steps: int) -> cs.Experiment:
    """Return a recording of the block without tracks, with `count` markers and `steps` samples."""
    t_s = STEP_S * np.arange(steps)
    upright = Rotation.identity()
    poses = swing(t_s, (0.02, 0.02, 0.01), (0.3, 0.3, 0.5), (1.7, 2.3, 1.3), 0.2, upright)
    x = body.nodes_m
    high = np.array(SIZE_M)
    surface = np.flatnonzero(
        ((x < 1e-9) | (x > high - 1e-9)).any(axis=1) & (x[:, 2] < high[2] - 0.01)
    )
    chosen = np.random.default_rng(0).permutation(surface)[:count]
    names = [f"m{k}" for k in range(len(chosen))]
    no_tracks = np.zeros((steps, len(chosen), 3))
    markers = cs.Markers(t_s, no_tracks, SIGMA_M, names, x[chosen]).on_body(body)
    grasp = cs.Grasp(np.flatnonzero(x[:, 2] > high[2] - 1e-9), poses)
    return cs.Experiment(body, t_s, [grasp], markers, nuisance=cs.Nuisance.none())


def problem_of(twin: FieldTwin, seed: int) -> tuple[cs.Problem, Array]:
    """Return the problem of a twin, and the logarithm of the true E in every cell (cells,)."""
    mesh = cs.box_mesh(SIZE_M, tuple(round(size / EDGE_M) for size in SIZE_M))
    stiff = stiff_cells(twin.kind, mesh)
    regions = [cs.Region("stiff", stiff)] if stiff.any() else []
    true_body = Body(mesh, density_kg_m3=1000.0, regions=regions)
    values = {"young_pa": YOUNG_PA, "stiff.young_pa": twin.ratio * YOUNG_PA, **OTHER_TRUTHS}
    true_values = {n: v for n, v in values.items() if regions or not n.startswith("stiff")}
    simulation = cs.simulate(
        hanging_block(true_body, twin.markers, twin.steps), true_values, "midpoint", substeps=1
    )
    field = cs.Field(twin.length_m, modes=twin.modes, amplitude=twin.amplitude)
    described = hanging_block(
        Body(mesh, density_kg_m3=1000.0, field=field), twin.markers, twin.steps
    )
    noise = np.random.default_rng(seed).normal(size=simulation.markers_m.shape)
    experiment = cs.with_markers(described, simulation.markers_m + SIGMA_M * noise)
    guesses = {n: cs.Unknown(0.7 * values[n]) for n in ("young_pa", "gamma_r_s")}
    problem = cs.Problem([experiment], {**OTHER_TRUTHS, **guesses}, substeps=1)
    return problem, np.log(YOUNG_PA * np.where(stiff, twin.ratio, 1.0))


TWINS = (
    FieldTwin("stiff half, twice", "half", 2.0, 0.04, 60),
    FieldTwin("the same, length of 3", "half", 2.0, (0.01, 0.04, 0.16), 60),
    FieldTwin("the same, 12 markers", "half", 2.0, 0.04, 60, markers=12),
    FieldTwin("stiff ball, twice", "ball", 2.0, 0.03, 80),
    FieldTwin("stiff ball, three times", "ball", 3.0, 0.03, 80),
    FieldTwin("even", "none", 1.0, 0.04, 60),
    FieldTwin("half, amplitude 0.1", "half", 2.0, 0.04, 60, 0.1),
    FieldTwin("half, length 0.4 m", "half", 2.0, 0.4, 60),
    FieldTwin("half, length 0.004 m", "half", 2.0, 0.004, 60),
)


@dataclass(frozen=True)
class FieldAnswer:
    """Estimated field of one twin."""

    field: FieldEstimate
    truth: Array  # logarithm of the true E [Pa]
    mesh: cs.TetMesh


def identify(twin: FieldTwin, seed: int) -> FieldAnswer:
    """Identify a twin."""
    problem, truth = problem_of(twin, seed)
    solution = cs.solve(problem)
    assert solution.status.converged, solution.message
    collocation = solution.collocation
    uncertainty = uncertainty_at(collocation, solution.z)
    body = collocation.transcriptions[0].body
    (field,) = field_estimates(body, collocation.parameters, solution.q, uncertainty)
    return FieldAnswer(field, truth, body.mesh)


def table_row(twin: FieldTwin, seeds: range) -> str:
    """Return a row of the table, with the means over the twins of all seeds."""
    rows = []
    notes = set[str]()
    for seed in seeds:
        answer = identify(twin, seed)
        field, truth = answer.field, answer.truth
        low, high = np.log(field.statistical95)
        contains_truth = (low < truth) & (truth < high)
        stiff = stiff_cells(twin.kind, answer.mesh)
        log = np.log(field.value)
        z_m = answer.mesh.points_m[answer.mesh.tetrahedra].mean(axis=1)[:, 2]
        determined = field.is_informed
        rows.append(
            (
                100 * determined.mean(),
                100 * contains_truth[determined].mean() if determined.any() else np.nan,
                100 * contains_truth.mean(),
                np.sqrt(np.mean((log - truth) ** 2)),
                np.median(field.deviation),
                np.exp(log[stiff].mean() - log[~stiff].mean()) if stiff.any() else np.nan,
                1e3 * step_height_m(z_m, log) if twin.kind == "half" else np.nan,
                100 * contains_truth[stiff].mean() if stiff.any() else np.nan,
            )
        )
        notes |= {concern.code for concern in field.list_concerns()}
        notes |= {f"length {field.modes.length_m:g}"} if isinstance(twin.length_m, tuple) else set()
    cells = [f"{mean:.3g}" for mean in np.mean(rows, axis=0)]
    return f"| {twin.name} | {' | '.join(cells)} | {', '.join(sorted(notes))} |"


def step_height_m(z_m: Array, log: Array) -> float:
    """Return the height of the step that fits the logarithm of stiffness best [m].

    `z_m` (cells,) are the heights of the cells, and `log` (cells,) are their logarithms.
    """
    edges = np.linspace(0, SIZE_M[2], 61)[5:-5]
    misfits = [
        sum(
            ((part - part.mean()) ** 2).sum()
            for part in (log[z_m < height_m], log[z_m >= height_m])
        )
        for height_m in edges
    ]
    return float(edges[np.array(misfits) < min(misfits) * (1 + 1e-9)].mean())


def main() -> None:
    """Run the study with the options of the command line, and print its tables."""
    parser = make_parser(__doc__)
    parser.add_argument("--twins", type=int, default=10)
    parser.add_argument("--only", default="", help="twins whose name contains this text")
    options = parser.parse_args()
    print(
        "| twin | elements determined % | coverage of their intervals % | of all intervals % "
        "| RMS error of ln E | median standard deviation of ln E | ratio | step at mm "
        "| coverage in the stiff part % | notes |\n|---|" + "---|" * 9
    )
    for twin in TWINS:
        if options.only in twin.name:
            print(table_row(twin, range(options.twins)), flush=True)


if __name__ == "__main__":
    main()
