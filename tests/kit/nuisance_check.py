"""Check of a nuisance parameter of a recording: `check_nuisance`."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from collocation_sysid.common.array_types import Array
from collocation_sysid.fem.body import Body
from collocation_sysid.model.nuisance_map import NuisanceMap
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.markers.residual import MarkerResidual
from collocation_sysid.recording.deviation import Deviation
from collocation_sysid.recording.experiment import Experiment
from collocation_sysid.recording.nuisance import KINDS
from collocation_sysid.testing.property_check import PropertyCheck
from collocation_sysid.testing.small_problems import DENSITY_KG_M3, program_of, swung_experiment
from kit.problems import uneven_box
from kit.program_derivatives import require_derivatives

# Standard deviation of a kind that has none by default.
USUAL_SIGMA = 0.01
# Values of the parameters in their prior standard deviations: large enough that nothing is linear
# by accident.
LARGEST_DEVIATION = 0.5
# First sample of which all neighbours, which a clock interpolates from, are within the recording.
FIRST_INNER_SAMPLE = 2


def check_nuisance(row: Deviation, *, experiment: Experiment | None = None) -> None:
    """Check a nuisance parameter: effect and derivatives in programs.

    Zero changes nothing; the reading's first and second derivatives agree with central
    differences. In a small recording the predicted markers are the reading of those without the
    parameter, or the markers at the later time of its clock; gradient, Jacobian and Hessian of
    the program pass a Taylor test.

    Parameters
    ----------
    row : Deviation
        Parameter of your own, or one of the package.
    experiment : Experiment, optional
        Recording that has the parameter; by default a swung box with markers. Other parameters of
        its `nuisance` are kept.

    Raises
    ------
    AssertionError
        For the first property that fails: which one, where, found and expected value.
    InputError
        If the reading or clock cannot be evaluated, has the wrong shape, or is not finite at zero.
    """
    check = PropertyCheck(f"nuisance parameter {row.name!r}")
    base = experiment or swung_experiment(Body(uneven_box(1), density_kg_m3=DENSITY_KG_M3))
    changed = _with_row(base, row)
    size = NuisanceMap.from_experiment(changed).size
    if size == NuisanceMap.from_experiment(base).size:
        check.fail(
            f"the recording {base.name!r} has no value of this parameter",
            "no value",
            expected="at least one value",
        )
    collocation = program_of(changed, {})
    if row.reading is not None:
        _check_reading(check, row, collocation=collocation)
    if row.clock is not None:
        _check_clock(check, row, collocation=collocation)
    require_derivatives(check, collocation)


def _with_row(experiment: Experiment, row: Deviation) -> Experiment:
    """Return the experiment in which the parameter of a row is estimated."""
    nuisance = experiment.nuisance
    if row not in KINDS:
        return replace(experiment, nuisance=replace(nuisance, own=(*nuisance.own, row)))
    sigma = row.sigma or row.considered or USUAL_SIGMA
    return replace(experiment, nuisance=replace(nuisance, **{row.name: sigma}))


def _value_count(row: Deviation) -> int:
    """Return the number of axes of a row, 1 without axes."""
    return len(row.axes.split()) or 1


def _read(row: Deviation, y: Array, values: Array, t_s: float, data: NuisanceMap) -> Array:
    """Return the reading (3,), or the delay (1,), of a row, called with numbers."""
    argument = ca.DM(values)
    result = (
        row.reading(ca.DM(y), argument, t_s, data)  # type: ignore[arg-type]
        if row.reading
        else row.clock(argument, t_s, data)  # type: ignore[misc]
    )
    return np.ravel(ca.evalf(ca.SX(result)).full())


def _check_reading(check: PropertyCheck, row: Deviation, collocation: Collocation) -> None:
    """Require no effect at zero, right derivatives, and predictions by the reading."""
    assert row.reading is not None
    (transcription,) = collocation.transcriptions
    data = transcription.nuisance
    count = _value_count(row)
    sigma = row.sigma or row.considered or USUAL_SIGMA
    t_s = float(np.mean(data.recorded_s))
    y = check.rng.uniform(0.01, 0.1, 3)
    check.require_equal(
        _read(row, y, values=np.zeros(count), t_s=t_s, data=data),
        y,
        statement="the value zero changes the reading of a marker",
    )
    symbol = ca.SX.sym("u", 3 + count)
    weights = check.rng.standard_normal(3)
    expression = ca.SX(row.reading(symbol[:3], symbol[3:], ca.SX(t_s), data))
    first = ca.jacobian(expression, symbol)
    second, _ = ca.hessian(ca.dot(ca.DM(weights), expression), symbol)
    derivatives = ca.Function("d", [symbol], [ca.densify(first), ca.densify(second)])
    u = np.concatenate([y, sigma * check.rng.uniform(-LARGEST_DEVIATION, LARGEST_DEVIATION, count)])
    jacobian, hessian = (each.full() for each in derivatives.call([u]))
    scale = np.concatenate([np.full(3, 0.01), np.full(count, sigma)])
    check.require_derivative(
        lambda at: _read(row, at[:3], values=at[3:], t_s=t_s, data=data),
        jacobian,
        point=u,
        statement="the first derivative of the reading is wrong",
        scale=scale,
    )
    check.require_derivative(
        lambda at: weights @ derivatives.call([at])[0].full(),
        hessian,
        point=u,
        statement="the second derivative of the reading is wrong",
        scale=scale,
    )
    _check_predicted_reading(check, row, collocation=collocation)


def _marker_residual(collocation: Collocation) -> MarkerResidual:
    """Return the marker model of a recording with one experiment with markers."""
    (transcription,) = collocation.transcriptions
    (markers,) = (r for r in transcription.residuals if isinstance(r, MarkerResidual))
    return markers


def _check_predicted_reading(
    check: PropertyCheck, row: Deviation, collocation: Collocation
) -> None:
    """Require predicted markers by the reading, at every sample."""
    residual = _marker_residual(collocation)
    data = residual.nuisance
    x = _smooth_motion(collocation)
    phi = np.zeros(data.size)
    plain = residual.predict_positions(x, phi)
    for marker in range(plain.shape[1]):
        of_marker = [k for k in residual.own_parameters[marker] if data.entries[k].row == row]
        values = check.rng.uniform(-LARGEST_DEVIATION, LARGEST_DEVIATION, len(of_marker))
        phi[of_marker] = values
        predicted = residual.predict_positions(x, phi)[:, marker]
        physical = values * data.scales[of_marker]
        for sample, t_s in enumerate(residual.t_s):
            check.require_equal(
                predicted[sample],
                _read(row, plain[sample, marker], values=physical, t_s=float(t_s), data=data),
                statement=f"the predicted marker {residual.names[marker]} is not the reading "
                f"at t = {t_s:.4g} s",
                scale=float(np.abs(plain).max()),
            )


def _check_clock(check: PropertyCheck, row: Deviation, collocation: Collocation) -> None:
    """Require no delay at zero, and the first marker of a known motion at the later time, at all
    samples from `FIRST_INNER_SAMPLE` on.
    """
    residual = _marker_residual(collocation)
    data = residual.nuisance
    count = _value_count(row)
    late = _read(row, np.zeros(3), values=np.zeros(count), t_s=float(data.recorded_s[1]), data=data)
    check.require_equal(late, np.zeros(1), statement="the value zero changes the clock", scale=1.0)
    indices = np.array([k for k, entry in enumerate(data.entries) if entry.row == row])
    phi = np.zeros(data.size)
    phi[indices] = LARGEST_DEVIATION
    x = _smooth_motion(collocation)
    predicted = residual.predict_positions(x, phi)
    own = residual.own_parameters[0]
    values = (phi * data.scales)[[k for k in own if k in indices]]
    for sample in range(FIRST_INNER_SAMPLE, len(residual.t_s)):
        t_s = float(residual.t_s[sample])
        delay = _read(row, np.zeros(3), values=values, t_s=t_s, data=data)[0]
        later = _smooth_motion(collocation, shift_s=float(delay))
        check.require_equal(
            predicted[sample, 0],
            residual.predict_positions(later, np.zeros(data.size))[sample, 0],
            statement=(
                f"the program predicts the marker {residual.names[0]} at t = {t_s:.4g} s at another "
                f"position [m] than the motion has {float(delay):.4g} s later, the delay that "
                "clock(values, t_s, data) returns"
            ),
            tolerance=1e-7,
        )


def _smooth_motion(collocation: Collocation, shift_s: float = 0.0) -> Array:
    """Return grid positions (N, 3n) of a motion that is affine in space and quadratic in time."""
    (transcription,) = collocation.transcriptions
    nodes_m = transcription.body.nodes_m
    rates = np.random.default_rng(3).standard_normal((2, 3, 3))
    t_s = transcription.dynamics.t_s + shift_s
    steps = rates[0] * t_s[:, None, None] + 10 * rates[1] * t_s[:, None, None] ** 2
    return np.einsum("tij,nj->tni", np.eye(3) + steps, nodes_m).reshape(len(t_s), -1)
