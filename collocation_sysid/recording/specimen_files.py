"""Tables of material tests: stretch or strain against stress, or displacement against force.

All are converted to the strain and the engineering stress of `Specimen`. True stresses are
converted with the area of the deformed specimen, which follows from the lateral stretch where it is
measured, else from incompressibility.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np

from ..common.array_types import Array
from ..common.time_dependence import over_time
from ..errors import InputError
from .experiment import Experiment
from .homogeneous_deformation import AXES, CELL_SIZE_M, DEFORMATIONS, transverse_stretch
from .sources.columns import (
    DISPLACEMENT,
    FORCE,
    FREQUENCY,
    LATERAL_STRAIN,
    LATERAL_STRETCH,
    LOSS,
    LOSS_FACTOR,
    MISSING,
    MODULUS,
    NOISES,
    PRESSURE,
    SECOND_DISPLACEMENT,
    SECOND_FORCE,
    SECOND_STRAIN,
    SECOND_STRESS,
    SECOND_STRETCH,
    STORAGE,
    STRAIN,
    STRESS,
    STRESS_DIFFERENCE,
    STRETCH,
    TIME,
    TRUE_STRESS,
    VOLUME_RATIO,
    Quantity,
    QuantityTable,
    column_statement,
    fitting_column_names,
    name_and_unit,
    names_compression,
    other_columns_text,
    read_columns,
    similar_column_names,
)
from .sources.text import Table, names_file_in_errors
from .sources.units import si_factor
from .specimen import LATERAL_NAME, LOSS_NOISE, SECOND_STRESS_NAME, STRESS_NAME, moduli_per_stress

# Most statements of columns that a message lists: more are not read.
MOST_STATEMENTS = 4
Sign = Literal[1, -1]
StressMeasure = Literal["engineering", "true"]
# What a table of a modulus has: the relaxation modulus over time, or the complex one over frequency.
ModulusTable = Literal["relaxation", "harmonic"]
# Kinds of `KINDS` that the names of columns may not state, by the kind of test.
OTHER_KINDS = {
    "uniaxial": ("shear", "pure shear", "two axes", "volume"),
    "equibiaxial": ("shear", "volume"),
    "biaxial": ("shear", "volume"),
    "biaxial-difference": ("shear", "volume"),
    "planar": ("simple shear", "volume"),
    "simple-shear": ("tension", "pure shear", "two axes", "volume"),
    "confined": ("shear", "two axes"),
    "volumetric": ("tension", "shear", "two axes", "absolute"),
}
# Kinds of test that columns of these kinds belong to.
TEST_OF_KIND = {
    "tension": "uniaxial",
    "shear": "simple-shear",
    "simple shear": "simple-shear",
    "pure shear": "planar",
    "two axes": "equibiaxial",
    "volume": "volumetric",
}


@dataclass(frozen=True, kw_only=True)
class SpecimenLayout:
    """Meaning of the columns of a table of a material test."""

    test: str  # kind of test, see `Specimen`
    # mapping of str to str: name of the column by quantity, where it is not recognised.
    columns: Mapping[str, str]
    # Factors on strains or displacements, and on stresses or forces: −1 where compression is
    # positive. Stretches, volume ratios and pressures have none.
    strain_sign: Sign = 1
    stress_sign: Sign = 1
    # Area by which the force was divided: the undeformed or the deformed one.
    stress: StressMeasure = "engineering"
    length_m: float | None = None  # undeformed length that divides a displacement
    area_m2: float | None = None  # undeformed area by which a force is divided
    requires_times: bool = False  # whether the table must have times that increase
    # Those of `Specimen`.
    axial_stretch: float = 1.0
    transverse_stretch: float | None = None
    # Whether the table has a modulus, E of a "uniaxial" and G of a "simple-shear" test: over time, or
    # storage and loss modulus over frequency.
    modulus: ModulusTable | None = None
    # mapping of str to str: columns of standard deviations by their keys "sigma_pa" or "sigma_n",
    # and "lateral_sigma".
    noise_columns: Mapping[str, str] = field(default_factory=dict)
    header_line: int | None = None  # line of the column names; None to find it
    window_s: tuple[float, float] | None = None  # first and last time of the rows

    @property
    def other_kinds(self) -> dict[str, str]:
        """Kinds of strain, stress or modulus that the test does not have, with the remedy."""
        tests = dict(TEST_OF_KIND)
        if self.modulus:
            tests |= {"tension": self.modulus, "shear": f"shear-{self.modulus}"}
        remedies = {kind: f'test = "{test}"' for kind, test in tests.items()}
        remedies["absolute"] = "the pressure above that of the surroundings"
        return {kind: remedies[kind] for kind in OTHER_KINDS[self.test]}

    def list_quantities(self) -> tuple[Quantity, ...]:
        """Return the quantities that the table of this kind of test may have.

        All have strain, stress, displacement and force, and all but simple shear stretch;
        "volumetric" tests have volume ratio, stretch, strain, pressure and stress only,
        "biaxial-difference" tests the difference of the stresses and no other. The second axis and
        a lateral stretch or strain are added where the test has them, true stress if `stress` is
        "true". A table of a modulus has nothing else.
        """
        if self.modulus == "relaxation":
            return (MODULUS,)
        if self.modulus == "harmonic":
            return FREQUENCY, STORAGE, LOSS, LOSS_FACTOR
        deformation = DEFORMATIONS[self.test]
        stresses = (STRESS,) if self.stress == "engineering" else (STRESS, TRUE_STRESS)
        if self.test == "volumetric":
            return VOLUME_RATIO, STRETCH, STRAIN, PRESSURE, *stresses
        loads = (*stresses, FORCE)
        quantities = [
            STRAIN,
            *((STRESS_DIFFERENCE,) if self.test == "biaxial-difference" else loads),
            DISPLACEMENT,
        ]
        if self.test != "simple-shear":
            quantities.append(STRETCH)
        if deformation.second:
            quantities += [SECOND_STRETCH, SECOND_STRAIN, SECOND_DISPLACEMENT]
        if deformation.second_stress:
            quantities += [SECOND_STRESS, SECOND_FORCE]
        if deformation.lateral:
            quantities += [LATERAL_STRETCH, LATERAL_STRAIN]
        return tuple(quantities)

    def list_deformations(self) -> tuple[Quantity, ...]:
        """Return the quantities of which the table must have exactly one, the first deformation."""
        known = (STRETCH, STRAIN, DISPLACEMENT, VOLUME_RATIO)
        return tuple(each for each in known if each in self.list_quantities())

    @property
    def loads(self) -> tuple[Quantity, ...]:
        """Quantities of which the table must have exactly one, the first load."""
        known = (STRESS, TRUE_STRESS, FORCE, PRESSURE, STRESS_DIFFERENCE, MODULUS)
        return tuple(each for each in known if each in self.list_quantities())

    def list_second_deformations(self) -> tuple[Quantity, ...]:
        """Return the quantities of which the table of a test with two strains must have exactly
        one; empty for other tests.
        """
        of_second = SECOND_STRETCH, SECOND_STRAIN, SECOND_DISPLACEMENT
        return of_second if DEFORMATIONS[self.test].second else ()


@dataclass(frozen=True, eq=False)
class SpecimenTable:
    """Measurements of a material test in the terms of `Specimen`."""

    # (T,): times; the number of the row in seconds if the table has none, or none in order.
    t_s: Array = field(metadata=over_time())
    # (T,): strain without NaN; stress NaN where the cell is blank.
    strain: Array = field(metadata=over_time())
    stress_pa: Array = field(metadata=over_time())
    # (T,) or None: none if the table has no such column; stress and stretch NaN where the cell is
    # blank.
    second_strain: Array | None = field(metadata=over_time())
    second_stress_pa: Array | None = field(metadata=over_time())
    lateral_stretch: Array | None = field(metadata=over_time())
    # Whether true stresses, or their difference, count as those of an incompressible specimen.
    is_incompressible: bool
    # Quantities that the table has, such as "stretch" and "lateral_strain".
    columns: tuple[str, ...]
    unread: tuple[str, ...]  # columns with a unit that are not read
    notes: tuple[str, ...] = ()  # see `QuantityTable`
    row_count: int = 0
    # (T,) or None: standard deviations of stress, or of the modulus, and of the lateral stretch;
    # None without a column of them.
    sigma_pa: Array | None = field(default=None, metadata=over_time())
    lateral_sigma: Array | None = field(default=None, metadata=over_time())
    # Frequency and loss modulus of a harmonic test, whose storage modulus counts as stress.
    frequency_hz: Array | None = field(default=None, metadata=over_time())
    loss_pa: Array | None = field(default=None, metadata=over_time())
    # Columns whose names state compression, such as Druckspannung.
    compressive: tuple[str, ...] = ()

    @property
    def is_displacement(self) -> bool:
        """Whether the strain is a displacement over the length of the specimen."""
        return DISPLACEMENT.key in self.columns


@names_file_in_errors
def read_specimen(path: str | Path, layout: SpecimenLayout) -> SpecimenTable:
    """Read the table of a material test, and convert it to engineering stresses, positive in
    tension.

    Parameters
    ----------
    layout : SpecimenLayout
        Meaning of the columns.

    Raises
    ------
    InputError
        If a column is missing, repeated or in an unknown unit, a cell is not a number, a strain is
        blank or not possible, time does not increase, or length or area of the specimen are needed;
        file and line are named.
    """
    if layout.test == "simple-shear" and "stretch" in layout.columns:
        raise InputError(
            "found a column for the stretch of a simple-shear test; expected one for its strain",
            where="columns",
        )
    table = read_columns(
        path,
        layout.list_quantities(),
        column_names=layout.columns,
        blank_allowed=True,
        requires_times=layout.requires_times,
        is_timed=layout.requires_times,
        column_advice=partial(column_advice, layout=layout),
        noise_columns=layout.noise_columns,
        header_line=layout.header_line,
        window_s=layout.window_s,
        other_kinds=layout.other_kinds,
    )
    sigma_pa = table.noises.get("sigma_pa")
    if layout.modulus == "relaxation":
        return _relaxation(table, sigma_pa)
    if layout.modulus == "harmonic":
        return _harmonic(table, layout)
    strain = _strain(table, layout)
    second_strain = _second_strain(table, layout)
    lateral = _lateral_stretch(table, layout)
    areas = _area_ratios(layout, strain, second_strain=second_strain, lateral=lateral)
    stress_pa = _stress_pa(table, layout)
    second_pa = _second_stress_pa(table, layout)
    factor = np.ones_like(strain)
    if layout.test == "volumetric":
        factor = (1 + strain) ** 2
    elif layout.test == "biaxial-difference":
        assert second_strain is not None
        factor = _volume_ratio(strain, second_strain, lateral)
    elif layout.stress == "true":
        factor = areas[0]
    stress_pa = stress_pa * factor
    if "sigma_n" in table.noises and layout.area_m2 is not None:
        sigma_pa = table.noises["sigma_n"] / layout.area_m2
    if second_pa is not None:
        second_pa = layout.stress_sign * second_pa
        second_pa = second_pa * areas[1] if layout.stress == "true" else second_pa
    return SpecimenTable(
        table.t_s,
        strain,
        stress_pa=stress_pa,
        second_strain=second_strain,
        second_stress_pa=second_pa,
        lateral_stretch=lateral,
        is_incompressible=(layout.stress == "true" or layout.test == "biaxial-difference")
        and lateral is None
        and bool(DEFORMATIONS[layout.test].lateral),
        compressive=tuple(
            each
            for each in layout.columns.values() or table.grid.columns
            if names_compression(each) and each not in table.unread
        ),
        columns=tuple(table.values),
        unread=table.unread,
        notes=table.notes,
        row_count=table.row_count,
        sigma_pa=None if sigma_pa is None else sigma_pa * factor,
        lateral_sigma=table.noises.get("lateral_sigma"),
    )


def _relaxation(table: QuantityTable, sigma_pa: Array | None) -> SpecimenTable:
    """Return the table of a relaxation modulus, which counts as stress, at a strain of one."""
    if table.t_s[0] <= 0:
        raise table.grid.error_at(
            f"the time is {table.t_s[0]:g} s; expected times after the strain was applied, above 0",
            0,
        )
    return _modulus_table(table, table.values[MODULUS.key], sigma_pa=sigma_pa)


def _harmonic(table: QuantityTable, layout: SpecimenLayout) -> SpecimenTable:
    """Return the table of a harmonic test; the loss modulus may be that of the loss factor tan δ."""
    storage_pa = _complete(table, _one_of(table, (STORAGE,), "storage modulus", layout))
    frequency_hz = _complete(table, _one_of(table, (FREQUENCY,), "frequency", layout))
    if LOSS.key in table.values:
        loss_pa = _complete(table, LOSS)
    else:
        loss_pa = storage_pa * _complete(
            table, _one_of(table, (LOSS, LOSS_FACTOR), "loss modulus", layout)
        )
    for quantity, values, is_wrong in (
        (FREQUENCY, frequency_hz, frequency_hz <= 0),
        (STORAGE, storage_pa, storage_pa < 0),
        (LOSS, loss_pa, (loss_pa < -LOSS_NOISE * storage_pa) | (storage_pa + loss_pa <= 0)),
    ):
        if is_wrong.any():
            row = int(is_wrong.argmax())
            fault = f"the {quantity.key} is {values[row]:g}; expected a positive number"
            raise table.grid.error_at(fault, row)
    return _modulus_table(table, storage_pa, frequency_hz=frequency_hz, loss_pa=loss_pa)


def _modulus_table(
    table: QuantityTable,
    modulus_pa: Array,
    sigma_pa: Array | None = None,
    frequency_hz: Array | None = None,
    loss_pa: Array | None = None,
) -> SpecimenTable:
    return SpecimenTable(
        table.t_s,
        np.ones_like(table.t_s),
        stress_pa=modulus_pa,
        second_strain=None,
        second_stress_pa=None,
        lateral_stretch=None,
        is_incompressible=False,
        columns=tuple(table.values),
        unread=table.unread,
        notes=table.notes,
        row_count=table.row_count,
        sigma_pa=sigma_pa,
        frequency_hz=frequency_hz,
        loss_pa=loss_pa,
    )


def column_advice(grid: Table, layout: SpecimenLayout) -> str:
    """Return the complete statements `columns = { … }` with which a table is unambiguous, joined by
    "or", at most `MOST_STATEMENTS`.

    Each names one deformation, one load and the optional quantities that one column fits, with the
    names of the table's own columns; of several that fit only by their unit, the first is that of
    the first axis. "…" stands for a quantity that no column fits. Columns that the layout states
    are kept. Sizes of the specimen that a statement needs and the layout lacks
    are named after it.

    Parameters
    ----------
    layout : SpecimenLayout
        Meaning of the columns.
    """
    if layout.modulus == "harmonic":
        names: dict[str, str] = {}
        for quantity in (FREQUENCY, STORAGE, LOSS):
            found = _column_choices(grid, (quantity,), layout.columns, taken=names.values())
            if quantity == LOSS and found[0] == {LOSS.key: MISSING}:
                found = _column_choices(grid, (LOSS_FACTOR, LOSS), layout.columns, names.values())
            names |= found[0]
        return column_statement(names)
    deformations = _column_choices(grid, layout.list_deformations(), stated=layout.columns)
    groups = [deformations]
    if second := layout.list_second_deformations():
        of_second = _column_choices(grid, second, layout.columns, taken=_names_of(deformations))
        keys = [key for each in deformations for key in each]
        alike = [[each.key] * 2 for each in (STRETCH, STRAIN, DISPLACEMENT)]
        if MISSING in _names_of(of_second) and keys in alike:
            # Two of unknown axes: the first column is taken for the first axis.
            of_second = [{f"second_{keys[0]}": deformations[1][keys[0]]}]
            groups = [deformations[:1]]
        groups.append(of_second)
    groups.append(_column_choices(grid, layout.loads, stated=layout.columns))
    required = {*layout.list_deformations(), *layout.list_second_deformations()}
    required |= {*layout.loads}
    other = {
        quantity.key: choices[0][quantity.key]
        for quantity in (TIME, *layout.list_quantities())
        if quantity not in required
        and len(
            choices := _column_choices(grid, (quantity,), stated=layout.columns, is_optional=True)
        )
        == 1
        and (quantity != TIME or TIME.key in layout.columns)
    }
    # Two stresses of unknown axes: the first column is taken for the first axis.
    loads = groups[-1]
    for first, second_load in ((STRESS, SECOND_STRESS), (FORCE, SECOND_FORCE)):
        if (
            second_load in layout.list_quantities()
            and second_load.key not in other
            and [*map(list, loads)] == [[first.key]] * 2
        ):
            groups[-1] = loads[:1]
            other[second_load.key] = loads[1][first.key]
    statements = []
    for combination in product(*groups):
        chosen = {key: name for each in combination for key, name in each.items()}
        sizes = [
            size
            for quantity, size, value in (
                (DISPLACEMENT, "length_m", layout.length_m),
                (FORCE, "area_m2", layout.area_m2),
            )
            if quantity.key in chosen and value is None
        ]
        suffix = f" with {' and '.join(sizes)}" if sizes else ""
        statements.append(column_statement(chosen | other) + suffix)
    return ", or ".join(statements[:MOST_STATEMENTS])


def _column_choices(
    grid: Table,
    quantities: tuple[Quantity, ...],
    stated: Mapping[str, str],
    taken: Collection[str] = (),
    *,
    is_optional: bool = False,
) -> list[dict[str, str]]:
    """Return stated, else fitting, else similar columns, each by the quantity's key."""
    choices = [
        {quantity.key: stated[quantity.key]} for quantity in quantities if quantity.key in stated
    ]
    searches = [fitting_column_names]
    if not is_optional:
        searches.append(similar_column_names)
    for names_for in searches:
        if not choices:
            choices = [
                {quantity.key: name}
                for quantity in quantities
                for name in names_for(grid, quantity)
                if name not in taken
            ]
    if not choices and not is_optional:
        return [{quantities[-1].key: MISSING} if quantities else {}]
    return choices


def _names_of(choices: Iterable[Mapping[str, str]]) -> set[str]:
    return {name for each in choices for name in each.values()}


def _one_of(
    table: QuantityTable, quantities: tuple[Quantity, ...], what: str, layout: SpecimenLayout
) -> Quantity:
    there = [quantity for quantity in quantities if quantity.key in table.values]
    if len(there) != 1:
        present = " and ".join(quantity.key for quantity in there)
        expected = ", ".join(quantity.column for quantity in quantities)
        if not there and (why := table.contradiction(quantities)):
            remedy = ', or stress = "true"' if "holds a true stress" in why else ""
            raise table.grid.error_at(why + remedy)
        raise table.grid.error_at(
            f"the columns are {', '.join(table.grid.columns)}; found "
            f"{present or 'no column'} of the {what}, "
            f"expected exactly one of {expected}, in these or other units"
            f"{other_columns_text(table.known_grid, layout.list_quantities())}. State "
            f"{column_advice(table.known_grid, layout)}"
        )
    return there[0]


def _complete(table: QuantityTable, quantity: Quantity) -> Array:
    """Return the values (T,) of a column without blank cells."""
    values = table.values[quantity.key]
    if (blank := np.isnan(values)).any():
        raise table.grid.error_at(
            f"the {quantity.key} is blank; expected a number in every row", int(blank.argmax())
        )
    return values


def _strain(table: QuantityTable, layout: SpecimenLayout) -> Array:
    """Return the strain (T,) as `Specimen` defines it; stretches and ratios have no sign."""
    quantity = _one_of(table, layout.list_deformations(), what="deformation", layout=layout)
    values = _complete(table, quantity)
    if quantity == STRETCH:
        _require_positive(table, quantity, ratio=values)
        return values - 1
    if layout.test == "volumetric":
        ratio = values if quantity == VOLUME_RATIO else 1 + layout.strain_sign * values
        _require_positive(table, quantity, ratio=ratio)
        return np.cbrt(ratio) - 1
    if quantity == DISPLACEMENT:
        values = values / _length_m(table, layout)
    strain = layout.strain_sign * values
    if layout.test != "simple-shear":
        _require_positive(table, quantity, ratio=1 + strain)
    return strain


def _length_m(table: QuantityTable, layout: SpecimenLayout) -> float:
    if layout.length_m is None:
        raise table.grid.error_at(
            "found a column of displacements, but not length_m; expected length_m, the undeformed "
            "length of the specimen, or the gap of a shear test"
        )
    return layout.length_m


def _require_positive(table: QuantityTable, quantity: Quantity, ratio: Array) -> None:
    """Refuse a ratio (T,) of deformed to undeformed size that is not positive everywhere."""
    if (ratio > 0).all():
        return
    row = int(np.argmax(ratio <= 0))
    name = quantity.key.replace("_", " ")
    likely = {
        DISPLACEMENT: "check length_m, strain_sign and the unit of the displacement",
        VOLUME_RATIO: "a volume ratio is 1 without load",
        STRETCH: "a stretch is 1 without load; if the column has strains, call it strain",
        SECOND_STRETCH: "a stretch is 1 without load; if the column has strains, call it second "
        "strain",
    }.get(quantity, f'if these are percent, call the column "{name} (%)"')
    raise table.grid.error_at(
        f"the {quantity.key} makes the specimen {ratio[row]:.4g} times as large as without load; "
        f"expected a positive ratio: {likely}",
        row,
    )


def _second_strain(table: QuantityTable, layout: SpecimenLayout) -> Array | None:
    """Return the strain (T,) along the second axis; None for tests with one strain."""
    if not DEFORMATIONS[layout.test].second:
        return None
    quantity = _one_of(
        table,
        layout.list_second_deformations(),
        what="deformation of the second axis",
        layout=layout,
    )
    values = _complete(table, quantity)
    if quantity == SECOND_STRETCH:
        _require_positive(table, quantity, ratio=values)
        return values - 1
    if quantity == SECOND_DISPLACEMENT:
        values = values / _length_m(table, layout)
    strain = layout.strain_sign * values
    _require_positive(table, quantity, ratio=1 + strain)
    return strain


def _lateral_stretch(table: QuantityTable, layout: SpecimenLayout) -> Array | None:
    """Return the lateral stretch (T,), NaN where blank; None if the table has none."""
    if LATERAL_STRETCH.key in table.values:
        return table.values[LATERAL_STRETCH.key]
    if LATERAL_STRAIN.key in table.values:
        return 1 + layout.strain_sign * table.values[LATERAL_STRAIN.key]
    return None


def _stress_pa(table: QuantityTable, layout: SpecimenLayout) -> Array:
    """Return the stress (T,), positive in tension [Pa]; pressures have no `stress_sign`."""
    quantity = _one_of(table, layout.loads, what="load", layout=layout)
    values = table.values[quantity.key]
    if quantity == PRESSURE:
        return -values
    if quantity == FORCE:
        values = values / _area_m2(table, layout)
    return layout.stress_sign * values


def _second_stress_pa(table: QuantityTable, layout: SpecimenLayout) -> Array | None:
    """Return the second stress (T,), before its sign is applied; None without one."""
    both = [each for each in (SECOND_STRESS, SECOND_FORCE) if each.key in table.values]
    if len(both) > 1:
        _one_of(table, (SECOND_STRESS, SECOND_FORCE), "second load", layout)
    if SECOND_FORCE.key in table.values:
        return table.values[SECOND_FORCE.key] / _area_m2(table, layout)
    return table.values.get(SECOND_STRESS.key)


def _area_m2(table: QuantityTable, layout: SpecimenLayout) -> float:
    if layout.stress == "true":
        raise table.grid.error_at(
            'found a column of forces and stress = "true"; expected a column of true stresses, or '
            'no stress = "true": the deformed area on which the force acts is not known'
        )
    if layout.area_m2 is None:
        raise table.grid.error_at(
            "found a column of forces, but not area_m2; expected area_m2, the undeformed area on "
            "which the force acts"
        )
    return layout.area_m2


def _area_ratios(
    layout: SpecimenLayout, strain: Array, second_strain: Array | None, lateral: Array | None
) -> tuple[Array, Array]:
    """Return the deformed over the undeformed area (T,) of the faces of both stresses."""
    stretch = 1 + strain
    if layout.test in ("confined", "simple-shear", "volumetric", "biaxial-difference"):
        across = transverse_stretch(layout.axial_stretch, layout.transverse_stretch)
        return np.full_like(stretch, across**2), np.full_like(stretch, across**2)
    second = {
        "equibiaxial": stretch,
        "planar": np.ones_like(stretch),
        "biaxial": stretch if second_strain is None else 1 + second_strain,
    }.get(layout.test)
    if second is None:
        across = np.sqrt(1 / stretch) if lateral is None else lateral
        return across**2, across**2
    thickness = 1 / (stretch * second) if lateral is None else lateral
    return second * thickness, stretch * thickness


def _volume_ratio(strain: Array, second_strain: Array, lateral: Array | None) -> Array:
    """Return J (T,) of a specimen with two strains; 1 without a lateral stretch."""
    if lateral is None:
        return np.ones_like(strain)
    return (1 + strain) * (1 + second_strain) * lateral


def specimen_strains(experiment: Experiment) -> tuple[Array, Array]:
    """Return the first and the second strain (T,) of the experiment of a specimen, from the poses
    of its grasps; the second is zero unless the test has two.
    """
    deformation = experiment.specimen
    assert deformation is not None
    shifts = deformed_gradients(experiment) - deformation.held_gradient()
    by_strain = deformation.per_strain().reshape(2, 9)
    # Components of different strains are orthogonal.
    strains = shifts.reshape(-1, 9) @ by_strain.T / np.maximum((by_strain**2).sum(axis=1), 1e-300)
    return strains[:, 0], strains[:, 1]


def moduli_of(experiment: Experiment) -> dict[str, Array]:
    """Return the factors (T,) of the stresses of an experiment to moduli, see `moduli_per_stress`;
    empty unless it is a table of moduli.
    """
    return moduli_per_stress(specimen_strains(experiment)[0]) if experiment.specimen else {}


def initial_modulus_pa(experiment: Experiment) -> float:
    """Return Young's modulus [Pa] by the median |stress / strain| of the smaller strains of a
    specimen, or NaN.
    """
    assert experiment.specimen is not None
    strain, _ = specimen_strains(experiment)
    stress = experiment.readings[0]
    stress_pa = stress.measured_values[:, 0]
    is_known = np.isfinite(stress_pa) & (strain != 0)
    if stress.name != STRESS_NAME or not is_known.any():
        return np.nan
    order = np.argsort(np.abs(strain[is_known]))[: len(strain) // 2 + 1]
    slope = float(np.median(np.abs(stress_pa[is_known][order] / strain[is_known][order])))
    ratio = experiment.specimen.young_ratio
    return slope / (ratio if np.isfinite(ratio) else 1.0)


def deformed_gradients(experiment: Experiment) -> Array:
    """Return F (T, 3, 3) that the grasps of a specimen prescribe, with 1 in place of free
    components.
    """
    shifts_m = [grasp.poses.at(experiment.t_s)[1] for grasp in experiment.grasps[1 : 1 + len(AXES)]]
    return np.eye(3) + np.stack(shifts_m, axis=2) / CELL_SIZE_M


def specimen_columns(
    experiment: Experiment, values: Mapping[str, Array], layout: SpecimenLayout
) -> dict[str, Array]:
    """Return the columns (T,) of the table of a specimen by name, as `read_specimen` reads them.

    The columns are those that `layout` names, in the units of their names. If it names none but the
    time, deformations are written as stretches, those of simple shear as strains and of volumetric
    tests as volume ratios with pressures, under standard names. Stresses are true or engineering,
    and signs are as `layout` states.

    Parameters
    ----------
    values : mapping of str to (T,) array
        Values of its sensors by name, at the sample times; a quantity that does not follow from
        them has no column.
    layout : SpecimenLayout
        Meaning of the columns.
    """
    quantities = _specimen_quantities(experiment, values, layout=layout)
    named = [key for key in layout.columns if key != TIME.key]
    usual = [quantity.key for quantity in _usual_quantities(layout)]
    columns = {}
    for key in (TIME.key, *(named or usual)):
        for quantity, column in quantities.items():
            if quantity.key == key:
                name = layout.columns.get(key, quantity.column)
                unit = name_and_unit(name)[1] or quantity.unit
                factor = si_factor(unit, quantity.dimension) or 1.0
                columns[name] = column / factor
    return columns | _noise_columns(experiment, values, layout)


def _noise_columns(
    experiment: Experiment, values: Mapping[str, Array], layout: SpecimenLayout
) -> dict[str, Array]:
    if not layout.noise_columns:
        return {}
    sigmas = {
        gauge.name: np.broadcast_to(gauge.sample_sigmas[:, 0], experiment.t_s.shape)
        for gauge in experiment.readings
    }
    noise = {
        quantity: np.abs(column)
        for quantity, column in _specimen_quantities(
            experiment, dict(values) | {STRESS_NAME: sigmas.get(STRESS_NAME, np.zeros(0))}, layout
        ).items()
    }
    sources = {
        "sigma_pa": noise.get(MODULUS, noise.get(STRESS, noise.get(STRESS_DIFFERENCE))),
        "sigma_n": noise.get(FORCE),
        "lateral_sigma": sigmas.get(LATERAL_NAME),
    }
    columns: dict[str, Array] = {}
    for key, name in layout.noise_columns.items():
        column = sources[key]
        assert column is not None
        unit = name_and_unit(name)[1] or NOISES[key].unit
        columns[name] = column / (si_factor(unit, NOISES[key].dimension) or 1.0)
    return columns


def _usual_quantities(layout: SpecimenLayout) -> tuple[Quantity, ...]:
    """Return the quantities that are written for a test if the layout names no columns."""
    if layout.modulus:
        return layout.list_quantities()[: -1 if layout.modulus == "harmonic" else None]
    if layout.test == "volumetric":
        return VOLUME_RATIO, PRESSURE
    deformation = STRAIN if layout.test == "simple-shear" else STRETCH
    return (
        *(deformation, SECOND_STRETCH, STRESS, STRESS_DIFFERENCE, SECOND_STRESS, LATERAL_STRETCH),
    )


def _specimen_quantities(
    experiment: Experiment, values: Mapping[str, Array], layout: SpecimenLayout
) -> dict[Quantity, Array]:
    """Return each quantity (T,), in SI units and with the signs of `layout`."""
    strain, second_strain = specimen_strains(experiment)
    if layout.modulus == "harmonic":
        # After the sample at rest: those at the largest strain, and a quarter of a period later.
        amplitude, moduli = strain[1::2], values[STRESS_NAME][1:].reshape(-1, 2)
        storage_pa, loss_pa = moduli.T / amplitude
        frequency_hz = 0.25 / np.diff(experiment.t_s)[::2]
        return {
            FREQUENCY: frequency_hz,
            STORAGE: storage_pa,
            LOSS: -loss_pa,
            LOSS_FACTOR: -loss_pa / storage_pa,
        }
    if layout.modulus == "relaxation":
        # The first two samples are those of the step of the strain.
        modulus_pa = values[STRESS_NAME][2:] / strain[2:]
        return {TIME: experiment.t_s[2:], MODULUS: modulus_pa}
    stretch = 1 + strain
    lateral = values.get(LATERAL_NAME)
    areas = _area_ratios(layout, strain, second_strain=second_strain, lateral=lateral)
    is_true = layout.stress == "true"
    is_volumetric = layout.test == "volumetric"
    table_strain = stretch**3 - 1 if is_volumetric else strain
    quantities = {
        TIME: experiment.t_s,
        STRETCH: stretch,
        STRAIN: layout.strain_sign * table_strain,
        VOLUME_RATIO: stretch**3,
    }
    if layout.length_m is not None:
        quantities[DISPLACEMENT] = layout.strain_sign * strain * layout.length_m
        quantities[SECOND_DISPLACEMENT] = layout.strain_sign * second_strain * layout.length_m
    if layout.list_second_deformations():
        quantities[SECOND_STRETCH] = 1 + second_strain
        quantities[SECOND_STRAIN] = layout.strain_sign * second_strain
    if lateral is not None:
        quantities[LATERAL_STRETCH] = lateral
        quantities[LATERAL_STRAIN] = layout.strain_sign * (lateral - 1)
    if STRESS_NAME in values:
        stress_pa = values[STRESS_NAME]
        if is_volumetric:
            stress_pa = stress_pa / stretch**2
        elif is_true:
            stress_pa = stress_pa / areas[0]
        if layout.test == "biaxial-difference":
            difference_pa = stress_pa / _volume_ratio(strain, second_strain, lateral)
            return quantities | {STRESS_DIFFERENCE: layout.stress_sign * difference_pa}
        quantities[PRESSURE] = -stress_pa
        quantities[STRESS] = layout.stress_sign * stress_pa
        quantities[TRUE_STRESS] = quantities[STRESS]
        if layout.area_m2 is not None:
            quantities[FORCE] = quantities[STRESS] * layout.area_m2
    if SECOND_STRESS_NAME in values:
        second_pa = values[SECOND_STRESS_NAME]
        second_pa = second_pa / areas[1] if is_true else second_pa
        quantities[SECOND_STRESS] = layout.stress_sign * second_pa
        if layout.area_m2 is not None:
            quantities[SECOND_FORCE] = quantities[SECOND_STRESS] * layout.area_m2
    return quantities
