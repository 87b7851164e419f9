"""Classes of a user's script whose arguments are validated."""

from __future__ import annotations

import pytest

from collocation_sysid.common.validated_classes import validated
from collocation_sysid.errors import InputError

SCRIPT = """
@validated
class Options:
    steps: int = 3
"""


def test_options_of_a_script_can_be_sent_to_another_process_after_their_use():
    cloudpickle = pytest.importorskip("cloudpickle")
    names = {"validated": validated, "__name__": "__main__"}
    exec(SCRIPT, names)
    options = names["Options"](steps=5)
    twin = cloudpickle.loads(cloudpickle.dumps(options))
    assert twin.steps == 5
    with pytest.raises(InputError, match="'many'"):
        type(twin)(steps="many")
