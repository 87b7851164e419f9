"""Check of a custom sensor: `check_sensor`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import ClassVar

import casadi as ca
import numpy as np

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..fem.body import Body
from ..fem.meshes.mesh import TetMesh
from ..fem.meshes.structured import box_mesh
from ..program.collocation import Collocation
from ..program.custom_sensor_residual import CustomSensorResidual
from ..recording.custom_sensor import CustomSensor, stack_values
from .property_check import PropertyCheck
from .small_problems import DENSITY_KG_M3, STEPS, TIMESTEP_S, program_of, swung_experiment

# Number of random states.
STATES = 3
# Random velocities [m/s], accelerations [m/s²], forces [N] and torques [N m] of a hand-held body
# of 0.1 m.
SIZES = {
    "position_m": 2e-3,
    "velocity_m_s": 0.3,
    "acceleration_m_s2": 10.0,
    "force_n": 1.0,
    "torque_nm": 0.05,
}
# Space between the points of a sensor and the surface of the small body [m].
MARGIN_M = 0.02
# Sample times of the sensor within the small recording: between its samples, too.
SAMPLES = 7


@validated
def check_sensor(sensor: CustomSensor) -> None:
    """Check a custom sensor: values, derivatives and predictions.

    At random states the expression's first and second derivatives agree with central differences
    of the expression called with numbers. In a small recording of a body around the sensor's
    points, the prediction for a motion that is quadratic in time is the expression at the exact
    positions, velocities and accelerations.

    Parameters
    ----------
    sensor : CustomSensor
        Sensor on points or on a grasp; its samples are not used.

    Raises
    ------
    AssertionError
        For the first property that fails: which one, where, found and expected value.

    Notes
    -----
    The prediction for a known motion is checked only for sensors on points. Values of `sensor` and
    its times are ignored.
    """
    check = PropertyCheck(f"sensor {sensor.name!r}")
    expression = SensorExpression(sensor)
    for number in range(STATES):
        u = expression.random_state(check.rng)
        _check_derivatives(check, expression, u=u, where=f"at random state {number}")
    if sensor.grasp is None:
        _check_prediction(check, expression, collocation=_small_program(sensor))


@dataclass(frozen=True, eq=False)
class SensorExpression:
    """Expression of a sensor as a function of u: inputs, column after column, then unknowns."""

    t_s: ClassVar[float] = 2.5 * TIMESTEP_S  # time at which the expression is evaluated [s]

    sensor: CustomSensor

    def make_inputs(self) -> dict[str, Array]:
        """Return the undeformed values of the inputs by name: for a sensor on P points positions
        and zeros of velocity and acceleration, (3, P) each; at a grasp ones (3, 1) for force and
        torque.
        """
        _, *names = (each.name for each in fields(self.sensor.quantities))
        if self.sensor.grasp is not None:
            return {name: np.ones((3, 1)) for name in names}
        points = np.asarray(self.sensor.points_m).T
        return {name: points if name == "position_m" else np.zeros_like(points) for name in names}

    def random_state(self, rng: np.random.Generator) -> Array:
        """Return u (k,): inputs near the undeformed ones, with deviations of `SIZES`, and unknowns
        of the size of their priors.
        """
        changed = [
            (each + SIZES[name] * rng.standard_normal(each.shape)).ravel(order="F")
            for name, each in self.make_inputs().items()
        ]
        sigmas = np.array([*self.sensor.unknowns.values()], dtype=float)
        return np.concatenate([*changed, sigmas * rng.standard_normal(len(sigmas))])

    def compute_scale(self) -> Array:
        """Return the size of a large change of each entry of u (k,): `SIZES` for inputs, the prior
        standard deviation for unknowns.
        """
        sizes = [np.full(each.size, SIZES[name]) for name, each in self.make_inputs().items()]
        return np.concatenate([*sizes, np.array([*self.sensor.unknowns.values()], dtype=float)])

    def evaluate_plain(self, u: Array, t_s: float | None = None) -> Array:
        """Return the numbers (c,) of the sensor by calling its expression with numbers; a matrix
        column after column.

        Parameters
        ----------
        t_s : float, optional
            Time of the sample; that of the random states by default.
        """
        shapes = [each.shape for each in self.make_inputs().values()]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        *parts, unknowns = np.split(u, ends)
        values = (
            ca.DM(part.reshape(shape, order="F")) for part, shape in zip(parts, shapes, strict=True)
        )
        named = dict(zip(self.sensor.unknowns, map(float, unknowns), strict=True))
        now_s = self.t_s if t_s is None else t_s
        # Numbers in place of expressions.
        at = self.sensor.quantities(now_s, *values)  # type: ignore[arg-type]
        reading = stack_values(self.sensor.predict(at, **named))
        return ca.evalf(reading).full().ravel()

    @cached_property
    def automatic(self) -> ca.Function:
        """Function of u and weights w: y, ∂y/∂u and ∂²(wᵀy)/∂u², from the expression in SX at the
        time `t_s`.
        """
        symbols = [ca.SX.sym(name, *each.shape) for name, each in self.make_inputs().items()]
        unknowns = ca.SX.sym("unknowns", len(self.sensor.unknowns))
        own = ca.vertsplit(unknowns) if self.sensor.unknowns else []
        y = self.sensor.read(ca.SX(self.t_s), symbols, own)
        u = ca.veccat(*symbols, unknowns)
        weights = ca.SX.sym("w", y.numel())
        second, _ = ca.hessian(ca.dot(weights, y), u)
        outputs = [y, ca.densify(ca.jacobian(y, u)), ca.densify(second)]
        return ca.Function("automatic", [u, weights], outputs)


def _check_derivatives(
    check: PropertyCheck, expression: SensorExpression, u: Array, where: str
) -> None:
    """Compare value and derivatives with numbers and central differences."""
    plain = expression.evaluate_plain(u)
    weights = check.rng.standard_normal(len(plain))
    y, jacobian, hessian = (each.full() for each in expression.automatic.call([u, weights]))
    check.require_equal(
        y.ravel(), plain, statement=f"the expression differs from its function {where}"
    )
    check.require_derivative(
        expression.evaluate_plain,
        jacobian,
        point=u,
        statement=f"the first derivative of the expression is wrong {where}",
        scale=expression.compute_scale(),
    )
    check.require_derivative(
        lambda at: weights @ expression.automatic.call([at, weights])[1].full(),
        hessian,
        point=u,
        statement=f"the second derivative of the expression is wrong {where}",
        scale=expression.compute_scale(),
    )


def _small_program(sensor: CustomSensor) -> Collocation:
    """Return the program of a small recording with the sensor, whose body is a box that contains
    the sensor's points with a margin.
    """
    points = np.asarray(sensor.points_m).reshape(-1, 3)
    low = points.min(axis=0)
    high = points.max(axis=0)
    size = tuple(float(each) for each in high - low + 2 * MARGIN_M)
    box = box_mesh(size, (1, 1, 2))
    mesh = TetMesh(box.points_m + low - MARGIN_M, box.tetrahedra)
    t_s = np.linspace(1.3, STEPS - 1.3, SAMPLES) * TIMESTEP_S
    retimed = sensor.with_samples(t_s, None)
    body = Body(mesh, density_kg_m3=DENSITY_KG_M3)
    return program_of(swung_experiment(body, readings=[retimed]), {})


def _check_prediction(
    check: PropertyCheck, expression: SensorExpression, collocation: Collocation
) -> None:
    """Require that the predicted numbers are the expression's value at exact positions, velocities
    and accelerations, for a motion that is affine in space and quadratic in time, with random
    unknowns.
    """
    transcription = collocation.transcriptions[0]
    rates = [scale * check.rng.standard_normal((3, 3)) for scale in (0.05, 1.0, 20.0)]
    identity = np.eye(3)

    def gradient_at(t: float) -> list[Array]:
        """Return the matrix (3, 3) of the motion x = A(t) X at a time [s], with its first and
        second derivative by time.
        """
        zero, one, two = rates
        return [identity + zero + one * t + two * t**2, one + 2 * two * t, 2 * two]

    grid_s = transcription.dynamics.t_s
    nodes_m = transcription.body.nodes_m
    x = np.array([(nodes_m @ gradient_at(t)[0].T).ravel() for t in grid_s])
    p = collocation.guess_p
    p[collocation.nq :] = check.rng.standard_normal(collocation.nphi)
    (iterate,) = collocation.iterates_at(p, [x])
    (residual,) = transcription.residuals_of(CustomSensorResidual)
    motion = iterate.motion_for(residual.observable)
    found = residual.numbers(residual.predict_motion(motion, iterate.phi))
    unknowns = iterate.phi * np.array([*expression.sensor.unknowns.values()], dtype=float)
    points = np.asarray(expression.sensor.points_m).T
    for t_s, numbers in zip(residual.t_s, found, strict=True):
        exact = [(matrix @ points).ravel(order="F") for matrix in gradient_at(t_s)]
        check.require_equal(
            numbers,
            expression.evaluate_plain(np.concatenate([*exact, unknowns]), float(t_s)),
            statement=f"the prediction for a known motion is wrong at t = {t_s:.4g} s",
            tolerance=1e-7,
        )
