"""Make the film and the table of the README and of the first page from one run, and draw the video.

The run is that of problems/foam_cylinder/recording.toml, which both pages quote.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import draw_video
from script_arguments import require_no_arguments

import collocation_sysid as cs
from collocation_sysid.result.animation import animate

ROOT = Path(__file__).parents[2]


def main() -> None:
    """Write docs/swing.gif and docs/pictures/tracked_video.png, and print the table."""
    run = cs.run(cs.Problem.read(ROOT / "problems" / "foam_cylinder" / "recording.toml"))
    with TemporaryDirectory() as folder:
        animate(
            run.save(Path(folder) / "run", pictures=False),
            ROOT / "docs" / "swing.gif",
            fps=10,
            slowdown=4,
        )
    print(run)
    draw_video.main()


if __name__ == "__main__":
    require_no_arguments(__doc__)
    main()
