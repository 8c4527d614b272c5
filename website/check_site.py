"""Faults of a built site: requests to other hosts, links to files that are not there, names without an entry."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pianofit

# Elements and attributes that a browser loads by itself. A link to click, <a href>, may lead anywhere.
LOADED = {("link", "href"), ("script", "src"), ("img", "src"), ("audio", "src"), ("source", "src"), ("iframe", "src")}
CSS_URL = re.compile(r"""(?:@import\s+|url\()\s*["']?((?:https?:)?//[^"')\s]+)""")


class _Page(HTMLParser):
    """Collects targets and anchors of one page."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.linked: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.anchors.add(value)
            elif (tag, name) in LOADED and value:
                self.loaded.append(value)
            elif (tag, name) == ("a", "href") and value:
                self.linked.append(value)


def read(file: Path) -> _Page:
    """Parse one page."""
    page = _Page()
    page.feed(file.read_text(encoding="utf-8"))
    return page


def faults(site: Path) -> list[str]:
    """List the faults of a built site.

    Parameters
    ----------
    site : folder with its index.html.

    Returns
    -------
    One line for each fault; empty if there is none.
    """
    pages = {file: read(file) for file in sorted(site.rglob("*.html"))}
    found = [f"{name} has no entry in the reference" for name in _without_entry(pages)]
    for file, page in pages.items():
        where = file.relative_to(site)
        found += [f"{where} loads {target}" for target in page.loaded if _is_outside(target)]
        found += [f"{where} names the missing file {target}" for target in _missing(file, page)]
    for file in sorted(site.rglob("*.css")):
        urls = CSS_URL.findall(file.read_text(encoding="utf-8"))
        found += [f"{file.relative_to(site)} loads {url}" for url in urls]
    return found


def _without_entry(pages: dict[Path, _Page]) -> list[str]:
    anchors = {anchor for file, page in pages.items() if file.parent.name == "reference" for anchor in page.anchors}
    return [name for name in pianofit.__all__ if name != "__version__" and f"pianofit.{name}" not in anchors]


def _is_outside(target: str) -> bool:
    parts = urlsplit(target)
    return parts.scheme not in ("", "data") or bool(parts.netloc)


def _missing(file: Path, page: _Page) -> list[str]:
    """Return relative targets of a page that are not files. 404.html is served at any address, so it has none."""
    targets = [] if file.name == "404.html" else [x for x in page.loaded + page.linked if not _is_outside(x)]
    paths = [(target, unquote(urlsplit(target).path)) for target in targets if not target.startswith("data:")]
    return [target for target, path in paths if path and not (file.parent / path).exists()]
