"""Notes on material tests of one kind, which do not test the law that is fitted to them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ...fem.laws.constants import without_region
from ...model.parameters import Parameters
from ...recording.experiment import Experiment

# Moduli of small strain, whose meaning does not depend on the law.
MODULI = frozenset({"young_pa", "poisson", "lambda_pa", "mu_pa", "kappa_pa"})
# Kinds of test in which two stretches differ independently.
GENERAL_TESTS = frozenset({"biaxial", "biaxial-difference"})
# Fewest estimated constants with which different laws fit one curve equally well.
FEWEST_CONSTANTS = 2


def one_kind_notes(experiments: Sequence[Experiment], parameters: Parameters) -> Iterator[str]:
    """Yield one note if a law with several constants is fitted to specimens of one kind of test.

    Nothing is yielded if another kind of test is predicted, if another recording is fitted, for
    biaxial tests, or unless at least `FEWEST_CONSTANTS` elastic constants are estimated, of which
    one belongs to the law and is no usual modulus (`MODULI`).
    """
    if any(each.specimen is None for each in experiments):
        return
    tests = {each.specimen.test for each in experiments if each.specimen is not None}
    if len(tests) != 1 or tests & GENERAL_TESTS:
        return
    materials = [part.material for part in experiments[0].body.parts]
    own = {constant.name for material in materials for constant in material.constants}
    free = {without_region(item.name) for item in parameters.free} & (own | MODULI)
    if len(free) < FEWEST_CONSTANTS or free <= MODULI:
        return
    (test,) = tests
    laws = ", ".join(dict.fromkeys(material.name for material in materials))
    yield (
        f"all specimens are {test} tests: the intervals assume that the law {laws} is right, which "
        "one kind of test cannot show, and predictions of other deformations may be far off; add "
        "another kind of test, fitted or with validation = true"
    )
