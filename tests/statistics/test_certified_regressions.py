"""Values, standard errors and likelihoods of regressions certified by NIST.

Data and certified values are those of the Statistical Reference Datasets (NIST, public domain). All
27 regressions are solved by scripts/studies/study_regressions.py.
"""

from __future__ import annotations

import numpy as np
import pytest
from regressions import Regression
from study_regressions import by_collocation_sysid, digits, near_singular, profile_error

MISRA_X = [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1]
MISRA_X += [689.1, 760.0]
MISRA_Y = [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40]
MISRA_Y += [75.47, 81.78]


def regression(name, formula, x, y, starts, values, errors, squares) -> Regression:
    starts, values, errors = map(np.array, (starts, values, errors))
    x, y = np.array(x)[:, None], np.array(y)
    return Regression(name, "", formula, x, y, starts, values, errors, squares)


MISRA_1A = regression(
    "Misra1a",
    "b1*(1-exp(-b2*x))",
    MISRA_X,
    MISRA_Y,
    [[500.0, 0.0001], [250.0, 0.0005]],
    [2.3894212918e02, 5.5015643181e-04],
    [2.7070075241e00, 7.2668688436e-06],
    1.2455138894e-01,
)
BOX_BOD = regression(
    "BoxBOD",
    "b1*(1-exp(-b2*x))",
    [1.0, 2.0, 3.0, 5.0, 7.0, 10.0],
    [109.0, 149.0, 149.0, 191.0, 213.0, 224.0],
    [[1.0, 1.0], [100.0, 0.75]],
    [2.1380940889e02, 5.4723748542e-01],
    [1.2354515176e01, 1.0455993237e-01],
    1.1680088766e03,
)
MISRA_1D = regression(
    "Misra1d",
    "b1*b2*x*((1+b2*x)**(-1))",
    MISRA_X,
    MISRA_Y,
    [[500.0, 0.0001], [450.0, 0.0003]],
    [4.3736970754e02, 3.0227324449e-04],
    [3.6489174345e00, 2.9334354479e-06],
    5.6419295283e-02,
)
OSBORNE_Y = [844, 908, 932, 936, 925, 908, 881, 850, 818, 784, 751, 718, 685, 658, 628, 603, 580]
OSBORNE_Y += [558, 538, 522, 506, 490, 478, 467, 457, 448, 438, 431, 424, 420, 414, 411, 406]
MGH_17 = regression(
    "MGH17",
    "b1 + b2*exp(-x*b4) + b3*exp(-x*b5)",
    np.arange(0.0, 330.0, 10.0),
    np.divide(OSBORNE_Y, 1000),
    [[50.0, 150.0, -100.0, 1.0, 2.0], [0.5, 1.5, -1.0, 0.01, 0.02]],
    [3.7541005211e-01, 1.9358469127e00, -1.4646871366e00, 1.2867534640e-02, 2.2122699662e-02],
    [2.0723153551e-03, 2.2031669222e-01, 2.2175707739e-01, 4.4861358114e-04, 8.9471996575e-04],
    5.4648946975e-05,
)
MGH_09 = regression(
    "MGH09",
    "b1*(x**2+x*b2) / (x**2+x*b3+b4)",
    [4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625],
    [0.1957, 0.1947, 0.1735, 0.16, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246],
    [[25.0, 39.0, 41.5, 39.0], [0.25, 0.39, 0.415, 0.39]],
    [1.9280693458e-01, 1.9128232873e-01, 1.2305650693e-01, 1.3606233068e-01],
    [1.1435312227e-02, 1.9633220911e-01, 8.0842031232e-02, 9.0025542308e-02],
    3.0750560385e-04,
)


ROSZMAN = regression(
    "Roszman1",
    "b1 - b2*x - arctan(b3/(x-b4))/pi",
    [
        -4868.68,
        -4868.09,
        -4867.41,
        -3375.19,
        -3373.14,
        -3372.03,
        -2473.74,
        -2472.35,
        -2469.45,
        -1894.65,
        -1893.4,
        -1497.24,
        -1495.85,
        -1493.41,
        -1208.68,
        -1206.18,
        -1206.04,
        -997.92,
        -996.61,
        -996.31,
        -834.94,
        -834.66,
        -710.03,
        -530.16,
        -464.17,
    ],
    [
        0.252429,
        0.252141,
        0.251809,
        0.297989,
        0.296257,
        0.295319,
        0.339603,
        0.337731,
        0.33382,
        0.38951,
        0.386998,
        0.438864,
        0.434887,
        0.427893,
        0.471568,
        0.461699,
        0.461144,
        0.513532,
        0.506641,
        0.505062,
        0.535648,
        0.533726,
        0.568064,
        0.612886,
        0.624169,
    ],
    [[0.1, -0.00001, 1000.0, -100.0], [0.2, -0.000005, 1200.0, -150.0]],
    [2.0196866396e-01, -6.1953516256e-06, 1.2044556708e03, -1.8134269537e02],
    [1.9172666023e-02, 3.2058931691e-06, 7.4050983057e01, 4.9573513849e01],
    4.9484847331e-04,
)


@pytest.mark.parametrize(
    ("problem", "start"),
    [
        (MISRA_1A, 1),
        (MISRA_1D, 1),
        pytest.param(MGH_17, 1, marks=pytest.mark.long),
        (BOX_BOD, 0),
        (MGH_09, 1),
    ],
    ids=lambda value: getattr(value, "name", str(value)),
)
def test_values_and_standard_errors_have_seven_certified_digits(problem, start):
    assert np.sum(problem.residuals(problem.values) ** 2) == pytest.approx(problem.squares, 1e-9)
    values, errors = by_collocation_sysid(problem, problem.starts[start])
    assert digits(values, problem.values) > 7
    assert digits(errors, problem.errors) > 7


@pytest.mark.parametrize(
    "problem",
    [BOX_BOD, ROSZMAN, pytest.param(MGH_09, marks=pytest.mark.long)],
    ids=lambda problem: problem.name,
)
def test_ends_of_a_curved_likelihood_are_those_of_independent_refits(problem):
    assert profile_error(problem) < 0.02


def test_nearly_singular_standard_errors_are_exact_or_infinite():
    for _, _, own, normal in near_singular():
        if "determined" not in own:
            assert float(own) > 3
            assert float(own) >= float(normal)
    assert any("determined" in own for _, _, own, _ in near_singular())
