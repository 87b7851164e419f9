"""Predictions of Kawabata's biaxial data by laws that are fitted to some of the tests.

Each law is fitted to uniaxial tension, or to uniaxial, equibiaxial and planar tension, with
stretches up to a limit, and predicts all other pairs of stretches up to the same limit. Errors are
root mean squares of engineering stresses.

    python scripts/study_kawabata.py
"""

from __future__ import annotations

import argparse

import numpy as np
from studies import markdown

import collocation_sysid as cs

KAPPA_PA = 1e9
UNDAMPED = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
# Constants of each law, and guesses of those that a scan of the stiffness does not give.
LAWS = {
    "neo-hookean": {"mu_pa": cs.Unknown(), "lambda_pa": KAPPA_PA},
    "mooney-rivlin": {"c10_pa": cs.Unknown(), "c01_pa": cs.Unknown(), "kappa_pa": KAPPA_PA},
    "yeoh": {
        "c10_pa": cs.Unknown(),
        "c20_pa": cs.Unknown(),
        "c30_pa": cs.Unknown(),
        "kappa_pa": KAPPA_PA,
    },
    "gent": {"mu_pa": cs.Unknown(), "gent_limit": cs.Unknown(guess=60.0), "kappa_pa": KAPPA_PA},
    "arruda-boyce": {
        "mu_pa": cs.Unknown(),
        "chain_stretch": cs.Unknown(guess=5.0),
        "kappa_pa": KAPPA_PA,
    },
}
LIMITS = (1.3, 2.5)
FITTED = (("uniaxial",), ("uniaxial", "equibiaxial", "planar"))
ALL_TESTS = ("uniaxial", "equibiaxial", "planar", "biaxial")


def main() -> None:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    rows = []
    for limit in LIMITS:
        for fitted in FITTED:
            rows += [row(law, limit, fitted) for law in LAWS]
    heads = ("stretch up to, fitted", "law", "E MPa", "fit kPa")
    print(markdown((*heads, *(f"{test} kPa" for test in ALL_TESTS)), rows))


def row(law: str, limit: float, fitted: tuple[str, ...]) -> tuple[str, ...]:
    """Modulus, error of the fit, and error of the prediction of each test that is not fitted."""
    tests = cs.datasets.kawabata_1981(law, tests=ALL_TESTS, largest_stretch=limit)
    known = [each for each in tests if each.name in fitted]
    run = cs.run(cs.Problem(known, {**LAWS[law], **UNDAMPED}))
    errors = {each.name: rms_pa(each, run.solution.parameters) for each in tests}
    fit = np.concatenate([residuals_pa(each, run.solution.parameters) for each in known])
    young_pa = run.estimates["young_pa"].value
    cells = ["fitted" if name in fitted else f"{errors[name] / 1e3:.3g}" for name in ALL_TESTS]
    return (
        f"{limit}, {', '.join(fitted)}",
        law,
        f"{young_pa / 1e6:.3g}",
        f"{np.sqrt(np.mean(fit**2)) / 1e3:.3g}",
        *cells,
    )


def rms_pa(experiment: cs.Experiment, parameters: dict[str, float]) -> float:
    """Root mean square error of the predicted stresses of a test [Pa]."""
    return float(np.sqrt(np.mean(residuals_pa(experiment, parameters) ** 2)))


def residuals_pa(experiment: cs.Experiment, parameters: dict[str, float]) -> np.ndarray:
    """Differences of predicted and measured stresses of a test [Pa]."""
    trajectory = cs.simulate(experiment, parameters)
    pairs = zip(trajectory.custom_sensor_values, experiment.readings, strict=True)
    return np.concatenate([(read - gauge.measured_values).ravel() for read, gauge in pairs])


if __name__ == "__main__":
    main()
