"""Quick work for batches in two passes: the `fit.json` of a synthetic piano, which records the prior of its setup."""

from __future__ import annotations

import json
import time
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

from batch_cases import quick_work
from instrument_cases import ERRORS, fit_document, true_note

from pianofit.analysis.note_names import note_to_midi
from pianofit.batch.fit_job import JobResult
from pianofit.batch.job import Job


def note_work(
    job: Job,
    contents: Sequence[bytes] | None = None,
    scratch: str | None = None,
    report_stage: Callable[[str], None] = lambda _: None,
) -> JobResult:
    """Files of a true key. The first word of a recording selects an error of `quick_work`, or one of the second pass.

    `no-second` refuses the second fit, and a number is a factor of the hammer mass.
    """
    text = Path(job.sources[0].path).read_text(encoding="utf-8").split()
    if text[0] == "refuse":
        return quick_work(job, contents, scratch, report_stage)
    prior = tomllib.loads(job.setup).get("prior")
    if prior is not None and text[0] == "no-second":
        return JobResult({}, "has no second fit")
    if prior is not None and text[0] == "stop":
        time.sleep(0.5)  # the other keys are done by then
        return JobResult({}, "/scratch: cannot be written", stop=True)
    note = true_note(note_to_midi(job.note))
    factor = float(text[1]) if len(text) > 1 else 1.0
    note = note._replace(hammer=note.hammer._replace(M_H=factor * note.hammer.M_H))
    document = fit_document(note, ERRORS) | {"prior": prior}
    return JobResult({"fit.json": json.dumps(document).encode()}, seconds=0.1, memory=1)
