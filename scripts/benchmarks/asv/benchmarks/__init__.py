"""The benchmarks of `scripts/`, followed over commits by asv (airspeed velocity).

pip install asv
cd scripts/benchmarks/asv && asv machine --yes && asv continuous HEAD~1 HEAD
"""

import sys
from pathlib import Path

sys.path[:0] = [str(folder) for folder in Path(__file__).parents[3].iterdir()]
