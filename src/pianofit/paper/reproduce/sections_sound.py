"""Section of the page: sounds to hear, and the listening test beside it."""

from __future__ import annotations

import numpy as np

from ...report.words import number
from ..laboratory import chosen
from .findings import Findings
from .fits import RECIPES
from .listening import MEASURED, Heard, Question, write_listening
from .page import Book, Paragraph, Player, Section

__all__ = ["sounds", "write_test"]

# s of the sounds in the listening test, and of silence before them.
SECONDS, LEAD = 2.2, 0.05


def sounds(book: Book, f: Findings) -> Section:
    """Players, and the sounds as files."""
    rate, scale = f.origin.case.recording.rate, chosen.SCALE
    order = ("measured", "initial", *(RECIPES[recipe] for recipe in ("global", "paper", "read", "default")))
    own = {name: f.origin.sounds[name] for name in order}
    players = [Player("own", f"The blow of {number(f.plan.origin)} m/s", book.play(
        f"{f.plan.origin:.3f}", own, rate, scale
    ))]  # fmt: skip
    for one, blow in zip(f.predictions, [b for b in f.blows if b is not f.origin], strict=True):
        pair = {
            "measured": blow.sounds["measured"], "predicted, three bands": one.sounds["paper"],
            "predicted, string read": one.sounds["read"], "initial": blow.sounds["initial"],
        }  # fmt: skip
        keys = book.play(f"{one.velocity:.3f}", pair, rate, scale)
        title = f"{number(one.velocity)} m/s, predicted from {number(f.plan.origin)} m/s"
        players.append(Player(f"v{one.velocity:.3f}".replace(".", "-"), title, keys))
    text = (
        "The sounds are the string's velocity at the pickup, without soundboard or room. Within each group they are "
        "equally loud (K-weighted, ITU-R BS.1770); switching keeps the place. The WAV files have their own levels: "
        f"full scale is {number(scale)} m/s."
    )
    test = (
        "The paper reports an informal listening test. listening.html, beside this page, asks it blind: which of two "
        "sounds is nearer the measured one. What came of it depends on who listens, so nothing is claimed here."
    )
    return Section("sounds", "Sounds", [Paragraph(text), *players, Paragraph(test)])


def write_test(book: Book, f: Findings) -> None:
    """Write `listening.html`."""
    questions = []
    rate = f.origin.case.recording.rate
    for blow in f.blows:
        if blow.case.velocity not in f.plan.heard:
            continue
        heard = {
            name: Heard(name, blow.case.velocity, _cut(samples, rate)) for name, samples in blow.sounds.items()
        }  # fmt: skip
        reference, three, read = heard[MEASURED], heard[RECIPES["paper"]], heard[RECIPES["read"]]
        whole, first = heard[RECIPES["global"]], heard["initial"]
        pairs = [(three, first), (three, whole), (read, first), (read, whole)]
        pairs += [(heard[RECIPES["default"]], read)] if RECIPES["default"] in heard else []
        questions += [Question(reference, pair) for pair in pairs]
        questions.append(Question(reference, (reference, heard["initial"]), 1))
    origin = "measurements of pianofit's own laboratory, which stand for the paper's: those are not public"
    write_listening(book.folder / "listening.html", questions, rate, LEAD, f.seed, origin)


def _cut(samples: np.ndarray, rate: int) -> np.ndarray:
    return np.pad(samples[: int(SECONDS * rate)], (int(LEAD * rate), 0))
