"""Certified regressions of NIST (Statistical Reference Datasets, nonlinear) as identifications.

The response y = f(x; b) is the force of a custom law with the constants b on a node of a body whose
grasp moves it to x; all of its nodes are held, gravity is zero, and a sensor at the grasp measures
the force. Search, covariance and profile likelihood are therefore those of any recording.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array

# Constants of the body, which is not deformed.
UNUSED = {"young_pa": 1e-3, "poisson": 0.3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


@dataclass(frozen=True, eq=False)
class Regression:
    """One regression with P parameters, S observations, and V predictors."""

    name: str
    difficulty: str
    formula: str  # f(x; b) in Python, of exp, cos, sin, arctan, pi, the predictors and b1, b2, …
    x: Array  # (S, V)
    y: Array  # (S,): response; the logarithm of the measured one where the model states that
    starts: Array  # (2, P): official starting values
    # (P,): certified values and standard errors.
    values: Array
    errors: Array
    squares: float  # certified residual sum of squares

    @property
    def names(self) -> list[str]:
        """Names (P,) of the parameters, b1, b2, …"""
        return [f"b{k + 1}" for k in range(len(self.values))]

    def predict(self, x: Any, b: Any, module: Any = np) -> Any:
        """Evaluate f at predictors (V, …) and parameters (P,), with the functions of a module."""
        names = ["x"] if len(x) == 1 else [f"x{k + 1}" for k in range(len(x))]
        functions = {name: getattr(module, name) for name in ("exp", "cos", "sin")}
        arctan = module.arctan if module is np else module.atan
        known = functions | {"arctan": arctan, "pi": np.pi}
        known |= dict(zip(names, x, strict=True)) | dict(zip(self.names, b, strict=True))
        return eval(self.formula, {"__builtins__": {}}, known)

    def residuals(self, b: Array) -> Array:
        """Return f(x; b) − y (S,)."""
        return self.predict(self.x.T, b) - self.y


def read_regression(path: Path) -> Regression:
    """Read a file of the nonlinear regressions of NIST, as published."""
    text = path.read_text()
    lines = text.splitlines()
    (formula,) = re.findall(r"^\s*(?:y|log\[y\])\s*=(.*?)\+\s*e\s*$", text, re.M | re.S)
    formula = " ".join(formula.replace("[", "(").replace("]", ")").split())
    table = np.array([line.split()[2:6] for line in lines if re.match(r"\s*b\d+\s*=", line)], float)
    (squares,) = re.findall(r"Residual Sum of Squares:\s+(\S+)", text)
    (difficulty,) = re.findall(r"(Lower|Average|Higher) Level of Difficulty", text)
    first = max(k for k, line in enumerate(lines) if line.startswith("Data:")) + 1
    data = np.array([line.split() for line in lines[first:] if line.strip()], float)
    y = np.log(data[:, 0]) if "log[y]" in text else data[:, 0]
    return Regression(
        path.stem,
        difficulty,
        formula,
        data[:, 1:],
        y,
        table[:, :2].T,
        table[:, 2],
        table[:, 3],
        float(squares),
    )


def as_problem(regression: Regression, start: Array, sigma: float) -> cs.Problem:
    """State a regression as an identification with static samples, one second apart."""
    predictors = regression.x.shape[1]

    def force(x: ca.SX, v: ca.SX, at: Any, **b: ca.SX) -> list[ca.SX | float]:
        response = regression.predict(ca.vertsplit(x)[:predictors], list(b.values()), ca)
        return [response, 0.0, 0.0]

    constants = tuple(
        cs.Constant(name, bounds=(-1e30, 1e30), scale="linear", typical=abs(float(value)))
        for name, value in zip(regression.names, start, strict=True)
    )
    mesh = cs.box_mesh((1.0, 1.0, 1.0), (1, 1, 2))
    law = cs.NodeForce("response", force, constants, nodes=np.array([0]))
    body = cs.Body(mesh, density_kg_m3=1.0, forces=[law])
    t_s = np.arange(len(regression.y), dtype=float)
    moved = np.zeros((len(t_s), 3))
    moved[:, :predictors] = regression.x
    poses = cs.PoseSequence(t_s, moved, np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)))
    held = np.flatnonzero(mesh.points_m[:, 2] < 0.75)
    hold = cs.Grasp(held, poses)
    gauge = cs.Gauge(
        "response", lambda at: -at.force_n[0], t_s, regression.y, sigma, grasp=1, frame="world"
    )
    experiment = cs.Experiment(
        body,
        t_s,
        [hold],
        readings=[gauge],
        nuisance=cs.Nuisance.none(),
        kind="static",
        gravity_m_s2=(0.0, 0.0, 0.0),
        air_density_kg_m3="none",
    )
    unknowns = {name: cs.Unknown(float(v)) for name, v in zip(regression.names, start, strict=True)}
    return cs.Problem([experiment], UNUSED | unknowns)
