"""Contents of the corpus: recordings with known truth, in the proportions in which people come.

Half of them are faultless, and half have a hidden mistake with the causes that are right. Modules of
twins are imported when a recording is made, so that one that cannot be made does not stop the others.
Recordings of other programs and measured data are in the folder `shared` beside the clone, or in that
of the environment variable `CORPUS_SHARED`; without it the rest runs.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import collocation_sysid as cs

ROOT = Path(__file__).parents[2]
SHARED = Path(os.environ.get("CORPUS_SHARED", ROOT.parent / "shared"))
# Seed of the random choices of a mistake, such as which markers are exchanged.
FAULT_SEED = 3


@dataclass(frozen=True)
class Recording:
    """A problem with what is true of it."""

    name: str
    make: Callable[[], cs.Problem]
    truth: Mapping[str, float]  # constants; those of the problem that are estimated are compared
    mistake: str = ""
    # Regular expressions of the code or the subject of a first reason that is right; empty if no
    # reason can name the mistake.
    causes: tuple[str, ...] = ()
    quick: bool = False
    # Recordings of one name are repeats: in place of a truth each has the median of the others.
    repeats: str = ""


def recordings() -> list[Recording]:
    """Return all recordings that are available here."""
    parts = [
        other_solids,
        *(bars, effects, markers, wrenches, videos, depths, hidden),
        *(other_cables, cables, other_specimens, repeats, contact, shipped),
    ]
    return [each for part in parts for each in part()]


def twins(module: str) -> Any:
    """Return a module of this folder, imported now."""
    return importlib.import_module(module)


# Solid bodies in a gripper ------------------------------------------------------------------------

SOLID_CAUSES = {
    "butter": ("filter",),
    "clampmass": (),
    "drop": ("clock", "time", "frames", "dropped"),
    "flange": ("frame", "pose", "in the grasp"),
    "gravframe": ("gravity", "frame"),
    "jaw": ("in the grasp", "gripper", "grip turn"),
    "mk3": ("marker",),
    "rate3": ("clock rate", "clock_rate", "time scale"),
    "shrink": ("size", "scale"),
    "slide": ("marker",),
    "stretchlag": ("pose", "clock", "late", "delay"),
    "swap": ("marker",),
    "taper": ("section", "surface", "taper", "mesh-section"),
    "temp": ("drift",),
    "tie": ("mass",),
}
QUICK_SOLIDS = "707", "711", "714", "clampmass", "gravframe", "shrink"


def other_solids() -> Iterator[Recording]:
    """Yield bodies of 27-node hexahedra of another program."""
    folder = SHARED / "corpus"
    for file in sorted(folder.glob("solids/*.npz")):
        name = file.stem
        mistake = name.removeprefix("mistake_")
        with np.load(file) as data:
            truth = dict(zip(CONSTANTS, data["truth"].tolist(), strict=True))
            cause = str(data["cause"])
        is_quick = any(each in name for each in QUICK_SOLIDS)
        causes = SOLID_CAUSES.get(mistake, ())
        make = partial(_loaded, folder, file)
        yield Recording(f"solid/markers/other {name}", make, truth, cause, causes, is_quick)


CONSTANTS: tuple[str, ...] = ("young_pa", "poisson", "gamma_r_s", "gamma_m_1_s")


def _loaded(folder: Path, file: Path) -> cs.Problem:
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module("load").load(file)[0]
    finally:
        sys.path.remove(str(folder))


def bars() -> Iterator[Recording]:
    """Yield tapered bars of the project's own other program."""
    module = twins("bar_twins")
    for seed in module.SEEDS:
        true = {name: module.draw(seed).truth[name] for name in CONSTANTS}
        yield Recording(
            f"solid/markers/hexahedral bar {seed}",
            partial(module.problem, seed),
            true,
            quick=seed < 2,
        )


def effects() -> Iterator[Recording]:
    """Yield a bar in which every effect of the budget is drawn."""

    def make() -> cs.Problem:
        return twins("effect_twins").problem(0, (1, 1, 4))

    true = {name: twins("bar_twins").draw(0, exact=True).truth[name] for name in CONSTANTS}
    yield Recording("solid/markers/all effects", make, true)


def _wrong(correct: Callable[[], cs.Problem], table: str, name: str) -> cs.Problem:
    module, _, faults = table.partition(".")
    fault = getattr(twins(module), faults)[name]
    return fault(correct(), np.random.default_rng(FAULT_SEED))


def exact(make: Callable[..., cs.Problem], *arguments: Any, **options: Any) -> cs.Problem:
    """Return the problem of a twin that was simulated with the mesh and the time steps of its
    description, which says so.
    """
    stated = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
    return replace(make(*arguments, **options), uncertainty=stated)


def _with_faults(
    kind: str,
    correct: Callable[[], cs.Problem],
    truth: Mapping[str, float],
    table: str,
    chosen: Mapping[str, tuple[str, ...]],
    quick: tuple[str, ...] = (),
) -> Iterator[Recording]:
    for name, causes in chosen.items():
        make = partial(_wrong, correct, table, name)
        is_quick = name in quick
        yield Recording(f"{kind}/{name}", make, truth, name, causes, is_quick)


def markers() -> Iterator[Recording]:
    """Yield small blocks and bars that are moved at random, and descriptions of them."""
    module = twins("twins")
    for body in module.BODIES:
        for seed in (1, 2):
            make = partial(exact, module.twin, body, module.SOFT, seed, samples=40)
            yield Recording(f"solid/markers/{body} {seed}", make, module.SOFT, quick=seed == 1)
    correct = partial(exact, module.twin, "bar", module.SOFT, 1, samples=40)
    chosen = {
        "poses in mm": ("length-unit",),
        "mesh in mm": ("length-unit",),
        "wxyz as xyzw": ("quaternion-order",),
        "poses inverted": ("poses-inverted",),
        "clock 30 ms late": ("clock", "time shift", "delay"),
        "gripper's frame": ("frame",),
        "cameras' frame": ("camera-frame", "frame"),
        "markers exchanged": ("marker",),
        "gravity": ("gravity",),
        "grasp one layer deeper": ("grasp",),
        "pose jumps": ("pose", "jump"),
        "marker slips": ("marker",),
    }
    quick = ("wxyz as xyzw", "gravity", "marker slips", "grasp one layer deeper")
    yield from _with_faults(
        "solid/markers", correct, module.SOFT, "wrong_twins.FAULTS", chosen, quick
    )
    axes = {"markers: y and z exchanged": ("axes", "frame")}
    table = "wrong_twins.TRACK_FAULTS"
    yield from _with_faults("solid/markers", correct, module.SOFT, table, axes)


def wrenches() -> Iterator[Recording]:
    """Yield the same bodies on a force sensor."""
    module = twins("twins")
    for body in module.BODIES:
        make = partial(exact, module.sensing_twin, body, module.SOFT, 1, 40)
        yield Recording(f"solid/wrench/{body}", make, module.SOFT, quick=body == "bar")
    correct = partial(exact, module.sensing_twin, "bar", module.SOFT, 1, 40)
    chosen = {
        "wrench: sign": ("sign",),
        "wrench: y and z exchanged": ("axes",),
        "wrench: torques in N mm": ("unit",),
        "wrench: gain 20 % too large": ("gain", "wrench", "sensor"),
        "wrench: 0.1 s late": ("late", "clock", "delay", "time"),
        "wrench: tared with the body": ("tare", "zero"),
    }
    quick = ("wrench: sign", "wrench: tared with the body")
    table = "wrong_twins.WRENCH_FAULTS"
    yield from _with_faults("solid/wrench", correct, module.SOFT, table, chosen, quick)


def videos() -> Iterator[Recording]:
    """Yield a bar that one or two cameras film."""
    module = twins("filmed_twins")
    truth = module.TRUTH
    for seed in (1, 2, 3):
        make = partial(exact, module.filmed_twin, seed)
        yield Recording(f"solid/one camera/{seed}", make, truth, quick=seed == 1)
    for seed in (1, 2):
        make = partial(exact, module.filmed_twin, seed, cameras=("front", "top"))
        yield Recording(f"solid/two cameras/{seed}", make, truth, quick=seed == 1)
    make = partial(exact, module.filmed_twin, 1, are_places_known=False)
    yield Recording("solid/one camera/unknown places", make, truth)
    chosen = {
        "video: (row, column) as (u, v)": ("image-tracks", "camera"),
        "video: 0.1 s late": ("clock", "late", "image-tracks/motion", "delay"),
        "video: one track on the wall": ("track",),
        "video: world with y up": ("image-tracks", "frame", "axes"),
        "video: rolling shutter of 22 ms": ("rolling", "line delay"),
        "video: focal length 0.9 times (stabilised)": ("focal", "camera"),
    }
    quick = ("video: one track on the wall",)
    correct = partial(exact, module.filmed_twin, 1)
    yield from _with_faults(
        "solid/one camera", correct, truth, "wrong_videos.VIDEO_FAULTS", chosen, quick
    )
    pairs = {"video: second camera 0.1 s late": ("clock", "late", "image-tracks", "delay")}
    correct = partial(exact, module.filmed_twin, 1, cameras=("front", "top"))
    yield from _with_faults("solid/two cameras", correct, truth, "wrong_videos.PAIR_FAULTS", pairs)


def depths() -> Iterator[Recording]:
    """Yield a bar that a depth camera observes, at rest and in motion."""
    module = twins("depth_twins")
    truth = module.TRUTH
    for seed in (1, 2):
        make = partial(exact, module.hanging_twin, seed)
        yield Recording(f"solid/depth/hanging {seed}", make, truth, quick=seed == 1)
        yield Recording(
            f"solid/depth/swinging {seed}", partial(exact, module.swinging_twin, seed), truth
        )
    chosen = {
        "depth: millimetres as metres": ("camera", "unit"),
        "depth: principal point mirrored": ("camera",),
        "depth: pose of an OpenGL frame": ("camera",),
        "depth: background not removed": ("background", "points", "wild"),
        "depth: camera turned by 15 deg": ("camera", "turn"),
    }
    correct = partial(exact, module.hanging_twin, 1)
    quick = ("depth: principal point mirrored",)
    yield from _with_faults(
        "solid/depth", correct, truth, "wrong_cameras.DEPTH_FAULTS", chosen, quick
    )


HIDDEN_CAUSES = {
    "markers": ("mass",),
    "memory": ("memory", "damping"),
    "mesh": ("size", "mesh", "section", "mass"),
    "gradient": ("gradient",),
    "mirrored": ("mesh-mirrored",),
    "hanging": ("rest-shape",),
    "filtered": ("filter",),
    "twice": ("markers-same",),
    "law": ("law",),
}


def hidden() -> Iterator[Recording]:
    """Yield a foam block and a bent bar with errors that residuals show badly."""
    module = twins("hidden_twins")
    for name in ("none", "bar"):
        make = partial(module.twin, name, 0)
        yield Recording(f"solid/markers/foam {name}", make, module.TRUTH, quick=name == "none")
    for name, causes in HIDDEN_CAUSES.items():
        mistake = module.ERRORS[name][0]
        make = partial(module.twin, name, 0)
        is_quick = name in ("markers", "memory")
        label = f"solid/markers/foam {name}"
        yield Recording(label, make, module.TRUTH, mistake, causes, is_quick)


# Cables -------------------------------------------------------------------------------------------

CABLE_MISTAKES = {
    "f_dir": ("direction of the clamp 5° off", ("turn in the grasp", "clamp")),
    "f_s": ("arc lengths of the markers 15 mm off", ("place", "length")),
    "f_mass": ("mass per length 15 % too large", ("mass",)),
    "f_tip": ("weight of 20 g at the end forgotten", ("mass",)),
    "f_len": ("length 2 % wrong", ("length", "size")),
    "f_payload": ("payload of the sensor not zeroed", ("tool", "payload")),
    "f_table": ("the cable touches a table", ("table", "contact", "touch")),
}


def other_cables() -> Iterator[Recording]:
    """Yield cables of a program of discrete elastic rods."""
    for file in sorted((SHARED / "corpus" / "cables").glob("*/problem.toml")):
        name = file.parent.name
        truth = json.loads((file.parent / "truth.json").read_text())["truth"]
        mistake, causes = CABLE_MISTAKES.get(name, ("", ()))
        is_quick = name in ("c2", "c4", "c6", "c8", "f_s", "f_tip")
        make = partial(cs.Problem.read, file)
        yield Recording(f"cable/other {name}", make, truth, mistake, causes, is_quick)


def cables() -> Iterator[Recording]:
    """Yield the example of a cable, and twins of it."""
    from collocation_sysid.problem.new import TEMPLATES

    module = twins("cable_twins")
    make = partial(cs.Problem.read, TEMPLATES / "cable" / "problem.toml")
    yield Recording("cable/example", make, module.TRUTH)
    for seed in (0, 1):
        yield Recording(f"cable/twin {seed}", partial(_cable, seed), module.TRUTH, quick=seed == 0)


def _cable(seed: int) -> cs.Problem:
    folder = scratch() / f"cable_{seed}"
    twins("cable_twins").write_twin(folder, seed)
    return cs.Problem.read(folder / "problem.toml")


# Specimens ----------------------------------------------------------------------------------------

SPECIMEN_LAWS = {
    "ogden": ("ogden-2", 0.4999),
    "yeoh": ("yeoh", 0.4999),
    "foam": ("hyperfoam-1", None),
    "prony": ("neo-hookean", 0.49),
}
SPECIMEN_MISTAKES = {
    "ogden_slack": (
        "strip loose over the first 3 % of strain",
        ("strain zero", "strain_zero", "slack", "initial slope"),
    ),
    "yeoh_machine": ("compliance of the machine 8 µm/N", ("machine", "compliance")),
    "yeoh_dogbone": ("30 mm stated, 24 mm take part", ("length",)),
    "yeoh_area": ("area of one of two tests 3 % too small", ("area",)),
    "prony_drift": ("load cell drifts by 5 %", ("drift",)),
    "prony_late": ("load 0.2 s late", ("late", "delay", "clock")),
    "prony_one": ("two branches fitted by one", ("branch",)),
}


def other_specimens() -> Iterator[Recording]:
    """Yield material tests in closed form."""
    folder = SHARED / "corpus" / "specimens"
    if not (folder / "truth.json").is_file():
        return
    truths = json.loads((folder / "truth.json").read_text())
    for file in sorted(folder.glob("*_*.json")):
        name = file.stem
        law, poisson = SPECIMEN_LAWS.get(name.partition("_")[0], ("", None))
        if not law:
            continue
        known = truths[f"{name.partition('_')[0]}_*"]
        truth = {key: value for key, value in known.items() if isinstance(value, float)}
        if name == "prony_one":
            truth = {"young_pa": truth["young_pa"]}  # no single branch is a truth
        mistake, causes = SPECIMEN_MISTAKES.get(name, ("", ()))
        make = partial(_specimens, file, law, poisson, tuple(truth))
        is_quick = name in ("yeoh_ok", "foam_ok", "yeoh_dogbone", "yeoh_area", "prony_drift")
        yield Recording(f"specimen/other {name}", make, truth, mistake, causes, is_quick)


def _specimens(file: Path, law: str, poisson: float | None, names: tuple[str, ...]) -> cs.Problem:
    count = {"prony_one": 1}.get(file.stem, 2) if law == "neo-hookean" else 0
    branches = [("fast", 1.0), ("slow", 10.0)][:count]
    top = "".join(f'[[object.prony]]\nname = "{name}"\n' for name, _ in branches)
    text = f'[object]\nmaterial = "{law}"\n{top}[parameters]\n'
    stated = {each for each in names if "." not in each}
    text += "".join(f"{name} = {{}}\n" for name in sorted(stated))
    for name, tau_s in branches:
        text += f'"{name}.share" = {{ guess = 0.2 }}\n"{name}.tau_s" = {{ guess = {tau_s} }}\n'
    text += "" if poisson is None else f"poisson = {poisson}\n"
    folder = scratch() / file.stem
    folder.mkdir(exist_ok=True)
    columns = {"t_s": "t_s", "strain": "strain_1", "stress_pa": "stress_pa"}
    columns |= {"lateral_stretch": "lateral_stretch_1"}
    for test in json.loads(file.read_text()):
        rows = {head: test[key] for key, head in columns.items() if isinstance(test.get(key), list)}
        table = np.column_stack([*rows.values()])
        path = folder / f"{test['name']}.csv"
        np.savetxt(path, table, "%.9g", ",", header=",".join(rows), comments="")
        text += f'[[experiment]]\nname = "{test["name"]}"\nkind = "specimen"\n'
        text += f'test = "{test["test"]}"\nfile = "{path.name}"\n'
        stated_of = ("sigma_pa", "lateral_sigma", "length_m", "area_m2")
        text += "".join(f"{key} = {test[key]}\n" for key in stated_of if key in test)
    (folder / "problem.toml").write_text(text)
    return cs.Problem.read(folder / "problem.toml")


PHANTOMS = ("EF10_50T", "EF30_0T", "EF50_0T")
# Range of the strain in which the law is fitted.
STRAINS = (0.01, 0.05)


def repeats() -> Iterator[Recording]:
    """Yield measured data whose repeats must agree: compressed silicones, photographs of wires, a
    tentacle under each of two tendons."""
    folder = SHARED / "data" / "silicone_phantoms"
    for material in PHANTOMS if folder.is_dir() else ():
        for which in "AB":
            files = sorted(folder.glob(f"{material}_{which}*.csv"))
            make = partial(_phantoms, files)
            name = f"specimen/measured {material} {which}"
            is_quick = material == "EF30_0T"
            yield Recording(name, make, {"young_pa": np.nan}, quick=is_quick, repeats=material)
    folder = SHARED / "data" / "wire_loops"
    for wire in ("black", "white") if folder.is_dir() else ():
        for number in range(3):
            make = partial(_wire, folder / f"{wire}_{number}.csv", wire)
            name, truth = f"cable/measured {wire} {number}", {"bending_n_m2": np.nan}
            yield Recording(name, make, truth, repeats=wire)
    if (SHARED / "data" / "soft_tentacle").is_dir():
        for tendon in ("m1", "m2"):
            name = f"bench/measured tentacle {tendon}"
            make = partial(_tentacle, tendon)
            yield Recording(name, make, {"young_pa": np.nan}, repeats="tentacle")


def _phantoms(files: list[Path]) -> cs.Problem:
    text = """[object]
material = "neo-hookean"
[parameters]
young_pa = {}
poisson = 0.499
[experiment_defaults]
kind = "specimen"
test = "uniaxial"
columns = { strain = "Engineering Strain [-]", stress = "Engineering Stress (kPa)" }
"""
    for file in files:
        rows = np.genfromtxt(file, delimiter=",", skip_header=8)
        inside = (-rows[:, 3] >= STRAINS[0]) & (-rows[:, 3] <= STRAINS[1])
        t_s, stress_pa = rows[inside, 0], -1e3 * rows[inside, 4]
        text += f'[[experiment]]\nname = "{file.stem[-2:]}"\nfile = "{file}"\n'
        text += f'specimen = "{file.stem[-2]}"\nsigma_pa = {0.003 * stress_pa.max()}\n'
        text += f"window_s = [{t_s[0]}, {t_s[-1]}]\n"
    path = scratch() / f"{files[0].stem}.toml"
    path.write_text(text)
    return cs.Problem.read(path)


def _wire(file: Path, name: str) -> cs.Problem:
    module = twins("study_wires")
    wire = next(each for each in module.WIRES if each.name == name)
    loop_m = module.read_loop(file)
    return module.loops_problem([loop_m], wire.mass_per_length_kg_m, wire.bending_n_m2)


@cache
def _all_tendons() -> cs.Problem:
    module = twins("get_soft_tentacle")
    folder = scratch() / "soft_tentacle"
    shutil.copytree(ROOT / "problems" / "soft_tentacle", folder)
    for name, groups in module.GROUPS.items():
        row = module.markers_m(SHARED / "data" / "soft_tentacle" / f"{name}.csv", groups).ravel()
        heads = ["t_s", *(f"M{k}_{axis}" for k in range(1, 5) for axis in "xyz")]
        np.savetxt(
            folder / f"{name}_markers.csv", [[0.0, *row]], "%.6f", ",",
            header=",".join(heads), comments="",
        )  # fmt: skip
    return cs.Problem.read(folder / "problem.toml")


def _tentacle(tendon: str) -> cs.Problem:
    problem = _all_tendons()
    chosen = [each for each in problem.experiments if each.name.startswith(tendon)]
    return replace(problem, experiments=chosen)


# Benches and contact ------------------------------------------------------------------------------


def contact() -> Iterator[Recording]:
    """Yield blocks that touch an obstacle, and the benches of the templates."""
    from collocation_sysid.problem.new import TEMPLATES

    true_pa = {"young_pa": twins("make_templates").YOUNG_PA}
    for kind in ("compression", "tension", "specimen"):
        make = partial(cs.Problem.read, TEMPLATES / kind / "problem.toml")
        folder = "specimen" if kind == "specimen" else "bench"
        truth = (
            {"mu_pa": twins("make_templates").SHEAR_MODULUS_PA} if folder == "specimen" else true_pa
        )
        yield Recording(f"{folder}/example {kind}", make, truth, quick=kind != "compression")
    module = twins("contact_twins")
    for seed in (1, 2):
        make = partial(exact, module.poked_twin, seed)
        yield Recording(f"contact/poked {seed}", make, module.TRUTH, quick=seed == 1)
        yield Recording(
            f"contact/dragged {seed}", partial(exact, module.sheared_twin, seed), module.TRUTH
        )
    chosen = {
        "obstacle: load reversed": ("sign", "obstacle-pull"),
        "obstacle: load in gram-force": ("unit",),
        "obstacle: load zeroed in contact": ("obstacle-pull", "zero", "tare"),
        "obstacle: displacement in mm": ("unit",),
        "obstacle: diameter for radius": ("radius",),
        "obstacle: stroke begins 0.5 mm late": ("obstacle", "stroke", "displacement", "zero"),
    }
    correct = partial(exact, module.poked_twin, 1)
    quick = ("obstacle: load reversed", "obstacle: diameter for radius")
    table = "wrong_obstacles.POKING_FAULTS"
    yield from _with_faults("contact", correct, module.TRUTH, table, chosen, quick)
    dragged = {"obstacle: friction 0 in place of 0.5": ("friction",)}
    correct, table = partial(exact, module.sheared_twin, 1), "wrong_obstacles.PLATE_FAULTS"
    yield from _with_faults("contact", correct, module.TRUTH, table, dragged)


# Shipped problems ---------------------------------------------------------------------------------


def shipped() -> Iterator[Recording]:
    """Yield shipped problems whose truth is known, and the other templates."""
    from collocation_sysid.problem.new import TEMPLATES

    templates = twins("make_templates"), twins("rendered_video")
    for name, file, truth in (
        ("solid/markers", "foam_cylinder/recording.toml", twins("make_foam_cylinder").TRUTH),
        ("solid/markers", "noisy_cylinder/problem.toml", twins("make_noisy_cylinder").TRUTH),
        ("solid/wrench", "wrist_sensor/problem.toml", twins("make_wrist_sensor").TRUTH),
        ("contact", "laid_block/problem.toml", twins("make_laid_block").TRUTH),
        ("contact", "poked_block/problem.toml", twins("make_poked_block").TRUTH),
    ):
        make = partial(cs.Problem.read, ROOT / "problems" / file)
        is_quick = "foam" in file or "wrist" in file
        yield Recording(f"{name}/{Path(file).parent}", make, truth, quick=is_quick)
    make = partial(cs.Problem.read, TEMPLATES / "swing" / "problem.toml")
    yield Recording("solid/markers/example swing", make, templates[0].SWUNG)
    make = partial(cs.Problem.read, TEMPLATES / "video" / "problem.toml")
    yield Recording("solid/one camera/example video", make, templates[1].TRUTH)


@cache
def scratch() -> Path:
    """Return a folder for files of problems, which the end of the process removes."""
    _SCRATCH.append(tempfile.TemporaryDirectory())
    return Path(_SCRATCH[-1].name)


_SCRATCH: list[tempfile.TemporaryDirectory] = []
