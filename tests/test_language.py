"""Prose is plain English of the field, in documents, docstrings, comments, messages and pages (docs/glossary.md)."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
# Patterns of words that are not used, each with what to write.
BANNED = {
    r"\bheard\b": "detected, recorded or used; a person hears",
    r"\btold apart\b|\btells? apart\b": "distinguished",
    r"\b(?:is|are|was|were) told\b|\btells? (?:nothing|of|them)\b": "given, reported or determined",
    r"\btaken? back\b|\btakes back\b": "reported as not identifiable",
    r"\bby (?:its|the|their) laws?\b": "with the string model only",
    r"\bway out\b": "hint",
    r"\bdoors?\b": "entry point",
    r"\bvalleys?\b": "minimum",
    r"\bneedles?\b": "narrow minimum",
    r"\btwins?\b": "synthetic recording",
    r"\bforetells?\b": "predicts",
    r"\blikeness(?:es)?\b": "similarity",
    r"\blest\b": "so that ... not",
    r"\b(?:is|are) no\b(?! longer)": "is not",
    r"\bbut for\b": "except for",
    r"\bsave (?:for|that)\b": "except",
    r"\bhangs? together\b": "is correlated",
    r"\bno findings?\b": "do not interpret",
    r"\bbeside\b": "next to",
    r"\bknown beforehand\b": "given",
    r"\bhowever many\b": "any number of",
    r"\bnobody (?:hears|knows)\b": "inaudible, unknown",
    r"\bat the (?:least|most)(?=[.,;:)]|$)": "at least, at most",
    r"\b(?:thereof|whereof|wherein)\b": "of which, in which",
    r"\b(?:the|a|its|their) (?:path|key|string|hammer|note|stroke|partial|recording|prior)'s?(?=[.,;:)]|$)": "a noun",
}
# A sentence does not begin with one of these, unless it is a question.
BEGINNING = r"(?:^|(?<=[.!?:] ))(?:Of|What|Whether)\b (?![^.\n]*\?)"
PATTERNS = {re.compile(pattern, re.IGNORECASE): instead for pattern, instead in BANNED.items()}
PATTERNS[re.compile(BEGINNING, re.MULTILINE)] = "begin with the subject"
CODE = re.compile(r"^```.*?^```$|`[^`\n]*`", re.MULTILINE | re.DOTALL)


def blank(match: re.Match[str]) -> str:
    """Code is not prose; its lines still count."""
    return re.sub(r"[^\n]", " ", match[0])


def prose_of_python(text: str) -> Iterator[tuple[int, str]]:
    """Comments and string literals with their lines."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("# ")
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, CODE.sub(blank, node.value)


def prose() -> Iterator[tuple[str, int, str]]:
    """All prose of the project: where it is, its line, its text."""
    sources = [ROOT / "src" / "pianofit", ROOT / "studies", ROOT / "website"]
    code = [path for source in sources for path in source.rglob("*.py")]
    for path in sorted([*code, *(ROOT / "examples").glob("*.py"), *(ROOT / "docs" / "gallery").glob("*.py")]):
        for line, text in prose_of_python(path.read_text(encoding="utf-8")):
            yield str(path.relative_to(ROOT)), line, text
    documents = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
    kinds = ("j2", "js", "css", "dsp")
    templates = [path for source in sources for kind in kinds for path in source.rglob(f"*.{kind}")]
    for path in sorted([*documents, *templates]):
        text = path.read_text(encoding="utf-8")
        yield str(path.relative_to(ROOT)), 1, CODE.sub(blank, text) if path.suffix == ".md" else text


def test_prose_is_plain():
    found = [
        f"{path}:{line + text[: match.start()].count(chr(10))}: {match[0]!r}; write: {instead}"
        for path, line, text in prose()
        for pattern, instead in PATTERNS.items()
        for match in pattern.finditer(text)
    ]
    assert not found, "\n".join(found)


def test_the_patterns_find_what_they_are_for():
    """A pattern that matches nothing is a defect."""
    samples = {
        "the note is heard by the program": 1,
        "Of a path recordings tell only their mean.": 1,
        "It is no hammer, but for the felt.": 2,
        "The fit is next to the path's, and the key's.": 2,
        "A person hears the note. Which of two is it? What is it?": 0,
    }
    for text, count in samples.items():
        assert sum(len(pattern.findall(text)) for pattern in PATTERNS) == count, text


def test_the_glossary_is_short_and_has_every_noun_once():
    rows = re.findall(r"^\| ([^|]+) \|", (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"), re.MULTILINE)
    nouns = [row for row in rows if row != "noun"]
    assert len(nouns) <= 60
    assert len(nouns) == len(set(nouns))
