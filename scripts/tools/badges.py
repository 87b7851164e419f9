"""Write badges that open the tutorial's notebooks in Colab and Binder: python scripts badges.

The badges need the address of the repository, `[project.urls] Repository` in pyproject.toml. While
that is not stated, the pages have none. They stand between two comments in README.md and in
scripts/notebooks/README.md; running the script again replaces them.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from urllib.parse import quote, urlsplit

from script_arguments import require_no_arguments

ROOT = Path(__file__).parents[2]
NOTEBOOKS = "scripts/notebooks"
NAMES = {
    "1_spring_and_tetrahedron": "1 · Spring and tetrahedron",
    "2_cylinder": "2 · Cylinder",
    "3_trust": "3 · Trust",
    "4_plan": "4 · Plan",
}
PAGES = ("README.md", f"{NOTEBOOKS}/README.md")
BEGIN = "<!-- badges of scripts/tools/badges.py -->"
END = "<!-- end of badges -->"
COLAB_IMAGE = "https://colab.research.google.com/assets/colab-badge.svg"
BINDER_IMAGE = "https://mybinder.org/badge_logo.svg"
# Branch that hosts show by default, whatever its name.
REVISION = "HEAD"
# Path of Binder for a host; for all others the complete address follows "git".
BINDER_PROVIDERS = {"github.com": "gh", "gitlab.com": "gl"}


def repository_url(pyproject: str) -> str | None:
    """Return the address of the repository that pyproject.toml, given as text, states; None if it
    does not.

    Raises
    ------
    ValueError
        If it is no web address.
    """
    urls = tomllib.loads(pyproject)["project"].get("urls", {})
    address = next((url for key, url in urls.items() if key.lower() == "repository"), None)
    if address is None:
        return None
    parts = urlsplit(address)
    if parts.scheme not in ("http", "https") or not parts.path.strip("/"):
        raise ValueError(
            f"[project.urls] Repository = {address!r}; expected an address such as "
            "https://github.com/OWNER/NAME"
        )
    return address.rstrip("/").removesuffix(".git")


def colab_url(repository: str, notebook: str) -> str | None:
    """Return the address that opens a notebook in Colab; None unless the host is GitHub, the only
    one that Colab reads.
    """
    parts = urlsplit(repository)
    if parts.netloc != "github.com":
        return None
    path = f"{parts.path.strip('/')}/blob/{REVISION}/{NOTEBOOKS}/{notebook}"
    return f"https://colab.research.google.com/github/{path}.ipynb"


def binder_url(repository: str, notebook: str) -> str:
    """Return the address that opens a notebook in Binder, for a repository on any host."""
    parts = urlsplit(repository)
    provider = BINDER_PROVIDERS.get(parts.netloc, "git")
    repository_path = parts.path.strip("/")
    if provider == "gl":
        repository_path = quote(repository_path, safe="")
    elif provider == "git":
        repository_path = quote(repository, safe="")
    file = quote(f"{NOTEBOOKS}/{notebook}.ipynb", safe="")
    return f"https://mybinder.org/v2/{provider}/{repository_path}/{REVISION}?labpath={file}"


def badges(repository: str | None) -> str:
    """Return the badges of all notebooks as lines of Markdown; empty without a repository."""
    if repository is None:
        return ""
    lines = []
    for notebook, title in NAMES.items():
        badge = f"[![Binder]({BINDER_IMAGE})]({binder_url(repository, notebook)})"
        colab = colab_url(repository, notebook)
        if colab is not None:
            badge = f"[![Colab]({COLAB_IMAGE})]({colab}) {badge}"
        lines.append(f"- {title}: {badge}")
    return "\n".join(lines)


def with_badges(page: str, lines: str) -> str:
    """Return a page with the badges between its two comments.

    Raises
    ------
    ValueError
        If the page does not have both comments, in this order.
    """
    pattern = re.compile(f"{re.escape(BEGIN)}.*?{re.escape(END)}", re.DOTALL)
    if len(pattern.findall(page)) != 1:
        raise ValueError(f"expected once: {BEGIN} … {END}")
    between = f"\n{lines}\n" if lines else "\n"
    return pattern.sub(lambda _: f"{BEGIN}{between}{END}", page)


def main() -> None:
    """Write the badges into the pages."""
    pyproject = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    lines = badges(repository_url(pyproject))
    for name in PAGES:
        file = ROOT / name
        page = file.read_text(encoding="utf-8")
        file.write_text(with_badges(page, lines), encoding="utf-8")


if __name__ == "__main__":
    require_no_arguments(__doc__)
    main()
