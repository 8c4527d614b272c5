"""The page as data: sections of paragraphs, verdicts, figures, tables and players; and the files beside it.

What is on the page is also in a file: every figure as PNG, every table as CSV with all its digits, every sound as WAV.
"""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...errors import OutputError
from ...io import encode_wav, replace_file
from ...report.sound import make_clips
from .captions import CAPTIONS
from .drawing import drawn
from .sheet import write_sheet
from .verdict import Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Book", "Paragraph", "Picture", "Player", "Section", "Sheet"]

# s of each sound that the page plays.
SECONDS = 2.2


class Paragraph(NamedTuple):
    """Plain text."""

    text: str


class Picture(NamedTuple):
    """A figure of the book."""

    name: str
    alt: str
    caption: str


class Sheet(NamedTuple):
    """A table of the book, in words; `file` has the numbers."""

    file: str
    caption: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    words: tuple[int, ...] = (0,)  # columns of words; the others are numbers, and stand to the right


class Player(NamedTuple):
    """Sounds to switch between."""

    name: str
    caption: str
    sounds: list[tuple[str, str]]  # label, key of the page's sounds


class Section(NamedTuple):
    """A heading and what is under it."""

    name: str
    title: str
    items: list[Paragraph | Verdict | Picture | Sheet | Player]


@dataclass
class Book:
    """Collects what the page needs, and writes the files behind it at once."""

    folder: Path
    figures: dict[str, str] = field(default_factory=dict)  # name -> data address
    clips: dict[str, str] = field(default_factory=dict)  # key -> WAV as base64
    files: list[str] = field(default_factory=list)

    def draw(self, name: str, figure: Callable[[], Figure], **fields: Any) -> Picture:
        """Keep a figure for the page and write its PNG; `fields` go into its caption (see `captions`)."""
        svg, png = drawn(figure)
        self.figures[name] = f"data:image/svg+xml;base64,{base64.b64encode(svg).decode()}"
        self._write(f"figures/{name}.png", png)
        alt, caption = CAPTIONS[name]
        return Picture(name, alt, caption.format(**fields))

    def tabulate(self, name: str, header: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
        """Write a table as CSV, numbers with all their digits; returns its file's name."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([[_cell(x) for x in row] for row in rows])
        return self._write(f"data/{name}.csv", text.getvalue().encode())

    def play(self, name: str, sounds: dict[str, np.ndarray], rate: int, full_scale: float) -> list[tuple[str, str]]:
        """Write sounds, m/s [samples], as they are, and keep equally loud ones for the page.

        Parameters
        ----------
        full_scale : m/s at digital full scale of the files.
        """
        for label, samples in sounds.items():
            self._write(f"sounds/{_slug(f'{name} {label}')}.wav", encode_wav(samples / full_scale, rate))
        cut = {label: samples[: int(SECONDS * rate)] for label, samples in sounds.items()}
        self.clips |= {_slug(f"{name} {c.name}"): c.uri.split(",", 1)[1] for c in make_clips(cut, rate)}
        return [(label, _slug(f"{name} {label}")) for label in sounds]

    def publish(self, sections: list[Section], **content: Any) -> None:
        """Write `index.html`."""
        verdicts = [item for section in sections for item in section.items if isinstance(item, Verdict)]
        kinds = {Paragraph: "text", Verdict: "verdict", Picture: "picture", Sheet: "table", Player: "player"}
        shown = [(s.name, s.title, [(kinds[type(item)], item) for item in s.items]) for s in sections]
        write_sheet(
            self.folder / "index.html", "index.html.j2", ("audio.js", "player.js"), sections=shown, verdicts=verdicts,
            figures=self.figures, clips=self.clips, files=sorted(self.files), **content,
        )  # fmt: skip

    def _write(self, name: str, content: bytes) -> str:
        target = self.folder / name
        try:
            target.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"{target.parent}: no folder can be made here ({error.strerror}); choose another"
            ) from None
        replace_file(target, content)
        self.files.append(name)
        return name


def _slug(text: str) -> str:
    return "-".join("".join(c if c.isalnum() or c == "." else " " for c in text.lower()).split())


def _cell(value: Any) -> Any:
    """A number with all its digits, nothing for what is not there."""
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, float | np.floating) else value
