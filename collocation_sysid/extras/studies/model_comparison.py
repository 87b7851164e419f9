"""Comparison of models in Python, without files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

from ...common.display import Table, plain_text
from ...common.validated_classes import validated
from ...errors import InputError
from ...problem import Problem
from ...recording.measurement_selection import measured_count
from .model_choice import advice, fit_record, model_notes, model_rows
from .planning import PlannedRun, fitted_recordings, require_predictable
from .plots import model_figure
from .rows import Row
from .tables import model_tables

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes a while to import


@dataclass(frozen=True, eq=False)
class ModelComparison:
    """Comparison of models by their predictions of held-out data; `print` shows it.

    Attributes
    ----------
    rows : tuple of dict
        One row for each model, with "model", "chosen", "held_out_rms", "delta_aic", "parameters"
        and other numbers.
    """

    rows: tuple[Row, ...] = field(repr=False)

    @property
    def chosen(self) -> str | None:
        """Name of the model to use; None if no model could be fitted."""
        return next((row["model"] for row in self.rows if row["chosen"]), None)

    @cached_property
    def advice(self) -> str:
        """The model to use, why, and how certain that is, in words."""
        return advice(self.rows)

    @cached_property
    def tables(self) -> list[Table]:
        """Tables of fit and prediction, and of the parameters."""
        return model_tables(self.rows)

    def __str__(self) -> str:
        return plain_text([self.advice, "", *self.tables, *model_notes(self.rows)])

    def plot(self) -> Figure:
        """Draw the prediction errors and the estimates with their combined intervals.

        Raises
        ------
        InputError
            If no model has a prediction or an interval.
        """
        figure = model_figure(self.rows)
        if figure is None:
            raise InputError("no model could be fitted; expected at least one to draw")
        return figure


@validated
def compare_models(
    models: Mapping[str, Problem],
    method: str | None = None,
    log: Callable[[str], None] | None = None,
) -> ModelComparison:
    """Fit models of the same recordings, and choose the one that best predicts held-out data, as
    the command ``compare-models`` does.

    Each model is fitted to all recordings, then to all but one in turn, which it predicts; of a
    single recording the last third is held out.

    Parameters
    ----------
    models : mapping of str to Problem
        Problems by the name of their model. They have the same recordings and samples, and differ
        in material, damping law, memory or anything else.
    method : str, optional
        Name of the method that fits every model; that of each problem by default.
    log : callable, optional
        Called with a text before each fit.

    Raises
    ------
    InputError
        For less than two models, models of different recordings, or recordings without markers,
        forces and stresses, by which predictions could be compared.
    """
    if len(models) < 2:
        raise InputError(f"found {len(models)} models; expected two or more to compare")
    for problem in models.values():
        require_predictable(problem)
    first, *others = (
        {e.name: measured_count(e) for e in problem.experiments if not e.validation}
        for problem in models.values()
    )
    for name, measured in zip([*models][1:], others, strict=True):
        if measured != first:
            raise InputError(
                f"the model {name!r} does not fit the same recordings and samples as "
                f"{next(iter(models))!r}; expected the same in all models"
            )
    planned, records = [], {}
    held_out = ("", *fitted_recordings(next(iter(models.values()))))
    for test_name in held_out:
        for name, problem in models.items():
            by = method or problem.method
            if not isinstance(by, str):
                raise InputError("found a method that is an object; expected the name of a method")
            run = PlannedRun(problem=name, method=by, model_name=name, test_name=test_name)
            if log is not None:
                log(f"fit {len(planned) + 1} of {len(held_out) * len(models)}: {run.label}")
            planned.append(run)
            records[run.label] = {"model": fit_record(problem, by, test_name)}
    return ModelComparison(tuple(model_rows(planned, records)))
