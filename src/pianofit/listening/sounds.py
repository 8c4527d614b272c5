"""Listening test of two folders: files of the same name are a pair, and a page asks whether they differ audibly.

Sounds are cut to their onset, those of a pair to the same length, and all get the same loudness. Listeners can then
use only the sound itself.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import RecordingError, check_range
from ..io.files import as_path, printable
from ..io.number_format import counted
from ..recording.recording import Recording
from .artefact_checks import failures
from .mushra import write_experiment
from .page import write_listening
from .pairs import MAX_PAIRS, load_pair, pairs_of
from .trials import ListeningSound, Question

# Time before the onset, s, because a knock may begin 12 ms earlier. The first half fades in.
LEAD = 0.02
# Maximum number of questions of a condition, about two hours.
MAX_TRIALS = 500


class ListeningSummary(NamedTuple):
    """Contents of a listening test."""

    names: list[str]  # names of the tested sounds
    alone: list[str]  # names that are missing in a folder
    failed: list[str]  # messages of failed checks
    trials: int


def write_listening_test(
    a: str | os.PathLike[str],
    b: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    reference: str | os.PathLike[str] | None = None,
    trials: int = 16,
    seconds: float = 4.0,
    seed: int = 0,
    exclude_invalid: bool = False,
) -> ListeningSummary:
    """Write `listen.html`, its key, and a webMUSHRA experiment with the same sounds.

    Parameters
    ----------
    a, b : two folders of sounds whose files have the same names, apart from the extension; or two files. One may be a
        folder of fits, whose sounds are paired with the recordings that they were fitted to.
    folder : existing folder for the output.
    reference : third folder or file. The test then also asks whether A or B is nearer to it. Default: A.
    trials : number of questions of each condition, shared among the names.
    seconds : maximum length of each sound, s.
    seed : seed of all random choices.
    exclude_invalid : leave out pairs of which a sound fails a check. Otherwise a failed check is an error.

    Returns
    -------
    The names of the sounds, those that were left out, and the number of questions.

    Raises
    ------
    ParameterError
        If `trials` or `seconds` is out of range.
    RecordingError
        If a sound cannot be read, fails a check, or differs from its pair in rate or channels.
    OutputError
        If a file cannot be written.

    Examples
    --------
    Middle C with two hammers:

    >>> from pathlib import Path
    >>> import pianofit
    >>> it = pianofit.typical("C4")
    >>> for name, mass in (("light", 0.8), ("heavy", 1.2), ("test", None)):
    ...     Path(name).mkdir()
    ...     if mass is not None:
    ...         hammer = it.hammer._replace(M_H=mass * it.hammer.M_H)
    ...         note = pianofit.Note(it.string, hammer, it.geometry, "bridge-force", gain=0.005)
    ...         pianofit.write_wav(f"{name}/C4.wav", note.render(2.0, seconds=2.0), 44_100)
    >>> pianofit.write_listening_test(Path("light"), Path("heavy"), Path("test"), trials=4).trials
    8
    """
    check_range("trials=", trials, 1, MAX_TRIALS)
    check_range("seconds=", seconds, 0.25, 30)
    sides, folder = [as_path(side) for side in (a, b, reference) if side is not None], as_path(folder)
    draw = np.random.default_rng(seed)
    labels, (groups, alone) = _labels(sides), pairs_of(sides)
    loaded = {name: load_pair(groups[name]) for name in sorted(draw.permutation([*groups])[:MAX_PAIRS].tolist())}
    messages = {
        name: [f"{printable(r.path)}: {text}" for r in group for text in failures(r)] for name, group in loaded.items()
    }
    failed = [message for own in messages.values() for message in own]
    kept = {name: group for name, group in loaded.items() if not messages[name]}
    if failed and not (exclude_invalid and kept):
        raise RecordingError(f"{'; '.join(failed)} (--exclude-invalid leaves such sounds out, if others remain)")
    rate = _check_formats(list(kept.values()))
    cases = [
        _cut_sounds(name, labels, kept[name], seconds) for name in sorted(draw.permutation([*kept])[:trials].tolist())
    ]
    questions = [question for part in _conditions(cases) for question in _balanced_trials(part, trials, draw)]
    clips = write_listening(
        folder / "listen.html",
        questions,
        rate,
        LEAD,
        seed,
        program="pianofit listen",
        about=f"{counted(len(cases), 'sound')}, each in two versions",
        key=folder / "key.json",
        seconds=seconds,
        origin=f"the same sounds in {'a third version' if reference else 'one of the two versions'}",
    )
    write_experiment(folder / "webmushra", clips, labels[-1] if reference else labels[0])
    return ListeningSummary(
        [case[0].case for case in cases], alone, failed, sum(question.times for question in questions)
    )


def _labels(sides: list[Path]) -> list[str]:
    """Names of the sides, with as many parent folders as needed to make them different."""
    for ending in (False, True):
        ends = [(*side.resolve().parts[:-1], side.name if ending else side.stem) for side in sides]
        for depth in range(1, max(map(len, ends)) + 1):
            labels = ["/".join(parts[-depth:]) for parts in ends]
            if len({*labels}) == len(labels) and all(labels):
                return [printable(label) for label in labels]
    raise RecordingError(f"{printable(sides[0])}: is given twice; give two different folders or files")


def _check_formats(groups: list[list[Recording]]) -> int:
    """Check that all sounds have one rate, and those of a pair the same channels. Return the rate, Hz."""
    first = groups[0][0]
    for group in groups:
        for sound in group:
            if sound.rate != first.rate:
                raise RecordingError(
                    f"{printable(sound.path)}: has {sound.rate} Hz, {printable(first.path)} {first.rate}; resample one"
                )
            if len(sound.frames) != len(group[0].frames):
                raise RecordingError(
                    f"{printable(sound.path)}: has {counted(len(sound.frames), 'channel')}, {printable(group[0].path)} "
                    f"has {len(group[0].frames)}; give both the same channels"
                )
    return first.rate


def _cut_sounds(name: str, labels: list[str], group: list[Recording], seconds: float) -> list[ListeningSound]:
    """Cut the sounds of a name to their onsets and to one length."""
    rate = group[0].rate
    lead = round(LEAD * rate)
    size = min(lead + min(len(sound.samples) - sound.onset for sound in group), round(seconds * rate))
    fade = np.hanning(lead)[: lead // 2]
    found = []
    for label, sound in zip(labels, group, strict=True):
        begin = sound.onset - lead
        cut = np.pad(sound.frames[:, max(begin, 0) : begin + size], ((0, 0), (max(-begin, 0), 0)))
        cut[:, : len(fade)] *= fade
        found.append(ListeningSound(label, name, cut))
    return found


def _conditions(cases: list[list[ListeningSound]]) -> list[list[Question]]:
    """Questions of each condition, one for each name."""
    if len(cases[0]) == 2:
        return [[Question(a, (a, b), kind="abx") for a, b in cases], [Question(a, (a, b)) for a, b in cases]]
    return [
        [Question(a, (a, b), kind="abx") for a, b, _ in cases],
        [Question(r, (a, b)) for a, b, r in cases],
        [Question(r, (r, a)) for a, _, r in cases],
        [Question(r, (r, b)) for _, b, r in cases],
    ]


def _balanced_trials(questions: list[Question], trials: int, draw: np.random.Generator) -> list[Question]:
    """Distribute `trials` repetitions evenly over the questions. The seed draws the questions that get one more."""
    base, remainder = divmod(trials, len(questions))
    times = dict.fromkeys(draw.permutation(len(questions))[:remainder].tolist(), base + 1)
    asked = [question._replace(times=times.get(n, base)) for n, question in enumerate(questions)]
    return [question for question in asked if question.times]
