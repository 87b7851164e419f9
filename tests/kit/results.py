"""A complete `Result` without a solve, for tests of output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from collocation_sysid.common.files import SCHEMA
from collocation_sysid.methods.solution import Timing
from collocation_sysid.runs.result_content import (
    DynamicsResult,
    Elapsed,
    FitResult,
    ForwardResult,
    ProgramSize,
    Provenance,
    Result,
    UncertaintyResult,
)
from collocation_sysid.statistics.assessment import Assessment
from collocation_sysid.statistics.budget.combined_intervals import ReportedEstimate

FIT = FitResult(1e-3, 1e-3, {})
ROLLOUT = ForwardResult(0.8e-3, 2e-3, {})


def value(number: float = 100.0, std_error: float | None = 1.0) -> ReportedEstimate:
    interval = None if std_error is None else (number - 2 * std_error, number + 2 * std_error)
    return ReportedEstimate(
        number,
        std_error,
        interval,
        combined_std_error=std_error,
        combined95=interval,
        guess=number,
        fixed=False,
    )


def uncertainty(names: Sequence[str], covariance: np.ndarray) -> UncertaintyResult:
    scale = np.sqrt(np.diag(covariance))
    quantiles = np.full(len(names), 1.96)
    correlation = covariance / np.outer(scale, scale)
    return UncertaintyResult(
        noise="given",
        errors="independent",
        reduced_chi_squared=1.0,
        noise_factors={},
        autocorrelation=0.0,
        names=tuple(names),
        correlation=correlation,
        covariance=covariance,
        quantiles=quantiles,
        verdicts=(),
        recordings=None,
        profiles={},
    )


def a_result(parameters: Mapping[str, ReportedEstimate] | None = None, **changes: Any) -> Result:
    """A converged run of these parameters, with other entries as they are given."""
    whole = Result(
        schema=SCHEMA,
        status="converged",
        converged=True,
        message="Converged.",
        missing="",
        trust=Assessment(()),
        method="reduced-space",
        title="small",
        parameters={"lambda_pa": value()} if parameters is None else parameters,
        derived={},
        basis=(),
        budget={},
        effects=(),
        joint=None,
        scale=None,
        places={},
        nuisance={},
        fields={},
        uncertainty=None,
        scan=None,
        fit=FIT,
        residuals=(),
        dynamics=DynamicsResult(1e-9, 1e-8, ()),
        rollout=ROLLOUT,
        iterations=5,
        evaluations=5,
        timing_s=Timing(0.1, 0.2, 0.3, 0.6),
        elapsed_s=Elapsed(search=2.0, checks=8.5, pictures=4.25),
        problem=ProgramSize(8, 6, 1, 10, 240, 200, "midpoint"),
        notes=(),
        history=(),
        provenance=Provenance("0", "3", "2", "3", "here", None, None, ()),
    )
    return replace(whole, **changes)
