"""Quantities that a simulator predicts: positions of markers, or loads, at the samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...common.array_types import Array
from ...program.simulation import Trajectory
from ...recording import Experiment
from ...recording.homogeneous_deformation import HomogeneousDeformation
from ...recording.measured_wrench import COMPONENTS

Quantity = Literal["markers", "forces", "stresses"]

# Columns of the three coordinates of a marker.
AXES = ("x", "y", "z")
# Name of the column of times [s], or of sample numbers where a test has no times.
TIME_KEY = "t_s"
SAMPLE_KEY = "sample"
# Components of a wrench that are forces.
FORCE_COUNT = 3


@dataclass(frozen=True, eq=False)
class Signal:
    """Table of one quantity of a recording."""

    # Positions of markers [m], forces of grasps on the specimen [N], or nominal stresses [Pa].
    quantity: Quantity
    key: str  # name of the first column: "t_s", or "sample" where a test has no times
    keys: Array  # (T,): times [s], or numbers of the samples, counted from 1
    # Names of the other columns; x, y and z of each marker follow each other.
    columns: tuple[str, ...]
    values: Array  # (T, C): SI units; NaN where nothing was measured

    @property
    def table(self) -> dict[str, Array]:
        """Columns (T,) of the table by name, the keys first; views of the arrays, not copies."""
        columns = dict(zip(self.columns, self.values.T, strict=True))
        return {self.key: self.keys, **columns}

    def with_values(self, values: Array) -> Signal:
        """Return a copy of the signal with other values (T, C), in the same order and units."""
        return replace(self, values=values)


@dataclass(frozen=True, eq=False)
class RecordingSignals:
    """Measured quantity of a recording, with two predictions of it."""

    measured: Signal
    sigma: Array  # (C,): stated standard deviation of each column
    simulated: Signal  # prediction by the forward simulation of this package
    # Prediction by the undeformed body, which its grasp moves rigidly and which has no loads.
    undeformed: Signal

    @classmethod
    def from_trajectory(cls, experiment: Experiment, trajectory: Trajectory) -> RecordingSignals:
        """Return the measured signals of an experiment, with its simulation and the undeformed body
        as the two predictions.

        An experiment with markers has their positions [m]; otherwise a material test without a mesh
        has its stresses [Pa]; another experiment has the forces [N] of its grasps, of which at
        least one must be measured.

        Parameters
        ----------
        experiment : Experiment
            Experiment with its measurements; NaN where a value is missing.
        trajectory : Trajectory
            Forward simulation of the experiment at the times of its samples; it becomes
            `simulated`.
        """
        if experiment.markers.names:
            return _marker_signals(experiment, trajectory)
        if experiment.specimen is not None:
            return _stress_signals(experiment, trajectory)
        return _force_signals(experiment, trajectory)


def stress_columns(deformation: HomogeneousDeformation) -> tuple[str, ...]:
    """Return the names of the columns of the nominal stresses [Pa] of a material test, such as
    "stress_zz_pa": one or two, for the first and the second direction, if their stress is measured.
    """
    components = (deformation.first_stress, deformation.second_stress)
    return tuple(f"stress_{each}_pa" for each in components if each)


def _marker_signals(experiment: Experiment, trajectory: Trajectory) -> RecordingSignals:
    """Return the positions of the markers [m], three columns each, at the times of the experiment:
    measured (NaN where missing), simulated, and moved rigidly with the grasp.
    """
    markers = experiment.markers
    count = len(experiment.t_s)
    present_m = np.where(markers.is_present[..., None], markers.positions_m, np.nan)
    measured = Signal(
        "markers",
        TIME_KEY,
        keys=experiment.t_s,
        columns=tuple(f"{name}_{axis}" for name in markers.names for axis in AXES),
        values=present_m.reshape(count, -1),
    )
    rigid_m = markers.predict_positions(experiment.rigid_positions(experiment.t_s))
    return RecordingSignals(
        measured,
        np.repeat(markers.sigma_m, len(AXES)),
        simulated=measured.with_values(trajectory.markers_m.reshape(count, -1)),
        undeformed=measured.with_values(rigid_m.reshape(count, -1)),
    )


def _stress_signals(experiment: Experiment, trajectory: Trajectory) -> RecordingSignals:
    """Return the nominal stresses [Pa] of a material test without a mesh by the number of the
    sample, from 1: measured, simulated, and zero for the undeformed body.
    """
    assert experiment.specimen is not None
    names = stress_columns(experiment.specimen)
    # The first sensors are of stresses, a further one of the lateral stretch.
    sensors = experiment.readings[: len(names)]
    simulated = trajectory.custom_sensor_values[: len(sensors)]
    measured = Signal(
        "stresses",
        SAMPLE_KEY,
        keys=np.arange(1.0, len(experiment.t_s) + 1),
        columns=names[: len(sensors)],
        values=np.column_stack([sensor.measured_values[:, 0] for sensor in sensors]),
    )
    return RecordingSignals(
        measured,
        np.array([np.ravel(sensor.sigma)[0] for sensor in sensors]),
        simulated=measured.with_values(np.column_stack([v[:, 0] for v in simulated])),
        undeformed=measured.with_values(np.zeros(measured.values.shape)),
    )


def _force_signals(experiment: Experiment, trajectory: Trajectory) -> RecordingSignals:
    """Return the measured components of the forces [N] of the grasps on the complete specimen:
    measured, simulated, and zero for the undeformed body.
    """
    columns: list[str] = []
    measured: list[Array] = []
    simulated: list[Array] = []
    sigma: list[float] = []
    instrumented = [
        number
        for number, grasp in enumerate(experiment.grasps, start=1)
        if grasp.wrench is not None
    ]
    for number, wrench, prediction in zip(
        instrumented, experiment.wrenches, trajectory.wrenches, strict=True
    ):
        for component in np.flatnonzero(wrench.measured_components[:FORCE_COUNT]):
            columns.append(f"grasp_{number}_{COMPONENTS[component]}_n")
            measured.append(wrench.symmetry * wrench.values[:, component])
            simulated.append(wrench.symmetry * prediction[:, component])
            sigma.append(wrench.symmetry * float(wrench.value_sigmas[component]))
    signal = Signal(
        "forces", TIME_KEY, experiment.wrenches[0].t_s, tuple(columns), np.column_stack(measured)
    )
    return RecordingSignals(
        signal,
        np.array(sigma),
        signal.with_values(np.column_stack(simulated)),
        signal.with_values(np.zeros(signal.values.shape)),
    )
