"""Listening test for webMUSHRA: sounds are graded against the reference, and compared in pairs.

webMUSHRA (Schoeffler et al., "webMUSHRA – A comprehensive framework for web-based listening tests", Journal of Open
Research Software 6, 2018) is a separate server. This module writes its configuration and its sounds.
"""

import json
from pathlib import Path
from typing import Any

from ..errors import OutputError
from ..io.files import printable, replace_file
from ..report.sound import Clip
from .trials import ListeningSound

# Folder of the sounds, relative to the root of webMUSHRA.
SOUNDS = "configs/resources/pianofit"
GRADE = "Grade each sound against the reference. One of them is the reference itself."
PAIR = "Which of the two is the reference?"
# Block size, samples, as in the examples of webMUSHRA.
BUFFER = 2048


def write_experiment(folder: Path, clips: list[tuple[ListeningSound, Clip]], reference: str) -> None:
    """Write `configs/pianofit.yaml` and the sounds, to be copied into webMUSHRA.

    Parameters
    ----------
    folder : created if needed.
    reference : name of the set whose sounds are the references. Each case has a page of BS.1116, and a forced pair for
        each other sound.

    Raises `OutputError` if a file cannot be written.
    """
    sounds = folder / SOUNDS
    try:
        sounds.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{printable(sounds)}: cannot create the folder ({error.strerror}); choose another") from None
    cases: dict[str, dict[str, str]] = {}
    for sound, clip in clips:
        replace_file(sounds / f"{clip.name}.wav", clip.wav)
        cases.setdefault(sound.case, {})[sound.what] = f"{SOUNDS}/{clip.name}.wav"
    pages: list[Any] = ["random"]
    for n, case in enumerate(cases.values(), 1):
        others = {f"C{k}": file for k, file in enumerate((f for what, f in case.items() if what != reference), 1)}
        standard = case[reference]
        pages.append(_page("bs1116", f"grade{n}", GRADE, standard, others, createAnchor35=False, createAnchor70=False))
        pages += [
            _page("paired_comparison", f"pair{n}{name}", PAIR, standard, {name: file}) for name, file in others.items()
        ]
    end = {"type": "finish", "name": "Thank you", "content": "Your answers are saved.", "writeResults": True}
    settings = {
        "testname": "A blind listening test",
        "testId": "pianofit",
        "bufferSize": BUFFER,
        "stopOnErrors": True,
        "showButtonPreviousPage": False,
        "remoteService": "service/write.php",
        "pages": [pages, end],
    }
    # JSON is YAML: https://yaml.org/spec/1.2.2, 1.3.
    replace_file(folder / "configs" / "pianofit.yaml", (json.dumps(settings, indent=2) + "\n").encode())


def _page(kind: str, name: str, content: str, reference: str, stimuli: dict[str, str], **more: Any) -> dict[str, Any]:
    return {
        "type": kind,
        "id": name,
        "name": "Listen",
        "content": content,
        "showWaveform": False,
        "enableLooping": False,
        "reference": reference,
        **more,
        "stimuli": stimuli,
    }
