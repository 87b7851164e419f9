"""The benchmarks of `scripts/`, followed over commits by asv (airspeed velocity).

pip install asv
cd scripts/asv && asv machine --yes && asv continuous HEAD~1 HEAD
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
