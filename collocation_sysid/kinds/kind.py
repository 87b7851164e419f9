"""What one kind of body, measurement or force contributes to each stage of an identification."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from ..common.array_types import Array
    from ..features.measurements import PredictionErrors
    from ..fem.meshes.mesh import TetMesh
    from ..judge.doubt import Doubt
    from ..judge.fit import Candidate, TestedFit
    from ..methods.solution import Solution
    from ..problem.measurement_section import MeasurementSection
    from ..program.experiment_iterate import ExperimentIterate
    from ..program.markers.association import MarkerAssociation
    from ..program.measurement_model import MeasurementModel
    from ..recording.deviation import Deviation
    from ..recording.experiment import Experiment
    from ..statistics.budget.effect import Effect, ExperimentAtAnswer
    from ..statistics.concerns import Concern, Topic
    from ..statistics.hypothesis import Hypothesis
    from .rod.stresses import GivenStresses

    Deviations = Mapping[str, float | None]
    RowEffect = Callable[[ExperimentAtAnswer, int], Effect | None]


class _Lazy:
    def __init__(self, module: str, name: str) -> None:
        self._module = module
        self._name = name

    def __set_name__(self, owner: type, name: str) -> None:
        self._package = owner.__module__

    def __get__(self, instance: object, owner: type) -> Any:
        return getattr(import_module(self._module, self._package), self._name)


def lazy(module: str, name: str) -> Any:
    """Return an attribute of a record that is imported where a stage asks for it, so that every
    stage can ask: a name of a module, relative to that of the record.
    """
    return _Lazy(module, name)


def _nothing(*_: object) -> tuple[()]:
    return ()


class Kind:
    """Contributions of one kind; those of this base class are empty, or those of a solid body."""

    name = "solid"

    # Bodies ---------------------------------------------------------------------------------------

    # Whether a body is a solid of tetrahedra. Another one has no surface, no moduli of its material,
    # and large stresses under small strains, which follow a law of strains of its own.
    is_solid = True
    # Force of the stresses of such a law, which are variables of a program.
    given_stresses: type[GivenStresses]
    buckles = ""  # message in place of that of a solid that loses its stability
    place_dimension = 3  # number of coordinates of a place
    # Coordinates of a place that an image shows, in words.
    places_in_images = ("on the surface, first", "on the surface, second")
    association: type[MarkerAssociation] = lazy(
        "...program.markers.association", "MarkerAssociation"
    )
    # Possible place (3,) nearest to a point (3,) and tangents (3, dimension) there, of a body that is
    # no solid, from its nodes (n, 3) and the point.
    nearest_place: Callable[[Array, Array], tuple[Array, Array]]
    # Mesh with elements of half the size.
    refined: Callable[[Any], TetMesh] = lazy("...fem.meshes.refinement", "split_in_eight")

    # Measurements and forces ----------------------------------------------------------------------

    # Name of the class with which users declare a measurement, an obstacle or a specimen.
    declares = ""
    model: type[MeasurementModel]  # residuals of a measurement
    table: type[MeasurementSection] | None = None  # class of its tables in [[experiment]]
    topics: Mapping[str, Topic] = {}  # topics of concerns that only this kind has
    messages: Mapping[str, str] = {}  # messages of its concerns of general topics, by code
    # Raises an `InputError` for data that cannot be fitted.
    require_valid: Callable[[Experiment], object] = _nothing
    # Concerns about the simulation at the guess, which may end before the recordings (False), about
    # the fit of all experiments, and about a forward simulation of an experiment.
    guess_concerns: Callable[[Sequence[ExperimentIterate], bool], Iterable[Concern]] = _nothing
    concerns: Callable[[Sequence[ExperimentIterate]], Iterable[Concern]] = _nothing
    simulation_concerns: Callable[[str, PredictionErrors], Iterable[Concern]] = _nothing
    notes: Callable[[ExperimentIterate], Iterable[str]] = _nothing  # on the fit of one experiment
    # Likely mistakes that the description shows without a fit, that an inconsistent fit shows, that
    # may be corrected and fitted again, and that a consistent fit does not exclude, with the standard
    # deviations of effects of the budget that are not the usual ones.
    described: Callable[[Experiment], Iterable[Hypothesis]] = _nothing
    fitted: Callable[[Solution], Iterable[Hypothesis]] = _nothing
    candidates: Callable[[TestedFit], Iterable[Candidate]] = _nothing
    consistent: Callable[[Solution, Deviations], Iterable[Hypothesis]] = _nothing

    # Budget and likely mistakes -------------------------------------------------------------------

    # Unit vectors (n, 3) into the grasp at the last held nodes of a body that is no solid, from its
    # mesh and the mask (n,) of held nodes; zero elsewhere.
    directions_beyond: Callable[[Any, NDArray[np.bool_]], Array]
    effects: tuple[Deviation, ...] = ()  # rows of the budget that only this kind has
    # Effects of rows of solids that are others for this kind, by the name of the row; None for those
    # that it does not have.
    other_effects: Mapping[str, RowEffect | None] = {}
    doubts: tuple[Doubt, ...] = ()  # likely mistakes in the description of such a body alone


SOLID = Kind()
