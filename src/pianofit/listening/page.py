"""Page of a blind listening test: which of two sounds is the third, or is nearer to it.

A seed determines the order of the questions and the sides of the sounds before the page is written. The page names
sounds by random numbers, and has their identity in an encoded form. A key next to the page has it as plain text. All
sounds are equally loud. The page saves the answers as JSON.
"""

import base64
import json
import os

import numpy as np

from .. import __version__
from ..io.files import replace_file
from ..report.html import write_page
from ..report.sound import Clip, make_clips
from ..schema.decode import builtins_of, encode_json
from ..schema.listening import ListeningKey, SoundIdentity
from .trials import KINDS, ListeningSound, Question, draw_trials

# Time that a listener needs for one question, min.
MINUTES = 0.25


def write_listening(
    path: str | os.PathLike[str],
    questions: list[Question],
    rate: int,
    onset: float,
    seed: int,
    *,
    program: str,
    about: str,
    origin: str,
    key: str | os.PathLike[str],
    seconds: float = 8.0,
) -> list[tuple[ListeningSound, Clip]]:
    """Write the page and its key.

    Parameters
    ----------
    onset : onset in all sounds, s.
    seed : seed of the order, the sides, every X and the names of the sounds.
    program : name of the program, for the footer and the saved answers.
    about : subject of the test, follows "A blind listening test on".
    origin : origin of the references, follows "The references are".
    key : path of a JSON file with the identity of each sound by name, and the trials in their order.
    seconds : maximum length of each sound, s.

    Returns
    -------
    The sounds, each with its clip as it is played.

    Raises `OutputError` if a file cannot be written.
    """
    draw = np.random.default_rng(seed)
    sounds = list(dict.fromkeys(sound for q in questions for sound in (q.reference, *q.pair)))
    names = {sound: f"s{n:03d}" for sound, n in zip(sounds, draw.permutation(len(sounds)), strict=True)}
    trials = tuple(draw_trials(questions, names, draw))
    clips = make_clips({name: sound.samples for sound, name in names.items()}, rate, onset, seconds=seconds)
    hidden = ListeningKey(
        program=program,
        version=__version__,
        seed=seed,
        sounds={name: SoundIdentity(sound.what, sound.case) for sound, name in names.items()},
        trials=trials,
    )
    test = {name: getattr(hidden, name) for name in ("schema", "program", "version", "seed")} | {
        "sounds": {clip.name: clip.text for clip in sorted(clips, key=lambda c: c.name)},
        "hidden": base64.b64encode(json.dumps(builtins_of(hidden)).encode()).decode(),
    }
    write_page(
        path,
        "listening.html.j2",
        package="pianofit.listening",
        styles=("listening.css",),
        scripts=("audio.js", "listening.js"),
        title="A blind listening test",
        test=test,
        counts={kind: sum(trial.kind == kind for trial in trials) for kind in KINDS},
        count=len(trials),
        about=about,
        origin=origin,
        minutes=max(1, round(MINUTES * len(trials))),
        controls=sum(trial.condition.startswith("hidden reference") for trial in trials),
    )
    replace_file(key, encode_json(hidden))
    return [*zip(sounds, clips, strict=True)]
