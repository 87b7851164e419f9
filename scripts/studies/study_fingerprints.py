"""Material Fingerprinting on the data of `study_plate`: its errors beside those of a fit.

Flaschel, Martonová, Veil and Kuhl (2025) compare a measurement with 30,200 simulations of five laws,
each with 100 values of a constant (or 100 × 100 of two) relative to that of the volume: the answer
is the simulation with the largest sum of the inner products of the normalised reactions and
of the normalised displacements, scaled to the measured reactions. Their database is not published.
Here the plate is simulated again on their mesh (`plate_triangles`; equal to their data to rounding)
at 15 × 15 of the 100 × 100 constants, interpolated by splines in the logarithms of the constants,
and the best candidates are simulated exactly. The noise is that of `study_plate`.

    python scripts study_fingerprints [FOLDER]
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from plate_triangles import Plate, energy_error
from scipy.interpolate import CubicSpline
from studies import markdown
from study_plate import DRAWS, NOISES, TRUTHS, data_with_noise, plate_of

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array

GRID = 100
NODES = np.unique(np.round(np.geomspace(1, GRID, 20)).astype(int)) - 1
# Simulated exactly are the candidates whose likeness may be the largest: at most so many of a law,
# as far as splines deviate by at most this much.
CANDIDATES = 400
SPLINES = 1e-6
# Constants of each law beside that of the volume, and the last value of each.
LAWS = {
    "NeoHooke": {"c10_pa": 10.0},
    "Blatz": {"c01_pa": 10.0},
    "MooneyRivlin": {"c10_pa": 10.0, "c01_pa": 10.0},
    "Demiray": {"demiray_pa": 10.0, "demiray": 10.0},
    "Gent": {"gent_pa": 10.0, "gent": 1.0},
}


@dataclass
class Family:
    """Fingerprints of a law: reactions of norm one, and displacements of norm one."""

    name: str
    values: dict[str, Array]
    fingerprints: Array
    """At the grid of its constants (G or G × G), 22 reactions and 242 displacements."""

    def constants(self, place: tuple[int, ...]) -> dict[str, float]:
        """Return the constants at a place of the grid, for p₀ = 1."""
        each = zip(self.values, place, strict=True)
        return {"kappa_pa": 2.0} | {name: float(self.values[name][k]) for name, k in each}


def normalised(reactions: Array, displacements: Array) -> Array:
    """Return both with norm one, one after the other."""
    return np.concatenate([each / np.linalg.norm(each) for each in (reactions, displacements)])


def family_of(plate: Plate, name: str) -> Family:
    """Simulate a law at the nodes of its grid and interpolate between them."""
    values = {each: np.linspace(0.1, end, GRID) for each, end in LAWS[name].items()}
    family = Family(name, values, np.empty(0))
    shape = (len(NODES),) * len(values)
    found = np.full((*shape, 264), np.nan)
    guess = None
    for place in product(range(len(NODES)), repeat=len(values)):
        try:
            at = tuple(int(NODES[k]) for k in place)
            reactions, displacements, guess = plate.equilibria(family.constants(at), guess)
        except RuntimeError:
            guess = None
            continue
        found[place] = normalised(reactions, displacements)
    missing = np.isnan(found[..., 0]).sum()
    print(f"{name}: {missing} of {found[..., 0].size} simulations failed", file=sys.stderr)
    for axis, points in enumerate(values.values()):
        # Simulations that fail are at the end of an axis: lines with gaps stay without a spline.
        spline = CubicSpline(np.log(points[NODES]), np.nan_to_num(found, nan=0.0), axis=axis)
        found = spline(np.log(points))
    family.fingerprints = found
    return family


def match(plate: Plate, families: list[Family], data: dict[str, Array]) -> dict[str, float]:
    """Return the law and the constants of the simulation that is most like the data."""
    measured = normalised(data["f_reaction"], data["f_u"])
    candidates = []
    for family in families:
        likeness = family.fingerprints @ measured
        for flat in np.argsort(-likeness.ravel())[:CANDIDATES]:
            place = tuple(int(k) for k in np.unravel_index(flat, likeness.shape))
            candidates.append((likeness.ravel()[flat], family, place))
    candidates.sort(key=lambda each: -each[0])
    best: tuple[float, dict[str, float]] = (-np.inf, {})
    for expected, family, place in candidates:
        if best[0] > expected + SPLINES:
            break
        constants = family.constants(place)
        with suppress(RuntimeError):
            reactions, displacements = simulated(plate, tuple(constants.items()))
            likeness = float(normalised(reactions, displacements) @ measured)
            if likeness > best[0]:
                scale = np.linalg.norm(data["f_reaction"]) / np.linalg.norm(reactions)
                scaled = {n: v * scale if n.endswith("_pa") else v for n, v in constants.items()}
                best = likeness, scaled
    else:
        raise RuntimeError(f"more than {CANDIDATES} candidates of a law are as likely")
    return best[1]


@cache
def simulated(plate: Plate, constants: tuple[tuple[str, float], ...]) -> tuple[Array, Array]:
    """Return reactions and displacements of the arc."""
    return plate.equilibria(dict(constants))[:2]


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    folder = parser.parse_args().folder or cs.datasets.fetch("plate_fingerprint")
    plate = plate_of(folder)
    begun_s = time.process_time()
    families = [family_of(plate, name) for name in LAWS]
    print(f"simulations: {time.process_time() - begun_s:.0f} CPU s", file=sys.stderr)
    rows = []
    for law, noise in product(TRUTHS, NOISES):
        errors, laws = [], []
        for draw in range(DRAWS if noise else 1):
            found = match(plate, families, data_with_noise(folder, law, noise, draw))
            errors.append(energy_error(found, TRUTHS[law]))
            laws.append(" + ".join(name for name in found if name != "kappa_pa"))
            print(law, noise, found, errors[-1], file=sys.stderr)
        counts = {each: laws.count(each) for each in laws}
        chosen = ", ".join(f"{each} ({count})" for each, count in counts.items())
        error = f"{100 * np.median(errors):.2g} % ({100 * max(errors):.2g} %)"
        rows.append([f"{law}, {100 * noise:g} %", error, chosen])
    print(markdown(["law, noise", "median (largest) error of the energy", "constants"], rows))


if __name__ == "__main__":
    main()
