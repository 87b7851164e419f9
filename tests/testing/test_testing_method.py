"""`check_method`: every method passes, and each fault is one sentence."""

from __future__ import annotations

from dataclasses import replace

import pytest

from collocation_sysid.methods import METHODS
from collocation_sysid.methods.comparison.penalty import Penalty
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.testing import check_method

# The penalty method leaves a slack in the equations of motion, and an error in the estimates.
PENALTY = Penalty.name
REDUCED = ReducedSpace()


@pytest.mark.long
@pytest.mark.parametrize("name", METHODS)
def test_every_method_passes(name: str):
    if name == PENALTY:
        check_method(METHODS[name](), is_exact=False, largest_error=0.05)
    else:
        check_method(METHODS[name]())


def plain_function(collocation, watch=None, start=None):
    return REDUCED(collocation, watch, start)


def test_a_plain_function_is_a_method():
    check_method(plain_function)


def stopped(collocation, watch=None, start=None):
    return ReducedSpace(max_iterations=1)(collocation, watch, start)


def silent(collocation, watch=None, start=None):
    return REDUCED(collocation, None, start)


def biased(collocation, watch=None, start=None):
    solution = REDUCED(collocation, watch, start)
    z = solution.z.copy()
    z[0] += 0.01
    return replace(solution, z=z)


def off_the_motion(collocation, watch=None, start=None):
    solution = REDUCED(collocation, watch, start)
    z = solution.z.copy()
    (transcription,) = solution.collocation.transcriptions
    z[solution.collocation.nq + transcription.dof_count + transcription.free_dofs[0]] += 0.1
    return replace(solution, z=z)


def forgetful(collocation, watch=None, start=None):
    if start is not None:
        return stopped(collocation, watch)
    return REDUCED(collocation, watch)


def meddling(collocation, watch=None, start=None):
    solution = REDUCED(collocation, watch, start)
    guesses = collocation.parameters.with_guess({"young_pa": 900.0})
    object.__setattr__(collocation, "parameters", guesses)
    return solution


def with_history(solution, history, watch):
    for line in history if watch is not None else ():
        watch(line)
    return replace(solution, history=type(solution.history)(history))


def ascending(collocation, watch=None, start=None):
    solution = REDUCED(collocation, None, start)
    return with_history(solution, solution.history[::-1], watch)


def partial(collocation, watch=None, start=None):
    solution = REDUCED(collocation, None, start)
    lines = [replace(line, share=0.5) for line in solution.history]
    return with_history(solution, lines, watch)


@pytest.mark.parametrize(
    ("method", "sentence"),
    [
        (stopped, "'stopped': it does not converge; found iteration-limit, expected converged"),
        (silent, r"watch did not get every line of the history; found 0, expected \d"),
        (biased, "the estimate of young_pa is wrong; found 80[0-9.]+, expected 800"),
        (off_the_motion, "the equations of motion do not hold: residual over the largest force; f"),
        (forgetful, "it does not converge from its own answer; found iteration-limit"),
        (ascending, "the loss of the last line of the history is above that of the first"),
        (partial, "no line of the history is about the complete recording; found 0.5"),
        (meddling, "'meddling': it changes the collocation that it solves, entry"),
        (lambda *a, **k: None, "it does not return a Solution; found NoneType, expected Solution"),
    ],
)
def test_a_fault_is_one_sentence(method, sentence: str):
    with pytest.raises(AssertionError, match=sentence):
        check_method(method)
