"""A test of two folders: files of one name are a pair, and a page asks whether they can be told apart.

All sounds are cut to their onset, those of one name to one length, and made equally loud, so that they differ in
nothing but how they sound.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import RecordingError, check_range
from ..io.files import printable
from ..io.number_format import counted
from ..recording.recording import Recording
from .artefact_checks import failures
from .mushra import write_experiment
from .page import Question, TestSound, write_listening
from .pairs import MOST, load_pair, pairs_of

__all__ = ["TestSummary", "listening_test"]

# Before the onset, s: a knock may begin 12 ms earlier. Half of it fades in.
LEAD = 0.02
# Questions of a condition at the most: some two hours.
MOST_TRIALS = 500


class TestSummary(NamedTuple):
    """What a test is made of."""

    names: list[str]  # of the sounds that are asked about
    alone: list[str]  # of those that one folder lacks
    failed: list[str]  # what failed a gate, one line each
    trials: int


def listening_test(
    a: Path, b: Path, folder: Path, *, reference: Path | None, trials: int, seconds: float, seed: int, leave_out: bool
) -> TestSummary:
    """Write `listen.html`, its key, and the same as a webMUSHRA experiment.

    Parameters
    ----------
    a, b : folders of sounds whose files have the same names, apart from the ending; or two files. One may be a folder
        of fits: their sounds are paired with the recordings that they were fitted to.
    folder : exists, and is to be written to.
    reference : likewise; then it is also asked which of A and B is nearer to it. Without, A is the reference.
    trials : of each condition; the names are taken in turn.
    seconds : what is heard of each sound at most, s.
    seed : of all that is drawn.
    leave_out : names of which a sound fails a gate are left out; otherwise they are an error.

    Raises `ParameterError` where `trials` or `seconds` is out of range; `RecordingError` where a sound cannot be read
    or fails a gate, or sounds that are compared differ in rate or channels; `OutputError` if a file cannot be written.
    """
    check_range("trials=", trials, 1, MOST_TRIALS)
    check_range("seconds=", seconds, 0.25, 30)
    sides = [a, b] if reference is None else [a, b, reference]
    draw = np.random.default_rng(seed)
    labels, (groups, alone) = _labels(sides), pairs_of(sides)
    loaded = {name: load_pair(groups[name]) for name in sorted(draw.permutation([*groups])[:MOST].tolist())}
    failed = [f"{printable(r.path)}: {words}" for group in loaded.values() for r in group for words in failures(r)]
    kept = {name: group for name, group in loaded.items() if not any(map(failures, group))}
    if failed and not (leave_out and kept):
        raise RecordingError(f"{'; '.join(failed)} (or give --leave-out, where other sounds remain)")
    rate = _common(list(kept.values()))
    heard = [_heard(name, labels, kept[name], seconds) for name in sorted(draw.permutation([*kept])[:trials].tolist())]
    questions = [question for order in _conditions(heard) for question in _balanced_trials(order, trials, draw)]
    clips = write_listening(
        folder / "listen.html", questions, rate, LEAD, seed, program="pianofit listen",
        about=f"{counted(len(heard), 'sound')}, each in two versions", key=folder / "key.json", seconds=seconds,
        origin=f"the same sounds in {'a third version' if reference else 'one of the two versions'}",
    )  # fmt: skip
    write_experiment(folder / "webmushra", clips, labels[-1] if reference else labels[0])
    return TestSummary([one[0].case for one in heard], alone, failed, sum(question.times for question in questions))


def _labels(sides: list[Path]) -> list[str]:
    """The names of the sides, each with as many folders before it as make the names different."""
    for ending in (False, True):
        ends = [(*side.resolve().parts[:-1], side.name if ending else side.stem) for side in sides]
        for depth in range(1, max(map(len, ends)) + 1):
            labels = ["/".join(parts[-depth:]) for parts in ends]
            if len({*labels}) == len(labels) and all(labels):
                return [printable(label) for label in labels]
    raise RecordingError(f"{printable(sides[0])}: is given twice; two different folders or files are compared")


def _common(groups: list[list[Recording]]) -> int:
    """The rate of all, Hz."""
    first = groups[0][0]
    for group in groups:
        for one in group:
            if one.rate != first.rate:
                raise RecordingError(
                    f"{printable(one.path)}: has {one.rate} Hz, {printable(first.path)} {first.rate}; resample one"
                )
            if len(one.frames) != len(group[0].frames):
                raise RecordingError(
                    f"{printable(one.path)}: has {counted(len(one.frames), 'channel')}, {printable(group[0].path)} "
                    f"{len(group[0].frames)}: that alone would tell them apart; make them alike"
                )
    return first.rate


def _heard(name: str, labels: list[str], group: list[Recording], seconds: float) -> list[TestSound]:
    """The sounds of one name, cut to their onsets and to one length."""
    rate = group[0].rate
    lead = round(LEAD * rate)
    size = min(lead + min(len(one.samples) - one.onset for one in group), round(seconds * rate))
    fade = np.hanning(lead)[: lead // 2]
    found = []
    for label, one in zip(labels, group, strict=True):
        begin = one.onset - lead
        cut = np.pad(one.frames[:, max(begin, 0) : begin + size], ((0, 0), (max(-begin, 0), 0)))
        cut[:, : len(fade)] *= fade
        found.append(TestSound(label, name, cut))
    return found


def _conditions(heard: list[list[TestSound]]) -> list[list[Question]]:
    """What is asked of each name, condition by condition."""
    if len(heard[0]) == 2:
        return [[Question(a, (a, b), kind="abx") for a, b in heard], [Question(a, (a, b)) for a, b in heard]]
    return [
        [Question(a, (a, b), kind="abx") for a, b, _ in heard],
        [Question(r, (a, b)) for a, b, r in heard],
        [Question(r, (r, a)) for a, _, r in heard],
        [Question(r, (r, b)) for _, b, r in heard],
    ]


def _balanced_trials(questions: list[Question], trials: int, draw: np.random.Generator) -> list[Question]:
    """`questions` asked `trials` times in all, each as often as the others or once more."""
    each, more = divmod(trials, len(questions))
    often = dict.fromkeys(draw.permutation(len(questions))[:more].tolist(), each + 1)
    asked = [question._replace(times=often.get(n, each)) for n, question in enumerate(questions)]
    return [question for question in asked if question.times]
