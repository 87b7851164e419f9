"""Benchmark of simulators: measured bodies, files for any simulator, and scores of predictions.

`bodies` lists the bodies and finds their constants in the catalogue, `folder`
writes files that can be read without this package, `prediction_files` reads the predictions of a
simulator, and `scores` compares them with the measurements. `signals` defines the compared
quantities, and `body_description` the text for readers.
"""

from .bodies import BODIES, BenchmarkBody
from .folder import write_benchmark
from .scores import Score, score_benchmark

__all__ = ["BODIES", "BenchmarkBody", "Score", "score_benchmark", "write_benchmark"]
