"""Copies of published material tests as tables, written in the layout of their HDF5 file."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

CURVES = Path("shared/data/hyperelastic_curves")
FOLDER = next((p / CURVES for p in Path(__file__).parents if (p / CURVES).is_dir()), None)


def write_curves(file: Path) -> None:
    """Write the tables of Budday and Meunier as deformation gradients and engineering stresses."""
    assert FOLDER is not None
    file.parent.mkdir(parents=True)
    with h5py.File(file, "w") as content:
        for table in [*FOLDER.glob("Budday_*.csv"), *FOLDER.glob("Meunier_*.csv")]:
            author, year, test = table.stem.split("_", 2)
            rows = np.genfromtxt(table, delimiter=",", skip_header=1)
            gradients = np.tile(np.eye(3), (len(rows), 1, 1))
            stresses = np.zeros_like(gradients)
            is_shear = "SS" in test.partition("_")[0]
            component = (0, 1) if is_shear else (0, 0)
            if "CSS" in test:
                gradients[:, 0, 0] = rows[:, 0]
            gradients[:, *component] = rows[:, 1 if "CSS" in test else 0]
            stresses[:, *component] = rows[:, 3 if "CSS" in test else 1]
            content[f"{author}_{year}/{test}/F"] = gradients
            content[f"{author}_{year}/{test}/stress"] = stresses
