"""Pages that are made from other files: sections of the README, and groups of public names."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

LINK = re.compile(r"\]\(([^)\s#]+)(#[^)\s]*)?\)")
# Lines of `pianofit/__init__.py`: a comment that names a group, and names that belong to it.
GROUP = re.compile(r"^# (.+)\.$")
NAME = re.compile(r'"(\w+)"')
# Section of the README that the site's navigation replaces.
CONTENTS = "Read on"


def slug(title: str) -> str:
    """Return a title as the name of a page."""
    return re.sub(r"[^\w]+", "-", title.lower()).strip("-")


def sections(readme: str) -> dict[str, str]:
    """Return each `##` section of the README as a page, with links as seen from docs/readme/.

    Parameters
    ----------
    readme : text of README.md.

    Returns
    -------
    Name of the page to its Markdown.
    """
    parts = re.split(r"^## (.+)$", readme, flags=re.MULTILINE)[1:]
    pairs = zip(parts[::2], parts[1::2], strict=True)
    return {slug(title): f"# {title}\n{_from_below(text)}" for title, text in pairs if title != CONTENTS}


def _from_below(text: str) -> str:
    """Rewrite relative links from the README: docs/X is one folder up, and all else is outside docs/."""
    text = re.sub(r"\]\(docs/", "](../", text)
    return re.sub(r"\]\((?!\.\./|#|https?:)", "](../../", text)


def repository_links(text: str, page: str, root: Path) -> list[tuple[str, str, str]]:
    """Return the links of a page to files of the repository that are not in docs/.

    Parameters
    ----------
    text : Markdown of the page.
    page : its path below docs/.
    root : folder of the repository.

    Returns
    -------
    For each link: as it is written, the file's path below the root, and the link to its copy in the site.
    """
    found = []
    for target, anchor in LINK.findall(text):
        path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), target))
        if not path.startswith(("docs/", "..", "README.md")) and "://" not in target and (root / path).is_file():
            copy = posixpath.relpath(f"repository/{path}", posixpath.dirname(page) or ".")
            found.append((target + anchor, path, copy))
    return found


def groups(root: Path) -> dict[str, list[str]]:
    """Return the public names by the groups in which `pianofit/__init__.py` lists them."""
    lines = (root / "src" / "pianofit" / "__init__.py").read_text(encoding="utf-8").splitlines()
    end = lines.index("if TYPE_CHECKING:")
    found: dict[str, list[str]] = {}
    title = ""
    for line in lines[:end]:
        if heading := GROUP.match(line):
            title = heading[1]
        elif title:
            found.setdefault(title, []).extend(NAME.findall(line))
    return found


def reference_pages(root: Path) -> dict[str, tuple[str, str]]:
    """Return the pages of the reference.

    Returns
    -------
    Path of the page below docs/, to its title and its Markdown.
    """
    pages = {}
    for title, names in groups(root).items():
        body = "\n\n".join(f"::: pianofit.{name}" for name in names)
        pages[f"reference/{slug(title)}.md"] = (title, f"# {title}\n\n{body}\n")
    return pages
