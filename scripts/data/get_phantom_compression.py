"""Get the compressed cylinders of problems/phantom_compression, from a folder or by downloading.

They are public data (CC BY 4.0): repository abubakardawood/tissue-phantom-material-database on
GitHub, Dawood et al. 2026, "Hyperelastic Characterisation of Silicone Tissue Phantoms: A Parametric
Database with Model Selection and Inverse Design Framework". The files stay as the machine wrote
them.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from script_arguments import fetched_files

FOLDER = Path(__file__).parents[2] / "problems" / "phantom_compression"
COMMIT = "52b1271f0f8a966c168e5ddc0886190f12c6551f"
SOURCE = (
    f"https://raw.githubusercontent.com/abubakardawood/tissue-phantom-material-database/{COMMIT}"
    "/data"
)
FILES = {
    f"{material}_A{k}.csv": f"{SOURCE}/{material}/{material}_A{k}.csv"
    for material in ("EF10_0T", "EF30_0T", "EF50_0T")
    for k in range(1, 6)
}


def main() -> None:
    for file in fetched_files(__doc__, FILES):
        print(shutil.copyfile(file, FOLDER / file.name))


if __name__ == "__main__":
    main()
