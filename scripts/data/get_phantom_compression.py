"""Get the compressed cylinders of problems/phantom_compression, from a folder or by downloading.

They are public data (CC BY 4.0): repository abubakardawood/tissue-phantom-material-database on
GitHub, Dawood et al. 2026, "Hyperelastic Characterisation of Silicone Tissue Phantoms: A Parametric
Database with Model Selection and Inverse Design Framework". The files stay as the machine wrote
them.
"""

from __future__ import annotations

import sys
import urllib.request
from pathlib import Path

from script_arguments import make_parser

FOLDER = Path(__file__).parents[2] / "problems" / "phantom_compression"
COMMIT = "52b1271f0f8a966c168e5ddc0886190f12c6551f"
SOURCE = (
    f"https://raw.githubusercontent.com/abubakardawood/tissue-phantom-material-database/{COMMIT}"
    "/data"
)
MATERIALS = ("EF10_0T", "EF30_0T", "EF50_0T")
RUNS = tuple(f"A{k}" for k in range(1, 6))


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--from",
        dest="source",
        type=Path,
        help="folder that has the files; without it, they are downloaded",
    )
    source = parser.parse_args().source
    for material in MATERIALS:
        for run in RUNS:
            file = f"{material}_{run}.csv"
            if source is None:
                content = urllib.request.urlopen(f"{SOURCE}/{material}/{file}").read()
            elif (source / file).is_file():
                content = (source / file).read_bytes()
            else:
                sys.exit(f"{source} has no {file}")
            (FOLDER / file).write_bytes(content)
            print(FOLDER / file)


if __name__ == "__main__":
    main()
