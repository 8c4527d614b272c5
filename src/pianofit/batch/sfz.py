"""Keys, velocity ranges and samples of an SFZ instrument, as rows of a manifest.

Of the format only what says which sample belongs to which key is read: headers with their inheritance, `sample`,
`default_path`, `key`, `pitch_keycenter`, `lovel`, `hivel`, `#include` and `#define`. A sample is of the key it was
recorded at, `pitch_keycenter`, however far the regions stretch it. What sounds when a key is let go, or with the pedal
down, is no stroke of a damped keyboard's string and is left out, and counted.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from ..errors import SetupError
from ..io import one_line
from .manifest import Row, manifest_text

__all__ = ["sfz_rows"]

MAX_INCLUDES = 200
MAX_TEXT = 2**24
_LEVELS = ("control", "global", "master", "group", "region")
_TOKEN = re.compile(r"<(\w+)>|([A-Za-z0-9_]+)=((?:(?!\s+[A-Za-z0-9_]+=|\s*<\w+>).)*)")
_DIRECTIVE = re.compile(r"""#include\s+"([^"]+)"|#define\s+(\$\w+)\s+(\S+)""")


def sfz_rows(source: Path, root: Path) -> tuple[list[Row], list[str]]:
    """Rows of an SFZ file, one for each key and sample, and remarks.

    Raises `SetupError`, naming the file and the region that cannot be understood.
    """
    name = one_line(source)
    rows: dict[tuple[str, str], Row] = {}
    left_out = 0
    for number, region in enumerate(_regions(source, root), 1):
        sample = region.get("sample", "")
        if not sample or sample.startswith("*"):  # a generator such as *sine
            left_out += 1
            continue
        if region.get("trigger", "attack") not in ("attack", "first", "legato") or _whole(region, "locc64", 0) > 0:
            left_out += 1
            continue
        note = region.get("pitch_keycenter", region.get("key", "60"))
        low, high = _whole(region, "lovel", 1), _whole(region, "hivel", 127)
        file = (region.get("default_path", "") + sample).replace("\\", "/")
        row = Row(f"region {number}", file, note, layer=f"v{low:03d}-{high:03d} {Path(file).stem}")
        held = rows.setdefault((file, note), row)
        rows[file, note] = min(held, row, key=lambda r: r.layer)  # the same sample in several regions is one recording
    if not rows:
        raise SetupError(f"{name}: has no region with a sample that sounds when a key is struck; give another SFZ file")
    remarks = [f"{left_out} regions without a sample, on release, or with the pedal down"] if left_out else []
    return list(rows.values()), remarks


def _whole(region: dict[str, str], opcode: str, default: int) -> int:
    text = region.get(opcode, "")
    return int(text) if re.fullmatch(r"\d{1,3}", text, re.ASCII) else default


def _regions(source: Path, root: Path) -> Iterator[dict[str, str]]:
    """Opcodes of every region, with those of the headers above it."""
    levels: dict[str, dict[str, str]] = {level: {} for level in _LEVELS}
    current = "control"
    for header, opcode, value in _tokens(source, root):
        if header:
            if current == "region":
                yield _merged(levels)
            current = header
            below = _LEVELS[_LEVELS.index(header) :] if header in _LEVELS else ()
            for level in below if header != "control" else ():
                levels[level] = {}
        elif current in _LEVELS:
            levels[current][opcode] = value.strip()
    if current == "region":
        yield _merged(levels)


def _merged(levels: dict[str, dict[str, str]]) -> dict[str, str]:
    """A region's opcodes; an own `key` goes before an inherited `pitch_keycenter`."""
    merged: dict[str, str] = {}
    for level in _LEVELS:
        own = levels[level]
        if "key" in own and "pitch_keycenter" not in own:
            merged.pop("pitch_keycenter", None)
        merged |= own
    return merged


def _tokens(source: Path, root: Path) -> Iterator[tuple[str, str, str]]:
    """Headers and opcodes in order: (header, "", "") or ("", opcode, value)."""
    for line in _lines(source, source.parent, root.resolve(), {}, [0, 0]):
        for match in _TOKEN.finditer(line):
            yield match[1] or "", match[2] or "", match[3] or ""


def _lines(source: Path, base: Path, fence: Path, defined: dict[str, str], spent: list[int]) -> Iterator[str]:
    """Lines without comments, with included files in their places and defined words replaced."""
    name, text = one_line(source), manifest_text(source)
    spent[0] += 1
    spent[1] += len(text)
    if spent[0] > MAX_INCLUDES or spent[1] > MAX_TEXT:
        raise SetupError(f"{name}: more than {MAX_INCLUDES} files or {MAX_TEXT // 2**20} MiB are included; it may "
                         "include itself")  # fmt: skip
    text = re.sub(r"/\*.*?\*/", lambda m: "\n" * m[0].count("\n"), text, flags=re.DOTALL)
    for line in text.splitlines():
        line = re.sub(r"//.*", "", line)
        for word in sorted(defined, key=len, reverse=True):
            line = line.replace(word, defined[word])
        if len(line) > 10_000:
            raise SetupError(f"{name}: has a line of {len(line)} letters; it is no SFZ file")
        for file, word, value in _DIRECTIVE.findall(line):
            if word:
                defined[word] = value
                continue
            included = (base / file.replace("\\", "/")).resolve()
            if not included.is_relative_to(fence):
                raise SetupError(f"{name}: includes {one_line(file)}, which leads out of {one_line(fence)}; allow a "
                                 "larger folder with --root")  # fmt: skip
            yield from _lines(included, base, fence, defined, spent)
        yield _DIRECTIVE.sub("", line)
