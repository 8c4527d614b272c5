"""An SFZ file played by sfizz, with keys and pedals at given times."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

RATE = 48_000
BLOCK = 64
# (s, method of the synthesiser, arguments), such as (0.5, "cc", 64, 127).
Event = tuple[Any, ...]


def play(file: Path, events: Sequence[Event], seconds: float, *, without: Sequence[str] = ()) -> np.ndarray:
    """Return the left channel; lines of the file that contain one of `without` are left out."""
    from pysfizz import Synth

    # sfizz streams samples from the disk in a separate thread; here it must load them before it plays.
    lines = [line for line in file.read_text().splitlines() if not any(word in line for word in without)]
    whole = file.with_name("whole.sfz")
    whole.write_text("\n".join(["<control> hint_ram_based=1", *lines]))
    synth = Synth(sample_rate=RATE, block_size=BLOCK)
    assert synth.load_sfz_file(whole, quiet=False)
    whole.unlink()
    pending, out = sorted(events, key=lambda event: event[0]), []
    for first in range(0, round(seconds * RATE), BLOCK):
        while pending and round(pending[0][0] * RATE) < first + BLOCK:
            at, method, *arguments = pending.pop(0)
            getattr(synth._synth, method)(round(at * RATE) - first, *arguments)
        out.append(synth._synth.render_block()[0])
    return np.concatenate(out)
