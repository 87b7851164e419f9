"""Features do not spread: few files mention one, and the package `features` declares it completely.

Files are counted by script in the whole text of each module of the package, case-insensitively. The
limits are the numbers that have been reached; lower them with each layer that no longer names a
feature. The aim is 25 files for each.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import collocation_sysid
from collocation_sysid.features.feature import Feature
from collocation_sysid.features.registry import FEATURES, merged_fields
from collocation_sysid.statistics.concerns import (
    TOPICS,
    declare_messages,
    declare_topics,
)

PACKAGE = Path(collocation_sysid.__file__).parent
# Largest number of files that mention a feature.
LIMITS = {"contact": 25, "depth": 30, "wrench": 25}
# Layers that iterate over features or use neutral interfaces, with the files in which a name is
# part of the output.
NEUTRAL = {
    "runs": {
        "check/__init__.py": {"wrench"},
    },
    "cli": {},
    "extras/design": {},
    "extras/studies": {},
    "program/forward": {},
    "program/lifted": {},
    "program/linear_algebra": {},
    "program/markers": {},
    "program/modes": {},
    "program/reactions": {},
    "statistics/probes": {},
    "statistics/residuals": {},
}
WORDS = re.compile("|".join(LIMITS), re.IGNORECASE)


def files_that_mention(word: str) -> list[str]:
    return sorted(
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        if word in path.read_text().lower()
    )


@pytest.mark.parametrize("word", LIMITS)
def test_few_files_mention_a_feature(word):
    assert len(files_that_mention(word)) <= LIMITS[word], files_that_mention(
        word
    )


@pytest.mark.parametrize("folder", NEUTRAL)
def test_a_neutral_layer_names_no_feature(folder):
    found = {
        str(path.relative_to(PACKAGE / folder)): {
            word.lower() for word in WORDS.findall(path.read_text())
        }
        for path in (PACKAGE / folder).rglob("*.py")
    }
    assert {name: words for name, words in found.items() if words} == NEUTRAL[
        folder
    ]


def test_only_the_registry_lists_the_features():
    """Modules above use a feature by its functions, or one result of it, but not its description."""
    names = {
        node.targets[0].id
        for path in (PACKAGE / "features").glob("*_feature.py")
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
        and "feature" in (node.module or "")
    }
    assert users == {"features/registry.py"}


def test_features_have_different_fields():
    assert merged_fields([{"a": 1}, {}, {"b": 2}]) == {"a": 1, "b": 2}
    with pytest.raises(
        ValueError, match="two features contribute the field 'a'"
    ):
        merged_fields([{"a": 1, "b": 2}, {"a": 3}])


def test_no_message_is_declared_twice():
    with pytest.raises(ValueError, match="the topic 'contact' is declared"):
        declare_topics({"contact": TOPICS["contact"]})
    code = "description/wrench-sign"
    with pytest.raises(ValueError, match=f"the message of '{code}' is"):
        declare_messages({code: "it has the opposite sign"})


def test_a_feature_without_functions_contributes_nothing():
    nothing = Feature("nothing")
    assert not [*nothing.hypotheses(None)]
    assert not [*nothing.error_texts(None, None)]
    assert not [*nothing.simulated_series(None, None)]
    assert not [*nothing.live_limitations(None)]
    assert nothing.simulated_hypotheses(None) == ((), ())
    assert nothing.reason_against_copy(None, None) == ""
    assert nothing.prediction_residuals(None, None, None) is None
    assert nothing.excluded_loss(None) == 0.0
    experiment = object()
    assert nothing.for_simulation(experiment) is experiment
