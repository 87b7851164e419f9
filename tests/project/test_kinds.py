"""Kinds declare different messages, and are optional in every part."""

from __future__ import annotations

import pytest

from collocation_sysid.kinds.kind import Kind
from collocation_sysid.kinds.registry import KINDS
from collocation_sysid.statistics.concerns import TOPICS, declare_messages, declare_topics


def test_no_message_is_declared_twice():
    with pytest.raises(ValueError, match="the topic 'contact' is declared"):
        declare_topics({"contact": TOPICS["contact"]})
    code = "residuals/outline"
    with pytest.raises(ValueError, match=f"the message of '{code}' is"):
        declare_messages({code: "it has the opposite sign"})


def test_a_kind_without_functions_contributes_nothing():
    assert not [*Kind().concerns([])]


def test_every_record_is_complete():
    """What a record names is in its room, and each class belongs to one kind."""
    for kind in KINDS:
        for name in vars(type(kind)):
            getattr(kind, name)
    declared = [kind.declares for kind in KINDS if kind.declares]
    assert len(declared) == len({*declared})
