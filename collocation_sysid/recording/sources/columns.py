"""Quantities over time in tables: columns are recognised by name and unit.

The project's own tables have names such as ``t_s`` and ``fz_n``, and every column must be known.
Tables of machines have names such as ``Time (s)``, ``Load [kN]``, ``Weg in mm``, and may have
further columns.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...common.array_types import Array
from ...errors import InputError, hint_at
from .source import read_table
from .text import Table, names_file_in_errors, numeric_cells, times_in_column
from .units import UNITS, expected_units, si_factor


@dataclass(frozen=True)
class Quantity:
    """A quantity that a column may hold.

    Parameters
    ----------
    key : str
        Name of its column in the project's own tables, without the unit.
    dimension : str
        Key of `UNITS`.
    unit : str
        SI unit, as it is written in the names of columns.
    words : str
        Words, separated by blanks, of which machines use one in the column's name.
    qualifier : str
        Key of `QUALIFIERS` whose words the column's name has too; "" for a name without any.
    unitless : bool
        Whether the column's name may state no unit, which then is 1.
    """

    key: str
    dimension: str
    unit: str
    words: str = ""
    qualifier: str = ""
    unitless: bool = False

    @property
    def column(self) -> str:
        """Name of its column in the project's own tables, with the unit."""
        return f"{self.key}_{self.unit}"


TIME = Quantity("t", "time", unit="s", words="time zeit temps tiempo tempo")
DISPLACEMENTS = tuple(Quantity(axis, "length", unit="m") for axis in "xyz")
FORCES = tuple(Quantity(f"f{axis}", "force", unit="n") for axis in "xyz")
TORQUES = tuple(Quantity(f"t{axis}", "torque", unit="nm") for axis in "xyz")
DISPLACEMENT = Quantity(
    "displacement",
    "length",
    unit="m",
    words="displacement extension elongation compression deflection stroke crosshead position travel "
    "weg verformung verschiebung längung längenänderung hub dehnung stauchung déplacement "
    "allongement desplazamiento spostamento",
)
FORCE = Quantity("force", "force", unit="n", words="force load kraft last fuerza forza")
STRAIN = Quantity(
    *("strain", "ratio"),
    unit="1",
    words="strain dehnung stauchung déformation deformación deformazione",
)
STRESS = Quantity(
    *("stress", "pressure"),
    unit="pa",
    words="stress spannung contrainte esfuerzo tensión sforzo tensione",
)
TENSION = Quantity("tension", "force", unit="n", words="tension")
PRESSURE = Quantity("pressure", "pressure", unit="pa", words="pressure druck pression")
_STRETCHES = "stretch lambda λ streckung"
STRETCH = Quantity("stretch", "ratio", unit="1", words=_STRETCHES, unitless=True)
SECOND_STRETCH = Quantity(
    "second_stretch", "ratio", unit="1", words=_STRETCHES, qualifier="second", unitless=True
)
LATERAL_STRETCH = Quantity(
    "lateral_stretch", "ratio", unit="1", words=_STRETCHES, qualifier="lateral", unitless=True
)
SECOND_STRAIN = Quantity("second_strain", "ratio", unit="1", words=STRAIN.words, qualifier="second")
LATERAL_STRAIN = Quantity(
    "lateral_strain", "ratio", unit="1", words=STRAIN.words, qualifier="lateral"
)
VOLUME_RATIO = Quantity(
    "volume_ratio", "ratio", unit="1", words="volumenverhältnis j", unitless=True
)
SECOND_STRESS = Quantity(
    "second_stress", "pressure", unit="pa", words=STRESS.words, qualifier="second"
)
TRUE_STRESS = Quantity(
    "true_stress", "pressure", unit="pa", words=STRESS.words, qualifier="deformed"
)
STRESS_DIFFERENCE = Quantity(
    "stress_difference", "pressure", unit="pa", words=STRESS.words, qualifier="difference"
)
MODULUS = Quantity(
    *("modulus", "pressure"),
    unit="pa",
    words="modulus modul module relaxationsmodul",
    qualifier="modulus",
)
FREQUENCY = Quantity(
    "frequency",
    "frequency",
    unit="hz",
    words="frequency freq omega ω frequenz fréquence frecuencia frequenza",
)
STORAGE = Quantity(
    "storage", "pressure", unit="pa", words="storage stor speichermodul", qualifier="storage"
)
LOSS = Quantity("loss", "pressure", unit="pa", words="loss verlustmodul", qualifier="loss")
LOSS_FACTOR = Quantity(
    *("loss_factor", "ratio"), unit="1", words="tan tanδ factor", qualifier="factor", unitless=True
)
# Standard deviations of samples, by the key of a problem file that names their column.
NOISES = {
    noise.key: noise
    for noise in (
        Quantity("sigma_pa", "pressure", unit="pa"),
        Quantity("sigma_n", "force", unit="n"),
        Quantity("sigma_nm", "torque", unit="nm"),
        Quantity("lateral_sigma", "ratio", unit="1", unitless=True),
    )
}
KNOWN_QUANTITIES = (
    *(TIME, *DISPLACEMENTS, *FORCES, *TORQUES),
    *(DISPLACEMENT, FORCE, STRAIN, STRESS, TENSION, PRESSURE),
    *(STRETCH, SECOND_STRETCH, LATERAL_STRETCH, SECOND_STRAIN, LATERAL_STRAIN),
    *(VOLUME_RATIO, SECOND_STRESS, TRUE_STRESS, STRESS_DIFFERENCE, MODULUS),
    *(FREQUENCY, STORAGE, LOSS, LOSS_FACTOR),
)

# A column's name and its unit: Load (kN), Load [kN], Load / kN, Load in kN, load_kn.
_NAMED = re.compile(
    r"(?P<name>.*?)\s*(?:[(\[](?P<bracketed>[^()\[\]]*)[)\]]"
    r"|(?:_|\s/\s*|\sin\s)(?P<behind>[^\s_]+))"
)
# A known unit behind a blank or a stroke, as in Strain % or stress/kPa.
_BARE_UNIT = re.compile(r"(?P<name>[^/]*?[^/\s])(?:\s+|/)(?P<unit>[^\s\d][^\s]*)")
# A unit with underscores, as in stress_kgf_cm2.
_PER_AREA = re.compile(r"(?P<name>.+)_(?P<unit>[^\W_]+)_(?P<area>[^\W_]+)")
# Strains and stresses of the deformed specimen, which neither its length nor its area multiplies.
_DEFORMED = {"true", "wahre", "cauchy", "logarithmic", "logarithmische", "log", "hencky", "natural"}
# German compounds end with what they are: Druckspannung, Prüfkraft, Kolbenweg.
_COMPOUND = re.compile(
    r"(?P<first>\w+)(?P<last>zeit|weg|kraft|last|spannung|dehnung|stauchung|streckung|druck)"
)
# Words in the name of a column that distinguish quantities with the same other words, by key.
QUALIFIERS = {
    "deformed": _DEFORMED,
    "second": {"second", "zweite"},
    "lateral": {"lateral", "transverse", "quer"},
    "difference": {"difference", "differenz", "différence"},
    "modulus": {"modulus", "modul", "module", "relaxationsmodul"},
    "storage": {"storage", "stor", "speichermodul"},
    "loss": {"loss", "verlustmodul"},
    "factor": {"factor", "tan", "tanδ"},
    # Of no quantity: values that are computed from others, of something else, or not measured.
    "other": {
        *("deviatoric", "hydrostatic", "mises", "tresca"),
        *("volumetric", "rate", "energy", "error", "fehler", "deviation", "abweichung", "std"),
        *("uncertainty", "residual", "target", "setpoint", "command", "commanded", "sollwert"),
        *("soll", "vor"),
        *("amplitude", "range", "strength", "limit", "noise"),
    },
}
_ALL_QUALIFIERS = frozenset().union(*QUALIFIERS.values())
# Names of columns in which compression counts as positive.
_COMPRESSIVE = re.compile(r"stauch|druck(spann|kraft)|compress|compres[ií]", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class QuantityTable:
    """Quantities of a table in SI units."""

    grid: Table  # cells of the table
    t_s: Array  # (T,)
    # dict: (T,) array by the key of each quantity that the table has, NaN where missing.
    values: Mapping[str, Array]
    # Columns with a unit that hold none of the quantities; empty if the user named the columns.
    unread: tuple[str, ...] = ()
    # dict: (T,) array of standard deviations by their key of `NOISES`, NaN where missing.
    noises: Mapping[str, Array] = field(default_factory=dict)


@names_file_in_errors
def read_columns(
    path: str | Path,
    quantities: Sequence[Quantity],
    column_names: Mapping[str, str] | None = None,
    blank_allowed: bool = False,
    requires_times: bool = True,
    is_timed: bool = True,
    requires_all: bool = False,
    column_advice: Callable[[Table], str] | None = None,
    noise_columns: Mapping[str, str] | None = None,
    other_columns: Collection[str] = (),
) -> QuantityTable:
    """Read those of some quantities that a table has, in any order, in SI units.

    Parameters
    ----------
    column_names : mapping, optional
        Column name by a quantity's key; "t" for the time. A unit that the file does not state may
        follow the name, as in "Load (N)". Other columns are not looked for if a quantity besides
        the time is mapped; without mapping, columns are recognised by name.
    blank_allowed : bool
        Whether cells may be blank, which become NaN; a column of blank cells alone is refused.
    requires_times : bool
        Whether times are required; otherwise rows are numbered in seconds if there are no times.
    is_timed : bool
        Whether times must be numbers that increase; otherwise a time that is no number is NaN.
    requires_all : bool
        Whether each of `quantities` is required; otherwise one is enough.
    column_advice : callable, optional
        Returns for the table the remedy that a message names if several columns fit one quantity;
        by default the statements that choose one of them, see `column_statement`.
    noise_columns : mapping, optional
        Column name by the key of `NOISES` that names it; these columns hold no other quantity.
    other_columns : collection of str
        Names of columns that others read, such as the noise of another sensor in the same file.

    Raises
    ------
    InputError
        If a column is missing, repeated, unknown, without unit or with a wrong one, a cell is not a
        number, or time does not increase (`is_timed`); the line is named.
    """
    grid = read_table(path)
    noises = {}
    for key, name in (noise_columns or {}).items():
        place, factor = _column_named_by_user(grid, NOISES[key], name=name, where=key)
        noises[key] = factor * numeric_cells(grid, [place], blank_allowed=True)[:, 0]
        grid = grid.without_column(place)
    for name in other_columns:
        if column := next((c for c in (name, name_and_unit(name)[0]) if c in grid.columns), None):
            grid = grid.without_column(grid.columns.index(column))
    if "t_s" in grid.columns and not column_names:
        _require_known_columns(grid, quantities, all_of=requires_all)
    places = _find_columns(grid, quantities, mapped=column_names or {}, column_advice=column_advice)
    t = places.pop(TIME.key, None)
    if len(places) < (len(quantities) if requires_all else 1) or (requires_times and t is None):
        advice = "" if column_advice is None or places else f". State {column_advice(grid)}"
        raise _columns_error(grid, quantities, all_of=requires_all, advice=advice)
    values = {}
    for key, (place, factor) in places.items():
        values[key] = factor * numeric_cells(grid, [place], blank_allowed=blank_allowed)[:, 0]
        if np.isnan(values[key]).all():
            raise InputError(f"column {grid.columns[place]} has no values; remove it")
    t_s = np.arange(float(len(grid.cells)))
    if t is not None:
        t_s = times_in_column(grid, *t, is_timed=is_timed)
    used = [place for place, _ in (*places.values(), *([] if t is None else [t]))]
    unread = [
        column
        for place, column in enumerate(grid.columns)
        if place not in used and name_and_unit(column)[1] is not None
    ]
    unread = [] if column_names else unread
    return QuantityTable(grid, t_s, values=values, unread=tuple(unread), noises=noises)


# Choice of columns --------------------------------------------------------------------------------


def _find_columns(
    grid: Table,
    quantities: Sequence[Quantity],
    mapped: Mapping[str, str],
    column_advice: Callable[[Table], str] | None = None,
) -> dict[str, tuple[int, float]]:
    by_key = {quantity.key: quantity for quantity in (TIME, *quantities)}
    for key in mapped:
        if key not in by_key:
            expected = f"expected one of {', '.join(by_key)}{hint_at(key, by_key)}"
            raise InputError(f"columns has the key {key!r}; {expected}")
    chosen = {
        key: _column_named_by_user(grid, by_key[key], name=name) for key, name in mapped.items()
    }
    sought = quantities if not chosen.keys() - {TIME.key} else ()
    recognised = {
        quantity.key: column
        for quantity in (TIME, *sought)
        if quantity.key not in chosen
        and (column := find_column(grid, quantity, sought, advice=column_advice)) is not None
    }
    return chosen | recognised


def _column_named_by_user(
    grid: Table, quantity: Quantity, name: str, where: str = ""
) -> tuple[int, float]:
    """The unit is in the name of the column, or behind it in `name`, as in "Load (N)"."""
    # A number at the end, as in "lambda_2", is no unit; only a 1 is, if there is no other.
    bare, unit_of_user = name_and_unit(name)
    column = name if name in grid.columns else bare
    if grid.columns.count(column) != 1:
        fault = "exists twice" if column in grid.columns else "does not exist"
        raise grid.error_at(
            f"{where or f'columns.{quantity.key}'} is {name!r}, which {fault}; the columns are "
            f"{', '.join(grid.columns)}{hint_at(name, grid.columns)}"
        )
    units = [each for each in (name_and_unit(column)[1], unit_of_user) if each]
    unit = next((each for each in units if not each.isdigit()), "1" if "1" in units else None)
    if unit is None and quantity.unitless:
        unit = quantity.unit
    if quantity in (STRAIN, STRESS) and _words(column) & _DEFORMED:
        raise grid.error_at(
            f"column {column} refers to the deformed specimen; expected engineering "
            f"{quantity.key}, relative to the undeformed length or area"
        )
    factor = None if unit is None else si_factor(unit, quantity.dimension)
    if factor is None:
        raise _unit_error(grid, column, unit=unit, quantity=quantity)
    return grid.columns.index(column), factor


def find_column(
    grid: Table,
    quantity: Quantity,
    others: Sequence[Quantity] = (),
    advice: Callable[[Table], str] | None = None,
) -> tuple[int, float] | None:
    """Return index and factor to SI of the column whose name and unit fit a quantity; None if no
    name fits. Of several columns with a fitting name, those with another unit are ignored.

    Parameters
    ----------
    others : sequence of Quantity
        Further quantities that the table may have: a column whose name and unit fit one of them
        needs no other unit.
    advice : callable, optional
        See `column_advice` of `read_columns`.

    Raises
    ------
    InputError
        If several columns fit, or names fit but no unit does.
    """
    units = _fitting_names(grid, quantity)
    fitting = _fitting_columns(grid, quantity)
    if len(fitting) > 1:
        names = [grid.columns[k] for k, _ in fitting]
        if len(set(names)) < len(names):
            remedy = "different names"
        elif advice is not None:
            remedy = advice(grid)
        else:
            remedy = " or ".join(column_statement({quantity.key: name}) for name in names)
        raise grid.error_at(
            f"the columns {', '.join(names)} could all be {quantity.key}; expected one of them, "
            f"or {remedy}"
        )
    if fitting:
        return fitting[0]
    explained = {k for other in others for k, _ in _fitting_columns(grid, other)}
    if (wrong := next((k for k in units if k not in explained), None)) is not None:
        raise _unit_error(grid, grid.columns[wrong], unit=units[wrong], quantity=quantity)
    return None


def find_time(grid: Table, measured: Collection[int] = ()) -> tuple[int, float] | None:
    """Return index and factor to seconds of the column of times; None without one. A column t_s has
    precedence.

    The columns `measured` have other quantities, whatever their names.

    Raises
    ------
    InputError
        If several columns have times, or their unit is missing or none of time.
    """
    if grid.columns.count(TIME.column) == 1:
        return grid.columns.index(TIME.column), 1.0
    names = ["" if k in measured else name for k, name in enumerate(grid.columns)]
    return find_column(replace(grid, columns=names), TIME)


def _fitting_names(grid: Table, quantity: Quantity) -> Mapping[int, str | None]:
    """Return the unit by index of each column whose name fits a quantity; None without."""
    units = {
        k: name_and_unit(column)[1]
        for k, column in enumerate(grid.columns)
        if _name_fits(column, quantity)
    }
    if quantity.unitless:
        units = {k: unit or quantity.unit for k, unit in units.items()}
    return units


def _fitting_columns(grid: Table, quantity: Quantity) -> list[tuple[int, float]]:
    factors = {
        k: si_factor(unit, quantity.dimension)
        for k, unit in _fitting_names(grid, quantity).items()
        if unit
    }
    return [(k, factor) for k, factor in factors.items() if factor is not None]


def fitting_column_names(grid: Table, quantity: Quantity) -> list[str]:
    """Return the names of all columns whose name and unit fit a quantity, in their order."""
    return [grid.columns[k] for k, _ in _fitting_columns(grid, quantity)]


def similar_column_names(grid: Table, quantity: Quantity) -> list[str]:
    """Return the names of all columns that may hold a quantity although their names do not fit it,
    in their order.

    These are columns of quantities whose unit, which is no number, fits, as "s_mpa" for a stress,
    and of `unitless` quantities those with one of its words and no unit but a number, as "lambda_2" for
    a second stretch. Names that fit another known quantity are left out.
    """
    names = []
    for column in grid.columns:
        name, unit = name_and_unit(column)
        if quantity.unitless:
            is_similar = bool(_words(name) & set(quantity.words.split())) and (
                unit is None or unit.isdigit()
            )
            others = ()
        else:
            is_similar = (
                unit is not None
                and not unit.isdigit()
                and si_factor(unit, quantity.dimension) is not None
            )
            others = KNOWN_QUANTITIES
        if (
            is_similar
            and not _other_word(column)
            and not _words(name) & _DEFORMED
            and not any(_name_fits(column, each) for each in others)
        ):
            names.append(column)
    return names


def deformed_column_names(grid: Table, quantity: Quantity) -> list[str]:
    """Return the names of all columns that hold a quantity of the deformed specimen, such as a true
    stress or a logarithmic strain, in their order.
    """
    words = set(quantity.words.split())
    named = ((column, _words(name_and_unit(column)[0])) for column in grid.columns)
    return [column for column, own in named if own & words and own & _DEFORMED]


def column_statement(names: Mapping[str, str]) -> str:
    """Return the key `columns` of a problem file in TOML that names a column for each quantity."""
    entries = [f"{key} = {json.dumps(name, ensure_ascii=False)}" for key, name in names.items()]
    return f"columns = {{ {', '.join(entries)} }}"


def _name_fits(column: str, quantity: Quantity) -> bool:
    """Return whether a name has the quantity's key, or one of its words and its qualifier."""
    # "true stress" fits `TRUE_STRESS`, not `STRESS`.
    name, _ = name_and_unit(column)
    words = _words(name)
    called = words & set(quantity.words.split())
    qualifiers = {key for key, of_key in QUALIFIERS.items() if words & of_key}
    if "difference" in qualifiers:  # one of true stresses, whether the name says so or not
        qualifiers.discard("deformed")
    if qualifiers & {"storage", "loss"}:
        qualifiers.discard("modulus")
    if "factor" in qualifiers:
        qualifiers.discard("loss")
    own = {quantity.qualifier} if quantity.qualifier else set()
    return _key_of(name) == quantity.key or bool(called and qualifiers == own)


def other_columns_text(grid: Table, quantities: Sequence[Quantity] = ()) -> str:
    """Return the addition to a message on missing columns that names those of other quantities than
    `quantities`, such as a stress difference; "" without any.
    """
    others = {
        column: word
        for column in grid.columns
        if (word := _other_word(column, {q.qualifier for q in quantities}))
        and not any(_name_fits(column, q) for q in quantities)
    }
    return "".join(
        f"; {column} is not read, because the word {word!r} makes it another quantity"
        for column, word in others.items()
    )


def _other_word(column: str, own: Collection[str] = ()) -> str:
    """Return the word that makes a column another quantity than any that is read, or ""."""
    keys = ("other", "difference", "storage", "loss", "modulus", *(("deformed",) if own else ()))
    words = _words(name_and_unit(column)[0])
    others = (words & QUALIFIERS[key] for key in keys if key not in own)
    return next((word for found in others for word in sorted(found)), "")


def name_and_unit(column: str) -> tuple[str, str | None]:
    """Return the parts of a column's name: ("Load", "kN") of "Load (kN)", "Load kN" or "Load/kN";
    the unit is None without one, or if the brackets are empty.
    """
    parts = _PER_AREA.fullmatch(column)
    if parts is not None:
        unit = f"{parts['unit']}/{parts['area']}"
        if si_factor(unit, STRESS.dimension) is not None:
            return parts["name"], unit
    if _key_of(column) in {quantity.key for quantity in KNOWN_QUANTITIES}:
        return column, None
    if (parts := _NAMED.fullmatch(column)) is not None:
        return parts["name"], parts["bracketed"] or parts["behind"]
    parts = _BARE_UNIT.fullmatch(column)
    if parts is not None and any(si_factor(parts["unit"], each) for each in UNITS):
        return parts["name"], parts["unit"]
    return column, None


def _key_of(name: str) -> str:
    return name.strip().lower().replace(" ", "_")


def names_compression(column: str) -> bool:
    """Return whether the name of a column states compression, as in Druckspannung."""
    return _COMPRESSIVE.search(column) is not None


def _words(name: str) -> set[str]:
    """Return sequences of letters in lower case, also as singulars and parts of compounds."""
    words = set(re.findall(r"[^\W\d_]+", name.lower()))
    words |= {word[: -len(end)] for word in words for end in ("s", "es") if word.endswith(end)}
    compounds = [*filter(None, map(_COMPOUND.fullmatch, words))]
    firsts = {c["first"] for c in compounds} & _ALL_QUALIFIERS
    return words | {c["last"] for c in compounds} | firsts


# Errors -------------------------------------------------------------------------------------------


def _require_known_columns(grid: Table, quantities: Sequence[Quantity], all_of: bool) -> None:
    known = {quantity.key for quantity in KNOWN_QUANTITIES}
    for column in grid.columns:
        if name_and_unit(column)[0].lower() not in known:
            hint = hint_at(column, [quantity.column for quantity in quantities])
            raise _columns_error(
                grid, quantities, all_of=all_of, why=f": {column} is not among them{hint}"
            )


def _columns_error(
    grid: Table, quantities: Sequence[Quantity], all_of: bool, why: str = "", advice: str = ""
) -> InputError:
    expected = ", ".join(quantity.column for quantity in quantities)
    needed = [
        f"; a {quantity.key} needs {size} of the undeformed specimen"
        for quantity, size in ((STRAIN, "length_m"), (STRESS, "area_m2"))
        if quantity not in quantities
        and any(_name_fits(column, quantity) for column in grid.columns)
    ]
    return grid.error_at(
        f"the columns are {', '.join(grid.columns)}; expected {TIME.column} and "
        f"{'all' if all_of else 'any'} of {expected}, each once, in these or other units"
        f"{why}{''.join(needed)}{other_columns_text(grid, quantities)}{advice}"
    )


def _unit_error(grid: Table, column: str, unit: str | None, quantity: Quantity) -> InputError:
    name = name_and_unit(column)[0] or column
    has = f"has the unit {unit}" if unit else "names no unit"
    remedy = (
        f"convert its values, then call it {quantity.column}"
        if unit
        else f"add the unit that it has, for example {name} ({quantity.unit})"
    )
    return grid.error_at(
        f"column {column} {has}; expected {expected_units(unit or '', quantity.dimension)}: "
        f"{remedy}"
    )
