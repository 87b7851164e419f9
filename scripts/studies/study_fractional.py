"""Branches of memory that measured complex moduli need, beside fractional elements.

Five temperatures of the raw frequency sweeps of pyvisco (BSD-3) are fitted by SciPy with free shift
factors, and the hottest one alone: E* = E (1 + Σ g x/(1 + x)), x = (iωτ)^α, with α = 1 for branches
(Prony) and a free α for fractional elements. Errors are relative to |E*|; BIC is n log(mean square)
+ k log n of n numbers and k parameters.

FILE is sample_data_freq_user_raw.csv of pyvisco.

    python scripts study_fractional FILE
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from studies import markdown

from collocation_sysid.common.array_types import Array

# Numbers of the sweeps, coldest first; shifts are relative to the middle one.
SWEEPS = (16, 17, 18, 19, 20)
# Change of log₁₀ of the relaxation times per kelvin at the start of the search.
SLOPE_1_K = -0.09


def fit(
    table: Array, sweeps: tuple[int, ...], count: int, *, fractional: bool
) -> tuple[int, float]:
    """Return the number of parameters, and the root mean square of the relative errors."""
    frequency_hz, storage, loss, celsius, number = table[np.isin(table[:, 4], sweeps)].T
    places = np.searchsorted(sweeps, number)
    middle = len(sweeps) // 2
    others = np.delete(np.arange(len(sweeps)), middle)
    modulus, omega = storage + 1j * loss, 2 * np.pi * frequency_hz

    def residuals(p: Array) -> Any:
        shifts = np.zeros(len(sweeps))
        shifts[others], (logarithm, *rest) = p[: len(others)], p[len(others) :]
        shares, times, powers = np.reshape(np.r_[rest, np.zeros(3 * count - len(rest))], (3, count))
        alpha = 1 / (1 + np.exp(-powers)) if fractional else 1.0
        x = (1j * (omega * 10 ** shifts[places])[:, None] * np.exp(times)) ** alpha
        error = np.exp(logarithm) * (1 + (np.exp(shares) * x / (1 + x)).sum(1)) - modulus
        return np.r_[error.real, error.imag] / np.r_[abs(modulus), abs(modulus)]

    means = np.array([celsius[places == k].mean() for k in range(len(sweeps))])
    times = np.linspace(np.log(1e-5), np.log(3), count + 2)[1:-1]
    start = [SLOPE_1_K * (means - means[middle])[others], [np.log(storage.min())]]
    start += [np.full(count, np.log(30 / count)), times, np.full(count * fractional, -0.3)]
    with np.errstate(all="ignore"):
        found = least_squares(residuals, np.concatenate(start), x_scale="jac", max_nfev=4000)
    return len(found.x), float(np.sqrt(np.mean(found.fun**2)))


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    file = parser.parse_args().file
    table = np.genfromtxt(file, delimiter=",", skip_header=2, encoding="utf-8-sig")
    rows = []
    for fractional, counts in ((False, range(1, 10)), (True, (1, 2))):
        for count in counts:
            row = [f"{count} {'fractional' if fractional else 'branches'}"]
            for sweeps in (SWEEPS, SWEEPS[-1:]):
                parameters, error = fit(table, sweeps, count, fractional=fractional)
                numbers = 2 * int(np.isin(table[:, 4], sweeps).sum())
                bic = numbers * np.log(error**2) + parameters * np.log(numbers)
                row += [str(parameters), f"{100 * error:.2g} %", f"{bic:.0f}"]
            rows.append(row)
    heads = ["model", *(["parameters", "error", "BIC"] * 2)]
    print(markdown(heads, rows))


if __name__ == "__main__":
    main()
