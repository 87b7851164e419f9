"""Does the description look right? Sizes, densities, and what tracks say of poses and frames."""

from __future__ import annotations

from ...methods.scan import usual_constants
from ...problem import Problem
from ...statistics.hypothesis import Hypothesis, ranked
from ...statistics.modal import doubts
from ...statistics.plausible import oddities


def description_causes(problem: Problem) -> tuple[Hypothesis, ...]:
    """What is likely wrong with a problem's description; mostly nothing.

    Odd sizes and densities come first, as the rest may follow from them; then the likeliest.

    Raises
    ------
    InputError
        For a size or a density that no body can have.
    """
    constants = usual_constants(problem.parameters)
    odd = (oddity for body in problem.bodies for oddity in oddities(body))
    doubtful = (cause for e in problem.experiments for cause in doubts(e, constants, problem.huber))
    return (*odd, *ranked(doubtful))
