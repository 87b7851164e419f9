"""Badges of the tutorial's notebooks, and the environment in which Binder opens them."""

from __future__ import annotations

import re
from pathlib import Path

import badges
import pytest

ROOT = Path(__file__).parents[2]
GITHUB = "https://github.com/someone/collocation_sysid"


def stating(url: str) -> str:
    """The project's pyproject.toml with an address of its repository."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert "[project.urls]" not in text
    return f'{text}\n[project.urls]\nRepository = "{url}"\n'


def test_pages_have_the_badges_of_the_stated_repository():
    """Also without one, when there are none."""
    stated = badges.repository_url((ROOT / "pyproject.toml").read_text())
    for name in badges.PAGES:
        page = (ROOT / name).read_text(encoding="utf-8")
        expected = badges.with_badges(page, badges.badges(stated))
        assert page == expected, "run scripts/tools/badges.py"


@pytest.mark.parametrize("suffix", ["", "/", ".git"])
def test_notebooks_on_github_open_in_colab_and_binder(suffix):
    repository = badges.repository_url(stating(GITHUB + suffix))
    assert repository == GITHUB
    lines = badges.badges(repository)
    assert lines.count("\n") == len(badges.NAMES) - 1
    assert (
        "https://colab.research.google.com/github/someone/collocation_sysid/blob/HEAD/"
        "scripts/notebooks/2_cylinder.ipynb" in lines
    )
    assert (
        "https://mybinder.org/v2/gh/someone/collocation_sysid/HEAD?labpath="
        "scripts%2Fnotebooks%2F2_cylinder.ipynb" in lines
    )


@pytest.mark.parametrize(
    ("url", "place"),
    [
        ("https://gitlab.com/a/b/soft", "gl/a%2Fb%2Fsoft"),
        ("https://git.example.org/a/soft", "git/https%3A%2F%2Fgit.example.org%2Fa%2Fsoft"),
    ],
)
def test_notebooks_on_other_hosts_open_in_binder_alone(url, place):
    lines = badges.badges(badges.repository_url(stating(url)))
    assert f"https://mybinder.org/v2/{place}/HEAD?labpath=" in lines
    assert "colab" not in lines


def test_badges_are_inserted_and_removed_again():
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    inserted = badges.with_badges(page, badges.badges(GITHUB))
    assert inserted.count("mybinder.org/v2/") == len(badges.NAMES)
    assert badges.with_badges(inserted, badges.badges(GITHUB)) == inserted
    assert badges.with_badges(inserted, "") == badges.with_badges(page, "")


def test_an_invalid_repository_address_is_refused():
    with pytest.raises(ValueError, match="expected an address such as"):
        badges.repository_url(stating("someone/collocation_sysid"))
    with pytest.raises(ValueError, match="expected once"):
        badges.with_badges("no comments", "")


def test_every_notebook_has_badges_and_states_a_time_of_at_most_45_minutes():
    scripts = sorted((ROOT / badges.NOTEBOOKS).glob("[0-9]_*.py"))
    assert [file.stem for file in scripts] == [*badges.NAMES]
    for file in scripts:
        text = file.read_text(encoding="utf-8")
        stated = re.search(r"\*\*Time:\*\* about (\d+) minutes", text)
        assert stated is not None, file.name
        assert int(stated[1]) <= 45
        assert stated.start() < text.index("# %%\n")  # before the first cell


def test_binder_installs_the_packages_of_the_notebooks():
    lines = (ROOT / ".binder/requirements.txt").read_text().splitlines()
    assert ".[notebook,interactive]" in lines
    runtime = (ROOT / ".binder/runtime.txt").read_text().strip()
    assert re.fullmatch(r"python-3\.1[1-9]", runtime)
