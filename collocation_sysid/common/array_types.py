"""Array types for annotations; shapes and units are stated in the docstrings."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
