"""Fits of laws in powers of the stretches to material tests, without guesses.

Ogden's law with one to three terms is fitted to the tests of rubber by Treloar (1944) and by Kawabata
et al. (1981), and the hyperfoam law with one and two terms to simulated tests of a foam of two terms:
compression to 40 %, tension to 30 % with lateral stretches, and simple shear to 0.15, each with its
own noise of 100 Pa and, of the lateral stretches, of 0.005. The table has the processor time and the
iterations of each search, whether it converged, how many terms the tests determine, and the error
of the fit: the root mean square of the residuals, in standard deviations of the measurements, with
those of the zeros of the strains and of the areas, which are estimated. A second table has the
verdict and the combined intervals of the foams.

With `--curves FOLDER`, published curves in that folder are fitted too, if it has them: all three
tests of Treloar, each test alone, silicone by Meunier et al. (2008), and white matter of the brain
by Budday et al. (2017) in tension, compression, and shear at axial stretches from 0.75 to 1.25.
The files are named and have the columns as in the repository
Chongran-Zhao/Calibration-Hyperelasticity, decoded to tables.

    python scripts study_power_laws
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from studies import markdown

import collocation_sysid as cs

UNDAMPED = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
FOAM = {
    "mu_1_pa": 20e3,
    "alpha_1": 8.0,
    "beta_1": 0.1,
    "mu_2_pa": 5e3,
    "alpha_2": -2.0,
    "beta_2": 0.1,
}
FOAM_TESTS = (
    ("uniaxial", np.linspace(0.0, -0.4, 20)),
    ("uniaxial", np.linspace(0.0, 0.3, 20)),
    ("simple-shear", np.linspace(0.0, 0.15, 10)),
)
STRESS_NOISE_PA = 100.0
STRETCH_NOISE = 5e-3
KINDS = {"UT": "uniaxial", "ET": "equibiaxial", "PS": "planar", "SS": "simple-shear"}
# Published curves: name, files, unit of their stresses and standard deviation [Pa], and laws.
RUBBERS = ("ogden-1", "ogden-2", "ogden-3")
BRAIN_STRETCHES = ("0d75", "0d80", "0d85", "0d90", "0d95", "1d05", "1d10", "1d15", "1d20", "1d25")
BRAIN = ("Budday_2017_UT_T_{}", "Budday_2017_UT_C_{}", "Budday_2017_SS_{}")
BRAIN_FILES = tuple(each.format("corona_radiata") for each in BRAIN)
SHEARED_FILES = tuple(f"Budday_2017_CSS_corona_radiata_lambda_{each}" for each in BRAIN_STRETCHES)
CURVES = (
    *(
        (f"Treloar, {KINDS[kind]}", (f"Treloar_1944_{kind}",), 1e6, 2e4, RUBBERS)
        for kind in ("PS", "ET")
    ),
    (
        "Treloar, three tests",
        ("Treloar_1944_UT", "Treloar_1944_PS", "Treloar_1944_ET"),
        1e6,
        1e4,
        RUBBERS,
    ),
    (
        "Meunier, three tests",
        ("Meunier_2008_UT", "Meunier_2008_PS", "Meunier_2008_ET"),
        1e6,
        1e4,
        RUBBERS,
    ),
    ("brain, pull, press, shear", BRAIN_FILES, 1e3, 20.0, ("ogden-1", "ogden-2")),
    ("brain, shear at ten pre-stretches", SHEARED_FILES, 1e3, 20.0, ("ogden-1", "ogden-2")),
    ("brain, all", (*BRAIN_FILES, *SHEARED_FILES), 1e3, 20.0, ("ogden-1", "ogden-2")),
)
HEADS = ("tests", "law", "converged", "iterations", "CPU s", "terms", "error of the fit, σ")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--foams", type=int, default=5, help="simulated foams")
    parser.add_argument("--curves", type=Path, help="folder with published curves")
    options = parser.parse_args()
    if options.curves is not None:
        published = [
            row(
                name,
                law,
                [curve(options.curves / f"{file}.csv", law, unit, sigma) for file in files],
            )
            for name, files, unit, sigma, laws in CURVES
            if all((options.curves / f"{file}.csv").is_file() for file in files)
            for law in laws
        ]
        print(markdown(HEADS, published), flush=True)
    treloar = cs.datasets.treloar_1944
    rows = [
        row("Treloar, uniaxial", law, treloar(law)) for law in ("ogden-1", "ogden-2", "ogden-3")
    ]
    three = ("uniaxial", "equibiaxial", "planar")
    for law in ("ogden-2", "ogden-3"):
        tests = cs.datasets.kawabata_1981(law, tests=three)
        rows.append(row("Kawabata, three tests", law, tests))
    for seed in range(options.foams):
        for law in ("hyperfoam-1", "hyperfoam-2"):
            rows.append(row(f"foam, noise {seed}", law, foam_tests(law, seed)))
    print(markdown(HEADS, rows), flush=True)
    foams = [foam_intervals(seed) for seed in range(options.foams)]
    print(markdown(("foam", "CPU s", "verdict", *FOAM), foams))


def foam_intervals(seed: int) -> tuple[str, ...]:
    """Return the combined intervals of the constants of a simulated foam as a row of the table."""
    began = time.process_time()
    answer = cs.run(cs.Problem(foam_tests("hyperfoam-2", seed), unknowns("hyperfoam-2")))
    intervals = [answer.interval(name) for name in FOAM]
    return (
        f"noise {seed}",
        f"{time.process_time() - began:.1f}",
        answer.trust.verdict,
        *("none" if each is None else f"{each[0]:.4g} … {each[1]:.4g}" for each in intervals),
    )


def curve(file: Path, law: str, unit: float, sigma_pa: float) -> cs.Experiment:
    """Return the test in a file, to be fitted by a law."""
    columns = np.genfromtxt(file, delimiter=",", skip_header=1, unpack=True)
    kind = file.stem.split("_")[2]
    if kind == "CSS":
        specimen = cs.Specimen(
            "simple-shear",
            columns[1],
            unit * columns[3],
            sigma_pa,
            axial_stretch=float(columns[0][0]),
        )
    else:
        strain = columns[0] - (kind != "SS")
        specimen = cs.Specimen(KINDS[kind], strain, unit * columns[1], sigma_pa)
    return specimen.experiment(law, file.stem)


def foam_tests(law: str, seed: int) -> list[cs.Experiment]:
    """Return the simulated tests of the foam, to be fitted by a law."""
    rng = np.random.default_rng(seed)
    experiments = []
    for number, (test, strain) in enumerate(FOAM_TESTS):
        lateral = np.ones_like(strain) if number == 1 else None
        blank = cs.Specimen(
            test, strain, 0 * strain, STRESS_NOISE_PA, strain_zero=0.0, area_error=0.0
        )
        if lateral is not None:
            blank = replace(blank, lateral_stretch=lateral)
        values = cs.simulate(blank.experiment("hyperfoam-2"), FOAM | UNDAMPED).custom_sensor_values
        noise_pa = STRESS_NOISE_PA * rng.standard_normal(len(strain))
        specimen = replace(blank, stress_pa=values[0].ravel() + noise_pa)
        if lateral is not None:
            noise = STRETCH_NOISE * rng.standard_normal(len(strain))
            specimen = replace(specimen, lateral_stretch=values[1].ravel() + noise)
        experiments.append(specimen.experiment(law, f"test {number}"))
    return experiments


def row(tests: str, law: str, experiments: Sequence[cs.Experiment]) -> tuple[str, ...]:
    """Return the fit of a law as a row of the table."""
    began = time.process_time()
    solution = cs.solve(cs.Problem(experiments, unknowns(law)))
    cpu_s = time.process_time() - began
    return (
        tests,
        law,
        "yes" if solution.status.converged else solution.status.value,
        str(solution.iterations),
        f"{cpu_s:.1f}",
        terms(law, solution.notes),
        f"{np.sqrt(solution.collocation.objective(solution.z)):.2f}",
    )


def unknowns(law: str) -> Mapping[str, cs.Unknown | float]:
    """Return the constants of a law, all unknown but the bulk modulus of rubber."""
    is_foam = law.startswith("hyperfoam")
    kinds = ("mu_{}_pa", "alpha_{}", "beta_{}")[: 3 if is_foam else 2]
    names = [kind.format(p) for p in range(1, 1 + int(law[-1])) for kind in kinds]
    fixed = UNDAMPED if is_foam else {**UNDAMPED, "kappa_pa": 1e9}
    return dict.fromkeys(names, cs.Unknown()) | fixed


def terms(law: str, notes: Sequence[str]) -> str:
    """Return how many terms the tests determine, which a note says if not all."""
    for note in notes:
        if found := re.search(r"determine (\d+ of \d+) terms", note):
            return found[1]
    return f"{law[-1]} of {law[-1]}"


if __name__ == "__main__":
    main()
