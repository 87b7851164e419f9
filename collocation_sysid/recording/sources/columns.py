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

from ...common.array_types import Array, Index
from ...errors import InputError, hint_at, listed
from ..sample_times import TIME_TOLERANCE_S
from .source import read_table
from .text import Table, names_file_in_errors, numeric_cells, times_in_column
from .units import UNITS, expected_units, si_factor, written_unit


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

    @property
    def text(self) -> str:
        """Name in messages."""
        return self.key.replace("_", " ")


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
TORQUE = Quantity(
    "torque", "torque", unit="nm", words="torque moment drehmoment couple torsionsmoment momento"
)
ANGLE = Quantity(
    "angle",
    "angle",
    unit="rad",
    words="angle rotation twist winkel drehwinkel verdrehwinkel verdrehung angolo ángulo",
)
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
SECOND_DISPLACEMENT = Quantity(
    "second_displacement", "length", unit="m", words=DISPLACEMENT.words, qualifier="second"
)
SECOND_FORCE = Quantity("second_force", "force", unit="n", words=FORCE.words, qualifier="second")
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
    *(DISPLACEMENT, FORCE, TORQUE, ANGLE, STRAIN, STRESS, TENSION, PRESSURE),
    *(STRETCH, SECOND_STRETCH, LATERAL_STRETCH, SECOND_STRAIN, LATERAL_STRAIN),
    *(SECOND_DISPLACEMENT, SECOND_FORCE),
    *(VOLUME_RATIO, SECOND_STRESS, TRUE_STRESS, STRESS_DIFFERENCE, MODULUS),
    *(FREQUENCY, STORAGE, LOSS, LOSS_FACTOR),
)

# Name of a column that no column of a table fits.
MISSING = "…"

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
_DEFORMED = {
    "true",
    "wahre",
    "cauchy",
    "logarithmic",
    "logarithmische",
    "log",
    "hencky",
    "natural",
    "ln",
}
# Strains and stresses of other measures, with what the strains are and the stretch that they give.
_GREEN = ("a Green-Lagrange strain", "√(1 + 2 E)")
_ALMANSI = ("an Almansi strain", "1/√(1 − 2 e)")
_LOGARITHM = ("a true strain, the logarithm of the stretch", "the exponential of the true strain")
STRAIN_MEASURES = {
    **dict.fromkeys(("lagrange", "lagrangian", "green", "vsg"), _GREEN),
    **dict.fromkeys(("almansi", "euler", "eulerian"), _ALMANSI),
    **dict.fromkeys(_DEFORMED, _LOGARITHM),
}
_OTHER_MEASURES = {*(STRAIN_MEASURES.keys() - _DEFORMED), "piola", "kirchhoff", "pk"}
# The first Piola-Kirchhoff stress is the engineering stress.
_FIRST_PIOLA = re.compile(r"(first|1st|1\.)\s+(piola([\s–-]+kirchhoff)?|pk)\b|\bpk\s?1\b")
# What the words of a name state about strains, stresses and moduli, or about the axis.
KINDS = {
    "tension": re.compile(
        r"tensile|\bzug|young|\b(uni)?axial|\bnormal(?!i[sz])|"
        r"compressive|druckspann"
    ),
    "shear": re.compile(
        r"shear|schub|scher|cisaillement|cortante|taglio|torsion|gamma|γ|\btau(?![^\W\d_])|τ|"
        r"(?<![^\W\d_])(xy|yz|xz)(?![^\W\d_])"
    ),
    "simple shear": re.compile(r"\bsimple\b|\beinfache"),
    "pure shear": re.compile(r"\bpure\b|\bplanar\b|\breine"),
    "two axes": re.compile(r"\b(equi-?)?biaxial"),
    "volume": re.compile(r"volumetric|volumen|hydrostat|\bbulk|\bkompressionsmodul"),
    "absolute": re.compile(r"\babs(olute)?\b|absolut"),
    **{axis: re.compile(rf"(?<![^\W\d_]){axis}(?![^\W\d_])") for axis in "xyz"},
}
# Symbols of moduli, as in E(t) and G′.
_MODULUS_SYMBOLS = {
    "tension": re.compile(r"\be(?![^\W\d_])"),
    "shear": re.compile(r"\bg(?![^\W\d_])"),
}
# Words for symbols.
_SYMBOLS = {
    "loss modulus": re.compile(r"\b[ge](''|′′|’’|″|\")"),
    "storage modulus": re.compile(r"\b[ge]['′’]"),
    "complex modulus": re.compile(r"\|?\b[ge]\*\|?"),
    "nominal": _FIRST_PIOLA,
}
# Words that state nothing that a reading could contradict.
_NEUTRAL = (
    "engineering eng nominal technical technische technischer ingénieur measured gemessen "
    "gemessene actual raw value signal channel kanal sensor transducer cell machine maschine "
    "instron zwick mts standard traverse traversen grip clamp video optical extensometer gauge dic "
    "digital camera laser elapsed test run of the in from axial uniaxial tensile compressive "
    "compression zug prüf st first cable tendon chamber relative relaxation dynamic angular "
    "delta δ amount shear sigma σ epsilon eps ε nominale spannungs elastizitäts "
    "relaxations kolben längen stauch xx yy zz"
)
# Signs of arithmetic in a name, as in strain^2, 1/strain, stretch - 1 and E*.
_ARITHMETIC = re.compile(r"[\^*√×÷|]\d*|\d+\s*/|^\s*[-−]|(?:(?<=\d)|(?<=\d ))[-−+]|[-−+]\s*\d+")
# German compounds end with what they are: Druckspannung, Prüfkraft, Kolbenweg.
_COMPOUND = re.compile(
    r"(?P<first>\w+)(?P<last>zeit|weg|kraft|last|spannung|dehnung|stauchung|streckung|druck|"
    r"modul)"
)
# Words in the name of a column that distinguish quantities with the same other words, by key.
QUALIFIERS = {
    "deformed": _DEFORMED,
    "measure": _OTHER_MEASURES,
    "second": {"second", "zweite"},
    "lateral": {"lateral", "transverse", "quer"},
    "difference": {"difference", "differenz", "différence"},
    "modulus": {"modulus", "modul", "module", "relaxationsmodul"},
    "storage": {"storage", "stor", "speichermodul"},
    "loss": {"loss", "verlustmodul"},
    "factor": {"factor", "tan", "tanδ"},
    # Of no quantity: values that are computed from others, of something else, or not measured.
    "other": {
        *("deviatoric", "mises", "tresca", "complex", "tangent", "secant", "plastic", "thermal"),
        *("rate", "energy", "error", "fehler", "deviation", "abweichung", "std"),
        *("uncertainty", "residual", "target", "setpoint", "command", "commanded", "sollwert"),
        *("soll", "vor"),
        *("amplitude", "range", "strength", "limit", "noise"),
    },
}
_ALL_QUALIFIERS = frozenset().union(*QUALIFIERS.values())
# Ends of names that are components and kinds instead of units, as in eng_strain_yy and strain [log].
_NO_UNITS = _ALL_QUALIFIERS.union(_NEUTRAL.split(), "xyz", ("xy", "yz", "xz"), ("11", "22", "33"))
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
    # Words of names that are not understood, and what else was assumed, a sentence each.
    notes: tuple[str, ...] = ()
    row_count: int = 0  # rows of the file, of which those within the window are read
    # dict: why a column that has a quantity's word does not hold it, by its name.
    contradictions: Mapping[str, str] = field(default_factory=dict)
    of_others: Collection[str] = ()  # columns of noise, and of others

    def contradiction(self, quantities: Sequence[Quantity]) -> str:
        """Return why columns with words of some quantities do not hold them; "" without any."""
        words = set().union(*(quantity.words.split() for quantity in quantities))
        found = [why for name, why in self.contradictions.items() if _words(name) & words]
        return "; ".join(found)

    @property
    def known_grid(self) -> Table:
        """Table in which columns that do not hold what their names say have no names."""
        return _without_names(self.grid, {*self.contradictions, *self.of_others})


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
    header_line: int | None = None,
    window_s: tuple[float, float] | None = None,
    other_kinds: Mapping[str, str] | None = None,
) -> QuantityTable:
    """Read those of some quantities that a table has, in any order, in SI units.

    Parameters
    ----------
    column_names : mapping, optional
        Column name by a quantity's key; "t" for the time. A unit that the file does not state may
        follow the name, as in "Load (N)". Other columns are not looked for if a quantity besides
        the time is mapped; without mapping, columns are recognised by name.
    blank_allowed : bool
        Whether cells may be blank, which become NaN; a column of blank cells alone counts as
        missing.
    requires_times : bool
        Whether times are required; otherwise rows are numbered in seconds if there are no times.
    is_timed : bool
        Whether times must increase; otherwise rows whose times do not are numbered, with a note.
    requires_all : bool
        Whether each of `quantities` is required; otherwise one is enough.
    column_advice : callable, optional
        Returns for the table the remedy that a message names if several columns fit one quantity;
        by default the statements that choose one of them, see `column_statement`.
    noise_columns : mapping, optional
        Column name by the key of `NOISES` that names it; these columns hold no other quantity.
    other_columns : collection of str
        Names of columns that others read, such as the noise of another sensor in the same file.
    header_line : int, optional
        Line of the column names; by default that above the longest table.
    window_s : (float, float), optional
        First and last time of the rows to read; cells of other rows are not read.
    other_kinds : mapping, optional
        Kinds among `KINDS` that the quantities do not have, with the statement that reads them,
        such as 'test = "simple-shear"'; columns whose names state them are not read.

    Raises
    ------
    InputError
        If a column is missing, repeated, unknown, without unit or with a wrong one, its name
        contradicts the quantity, a cell is not a number, or time does not increase; the line is
        named.
    """
    grid = read_table(path, header_line)
    named = dict(column_names or {})
    kinds = other_kinds or {}
    noise_places = {
        key: _column_named_by_user(grid, NOISES[key], name=name, where=key)
        for key, name in (noise_columns or {}).items()
    }
    of_others = {grid.columns[place] for place, _ in noise_places.values()} | {*other_columns}
    if "t_s" in grid.columns and not named:
        known = _without_names(grid, of_others)
        _require_known_columns(grid, known.columns, quantities, all_of=requires_all)
    empty = [c for k, c in enumerate(grid.columns) if c and _is_blank(grid, k)]
    contradictions = {} if named.keys() - {TIME.key} else _contradictions(grid, quantities, kinds)
    sought = _without_names(grid, {*empty, *contradictions, *of_others})
    places = _find_columns(grid, sought, quantities, mapped=named, column_advice=column_advice)
    t = places.pop(TIME.key, None)
    needs_times = requires_times or window_s is not None
    unused = [c for c in empty if any(_name_fits(c, each) for each in quantities)]
    contradictions |= {column: f"column {column} has no values" for column in unused}
    if len(places) < (len(quantities) if requires_all else 1) or (needs_times and t is None):
        if contradictions and not places:
            raise grid.error_at("; ".join(contradictions.values()))
        advice = "" if column_advice is None or places else f". State {column_advice(sought)}"
        raise _columns_error(grid, quantities, all_of=requires_all, advice=advice)
    t_s, rows, notes = _times(grid, t, is_timed, window_s)
    kept = grid if len(rows) == len(grid.cells) else grid.with_rows(rows)
    values = {
        key: factor * numeric_cells(kept, [place], blank_allowed=blank_allowed)[:, 0]
        for key, (place, factor) in places.items()
    }
    noises = {
        key: factor * numeric_cells(kept, [place], blank_allowed=True)[:, 0]
        for key, (place, factor) in noise_places.items()
    }
    used = {place for place, _ in (*places.values(), *noise_places.values(), *([t] if t else []))}
    left = [c for k, c in enumerate(grid.columns) if k not in used and c not in other_columns]
    unread = [c for c in left if name_and_unit(c)[1] is not None and c not in unused]
    by_key = {quantity.key: quantity for quantity in quantities}
    of_user = {key: place for key, (place, _) in places.items() if key in named}
    notes += [
        f"the name of column {grid.columns[place]} states {kind}, and it is read as "
        f"{by_key[key].text}, because columns states so"
        for key, place in of_user.items()
        for kind in _stated_kinds(grid.columns[place], by_key[key], kinds)
    ]
    words = {
        f"{listed([repr(each) for each in unknown])} in {grid.columns[place]!r}, which is read as "
        f"{by_key[key].text}"
        for key, (place, _) in places.items()
        if key not in of_user and (unknown := _unknown_words(grid.columns[place], by_key[key]))
    }
    notes += [f"column {column} has no values: it is not read" for column in unused]
    if words:
        notes.append(f"words that are not understood: {'; '.join(sorted(words))}")
    return QuantityTable(
        kept,
        t_s,
        values=values,
        unread=() if named else tuple(unread),
        noises=noises,
        notes=tuple(notes),
        row_count=len(grid.cells),
        contradictions=contradictions,
        of_others=of_others,
    )


def _is_blank(grid: Table, place: int) -> bool:
    """Return whether a column has no values at all."""
    cells = grid.cells[:, place]
    if cells.dtype != object:
        return bool(np.isnan(cells).all())
    return all(cell == "" or cell.lower() == "nan" for cell in cells)


def _without_names(grid: Table, names: Collection[str]) -> Table:
    """Return a table in which columns of some names, with or without units, have no name."""
    is_other = [c in names or name_and_unit(c)[0] in names for c in grid.columns]
    columns = ["" if is_so else c for c, is_so in zip(grid.columns, is_other, strict=True)]
    return replace(grid, columns=columns)


def _times(
    grid: Table,
    column: tuple[int, float] | None,
    is_timed: bool,
    window_s: tuple[float, float] | None,
) -> tuple[Array, Index, list[str]]:
    """Return the times (k,) and the indices (k,) of the rows to read, and notes.

    The rows of a window are those from the first time in it to the last before a time after it.
    Only the times of rows that are read are validated, and only if `is_timed`.
    """
    every = np.arange(len(grid.cells))
    if column is None:
        return every.astype(float), every, []
    place, factor = column
    times = grid.numbers_where_possible(place) * factor
    rows = every
    if window_s is not None:
        first_s, last_s = window_s[0] - TIME_TOLERANCE_S, window_s[1] + TIME_TOLERANCE_S
        begun = np.flatnonzero((times >= first_s) & (times <= last_s))
        rows = every[begun[0] :] if len(begun) else every[:0]
        ended = np.flatnonzero(times[rows] > last_s)
        rows = rows[: ended[0]] if len(ended) else rows
        if not len(rows):
            known = times[np.isfinite(times)]
            span = f", {known.min():g} s to {known.max():g} s" if len(known) else ""
            raise InputError(
                f"found [{window_s[0]:g}, {window_s[1]:g}], which contains no sample; expected a "
                f"window within the times of the table{span}",
                where="window_s",
            )
    kept = grid.with_rows(rows)
    try:
        return times_in_column(kept, place, factor), rows, []
    except InputError as error:
        if is_timed:
            raise
        note = (
            f"times are not in order ({error.where}: {error.message}); the rows are taken as they "
            "stand, because the law does not depend on times"
        )
        return np.arange(float(len(rows))), rows, [note]


# Choice of columns --------------------------------------------------------------------------------


def _find_columns(
    grid: Table,
    among: Table,
    quantities: Sequence[Quantity],
    mapped: Mapping[str, str],
    column_advice: Callable[[Table], str] | None = None,
) -> dict[str, tuple[int, float]]:
    """Columns that the user did not name are recognised by their names in `among`."""
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
        and (column := find_column(among, quantity, sought, advice=column_advice)) is not None
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
    if _is_blank(grid, grid.columns.index(column)):
        raise grid.error_at(
            f"{where or f'columns.{quantity.key}'} is {name!r}, which has no values; expected "
            f"another of the columns {', '.join(grid.columns)}"
        )
    own = name_and_unit(column)[1]
    is_part_of_name = quantity.unitless or column.endswith(f"_{own}")
    if own and is_part_of_name and not any(si_factor(own, each) for each in UNITS):
        own = None
    units = [each for each in (own, unit_of_user if column == bare else own) if each]
    unit = next((each for each in units if not each.isdigit()), "1" if "1" in units else None)
    if unit is None and _needs_no_unit(column, quantity):
        unit = quantity.unit
    if contradiction := _other_measure(column, quantity):
        raise grid.error_at(contradiction)
    factor = None if unit is None else si_factor(unit, quantity.dimension)
    if factor is None:
        key = where or f"columns.{quantity.key}"
        raise _unit_error(grid, column, unit=unit, quantity=quantity, stated_by=key)
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
        raise _unit_error(
            grid, grid.columns[wrong], unit=units[wrong], quantity=quantity, advice=advice
        )
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
    return {
        k: name_and_unit(column)[1] or (quantity.unit if _needs_no_unit(column, quantity) else None)
        for k, column in enumerate(grid.columns)
        if _name_fits(column, quantity)
    }


def _needs_no_unit(column: str, quantity: Quantity) -> bool:
    """Return whether a column without a unit has ratios, as below a blank cell in a row of units."""
    return quantity.unitless or (quantity.dimension == "ratio" and column.endswith("()"))


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
    a second stretch. Names and units that fit another known quantity are left out.
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
            and not _ARITHMETIC.search(name)
            and not _words(name) & _DEFORMED
            and not any(
                _name_fits(column, each) and unit and si_factor(unit, each.dimension) is not None
                for each in others
            )
        ):
            names.append(column)
    return names


def _contradictions(
    grid: Table, quantities: Sequence[Quantity], other_kinds: Mapping[str, str]
) -> dict[str, str]:
    """Return why columns do not hold quantities although they have their words, by name."""
    found: dict[str, str] = {}
    for column in grid.columns:
        if any(
            _name_fits(column, q) and not _stated_kinds(column, q, other_kinds) for q in quantities
        ):
            continue
        for quantity in quantities:
            if _key_of(name := name_and_unit(column)[0]) == quantity.key:
                continue
            if not _words(name) & set(quantity.words.split()):
                continue
            why = _other_measure(column, quantity)
            if not why and _name_fits(column, quantity):
                kind = _stated_kinds(column, quantity, other_kinds)[0]
                why = _kind_text(column, quantity, kind, remedy=other_kinds[kind])
            if why:
                found.setdefault(column, why)
    return found


def _kind_text(column: str, quantity: Quantity, kind: str, remedy: str) -> str:
    statement = column_statement({quantity.key: column})
    return (
        f"the name of column {column} states {kind}, which contradicts its reading; expected {remedy}, "
        f"or {statement} if the column holds the {quantity.text} of this table"
    )


def _other_measure(column: str, quantity: Quantity) -> str:
    """Return why a column is no engineering strain or stress, or ""."""
    words = _words(name_and_unit(column)[0])
    if "strain" in quantity.key:
        for word in sorted(words & STRAIN_MEASURES.keys()):
            what, stretch = STRAIN_MEASURES[word]
            return (
                f"column {column} holds {what}; expected an engineering strain, or the stretch, "
                f"which is {stretch}: convert its values, then call it stretch"
            )
    if quantity.key in (STRESS.key, SECOND_STRESS.key):
        if words & _DEFORMED:
            return (
                f"column {column} holds a true stress, force over deformed area; expected an "
                "engineering stress, force over undeformed area"
            )
        if words & _OTHER_MEASURES:
            return (
                f"the name of column {column} states another measure of stress; expected an "
                "engineering stress, force over undeformed area"
            )
    return ""


def _stated_kinds(column: str, quantity: Quantity, other_kinds: Mapping[str, str]) -> list[str]:
    """Return those of some kinds of `KINDS` that the name of a quantity's column states.

    Kinds of tests are those of strains, stresses and moduli: machines call forces tensile in any
    test.
    """
    name = name_and_unit(column)[0].lower()
    if _key_of(name) == quantity.key:
        return []
    is_of_test = quantity.dimension in ("ratio", "pressure")
    is_modulus = quantity.key in (MODULUS.key, STORAGE.key, LOSS.key)
    return [
        kind
        for kind in other_kinds
        if (is_of_test or kind in "xyz")
        and (
            KINDS[kind].search(name)
            or (is_modulus and kind in _MODULUS_SYMBOLS and _MODULUS_SYMBOLS[kind].search(name))
        )
    ]


def _unknown_words(column: str, quantity: Quantity) -> list[str]:
    """Return the words of a recognised column's name that are not understood."""
    name = name_and_unit(column)[0].lower()
    if _key_of(name) == quantity.key:
        return []
    qualifiers = {"storage": "modulus", "loss": "modulus", "factor": "loss"}
    own = [quantity.qualifier, qualifiers.get(quantity.qualifier, "")]
    known = {*quantity.words.split(), *_NEUTRAL.split()}
    known |= set().union(*(QUALIFIERS.get(key, ()) for key in own), quantity.key.split("_"))
    patterns = [*KINDS.values(), *(_MODULUS_SYMBOLS.values() if "modulus" in own else ())]
    known |= {"ratio"} if "stretch" in quantity.key else set()
    known |= {*"futp"} if "modulus" in own or len(own[0]) == 0 else set()

    def is_known(word: str) -> bool:
        if _words(word) & known and not _COMPOUND.fullmatch(word):
            return True
        if compound := _COMPOUND.fullmatch(word):
            first, last = compound["first"], compound["last"]
            return word in known or (last in known and is_known(first))
        return any(pattern.search(word) for pattern in patterns)

    plain = _without_symbols(re.sub(r"['’]s\b", "", name))
    unknown = [word for word in re.findall(r"[^\W\d_]+", plain) if not is_known(word)]
    return unknown + _ARITHMETIC.findall(plain)


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
    keys = (
        *("other", "measure", "difference", "storage", "loss", "modulus"),
        *(("deformed",) if own else ()),
    )
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
        unit = parts["bracketed"] or parts["behind"]
        is_word = (unit or "").lower() in _NO_UNITS
        if not is_word or any(si_factor(unit, each) for each in UNITS):
            return parts["name"], unit
    parts = _BARE_UNIT.fullmatch(column)
    if parts is not None and any(si_factor(parts["unit"], each) for each in UNITS):
        return parts["name"], parts["unit"]
    return column, None


def _key_of(name: str) -> str:
    return name.strip().lower().replace(" ", "_")


def names_compression(column: str) -> bool:
    """Return whether the name of a column states compression, as in Druckspannung."""
    return _COMPRESSIVE.search(column) is not None


def _without_symbols(name: str) -> str:
    for words, symbol in _SYMBOLS.items():
        name = symbol.sub(words, name)
    return name


def _words(name: str) -> set[str]:
    """Return sequences of letters in lower case, also as singulars and parts of compounds."""
    words = set(re.findall(r"[^\W\d_]+", _without_symbols(name.lower())))
    words |= {word[: -len(end)] for word in words for end in ("s", "es") if word.endswith(end)}
    compounds = [*filter(None, map(_COMPOUND.fullmatch, words))]
    firsts = {c["first"] for c in compounds} & _ALL_QUALIFIERS
    return words | {c["last"] for c in compounds} | firsts


# Errors -------------------------------------------------------------------------------------------


def _require_known_columns(
    grid: Table, columns: Collection[str], quantities: Sequence[Quantity], all_of: bool
) -> None:
    known = {quantity.key for quantity in KNOWN_QUANTITIES}
    for column in filter(None, columns):
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


def _unit_error(
    grid: Table,
    column: str,
    unit: str | None,
    quantity: Quantity,
    stated_by: str = "",
    advice: Callable[[Table], str] | None = None,
) -> InputError:
    """The remedy states columns where that is possible: by the user (`stated_by`), or by advice."""
    name = name_and_unit(column)[0] or column
    has = f"has the unit {unit}" if unit else "names no unit"
    written = written_unit(quantity.unit, quantity.dimension)
    remedy = (
        f"convert its values, then call it {quantity.column}"
        if unit
        else f"add the unit that it has, for example {name} ({written})"
    )
    if not unit and stated_by:
        with_unit = json.dumps(f"{column} ({written})", ensure_ascii=False)
        remedy = f"add the unit that it has, for example {stated_by} = {with_unit}"
    fitting = _fitting_names(grid, quantity)
    names = [c if fitting.get(k, c) else f"{c} ({written})" for k, c in enumerate(grid.columns)]
    tables = _without_names(grid, [column]), grid, replace(grid, columns=names)
    statements = [*map(advice, tables)] if advice else [MISSING]
    *stated, with_units = ["" if MISSING in each else each for each in statements]
    if statement := next(filter(None, stated), ""):
        remedy = f"state {statement}; or {remedy}"
    elif with_units and len({*names} - {*grid.columns}) > 1:
        remedy = f"state one with its unit, that of the loaded axis, for example {with_units}"
    return grid.error_at(
        f"column {column} {has}; expected {expected_units(unit or '', quantity.dimension)}: "
        f"{remedy}"
    )
