"""Repeated tests of two specimens of each of three silicones, fitted together and one by one.

FOLDER has the tables of the repository abubakardawood/tissue-phantom-material-database (CC BY 4.0,
see `get_phantom_compression`), such as `EF50_0T_A1.csv`: cylinders of 50 mm diameter and 30 mm
height, five tests of each of the specimens A and B.

    python scripts study_repeats FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from script_arguments import make_parser
from studies import markdown

from collocation_sysid import Run, run

MATERIALS = ("EF10_50T", "EF30_0T", "EF50_0T")
# Range of the strain in which the slope is measured and the law is fitted.
STRAINS = (0.01, 0.05)
HEAD = """
[object]
material = "neo-hookean"

[parameters]
young_pa = {}
poisson = 0.499

[uncertainty.assumptions]
specimen_sticking = "none"     # compared with slopes, which contain it too

[experiment_defaults]
kind = "specimen"
test = "uniaxial"
columns = { strain = "Engineering Strain [-]", stress = "Engineering Stress (kPa)" }
"""
TEST = """
[[experiment]]
name = "{name}"
file = "{file}"
specimen = "{specimen}"
sigma_pa = {sigma_pa}
window_s = [{first_s}, {last_s}]
"""


def curve(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times [s], strains and stresses [Pa] between `STRAINS`, positive in compression."""
    rows = np.genfromtxt(file, delimiter=",", skip_header=8)
    strain = -rows[:, 3]
    inside = (strain >= STRAINS[0]) & (strain <= STRAINS[1])
    return rows[inside, 0], strain[inside], -1e3 * rows[inside, 4]


def slope_pa(file: Path) -> float:
    """Return the slope [Pa] of the stress over the strain between `STRAINS`."""
    _, strain, stress_pa = curve(file)
    return float(np.polyfit(strain, stress_pa, 1)[0])


def fitted(files: list[Path], folder: Path) -> Run:
    """Return the fit of one law to tests; σ is 1 % of the largest stress."""
    text = HEAD
    for file in files:
        t_s, _, stress_pa = curve(file)
        name = file.stem.rpartition("_")[2]
        text += TEST.format(
            name=name,
            file=file,
            specimen=name[0],
            sigma_pa=0.01 * float(stress_pa.max()),
            first_s=t_s[0],
            last_s=t_s[-1],
        )
    problem = folder / "problem.toml"
    problem.write_text(text)
    return run(problem)


def interval_text(answer: Run) -> str:
    """Return Young's modulus with its combined interval in kPa, and the verdict."""
    low, high = (1e-3 * end for end in answer.interval("young_pa"))
    value = 1e-3 * answer.parameters["young_pa"]
    reasons = "; ".join(each.message for each in answer.trust.concerns)
    print(answer.trust.verdict, reasons, file=sys.stderr)
    return f"{value:.1f} ({low:.1f} … {high:.1f}), {answer.trust.verdict}"


def main() -> None:
    """Print a row for each silicone: all tests, those of each specimen, slopes."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    folder = parser.parse_args().folder.resolve()
    rows = []
    with TemporaryDirectory() as scratch:
        for material in MATERIALS:
            files = {k: sorted(folder.glob(f"{material}_{k}*.csv")) for k in ("A", "B")}
            both = [*files["A"], *files["B"]]
            slopes = [1e-3 * slope_pa(file) for file in both]
            tests = (both, files["A"], files["B"])
            answers = [interval_text(fitted(each, Path(scratch))) for each in tests]
            slope = f"{np.mean(slopes):.1f} ± {np.std(slopes, ddof=1):.1f}"
            rows.append([material, *answers, slope])
    print(markdown(["silicone", "E of A and B", "A alone", "B alone", "slope"], rows))


if __name__ == "__main__":
    main()
