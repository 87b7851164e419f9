"""Linear fits with known errors: a damped oscillation seen by a few markers, no simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.statistics.linearised import LinearisedFit, ResidualBlock

SAMPLE_S = 0.01
PARAMETERS = Parameters(
    tuple(
        Parameter(name, 1.0, 1e-9, 1e9)
        for name in ("lambda_pa", "mu_pa", "gamma_r_s", "gamma_m_1_s")
    )
)


@dataclass(frozen=True, eq=False)
class Problem:
    """Slopes of each experiment (T, M, 3, p) and priors; the shared parameters come first."""

    slopes: tuple[np.ndarray, ...]
    names: tuple[str, ...]
    prior_slope: np.ndarray
    present: tuple[np.ndarray, ...]

    def fit(self, errors: list[np.ndarray], truth: np.ndarray) -> tuple[LinearisedFit, np.ndarray]:
        """The fit to errors (T, M, 3) of each experiment, and the parameters less the truth (p,).

        The priors are at zero, so `truth` is how far the priors are wrong.
        """
        rows = [
            np.where(seen[..., None, None], slope, 0.0)
            for slope, seen in zip(self.slopes, self.present, strict=True)
        ]
        errors = [
            np.where(seen[..., None], error, 0.0)
            for error, seen in zip(errors, self.present, strict=True)
        ]
        width = len(self.names)
        matrix = np.concatenate([*(r.reshape(-1, width) for r in rows), np.diag(self.prior_slope)])
        right = np.concatenate([*(e.ravel() for e in errors), -self.prior_slope * truth])
        wrong = np.linalg.lstsq(matrix, right)[0]
        blocks = tuple(
            ResidualBlock(
                name=f"swing {k}",
                t_s=SAMPLE_S * np.arange(len(row)),
                marker_names=tuple(f"m{m}" for m in range(row.shape[1])),
                is_present=seen,
                residual=row @ wrong - error,
                jacobian=row,
                sigma_m=np.full(row.shape[1], 1e-3),
            )
            for k, (row, seen, error) in enumerate(zip(rows, self.present, errors, strict=True))
        )
        fit = LinearisedFit(
            blocks=blocks,
            names=self.names,
            shared_count=4,
            prior_residual=self.prior_slope * (wrong + truth),
            prior_jacobian=self.prior_slope,
            at_bound=np.zeros(width, dtype=bool),
        )
        return fit, wrong


def problem(
    samples: tuple[int, ...], markers: int, offsets: bool = True, missing: float = 0.0
) -> Problem:
    """Two damped modes, seen by markers that they move differently.

    NuisanceMap parameters are a time shift and, with `offsets`, the place of every marker.
    """
    rng = np.random.default_rng(0)
    slopes, names, priors, present = (
        [],
        list(item.name for item in PARAMETERS.items),
        [0.0] * 4,
        [],
    )
    locals_of = 1 + (3 * markers if offsets else 0)
    width = 4 + len(samples) * locals_of
    for k, count in enumerate(samples):
        shapes = np.array([1.5, 0.0, 0.0])[:, None] + rng.normal(size=(3, 3 * markers)) * [
            [1.0],
            [0.4],
            [0.3],
        ]
        t_s = SAMPLE_S * np.arange(count)
        slope = np.zeros((count, 3 * markers, width))
        for j, step in enumerate(1e-5 * np.eye(5)):
            change = _motion(step, t_s, shapes) - _motion(-step, t_s, shapes)
            column = j if j < 4 else 4 + k * locals_of
            slope[..., column] = change / 2e-5
        names.append(f"swing {k}: time shift [s]")
        priors.append(1.0)
        if offsets:
            for c in range(3 * markers):
                slope[:, c, 5 + k * locals_of + c] = 1.0
                names.append(f"swing {k}: offset of m{c // 3}, {'xyz'[c % 3]} [m]")
                priors.append(1 / 3)
        slopes.append(slope.reshape(count, markers, 3, width))
        present.append(rng.random((count, markers)) >= missing)
    return Problem(tuple(slopes), tuple(names), np.array(priors), tuple(present))


def _motion(step: np.ndarray, t_s: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """(T, 3M) in units of σ after a step of two stiffnesses, two dampings, and 10 ms of time."""
    first, second, stiff, mass = np.exp(step[:4])
    t_s = t_s + 0.01 * step[4]
    stiffness = np.array([0.3 * first + 0.7 * second, 0.8 * first + 0.2 * second])
    found = -9.0 * shapes[2] / stiffness[0] + np.zeros((len(t_s), 1))
    for shape, at, frequency_hz in zip(shapes[:2], stiffness, (3.0, 9.0), strict=True):
        angular = 2 * np.pi * frequency_hz * np.sqrt(at)
        decay = (0.004 * stiff * angular**2 + mass) / 2
        swing = np.exp(-decay * t_s) * np.cos(angular * t_s) - 1
        found = found + 30.0 * shape * swing[:, None] / at
    return found


def autoregressive(
    rng: np.random.Generator, samples: int, markers: int, phi: float, shared: float = 0.0
) -> np.ndarray:
    """(T, M, 3) errors of unit variance, correlated in time and (`shared`) among channels."""
    start = 300
    white = rng.normal(size=(samples + start, 3 * markers))
    common = rng.normal(size=(samples + start, 1))
    mixed = np.sqrt(1 - shared) * white + np.sqrt(shared) * common
    found = lfilter([np.sqrt(1 - phi**2)], [1, -phi], mixed, axis=0)[start:]
    return found.reshape(samples, markers, 3)
