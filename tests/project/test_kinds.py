"""Kinds declare different messages, and are optional in every part."""

from __future__ import annotations

import subprocess
import sys

from collocation_sysid.kinds.kind import Kind
from collocation_sysid.kinds.registry import KINDS


def test_no_message_is_declared_twice():
    """In a process that has declared none: a message that is there already is not a kind's own."""
    code = (
        "from collocation_sysid.kinds.registry import KINDS\n"
        "from collocation_sysid.statistics.concerns import TOPICS\n"
        "codes = [f'{key}/{each}' for key, topic in TOPICS.items() for each in topic.messages]\n"
        "topics = [*TOPICS, *(key for kind in KINDS for key in kind.topics)]\n"
        "codes += [code for kind in KINDS for code in kind.messages]\n"
        "print(len(codes) == len({*codes}) and len(topics) == len({*topics}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


def test_a_kind_without_functions_contributes_nothing():
    assert not [*Kind().concerns([])]


def test_every_record_is_complete():
    """What a record names is in its room, and each class belongs to one kind."""
    for kind in KINDS:
        for name in vars(type(kind)):
            getattr(kind, name)
    declared = [kind.declares for kind in KINDS if kind.declares]
    assert len(declared) == len({*declared})
