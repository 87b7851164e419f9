"""Interface of a streaming sweep: time marching along a recording that has no end yet.

Modules outside `program` that follow a recording frame by frame import from here alone
(`tests/project/test_architecture.py`):

- `StreamingModel` is the program of a recording that arrives frame by frame, and `StreamStencil`
  the rows that samples of an instrument need;
- `StreamingSweep` marches over `LoggedRow`s with their `Sample`s from a `SweepState`; it yields
  `StoredRow`s and `LinearisedResidual`s;
- `SquareRootInformation` accumulates the residuals;
- `lagrange_weights` interpolate samples, `one_blas_thread` limits threads while rows are solved,
  and samples later than `LARGEST_SAMPLE_DELAY` are not used.
"""

from .least_squares import SquareRootInformation
from .linear_algebra.lapack import one_blas_thread
from .measurement_residual import lagrange_weights
from .streaming_model import StreamingModel, StreamStencil
from .streaming_sweep import (
    LARGEST_SAMPLE_DELAY,
    LinearisedResidual,
    LoggedRow,
    Sample,
    StoredRow,
    StreamingSweep,
    SweepState,
)

__all__ = [
    "LARGEST_SAMPLE_DELAY",
    "LinearisedResidual",
    "LoggedRow",
    "Sample",
    "SquareRootInformation",
    "StoredRow",
    "StreamStencil",
    "StreamingModel",
    "StreamingSweep",
    "SweepState",
    "lagrange_weights",
    "one_blas_thread",
]
