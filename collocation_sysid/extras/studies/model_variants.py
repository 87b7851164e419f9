"""Variants of a problem's model as overrides of its file: other materials, damping laws, memory.

The estimated parameters follow the model. Constants that a material does not have are removed;
those that it needs in addition are estimated, starting from the stiffness of the file's guess or
from a scan of the stiffness. Everything else stays as in the file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from ...errors import InputError, require_among
from ...fem.laws.constants import MOST_TERMS, usual_value, without_region
from ...fem.laws.materials import DAMPINGS, MATERIALS
from ...fem.laws.moduli import ELASTIC, elastic_names
from ...problem import Problem
from ...problem.loading import read_problem_file
from ...recording.measurement_selection import measured_count
from .arguments import unique_items

# Initial guess of a new branch's share of the stiffness.
SHARE = 0.1
# Largest number of branches: no recording determines as many time constants.
MOST_BRANCHES = 20
# Elastic constants for the compressibility, of which a material needs one.
VOLUMETRIC = {"lambda_pa", "kappa_pa", "poisson"}
# Budget entries for other damping laws; they are switched off if damping laws are compared.
DAMPING_ASSUMPTIONS = ("damping_law", "rayleigh_damping")
# Poisson's ratio if the file states none.
USUAL_POISSON = 0.3
# Typical change of a constant about zero, over the shear modulus.
LESS = 0.1


@dataclass(frozen=True)
class ModelVariant:
    """One model."""

    label: str  # name of the model for the user
    overrides: tuple[str, ...]  # overrides "key=value" that derive it from the problem file
    path: Path  # problem file


def parse_materials(text: str) -> tuple[str, ...]:
    """Return names of materials from text separated by commas, such as "neo-hookean,yeoh", each
    once, in the order of the text.

    Raises
    ------
    InputError
        Without any name, or for an unknown one, with the most similar known one.
    """
    return _parse_names(text, MATERIALS, option="--materials")


def parse_dampings(text: str) -> tuple[str, ...]:
    """Return names of damping laws from text separated by commas, such as "kelvin-voigt,rayleigh",
    each once, in the order of the text.

    Raises
    ------
    InputError
        Without any name, or for an unknown one, with the most similar known one.
    """
    return _parse_names(text, DAMPINGS, option="--damping")


def _parse_names(text: str, known_names: Iterable[str], option: str) -> tuple[str, ...]:
    """Return names separated by commas, each once, in the order of the text."""
    names = unique_items(text)
    for name in names or ("",):
        require_among(name, known_names, where=option, count="some")
    return names


def parse_branches(text: str) -> tuple[int, ...]:
    """Return numbers of Prony branches from text separated by commas, such as "0,1,2", each once,
    in the order of the text.

    Raises
    ------
    InputError
        For anything but whole numbers from 0 to `MOST_BRANCHES`, and without any number.
    """
    items = [item.strip() for item in text.split(",") if item.strip()]
    counts = [int(item) for item in items if item.isascii() and item.isdecimal() and len(item) < 3]
    if not items or len(counts) < len(items) or max(counts) > MOST_BRANCHES:
        expected = f"whole numbers up to {MOST_BRANCHES}, such as 0,1,2"
        raise InputError(f"found {text!r}; expected {expected}", None, where="--prony")
    return tuple(dict.fromkeys(counts))


def models(
    problems: Sequence[Problem],
    overrides: Sequence[str],
    materials: Sequence[str] = (),
    branches: Sequence[int] = (),
    region: str | None = None,
    dampings: Sequence[str] = (),
) -> list[ModelVariant]:
    """Return a model for every problem file with every material, damping law and number of
    branches, file after file; of several files the labels begin with that of the file.

    Parameters
    ----------
    problems : sequence of Problem
        At least one, of the same recordings, each with its file; time constants of new branches
        start between the timestep and the duration of the first one's fitted recordings.
    overrides, materials, branches, region, dampings
        See `variants`. Without materials, branches and dampings the files themselves are the
        models.

    Raises
    ------
    InputError
        For less than two models, and what the files or variants refuse.
    """
    compared = file_variants(problems, overrides)
    if materials or branches or dampings:
        fitted = [e for e in problems[0].experiments if not e.validation]
        times_s = (min(e.timestep_s for e in fitted), max(e.duration_s for e in fitted))
        files, compared = compared, []
        for file in files:
            of_file = variants(
                file.path,
                overrides,
                materials=materials,
                branches=branches,
                times_s=times_s,
                region=region,
                dampings=dampings,
            )
            front = f"{file.label}: " * (len(files) > 1)
            compared += [replace(v, label=front + v.label, path=file.path) for v in of_file]
    if len(compared) < 2:
        options = {
            "--materials": (materials, "neo-hookean,yeoh"),
            "--damping": (dampings, "kelvin-voigt,rayleigh"),
            "--prony": (branches or (0,), "0,1"),
        }
        option, example = next((o, e) for o, (is_declared, e) in options.items() if is_declared)
        raise InputError(
            f"found the model {compared[0].label} alone; expected two or more to compare, such as "
            f"{example}",
            None,
            where=option,
        )
    return compared


def variants(
    path: Path,
    overrides: Sequence[str],
    materials: Sequence[str],
    branches: Sequence[int],
    times_s: tuple[float, float],
    region: str | None = None,
    dampings: Sequence[str] = (),
) -> list[ModelVariant]:
    """Return a model for every combination of material, damping law and number of branches, in this
    order; the last changes fastest.

    A label joins the names of what varies, such as "yeoh, 1 branch" ("no memory" for 0 branches),
    after the region if there is one, such as "tip: yeoh". Nothing is written.

    Parameters
    ----------
    path : Path
        Problem file.
    overrides : sequence of str
        Overrides "key=value" of the file; those of the models follow them.
    materials : sequence of str
        Names of materials; the file's own if empty.
    branches : sequence of int
        Numbers of Prony branches; as in the file if empty.
    times_s : (shortest, longest)
        Time constants of new branches start between them, evenly on a logarithmic scale [s].
    region : str, optional
        Region that gets material, damping law and branches; by default every part of the body.
    dampings : sequence of str
        Names of damping laws; as in the file if empty. If there are any, the budget's first-order
        estimate of other damping laws is switched off.

    Raises
    ------
    InputError
        If the file cannot be read or is invalid with the overrides, for an unknown region, and if
        branches are compared and the file has branches of another region.
    """
    file, _ = read_problem_file(path, overrides)
    content = file.model_dump(mode="json", exclude_unset=True, by_alias=True)
    body = content["object"]
    _require_region(body, region, branches=bool(branches), path=path)
    varied = []
    for material, damping, count in product(
        materials or (None,), dampings or (None,), branches or (None,)
    ):
        label = []
        changes: dict[str, Any] = {}
        parameters = content["parameters"]
        if material is not None:
            label.append(material)
            changes |= _law_changes(body, {"material": material}, region=region)
            parameters = _with_material(parameters, material, region=region)
        if damping is not None:
            label.append(damping)
            laws = {"damping": damping} | ({} if material is None else {"material": material})
            changes |= _law_changes(body, laws, region=region)
            for name in DAMPING_ASSUMPTIONS:
                changes[f"uncertainty.assumptions.{name}"] = "none"
        if count is not None:
            label.append("no memory" if count == 0 else f"{count} branch{'es' * (count > 1)}")
            own = [t for t in body.get("prony", []) if t.get("region") == region]
            others = [t for t in body.get("prony", []) if t.get("region") != region]
            tables = _branch_tables(own, count, others={t["name"] for t in others}, region=region)
            if tables or body.get("prony"):
                changes["object.prony"] = [*others, *tables]
            old = [each["name"] for each in own]
            parameters = _with_memory(parameters, old, tables=tables, times_s=times_s)
        changes["parameters"] = parameters
        settings = tuple(f"{key}={as_inline_toml(value)}" for key, value in changes.items())
        label_text = f"{region}: " * (region is not None) + ", ".join(label)
        varied.append(ModelVariant(label_text, (*overrides, *settings), path=path))
    return varied


def file_variants(problems: Sequence[Problem], overrides: Sequence[str]) -> list[ModelVariant]:
    """Return a model for each problem file of the same recordings, in the order of `problems`.

    Labels are the names of the files without suffix, or the paths of all of them if two have the
    same name. Files are not read, and overrides are stored in the models, not applied.

    Parameters
    ----------
    problems : sequence of Problem
        At least one problem, each with its file.
    overrides : sequence of str
        Overrides "key=value", the same for all files.

    Raises
    ------
    InputError
        If the files do not fit the same recordings and samples, so that neither predictions nor AIC
        could be compared, or a file is given twice.
    """
    first, *others = map(_measured_counts, problems)
    for problem, measured in zip(problems[1:], others, strict=True):
        if measured != first:
            raise InputError(
                f"this file fits {_measured_text(measured)}, but {problems[0].path} fits "
                f"{_measured_text(first)}; expected the same recordings and samples in all files",
                problem.path,
            )
    paths = [Path(str(problem.path)) for problem in problems]
    if len({path.resolve() for path in paths}) < len(paths):
        raise InputError("this file is given twice; expected another", paths[-1], where="--with")
    stems = [path.stem for path in paths]
    distinct = len(set(stems)) == len(stems)
    return [
        ModelVariant(path.stem if distinct else str(path), tuple(overrides), path=path)
        for path in paths
    ]


def _measured_counts(problem: Problem) -> dict[str, int]:
    return {e.name: measured_count(e) for e in problem.experiments if not e.validation}


def _measured_text(measured: Mapping[str, int]) -> str:
    """Return for example "'swing' (600 numbers) and 'press' (80 numbers)"."""
    return " and ".join(f"'{name}' ({count} numbers)" for name, count in measured.items())


def _require_region(
    body: Mapping[str, Any], region: str | None, branches: bool, path: Path
) -> None:
    """Refuse an unknown region, or branches of other regions in the file."""
    names = [each["name"] for each in body.get("region", [])]
    if region is not None and not names:
        message = f"found the region {region!r}, but the object has no regions; leave out --region"
        raise InputError(message, path, where="--region")
    if region is not None:
        require_among(region, names, source=path, where="--region")
    owners = {each.get("region") for each in body.get("prony", [])}
    if branches and owners - {region}:
        other_region = next(iter(owners - {region}))
        whose = (
            "all parts without their own" if other_region is None else f"region '{other_region}'"
        )
        expected = (
            "no --region, so that --prony varies these"
            if other_region is None
            else f"--region {other_region}, so that --prony varies these"
        )
        raise InputError(
            f"found branches of {whose}; expected {expected}", path, where="object.prony"
        )


def _law_changes(
    body: Mapping[str, Any], laws: Mapping[str, str], region: str | None
) -> dict[str, Any]:
    """Return values by dotted key; the value of "object.region" is the complete list of tables."""
    regions = [dict(each) for each in body.get("region", [])]
    for each in regions:
        if region is None:
            for key in laws:
                each.pop(key, None)
        elif each["name"] == region:
            each |= laws
    changes: dict[str, Any] = {"object.region": regions} if regions else {}
    if region is not None:
        return changes
    return changes | {f"object.{key}": law for key, law in laws.items()}


def _with_material(
    parameters: Mapping[str, Any], material: str, region: str | None
) -> dict[str, Any]:
    """Constants start from the same shear modulus, or for a scan if that is unknown."""
    of_any = {c.name for each in MATERIALS.values() for c in each.constants} | {*ELASTIC}
    fronts = {
        name[: -len(without_region(name))] for name in parameters if without_region(name) in of_any
    }
    if region is not None:
        fronts = {f"{region}."}
    for front in sorted(fronts):  # what is shared is first
        parameters = _with_part_material(parameters, front, material=material, of_any=of_any)
    return dict(parameters)


def _with_part_material(
    parameters: Mapping[str, Any], prefix: str, material: str, of_any: set[str]
) -> dict[str, Any]:
    """Shared constants count where the part has none of its own, and for compressibility."""
    own = [constant.name for constant in MATERIALS[material].constants]
    possible = {*own, *elastic_names(MATERIALS[material])}
    mine = {prefix + name for name in of_any}
    unchanged = {
        n: v for n, v in parameters.items() if n not in mine or without_region(n) in possible
    }
    alone = any(name in mine for name in parameters)
    elastic = {without_region(name) for name in unchanged if name in (mine if alone else of_any)}
    shear_pa = _shear_pa(parameters, prefix)
    if "mu_pa" in own and not elastic & {"mu_pa", "young_pa"}:
        unchanged[f"{prefix}mu_pa"] = _starting_guess("mu_pa", shear_pa)
    own_or_shared = {without_region(name) for name in unchanged if name in mine | of_any}
    if elastic_names(MATERIALS[material]) and not own_or_shared & VOLUMETRIC:
        # A foam has no modulus that another material could take over.
        unchanged[f"{prefix}poisson"] = _starting_guess("poisson", shear_pa)
    needed = [name for name in own if name not in ELASTIC and prefix + name not in unchanged]
    return unchanged | {prefix + name: _starting_guess(name, shear_pa) for name in needed}


def _shear_pa(parameters: Mapping[str, Any], prefix: str) -> float | None:
    """Return the shear modulus [Pa] of guesses or fixed values; None if unknown."""

    def guess(name: str) -> float:
        value = parameters.get(prefix + name, parameters.get(name))
        if isinstance(value, Mapping):
            value = value.get("fixed", value.get("guess"))
        return float("nan") if value is None else float(value)

    linear = 0.0 if math.isnan(guess("c01_pa")) else guess("c01_pa")
    poisson = USUAL_POISSON if math.isnan(guess("poisson")) else guess("poisson")
    terms = range(1, MOST_TERMS + 1)
    if any(not math.isnan(guess(f"beta_{p}")) for p in terms):
        factors = {p: 1.0 for p in terms}  # of a foam
    else:
        factors = {p: guess(f"alpha_{p}") / 2 for p in terms}
    products = [factor * guess(f"mu_{p}_pa") for p, factor in factors.items()]
    powers = sum(each for each in products if not math.isnan(each))
    ways = (
        guess("mu_pa"),
        powers,
        2 * (guess("c10_pa") + linear),
        guess("young_pa") / (2 * (1 + poisson)),
    )
    return next((each for each in ways if each > 0), None)


def _starting_guess(name: str, shear_pa: float | None) -> dict[str, Any]:
    """Return a table with the guess of a shear modulus [Pa], or empty for a scan."""
    if shear_pa is None:
        return {}
    usual = usual_value(name, 2 * (1 + USUAL_POISSON) * shear_pa, poisson=USUAL_POISSON)
    if usual is None:
        return {}
    return {"guess": usual} if usual else {"guess": usual, "typical": LESS * shear_pa}


def _branch_tables(
    own: Sequence[Mapping[str, Any]], count: int, others: set[str], region: str | None
) -> list[dict[str, Any]]:
    """Return `count` tables: the first of the file, then new ones."""
    tables = [dict(each) for each in own[:count]]
    used_names = {each["name"] for each in tables} | others
    names = (f"prony_{k}" for k in range(1, count + len(used_names) + 1))
    region_key = {} if region is None else {"region": region}
    new = [{"name": name, **region_key} for name in names if name not in used_names]
    return [*tables, *new[: count - len(tables)]]


def _with_memory(
    parameters: Mapping[str, Any],
    old: Sequence[str],
    tables: Sequence[Mapping[str, Any]],
    times_s: tuple[float, float],
) -> dict[str, Any]:
    """Known branches are kept."""
    names = [each["name"] for each in tables]
    removed_names = {name for name in old if name not in names}
    unchanged = {
        n: v
        for n, v in parameters.items()
        if n.removesuffix(f".{without_region(n)}") not in removed_names
    }
    shortest, longest = times_s
    for k, name in enumerate(names, start=1):
        tau_s = shortest * (longest / shortest) ** (k / (len(names) + 1))
        unchanged.setdefault(f"{name}.share", {"guess": SHARE})
        unchanged.setdefault(f"{name}.tau_s", {"guess": float(f"{tau_s:.3g}")})
    return unchanged


def as_inline_toml(value: Any) -> str:
    """Return a value in TOML's inline syntax, on one line; mappings, lists, tuples, texts, booleans
    and numbers are supported. None and other types are not: their text is no TOML, without an
    error.
    """
    if isinstance(value, Mapping):
        return (
            "{"
            + ", ".join(f"{json.dumps(k)} = {as_inline_toml(v)}" for k, v in value.items())
            + "}"
        )
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(as_inline_toml, value)) + "]"
    if isinstance(value, (str, bool)):
        return json.dumps(value)
    return repr(value)
