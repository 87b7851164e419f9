"""Features are listed once, declare different messages, and are optional in every part."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import collocation_sysid
from collocation_sysid.features.feature import Feature
from collocation_sysid.features.registry import FEATURES
from collocation_sysid.recording.markers import Markers
from collocation_sysid.statistics.concerns import TOPICS, declare_messages, declare_topics

PACKAGE = Path(collocation_sysid.__file__).parent


def test_only_the_registry_lists_the_features():
    """Modules above use a feature by its functions, or one result of it, but not its description."""
    names = {
        node.targets[0].id
        for path in (PACKAGE / "features").rglob("*feature.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Assign)
        and isinstance(node.value, ast.Call)
        and getattr(node.value.func, "id", "") == "Feature"
    }
    assert len(names) == len(FEATURES)
    users = {
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom)
        and names & {each.name for each in node.names}
        and (node.module or "").endswith("feature")
    }
    assert users == {"features/registry.py"}


def test_no_message_is_declared_twice():
    with pytest.raises(ValueError, match="the topic 'contact' is declared"):
        declare_topics({"contact": TOPICS["contact"]})
    code = "residuals/outline"
    with pytest.raises(ValueError, match=f"the message of '{code}' is"):
        declare_messages({code: "it has the opposite sign"})


def test_a_feature_without_functions_contributes_nothing():
    nothing = Feature(Markers)
    assert not [*nothing.concerns(None)]
