"""Methods that solve a `Collocation`: their names, options and option schemas.

`METHODS` maps every name of a method (key `method` of the table `[solver]`) to its class.

Solvers
    `reduced_space` eliminates the motion by the equations of motion and searches only for the
    parameters; `reduced_search` is its trust region, `loss_curvature` its second derivatives,
    `horizon` and `trajectory_sweeps` its linearised problem, and `experiment_executors` runs it in
    threads or on a Dask cluster. `interior_point` solves for motion and parameters simultaneously
    with IPOPT; `condensed_program` removes variables that follow from others, and
    `complementarity` adds hard obstacles. `comparison` contains methods of the literature, to
    compare with.
Start
    `starts` contains what happens before a search: scans, closed forms, simulations at given
    parameters.
Common
    `solution` defines the protocol of methods and the result, `solve_recorder` the history
    and the answer after an interruption, `options` the construction of methods from
    options by name, `nlpsol` the interface to CasADi's solvers.
"""

from __future__ import annotations

import inspect
from typing import Any

from pydantic import TypeAdapter

from ..errors import InputError, require_among
from .comparison.casadi_nlp import Sleqp, SqpMethod, refusal_reason
from .comparison.penalty import AugmentedLagrangian, Penalty
from .comparison.shooting import Shooting
from .interior_point import InteriorPoint
from .reduced_space import ReducedSpace

_ALL = (InteriorPoint, ReducedSpace, Penalty, AugmentedLagrangian, Shooting, SqpMethod, Sleqp)
METHODS: dict[str, type] = {kind.name: kind for kind in _ALL}


def require_method(name: str, option: str) -> None:
    """Raise `InputError` if no method has this name.

    Parameters
    ----------
    name : str
        Name of a method, for example "reduced-space".
    option : str
        Command-line option that contains the name, for the message.

    Raises
    ------
    InputError
        For an unknown name, and for solvers of CasADi that are not offered, with the reason.
    """
    if name not in METHODS:
        if (reason := refusal_reason(name)) is not None:
            raise InputError(reason, None, where=option)
        require_among(name, METHODS, where=option)


def method_summary(method: str) -> str:
    """Return the first line of the docstring of a method, a key of `METHODS`."""
    return inspect.cleandoc(METHODS[method].__doc__ or "").splitlines()[0]


def method_options_schema(method: str) -> dict[str, Any]:
    """Return the JSON schema of a method's options: types, ranges, defaults and descriptions, as a
    new dictionary.

    Parameters
    ----------
    method : str
        Name of a method, a key of `METHODS`.
    """
    kind = METHODS[method]
    defaults = kind()
    options = TypeAdapter(kind).json_schema()["properties"]
    for name, option in options.items():
        del option["title"]
        option["default"] = getattr(defaults, name)
    return {
        "type": "object",
        "description": method_summary(method),
        "properties": options,
        "additionalProperties": False,
    }
