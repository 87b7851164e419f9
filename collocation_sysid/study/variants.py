"""Variants of a problem's model as overrides of its file: other materials, other memory.

What is estimated follows the model. Constants that a material does not have are left out, those
that it needs besides are estimated, from where a scan of the stiffness starts them; all else stays
as the file states it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError, hint_at
from ..fem.constants import bare
from ..fem.materials import MATERIALS
from ..fem.moduli import ELASTIC, elastic_names
from ..problem.reading import read_problem_file

# Where a branch's share starts; time constants start evenly between a sample and the recording.
SHARE = 0.1
MOST_BRANCHES = 20


@dataclass(frozen=True)
class Variant:
    """One model.

    Attributes
    ----------
    label : str
    overrides : tuple of "key=value" that make it of the problem file
    """

    label: str
    overrides: tuple[str, ...]


def parse_materials(text: str) -> tuple[str, ...]:
    """Names of materials separated by commas, each once.

    Raises
    ------
    InputError
        For an unknown name, with the one that was probably meant.
    """
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    for name in names or ("",):
        if name not in MATERIALS:
            known = f"expected some of {', '.join(MATERIALS)}{hint_at(name, MATERIALS)}"
            raise InputError(f"found {name!r}; {known}", None, "--materials")
    return names


def parse_branches(text: str) -> tuple[int, ...]:
    """Numbers of Prony branches separated by commas, each once.

    Raises
    ------
    InputError
        For anything but whole numbers from 0 on.
    """
    items = [item.strip() for item in text.split(",") if item.strip()]
    counts = [int(item) for item in items if item.isdecimal() and len(item) < 3]
    if not items or len(counts) < len(items) or max(counts) > MOST_BRANCHES:
        expected = f"whole numbers up to {MOST_BRANCHES}, such as 0,1,2"
        raise InputError(f"found {text!r}; expected {expected}", None, "--prony")
    return tuple(dict.fromkeys(counts))


def variants(
    path: Path,
    overrides: Sequence[str],
    materials: Sequence[str],
    branches: Sequence[int],
    times_s: tuple[float, float],
) -> list[Variant]:
    """Every material with every number of branches.

    Parameters
    ----------
    path, overrides
        The problem file.
    materials : sequence of names; the file's own if there is none
    branches : sequence of numbers of Prony branches; as in the file if there is none
    times_s : (shortest, longest)
        Time constants of branches start between them.

    Raises
    ------
    InputError
        For less than two models, and for materials of a body with regions.
    """
    file, _ = read_problem_file(path, overrides)
    content = file.model_dump(mode="json", exclude_unset=True)
    body = content["object"]
    if materials and body.get("region"):
        raise InputError(
            "found regions in the object; expected a body of one material to compare others",
            path,
            "object.region",
        )
    found = []
    for material in materials or (None,):
        for count in branches or (None,):
            label, changes = [], {}
            parameters = content["parameters"]
            if material is not None:
                label.append(material)
                changes["object.material"] = material
                parameters = _of_material(parameters, material)
            if count is not None:
                label.append("no memory" if count == 0 else f"{count} branch{'es' * (count > 1)}")
                tables = _branches(body.get("prony", []), count)
                if tables or body.get("prony"):
                    changes["object.prony"] = tables
                old = [each["name"] for each in body.get("prony", [])]
                parameters = _with_memory(parameters, old, tables, times_s)
            changes["parameters"] = parameters
            settings = tuple(f"{key}={toml(value)}" for key, value in changes.items())
            found.append(Variant(", ".join(label), (*overrides, *settings)))
    if len(found) < 2:
        raise InputError(
            f"found the model {found[0].label} alone; expected two or more to compare, such as "
            "neo-hookean,yeoh",
            None,
            "--materials" if materials else "--prony",
        )
    return found


def _of_material(parameters: Mapping[str, Any], material: str) -> dict[str, Any]:
    """The parameters of a body that is of this material instead."""
    own = [constant.name for constant in MATERIALS[material].constants]
    of_any = {c.name for each in MATERIALS.values() for c in each.constants} | {*ELASTIC}
    elastic = [name for name in parameters if name in elastic_names(MATERIALS[material])]
    kept = {n: v for n, v in parameters.items() if n not in of_any or n in (*own, *elastic)}
    if "mu_pa" in own and "mu_pa" not in elastic and "young_pa" not in elastic:
        kept["mu_pa"] = {}
    return kept | {name: {} for name in own if name not in ELASTIC and name not in kept}


def _branches(given: Sequence[Mapping[str, Any]], count: int) -> list[dict[str, Any]]:
    """The first branches of the file, and others up to a number."""
    tables = [dict(each) for each in given[:count]]
    names = (f"prony_{k}" for k in range(1, 2 * count + 1))
    taken = {each["name"] for each in tables}
    new = [{"name": name} for name in names if name not in taken]
    return [*tables, *new[: count - len(tables)]]


def _with_memory(
    parameters: Mapping[str, Any],
    old: Sequence[str],
    tables: Sequence[Mapping[str, Any]],
    times_s: tuple[float, float],
) -> dict[str, Any]:
    """The parameters with a share and a time constant of each branch."""
    names = [each["name"] for each in tables]
    gone = {name for name in old if name not in names}
    kept = {n: v for n, v in parameters.items() if n.removesuffix(f".{bare(n)}") not in gone}
    shortest, longest = times_s
    for k, name in enumerate(names, start=1):
        tau_s = shortest * (longest / shortest) ** (k / (len(names) + 1))
        kept.setdefault(f"{name}.share", {"guess": SHARE})
        kept.setdefault(f"{name}.tau_s", {"guess": float(f"{tau_s:.3g}")})
    return kept


def toml(value: Any) -> str:
    """A value in TOML's inline syntax."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, (str, bool)):
        return json.dumps(value)
    return repr(value)
