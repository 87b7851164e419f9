"""Certified nonlinear regressions of NIST: correct digits of values and standard errors.

The 27 regressions of the Statistical Reference Datasets (NIST, public domain) are solved from both
official starts by this package (as identifications, see `regressions`) and by SciPy's `curve_fit`
(finite differences) and `least_squares` (exact derivatives), each with its default tolerances.
A digit is −log₁₀ |x − c|/|c| with the certified value c, at most 11, the smallest of all parameters.

With --profiles, the profile likelihood of regressions with up to 60 observations: that of the
parameter with the largest relative standard error is compared with refits by SciPy, whose tolerances
are 1e-14: the largest error of an end over its distance from the estimate.

FOLDER has the files of NIST, such as `MGH09.dat`, from https://www.itl.nist.gov/div898/strd/.

    python scripts study_regressions FOLDER
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from fractions import Fraction
from itertools import product
from operator import mul
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from regressions import Regression, as_problem, read_regression
from scipy.linalg import hilbert
from scipy.optimize import curve_fit, least_squares, root_scalar
from script_arguments import make_parser
from studies import markdown

from collocation_sysid.common.array_types import Array
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.program.least_squares import SquareRootInformation
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.profile_likelihood import THRESHOLD, profile_of_solution
from collocation_sysid.statistics.uncertainty import ErrorModel, uncertainty_from_fit

LEVELS = ("Lower", "Average", "Higher")
# Correct digits above which a value counts as found.
FOUND = 4.0
MOST_DIGITS = 11.0
# Observations up to which the profile likelihood is computed.
MOST_OBSERVATIONS = 60
# The noise is unknown: σ is this share of the range of y, and scaled by the residuals.
NOISE_SHARE = 0.01
ESTIMATED = ErrorModel(noise="estimated", errors="independent")
Fit = Callable[[Regression, Array], tuple[Array, Array]]


def digits(values: Array, certified: Array) -> float:
    """Return the smallest number of correct digits; 0 if a value is not finite or wrong."""
    with np.errstate(all="ignore"):
        each = -np.log10(np.abs(values - certified) / np.abs(certified))
    least = float(np.min(np.where(np.isfinite(values), each, 0.0)))
    return float(np.clip(least, 0.0, MOST_DIGITS))


def slopes(regression: Regression) -> Any:
    """Return a function of b (P,), the exact Jacobian (S, P) of the residuals."""
    b = ca.SX.sym("b", len(regression.values))
    rows = ca.vertcat(*(regression.predict(x, ca.vertsplit(b), ca) for x in regression.x))
    function = ca.Function("slopes", [b], [ca.jacobian(rows, b)])
    return lambda at: function(at).full()


def solved(regression: Regression, start: Array) -> Any:
    """Solve the identification and return its solution, linearised fit and uncertainty."""
    problem = as_problem(regression, start, NOISE_SHARE * float(np.ptp(regression.y)))
    solution = ReducedSpace(tolerance=1e-12)(problem.collocation())
    fit = linearise_fit(solution.collocation, solution.z)
    parameters = solution.collocation.parameters
    return solution, fit, uncertainty_from_fit(fit, parameters, solution.q, ESTIMATED)


def by_collocation_sysid(regression: Regression, start: Array) -> tuple[Array, Array]:
    """Values and standard errors (P,) of this package."""
    solution, _, uncertainty = solved(regression, start)
    values = np.array([solution.parameters[name] for name in regression.names])
    return values, np.sqrt(np.diag(uncertainty.covariance)) * np.abs(values)


def by_curve_fit(regression: Regression, start: Array) -> tuple[Array, Array]:
    """Values and standard errors (P,) of `scipy.optimize.curve_fit`."""
    values, covariance = curve_fit(
        lambda x, *b: regression.predict(x, b), regression.x.T, regression.y, start, maxfev=100_000
    )
    return values, np.sqrt(np.diag(covariance))


def standard_errors(regression: Regression, values: Array, information: Array) -> Array:
    """Standard errors (P,) from JᵀJ (P, P) and the residuals."""
    freedom = len(regression.y) - len(values)
    variance = np.sum(regression.residuals(values) ** 2) / freedom
    return np.sqrt(np.diag(np.linalg.inv(information)) * variance)


def by_least_squares(regression: Regression, start: Array) -> tuple[Array, Array]:
    """Values and standard errors (P,) of `scipy.optimize.least_squares`."""
    found = least_squares(
        regression.residuals, start, jac=slopes(regression), x_scale="jac", max_nfev=100_000
    )
    return found.x, standard_errors(regression, found.x, found.jac.T @ found.jac)


def profile_error(regression: Regression) -> float:
    """Return the largest relative error of the ends of a profile-likelihood interval."""
    k = int(np.argmax(regression.errors / np.abs(regression.values)))
    solution, fit, uncertainty = solved(regression, regression.starts[1])
    profile = profile_of_solution(solution, fit, uncertainty, regression.names[k])
    best = regression.values
    jacobian = slopes(regression)
    others = np.arange(len(best)) != k
    limit = regression.squares * (1 + THRESHOLD / (len(regression.y) - len(best)))

    def rise(value: float) -> float:
        full = best.copy()
        full[k] = value

        def place(rest: Array) -> Array:
            full[others] = rest
            return full

        reduced: Any = lambda rest: jacobian(place(rest))[:, others]  # noqa: E731
        found = least_squares(
            lambda rest: regression.residuals(place(rest)),
            full[others],
            jac=reduced,
            x_scale="jac",
            ftol=1e-14,
            xtol=1e-14,
            gtol=1e-14,
            max_nfev=10_000,
        )
        return 2 * found.cost - limit

    worst = 0.0
    for side, end in zip((-1, 1), profile.interval, strict=True):
        reach = side * regression.errors[k]
        while rise(best[k] + reach) < 0:
            reach *= 1.5
        exact = root_scalar(rise, bracket=(best[k], best[k] + reach), rtol=1e-9).root
        worst = max(worst, np.inf if end is None else abs((end - exact) / (exact - best[k])))
    return worst


def near_singular() -> list[list[str]]:
    """Return rows of the standard errors with segments of Hilbert's matrix as J, beside exact ones."""
    rows = []
    for size in range(3, 13):
        jacobian = hilbert(2 * size)[:, :size]
        exact = [[Fraction(value) for value in row] for row in jacobian.tolist()]
        columns = list(zip(*exact, strict=True))
        information = [[sum(map(mul, a, b), Fraction(0)) for b in columns] for a in columns]
        truth = np.array([float(value) ** 0.5 for value in diagonal_of_inverse(information)])
        problem = SquareRootInformation.empty(size).with_rows(np.zeros(2 * size), jacobian)
        own = problem.standard_errors
        named = f"{np.isinf(own).sum()} not determined" if np.isinf(own).any() else ""
        with np.errstate(all="ignore"):
            normal = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
        rows.append(
            [
                str(size),
                f"{np.linalg.cond(jacobian / np.linalg.norm(jacobian, axis=0)):.1e}",
                named or f"{digits(own, truth):.1f}",
                f"{digits(normal, truth):.1f}",
            ]
        )
    return rows


def diagonal_of_inverse(matrix: list[list[Fraction]]) -> list[Fraction]:
    """Return the diagonal of the inverse of a square matrix of fractions, exactly."""
    size = len(matrix)
    rows = [row + [Fraction(i == k) for k in range(size)] for i, row in enumerate(matrix)]
    for i in range(size):
        pivot = next(k for k in range(i, size) if rows[k][i])
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [value / rows[i][i] for value in rows[i]]
        for k in range(size):
            if k != i and rows[k][i]:
                factor = rows[k][i]
                rows[k] = [a - factor * b for a, b in zip(rows[k], rows[i], strict=True)]
    return [rows[k][size + k] for k in range(size)]


def main() -> None:
    """Run the study and print its tables."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--profiles", action="store_true", help="profile likelihoods alone")
    arguments = parser.parse_args()
    fits: dict[str, Fit] = {
        "this package": by_collocation_sysid,
        "curve_fit": by_curve_fit,
        "least_squares": by_least_squares,
    }
    regressions = [read_regression(each) for each in sorted(arguments.folder.glob("*.dat"))]
    regressions.sort(key=lambda r: LEVELS.index(r.difficulty))
    if arguments.profiles:
        few = [each for each in regressions if len(each.y) <= MOST_OBSERVATIONS]
        errors = [[each.name, f"{100 * profile_error(each):.2g} %"] for each in few]
        print(markdown(["regression", "error of the profile"], errors))
        return
    rows = []
    counts = {name: [0, 0] for name in fits}
    for regression, k in product(regressions, range(2)):
        row = [f"{regression.name}, {regression.difficulty.lower()}", str(k + 1)]
        for name, fit in fits.items():
            try:
                with warnings.catch_warnings(), np.errstate(all="ignore"):
                    warnings.simplefilter("ignore")
                    values, errors = fit(regression, regression.starts[k])
                correct = digits(values, regression.values), digits(errors, regression.errors)
            except Exception as error:  # of any of the packages: the search has failed
                print(regression.name, k + 1, name, repr(error), file=sys.stderr)
                correct = 0.0, 0.0
            is_found = correct[0] >= FOUND
            counts[name][0] += is_found
            counts[name][1] += is_found and correct[1] >= FOUND
            row.append(" / ".join(f"{each:.1f}" for each in correct) if is_found else "–")
        rows.append(row)
    for k, text in enumerate((f"values to {FOUND:g} digits", "and standard errors")):
        shares = [f"{each[k]} of {2 * len(regressions)}" for each in counts.values()]
        rows.append([text, "", *shares])
    print(markdown(["regression", "start", *fits], rows))
    heads = ["parameters", "condition of the scaled J", "this package", "inverse of JᵀJ"]
    print(markdown(heads, near_singular()))


if __name__ == "__main__":
    main()
