"""The same sounds as an experiment for webMUSHRA: graded against the reference, and paired.

webMUSHRA (Schoeffler et al., "webMUSHRA – A comprehensive framework for web-based listening tests", Journal of Open
Research Software 6, 2018) is a server of its own. What stands here is what it reads: a configuration and sounds.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..errors import OutputError
from ..io.files import printable, replace_file
from ..report.sound import Clip
from .page import TestSound

__all__ = ["write_experiment"]

# Where webMUSHRA looks for what is ours, from its own root.
SOUNDS = "configs/resources/pianofit"
GRADE = "Grade each sound against the reference. One of them is the reference itself."
PAIR = "Which of the two is the reference?"
# webMUSHRA's own block, samples; its examples have this.
BUFFER = 2048


def write_experiment(folder: Path, clips: list[tuple[TestSound, Clip]], reference: str) -> None:
    """Write `configs/pianofit.yaml` and the sounds, to be copied into a webMUSHRA.

    Parameters
    ----------
    folder : is made.
    reference : what the references are; a page of BS.1116 and a forced pair for each other sound of a case.

    Raises `OutputError` if a file cannot be written.
    """
    sounds = folder / SOUNDS
    try:
        sounds.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{printable(sounds)}: no folder can be made ({error.strerror}); choose another") from None
    cases: dict[str, dict[str, str]] = {}
    for heard, clip in clips:
        replace_file(sounds / f"{clip.name}.wav", clip.wav)
        cases.setdefault(heard.case, {})[heard.what] = f"{SOUNDS}/{clip.name}.wav"
    pages: list[Any] = ["random"]
    for n, case in enumerate(cases.values(), 1):
        others = {f"C{k}": file for k, file in enumerate((f for what, f in case.items() if what != reference), 1)}
        own = case[reference]
        pages.append(_page("bs1116", f"grade{n}", GRADE, own, others, createAnchor35=False, createAnchor70=False))
        pages += [
            _page("paired_comparison", f"pair{n}{name}", PAIR, own, {name: file}) for name, file in others.items()
        ]
    end = {"type": "finish", "name": "Thank you", "content": "Your answers are saved.", "writeResults": True}
    settings = {
        "testname": "A blind listening test", "testId": "pianofit", "bufferSize": BUFFER, "stopOnErrors": True,
        "showButtonPreviousPage": False, "remoteService": "service/write.php", "pages": [pages, end],
    }  # fmt: skip
    # JSON is YAML: https://yaml.org/spec/1.2.2, 1.3.
    replace_file(folder / "configs" / "pianofit.yaml", (json.dumps(settings, indent=2) + "\n").encode())


def _page(kind: str, name: str, content: str, reference: str, stimuli: dict[str, str], **more: Any) -> dict[str, Any]:
    return {
        "type": kind, "id": name, "name": "Listen", "content": content, "showWaveform": False, "enableLooping": False,
        "reference": reference, **more, "stimuli": stimuli,
    }  # fmt: skip
