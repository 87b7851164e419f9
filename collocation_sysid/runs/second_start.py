"""A second start where tracks may be explained twice: near incompressibility, and far from it.

Linear elements lock towards ν = ½, so that a body with a smaller modulus and a ratio near one half
can move almost like a stiffer, compressible one. A search that ended there is repeated from the
usual ratio at the same Young's modulus, and the better answer counts.
"""

from __future__ import annotations

from ..fem.constants import bare, usual_value
from ..methods.solution import Solution
from ..model.parameters import Parameters
from ..statistics.linearised import Derived

# Beyond this Poisson's ratio an answer is looked for from the second; less does not lock.
NEARLY_INCOMPRESSIBLE, USUAL = 0.42, 0.3
LAME = ("young_pa", "poisson", "lambda_pa", "mu_pa")


def second_start(solution: Solution) -> Parameters | None:
    """The answer with other Poisson's ratios where those it found are high; None where none is.

    Only ratios that were estimated count, by both of the moduli that tell them.
    """
    collocation, found = solution.collocation, solution.parameters
    constants = (segment.constants for segment in collocation.segments)
    values = {**Derived.of(constants, solution.q).values, **found}
    free = {item.name: item for item in collocation.parameters.free}
    changed: dict[str, float] = {}
    for name, ratio in values.items():
        if bare(name) == "poisson" and ratio > NEARLY_INCOMPRESSIBLE:
            region = name.removesuffix("poisson")
            own = [region + each for each in LAME if region + each in free]
            if len(own) == 2 or own == [name]:
                young_pa = values[region + "young_pa"]
                changed |= {each: _usual(each, young_pa) for each in own}
    if not changed or any(not free[n].lower < v < free[n].upper for n, v in changed.items()):
        return None
    return collocation.parameters.with_guess({name: found[name] for name in free} | changed)


def _usual(name: str, young_pa: float) -> float:
    value = USUAL if bare(name) == "poisson" else usual_value(name, young_pa, USUAL)
    assert value is not None
    return value
