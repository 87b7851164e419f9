"""Tables of a test bench as its problem reads them, made of what a simulation gives.

A problem states for each table which columns it has, along which axis and with which sign they are
measured, and which part of the specimen the mesh is. These functions undo all of that.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePath

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.array_types import Array
from ..errors import InputError
from ..fem.body import Body
from ..recording import Experiment, Grasp, Wrench
from ..recording.sources.columns import (
    ANGLE,
    DISPLACEMENT,
    DISPLACEMENTS,
    FORCE,
    FORCES,
    NOISES,
    STRAIN,
    STRESS,
    TIME,
    TORQUE,
    TORQUES,
    Quantity,
    name_and_unit,
)
from ..recording.sources.units import si_factor
from .recording_schema import (
    DisplacementSection,
    ExperimentSection,
    ForceSensorSection,
    TableSection,
)

# What the time is called in a table some of whose columns have names of the user's own: beside
# `t_s` a reader would refuse these.
OTHER_TIME = "Time (s)"


def strain_length_m(table: DisplacementSection, body: Body) -> float | None:
    """Return the undeformed length [m] by which a strain is multiplied: the stated `length_m`, or
    the extent of the undeformed body along the axis of the table if that is "body"; None if the
    table states none.
    """
    if table.length_m != "body":
        return table.length_m
    return float(np.ptp(body.nodes_m[:, "xyz".index(table.axis)]))


def has_displacement_table(section: ExperimentSection) -> bool:
    """Whether a grasp or an obstacle of an experiment is moved by a table of displacements."""
    return any(moved.displacement is not None for moved in section.moved_sections)


def table_name(section: ExperimentSection, table: TableSection) -> str:
    """Return the file name of a test bench's table, relative to the folder of a simulation.

    It is the stated path (of the table, else of the experiment) if that is inside the problem's
    folder, else its last part; without a stated file, the name of the experiment with .csv.
    """
    path = PurePath(section.file_of(table) or f"{section.name}.csv")
    is_below = not path.is_absolute() and ".." not in path.parts
    return str(path) if is_below else path.name


@dataclass
class BenchTable:
    """Columns over time by their names, in the order of their addition.

    Parameters
    ----------
    t_s : (T,) array
        Times of the rows [s].
    time_column : str
        Name of the time where the problem does not state it.
    columns : dict of name to (T,) array
        Columns in the units of the file, the time among them once `add` was called.
    """

    t_s: Array
    time_column: str = TIME.column
    columns: dict[str, Array] = field(default_factory=dict)

    def add(
        self,
        layout: TableSection,
        values: Mapping[str, Array],
        known_quantities: Sequence[Quantity],
    ) -> None:
        """Add the time and columns of quantities, in place, in the file's units and under its
        names.

        The name of a column is the one that `layout` states for its key, else the usual one of the
        quantity; its unit is that in the name, else the usual one.

        Parameters
        ----------
        layout : TableSection
            The names of its columns.
        values : mapping of key to (T,) array
            Quantities in SI units at the times of the table, by key; NaN leaves a cell empty.
        known_quantities : sequence of Quantity
            Name and unit of each key.

        Raises
        ------
        InputError
            If the table already has a column of that name with other values.
        KeyError
            If a key of `values` is not among `known_quantities`.
        """
        quantities = {quantity.key: quantity for quantity in (TIME, *known_quantities)}
        time = {TIME.key: self.t_s}
        for key, column in (time | dict(values)).items():
            quantity = quantities[key]
            usual = self.time_column if key == TIME.key else quantity.column
            name = layout.columns.get(key, usual)
            unit = name_and_unit(name)[1] or quantity.unit
            in_unit = column / (si_factor(unit, quantity.dimension) or 1.0)
            there = self.columns.setdefault(name, in_unit)
            if not np.array_equal(there, in_unit, equal_nan=True):
                raise InputError(
                    f"two grasps read the column {name}, but a simulation writes different values "
                    "for them; expected columns = { … } that names one for each, or files of "
                    "their own"
                )


def add_displacement(
    table: BenchTable, layout: DisplacementSection, grasp: Grasp, rest_length_m: float | None
) -> None:
    """Add the translations of a grasp at the times of the table, in place, as `read_displacement`
    reads them.

    They are those of the poses, from the undeformed place, times the sign of the layout and over
    its scale, thus those of the whole specimen. The columns are those that the layout names; if it
    names none, the strain if `rest_length_m` is given, else the displacement along the layout's
    axis, or along the axes of the grasp's `zero` if these are others.

    Parameters
    ----------
    rest_length_m : float or None
        Undeformed length [m] over which the displacement along the axis, before it is scaled, is
        the strain; None if the table has no strain.

    Raises
    ------
    InputError
        If the table already has a column of that name with other values.
    """
    factor = layout.sign / layout.scale
    rotations, translations_m = grasp.poses.at(table.t_s)
    centre_m = np.zeros(3) if layout.point_m is None else np.array(layout.point_m)
    shifts_m = factor * (translations_m + rotations @ centre_m - centre_m)
    turns = Rotation.from_matrix(rotations).as_rotvec()[:, "xyz".index(layout.axis)]
    displacement_m = shifts_m[:, "xyz".index(layout.axis)]
    values = {"displacement": displacement_m, **dict(zip("xyz", shifts_m.T, strict=True))}
    values["angle"] = factor * np.unwrap(turns)
    usual = ["displacement"] if grasp.zero in ("", layout.axis) else [*grasp.zero]
    if layout.point_m is not None:
        usual = ["angle", *([*grasp.zero] and usual)]
    if rest_length_m is not None:
        values["strain"] = displacement_m / rest_length_m
        usual = ["strain"]
    chosen = _named_quantities(layout) or usual
    known = (*DISPLACEMENTS, DISPLACEMENT, ANGLE, STRAIN)
    table.add(layout, {key: values[key] for key in chosen}, known)


def add_loads(table: BenchTable, layout: ForceSensorSection, at_s: Array, loads: Array) -> None:
    """Add measured forces and torques to a table, in place, such that they are read back.

    Parameters
    ----------
    layout : ForceSensorSection
        Sign, axis and symmetry; the loads of a body that the problem models in part are multiplied
        by `symmetry`. The stress is written instead of the force if `area_m2` is stated.
    at_s : (S,) array
        Times of the samples [s]. Each is assigned to the nearest row; other rows are left blank.
    loads : (S, 6) array
        Loads on the modelled part: fx, fy, fz [N], tx, ty, tz [N m]; NaN where not measured.

    Raises
    ------
    InputError
        If the table already has a column of that name with other values.

    Notes
    -----
    The columns are those that the layout names; if it names none, the stress if `area_m2` is
    stated, else a machine's force if only the force along the layout's axis is measured, else all
    measured components.
    """
    rows = np.searchsorted((table.t_s[1:] + table.t_s[:-1]) / 2, at_s)
    six_components = np.full((len(table.t_s), 6), np.nan)
    six_components[rows] = layout.sign * layout.symmetry * loads
    components = [quantity.key for quantity in (*FORCES, *TORQUES)]
    values = dict(zip(components, six_components.T, strict=True))
    column = f"f{layout.axis}"
    values["force"] = values[column]
    values["torque"] = values[f"t{layout.axis}"]
    measured = [key for key in components if np.isfinite(values[key]).any()]
    usual = ["force"] if measured == [column] else measured
    if layout.area_m2 is not None:
        values["stress"] = values[column] / layout.area_m2
        usual = ["stress"]
    chosen = _named_quantities(layout) or usual
    known = (*FORCES, *TORQUES, FORCE, TORQUE, STRESS)
    table.add(layout, {key: values[key] for key in chosen}, known)


def add_noises(table: BenchTable, layout: ForceSensorSection, wrench: Wrench) -> None:
    """Add the columns of standard deviations that the layout names to a table, in place."""
    rows = np.searchsorted((table.t_s[1:] + table.t_s[:-1]) / 2, wrench.t_s)
    for key, column in layout.noise_columns.items():
        noise = NOISES[key]
        table.columns[column] = np.full(len(table.t_s), np.nan)
        own = slice(0, 3) if key == "sigma_n" else slice(3, 6)
        # A component that is not measured has the median of all samples.
        sigma = wrench.sample_sigmas[:, own][:, np.argmax(wrench.measured_components[own])]
        factor = si_factor(name_and_unit(column)[1] or noise.unit, noise.dimension) or 1.0
        table.columns[column][rows] = layout.symmetry * sigma / factor


def _named_quantities(layout: TableSection) -> list[str]:
    """Return the quantities whose columns the table names, without the time."""
    return [key for key in layout.columns if key != TIME.key]


def bench_tables(
    section: ExperimentSection, experiment: Experiment, loads: Iterable[Array]
) -> dict[str, BenchTable]:
    """Return the tables of a test bench that a simulation writes, by file name, see `table_name`.

    Displacements are written at the times of the poses, loads into the same table if the file is
    the same, else at their own times. Nothing is written to disk.

    Parameters
    ----------
    section : ExperimentSection
        Table of the experiment in the problem file, which states the layout of the files.
    experiment : Experiment
        Simulated experiment, with the grasps and obstacles of `section` in the same order.
    loads : iterable of (S, 6) array
        Simulated force and torque of each grasp or obstacle with a sensor, at its own times [N, N
        m].

    Raises
    ------
    InputError
        If two grasps read the same column.
    """
    moved = list(zip(section.moved_sections, experiment.grasps, strict=True))
    declared_tables = [
        t for each in section.moved_sections for t in (each.displacement, each.sensor) if t
    ]
    usual_time = OTHER_TIME if any(table.columns for table in declared_tables) else TIME.column
    # A time that one table names is also that of the other tables of the same file.
    time_columns = {
        table_name(section, table): table.columns[TIME.key]
        for table in declared_tables
        if TIME.key in table.columns
    }
    tables: dict[str, BenchTable] = {}

    def table_of(layout: TableSection, t_s: Array) -> BenchTable:
        name = table_name(section, layout)
        time_column = time_columns.get(name, usual_time)
        return tables.setdefault(name, BenchTable(t_s, time_column))

    for declared, grasp in moved:
        if (layout := declared.displacement) is not None:
            add_displacement(
                table_of(layout, grasp.poses.t_s),
                layout,
                grasp=grasp,
                rest_length_m=strain_length_m(layout, experiment.body),
            )
    measured = iter(loads)
    for declared, grasp in moved:
        if (sensed := declared.sensor) is not None and grasp.wrench is not None:
            at_s = grasp.wrench.t_s
            table = table_of(sensed, at_s)
            add_loads(table, sensed, at_s=at_s, loads=next(measured))
            add_noises(table, sensed, grasp.wrench)
    return tables
