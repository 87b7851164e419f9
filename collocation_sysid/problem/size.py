"""Memory and time that a problem will take, estimated from its sizes before the work begins."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from ..common.display import duration
from ..common.files import require_size
from ..common.limits import machine_memory_mb
from ..errors import InputError

Say = Callable[[str], None]

# Text of recordings that is read in a second, on one core [MB].
TEXT_MB_PER_S = 2.0
TEXT_SUFFIXES = frozenset({".csv", ".tsv", ".txt", ".trc"})
# What takes longer is announced.
ANNOUNCED_READING_S = 5.0
# Estimated time of a solve above which it is announced [s].
ANNOUNCED_SOLVE_S = 60.0
# Number of nodes above which equilibria of a body are announced, whatever their number.
ANNOUNCED_NODES = 20_000
# Timestep of a sweep on one thread, and numbers in the factor of its matrix, as measured in
# docs/howto/large.md at this number of nodes, and the powers by which they grow.
NODES = 4953
# Time of a step of the sweep at `NODES` nodes [s].
STEP_S = 0.57
# Power of the number of nodes by which this time grows.
STEP_POWER = 1.5
# Numbers in the factor of the matrix at `NODES` nodes.
FACTOR_ENTRIES = 4.8e6
# Power of the number of nodes by which they grow.
FACTOR_POWER = 1.4
# Rows shorter than this take as long: Python calls [s].
LEAST_STEP_S = 2e-3
# Sweeps of a typical solve by reduced space.
SWEEPS = 10
# Number of markers of unknown position above which they, not the body, determine the memory.
MANY_MARKERS = 100
# Counts beyond this are not told apart.
MOST_SAMPLES = 10**15
# Positions that a simulation keeps, and, at each of two points of a search, those and the
# multipliers, with copies for the answer and its gradients; beside them the sensitivities.
SIMULATION_COPIES = 3
# The same at the two points of a search.
SEARCH_COPIES = 10
# Copies of the sensitivities.
SENSITIVITY_COPIES = 2
# Copies of the derivatives of the residuals: the array itself and its product with the weights.
DERIVATIVE_COPIES = 2
# Memory of the body's arrays and patterns [bytes].
BYTES_PER_ELEMENT = 8000


@dataclass(frozen=True)
class Size:
    """Sizes that decide what an experiment takes.

    Attributes
    ----------
    nodes, elements : int
        Nodes (mid nodes of quadratic elements too) and elements of the body.
    samples : int
        Samples of the experiment.
    substeps : int
        Timesteps per sample.
    unknowns : int
        Parameters that are estimated; none for a simulation.
    markers : int
        Markers of the recording; zero before it is read.
    unplaced_markers : int
        Markers of unknown position on the body; three coordinates of each are estimated.
    """

    nodes: int
    elements: int
    samples: int
    substeps: int = 1
    unknowns: int = 0
    markers: int = 0
    unplaced_markers: int = 0

    def memory_mb(self) -> float:
        """Return a lower bound of the memory that the problem needs [MB, 10⁶ bytes]: positions,
        sensitivities and derivatives of residuals if something is estimated, the factor of a
        matrix, and the body.
        """
        copies = SIMULATION_COPIES
        if self.unknowns:
            copies = SEARCH_COPIES + SENSITIVITY_COPIES * self.unknowns
        values = copies * 3 * self.nodes * (self.samples * self.substeps)
        if self.unknowns:
            # Derivatives of all residuals of markers by all parameters are one array.
            parameters = self.unknowns + 3 * self.unplaced_markers
            values += DERIVATIVE_COPIES * 3 * self.markers * self.samples * parameters
        values += FACTOR_ENTRIES * (self.nodes / NODES) ** FACTOR_POWER
        return (8 * values + BYTES_PER_ELEMENT * self.elements) / 1e6

    def time_s(self) -> float:
        """Return the estimated time [s] of a solve in the reduced space, or of a simulation if
        nothing is estimated, on one thread.
        """
        step_s = max(LEAST_STEP_S, STEP_S * (self.nodes / NODES) ** STEP_POWER)
        return (SWEEPS if self.unknowns else 1) * (self.samples * self.substeps) * step_s


def require_feasible(size: Size, say: Say | None = None) -> None:
    """Raise an error if this machine's memory cannot hold the problem, and announce long work.

    If the memory of the machine is unknown, no error is raised.

    Parameters
    ----------
    say : callable, optional
        Called with a sentence if the estimated time is beyond `ANNOUNCED_SOLVE_S`, or if a single
        sample has more than `ANNOUNCED_NODES` nodes; None announces nothing.

    Raises
    ------
    InputError
        With the sizes, both amounts of memory, and the remedy.
    """
    steps = f"{size.samples:,} sample" + "s" * (size.samples > 1)
    if size.substeps > 1:
        steps += f" of {size.substeps:,} substeps"
    what = f"{steps} of a body of {size.nodes:,} nodes"
    remedy = (
        "a coarser mesh (edge_length_m), a shorter window_s, a lower resample_hz, a larger every, "
        "or fewer substeps"
    )
    if size.unplaced_markers > MANY_MARKERS:
        what += f" with {size.unplaced_markers:,} markers of unknown position"
        remedy = f"fewer markers (markers.names), their positions (reference_m), {remedy}"
    there_mb = machine_memory_mb()
    if there_mb is not None and size.memory_mb() > there_mb:
        raise InputError(
            f"{what} take about {size.memory_mb() / 1e3:.3g} GB of memory, and this machine has "
            f"{there_mb / 1e3:.3g} GB; expected {remedy}"
        )
    is_large = size.samples == 1 and size.nodes > ANNOUNCED_NODES
    if say is not None and (is_large or size.time_s() > ANNOUNCED_SOLVE_S):
        act = "a solve" if size.unknowns else "a simulation"
        say(f"{what}: {act} may take more than a minute; check estimates its time")


def announce_reading(files: Iterable[Path], say: Say) -> None:
    """Call `say` once with an estimate of how long it takes to read text files, if it exceeds
    `ANNOUNCED_READING_S`; other kinds of files and missing files do not count.

    Raises
    ------
    InputError
        If one of them is too large to be read, see `require_size`.
    """
    files = [each for each in files if each.suffix.lower() in TEXT_SUFFIXES and each.is_file()]
    for file in files:
        require_size(file)
    sizes_mb = {file: file.stat().st_size / 1e6 for file in files}
    time_s = sum(sizes_mb.values()) / TEXT_MB_PER_S
    if time_s > ANNOUNCED_READING_S:
        largest = max(sizes_mb, key=lambda file: sizes_mb[file])
        say(
            f"reading {sum(sizes_mb.values()):.0f} MB of recordings, most of them in "
            f"{largest.name}, takes about {duration(time_s)}"
        )
