"""The build of the site: pages made from other files, formulas, sounds, a page to play, and a check of the built site.

MkDocs calls these functions (`hooks` in mkdocs.yml). No page is written twice: sections of the README become pages, and
the reference has one page for each group of names in `pianofit.__all__`.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from check_site import faults
from formulas import with_mathml
from gallery import gallery_files
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from pages import reference_pages, repository_links, sections
from playable import playable_files
from sounds import sound_files

ROOT = Path(__file__).parent.parent

# A link to a section of the README, which is a page here.
README_SECTION = re.compile(r"\]\((?:\.\./)+README\.md#([^)]+)\)")

# A link to a script of the gallery, which is a page here.
GALLERY_SCRIPT = re.compile(r"(\]\((?:\.\./)*gallery/\w+)\.py\)")


def on_config(config: Any) -> Any:
    """Complete the navigation by the pages of the reference."""
    reference = [{title: uri} for uri, (title, _) in reference_pages(ROOT).items()]
    config.nav = _completed(config.nav, reference)
    return config


def _completed(entries: list[Any], reference: list[Any]) -> list[Any]:
    done = []
    for entry in entries:
        ((title, target),) = entry.items()
        if target == "reference/":
            done.append({title: reference})
        elif isinstance(target, list):
            done.append({title: _completed(target, reference)})
        else:
            done.append(entry)
    return done


def on_files(files: Files, config: Any) -> Files:
    """Add the pages and sounds that are made here, the page to play, and linked files of the repository."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    pages = {f"readme/{name}.md": text for name, text in sections(readme).items()}
    pages |= {uri: text for uri, (_, text) in reference_pages(ROOT).items()}
    for uri, data in gallery_files(ROOT).items():
        files.append(File.generated(config, uri, content=data))
    for uri, text in pages.items():
        files.append(File.generated(config, uri, content=text))
    for uri, data in [*sound_files().items(), *playable_files(ROOT).items()]:
        files.append(File.generated(config, uri, content=data))
    texts = [*pages.items(), *((file.src_uri, file.content_string) for file in files.documentation_pages())]
    for source in sorted({source for uri, text in texts for _, source, _ in repository_links(text, uri, ROOT)}):
        content = (ROOT / source).read_bytes()
        files.append(File.generated(config, f"repository/{source}", content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Point links to files outside docs/ at their copies, and set formulas."""
    for written, _, there in repository_links(markdown, page.file.src_uri, ROOT):
        markdown = markdown.replace(f"]({written})", f"]({there})")
    markdown = GALLERY_SCRIPT.sub(r"\1.md)", markdown)
    sections_at = posixpath.relpath("readme", posixpath.dirname(page.file.src_uri) or ".")
    return with_mathml(README_SECTION.sub(rf"]({sections_at}/\1.md)", markdown))


def on_post_build(config: Any) -> None:
    """Fail if a page loads anything from outside, names a missing file, or if a public name has no entry."""
    found = faults(Path(config.site_dir))
    if found:
        raise PluginError("the built site is not complete:\n" + "\n".join(found))
