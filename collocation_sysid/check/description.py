"""Does the description look right? Sizes, densities, and what tracks say of poses and frames."""

from __future__ import annotations

from ..fem.plausible import oddities
from ..methods.scan import usual_constants
from ..problem import Problem
from ..statistics.cause import Cause, ranked
from ..statistics.description import doubts


def description_causes(problem: Problem) -> tuple[Cause, ...]:
    """What is likely wrong with a problem's description; mostly nothing.

    Odd sizes and densities come first, as the rest may follow from them; then the likeliest.

    Raises
    ------
    InputError
        For a size or a density that no body can have.
    """
    constants = usual_constants(problem.parameters)
    odd = [
        Cause(oddity.cause, oddity.sentence, oddity.factor)
        for body in problem.bodies
        for oddity in oddities(body)
    ]
    doubtful = (cause for e in problem.experiments for cause in doubts(e, constants, problem.huber))
    return (*odd, *ranked(doubtful))
