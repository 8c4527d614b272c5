"""What the page shows, and the same beside it as files: figures as PNG, tables as CSV, sounds as WAV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import OutputError
from ...io import encode_wav, replace_file
from ...report.drawing import png, styled, svg
from ...report.kit import data_uri
from ...report.sound import Clip, make_clips

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Book"]

# s of each sound that the page plays.
SECONDS = 2.2


@dataclass
class Book:
    """Collects what the page needs, and writes the files behind it at once."""

    folder: Path
    figures: dict[str, str] = field(default_factory=dict)  # name -> address within the page
    tables: dict[str, list[tuple[Any, ...]]] = field(default_factory=dict)  # name -> rows
    columns: dict[str, tuple[str, ...]] = field(default_factory=dict)  # name -> their headings
    players: dict[str, list[Clip]] = field(default_factory=dict)  # name -> sounds, equally loud
    files: list[str] = field(default_factory=list)

    def draw(self, name: str, figure: Callable[[], Figure]) -> None:
        """Keep a figure for the page and write its PNG."""
        with styled():
            made = figure()
            self.figures[name] = data_uri("image/svg+xml", svg(made))
            self._write(f"figures/{name}.png", png(made))

    def tabulate(self, name: str, columns: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
        """Keep a table for the page and write it as CSV, numbers with all their digits."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([[_cell(x) for x in row] for row in rows])
        self._write(f"data/{name}.csv", text.getvalue().encode())
        self.tables[name], self.columns[name] = rows, columns

    def play(self, name: str, sounds: dict[str, np.ndarray], rate: int, full_scale: float) -> None:
        """Write sounds, m/s [samples], as they are, and keep equally loud ones for the page.

        Parameters
        ----------
        full_scale : m/s at digital full scale of the files.
        """
        for label, samples in sounds.items():
            self._write(f"sounds/{_slug(f'{name} {label}')}.wav", encode_wav(samples / full_scale, rate))
        cut = {label: samples[: int(SECONDS * rate)] for label, samples in sounds.items()}
        self.players[name] = make_clips(cut, rate)

    def _write(self, name: str, content: bytes) -> None:
        target = self.folder / name
        try:
            target.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"{target.parent}: no folder can be made here ({error.strerror}); choose another"
            ) from None
        replace_file(target, content)
        self.files.append(name)


def _slug(text: str) -> str:
    return "-".join("".join(c if c.isalnum() or c == "." else " " for c in text.lower()).split())


def _cell(value: Any) -> Any:
    """A number with all its digits, nothing for what is not there."""
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, float | np.floating) else value
