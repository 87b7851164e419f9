"""Fits of Kawabata's biaxial data by several laws, and predictions of the data left out.

The first table fits each law to uniaxial tension, or to uniaxial, equibiaxial and planar tension,
with stretches up to a limit, and predicts all other pairs of stretches up to the same limit. The
second table fits each law to all pairs of stretches with the larger stretch λ₁ up to a limit, and
predicts all pairs with a larger λ₁; it lists the constants with their combined intervals. Errors
are root mean squares of engineering stresses.

    python scripts study_kawabata
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from script_arguments import make_parser
from studies import markdown

import collocation_sysid as cs
from collocation_sysid.recording.specimen_files import specimen_strains

UNKNOWN = cs.Unknown()
# Bulk modulus [Pa] so large that no stress depends on it: a thousand times the shear modulus.
KAPPA = {"kappa_pa": 1e9}
UNDAMPED = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
# Ogden's fit of Treloar's rubber (1972): a guess of the constants [Pa, 1], and fixed exponents.
OGDEN_TERMS = ((6e5, 1.3), (-1e4, -2.0), (1e3, 5.0))
# Largest stretches of the fits: where a handling robot works, and a moderate rubber test.
LIMITS = (1.3, 2.5)
# Tests that are fitted: one alone, or three.
FITTED = (("uniaxial",), ("uniaxial", "equibiaxial", "planar"))
ALL_TESTS = ("uniaxial", "equibiaxial", "planar", "biaxial")


@dataclass(frozen=True)
class Law:
    """Material law with the parameters of its fit."""

    name: str
    material: str
    # Constants that are estimated, with guesses where the scan of the stiffness gives none, and
    # constants that are fixed.
    parameters: dict[str, cs.Unknown | float]

    @property
    def free_names(self) -> list[str]:
        """Names of the constants that are estimated."""
        return [name for name, each in self.parameters.items() if isinstance(each, cs.Unknown)]


def ogden_law(terms: int, *, fixes_exponents: bool) -> Law:
    """Return Ogden's law with a number of terms, whose exponents are fixed or estimated."""
    parameters: dict[str, cs.Unknown | float] = dict(KAPPA)
    for number, (mu_pa, alpha) in enumerate(OGDEN_TERMS[:terms], start=1):
        parameters[f"mu_{number}_pa"] = cs.Unknown(guess=mu_pa)
        parameters[f"alpha_{number}"] = alpha if fixes_exponents else cs.Unknown(guess=alpha)
    suffix = ", α fixed" if fixes_exponents else ""
    return Law(f"ogden-{terms}{suffix}", f"ogden-{terms}", parameters)


LAWS = (
    Law("neo-hookean", "neo-hookean", {"mu_pa": UNKNOWN, "lambda_pa": KAPPA["kappa_pa"]}),
    Law("mooney-rivlin", "mooney-rivlin", {"c10_pa": UNKNOWN, "c01_pa": UNKNOWN, **KAPPA}),
    Law("yeoh", "yeoh", {"c10_pa": UNKNOWN, "c20_pa": UNKNOWN, "c30_pa": UNKNOWN, **KAPPA}),
    Law("gent", "gent", {"mu_pa": UNKNOWN, "gent_limit": cs.Unknown(guess=60.0), **KAPPA}),
    Law(
        "arruda-boyce",
        "arruda-boyce",
        {"mu_pa": UNKNOWN, "chain_stretch": cs.Unknown(guess=5.0), **KAPPA},
    ),
    ogden_law(1, fixes_exponents=False),
    ogden_law(2, fixes_exponents=False),
    ogden_law(3, fixes_exponents=True),
    ogden_law(3, fixes_exponents=False),
)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--laws", nargs="+", help="names of laws; all by default")
    options = parser.parse_args()
    laws = [law for law in LAWS if options.laws is None or law.name in options.laws]
    heads = (
        "stretch up to",
        "fitted tests",
        "law",
        "E, MPa",
        "error of the fit, kPa",
        *(f"error of {test}, kPa" for test in ALL_TESTS),
    )
    rows = [row_of_tests(law, limit, tests) for limit in LIMITS for tests in FITTED for law in laws]
    print(markdown(heads, rows), flush=True)
    heads = (
        "λ₁ up to",
        "law",
        "constants with combined 95 % intervals",
        "E with combined interval, MPa",
        "error of the fit, kPa",
        "error of the prediction at larger λ₁, kPa",
    )
    rows = [row_of_stretches(law, limit) for limit in LIMITS for law in laws]
    print(markdown(heads, rows))


def row_of_tests(law: Law, limit: float, fitted: tuple[str, ...]) -> tuple[str, ...]:
    """Return modulus, error of the fit, and error of the prediction of each other test."""
    experiments = cs.datasets.kawabata_1981(law.material, tests=ALL_TESTS, largest_stretch=limit)
    known = [each for each in experiments if each.name in fitted]
    run = cs.run(cs.Problem(known, {**law.parameters, **UNDAMPED}))
    constants = run.solution.parameters
    errors = {each.name: rms_kpa([each], constants) for each in experiments}
    cells = ["fitted" if name in fitted else errors[name] for name in ALL_TESTS]
    name = law.name if run.solution.status.converged else f"{law.name} (not converged)"
    return (
        str(limit),
        "uniaxial" if len(fitted) == 1 else "three tests",
        name,
        f"{run.estimates['young_pa'].value / 1e6:.3g}",
        rms_kpa(known, constants),
        *cells,
    )


def row_of_stretches(law: Law, limit: float) -> tuple[str, ...]:
    """Return constants, error of the fit up to a stretch, and error of the prediction beyond."""
    fitted = cs.datasets.kawabata_1981(law.material, tests=ALL_TESTS, largest_stretch=limit)
    run = cs.run(cs.Problem(fitted, {**law.parameters, **UNDAMPED}))
    constants = run.solution.parameters
    everything = cs.datasets.kawabata_1981(law.material, tests=ALL_TESTS)
    name = law.name if run.solution.status.converged else f"{law.name} (not converged)"
    return (
        str(limit),
        name,
        "; ".join(interval_text(run, each) for each in law.free_names),
        interval_text(run, "young_pa").removeprefix("E = "),
        rms_kpa(fitted, constants),
        rms_kpa(everything, constants, lambda stretch: stretch > limit),
    )


def interval_text(run: cs.Run, name: str) -> str:
    """Return an estimate with its combined interval, moduli in MPa."""
    estimate = run.estimates[name]
    scale = 1e-6 if name.endswith("_pa") else 1.0
    label = "E" if name == "young_pa" else name.removesuffix("_pa")
    if estimate.combined95 is None:
        return f"{label} = {scale * estimate.value:.3g} (no interval)"
    low, high = (scale * end for end in estimate.combined95)
    return f"{label} = {scale * estimate.value:.3g} ({low:.3g} … {high:.3g})"


def rms_kpa(
    experiments: Sequence[cs.Experiment],
    constants: dict[str, float],
    is_counted: Callable[[np.ndarray], np.ndarray] = np.isfinite,
) -> str:
    """Return the root mean square error of predicted stresses [kPa], or "unstable".

    "unstable" means that the constants allow no stable equilibrium in one of the experiments.
    """
    residuals_pa = []
    for experiment in experiments:
        stretch = 1 + np.maximum(*specimen_strains(experiment))
        try:
            trajectory = cs.simulate(experiment, constants)
        except cs.SimulationError:
            return "unstable"
        pairs = zip(trajectory.custom_sensor_values, experiment.readings, strict=True)
        for predicted, gauge in pairs:
            residuals_pa.append((predicted - gauge.measured_values)[is_counted(stretch), 0])
    return f"{np.sqrt(np.nanmean(np.concatenate(residuals_pa) ** 2)) / 1e3:.3g}"


if __name__ == "__main__":
    main()
