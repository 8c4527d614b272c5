"""Batches for the tests: small libraries, quick work that can go wrong on demand, and drivers to be killed.

`quick_work` replaces `fit_job`. Its files depend only on the contents of the recordings, so a batch that was killed and
resumed can be compared exactly. The first word of a recording selects an error. Real fits are tested on few keys.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pianofit.batch.fit_job import JobResult
from pianofit.batch.job import Job, Settings, Source, versions

TESTS = Path(__file__).parent
NOTES = ("C", "C#", "D", "D#", "E", "F", "F#", "G", "G#", "A", "A#", "B")


def quick_work(
    job: Job,
    contents: Sequence[bytes] | None = None,
    scratch: str | None = None,
    report_stage: Callable[[str], None] = lambda _: None,
) -> JobResult:
    """Files computed from the contents of the recordings in about 0.1 s, or the error that the first word selects."""
    data = [Path(s.path).read_bytes() for s in job.sources] if contents is None else list(contents)
    word, _, rest = data[0].partition(b" ")
    report_stage("hammer")
    if word == b"die":
        os.kill(os.getpid(), signal.SIGKILL)
    if word == b"die-once" and not (marker := Path(rest.decode())).exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if word == b"hang":
        time.sleep(600)
    if word == b"swell":
        try:
            np.ones(2**32)
        except MemoryError:
            return JobResult({}, "not enough memory")
    if word == b"refuse":
        return JobResult({}, rest.decode(), detected_note="C5" if b"sounds" in rest else "")
    if word == b"full":
        return JobResult({}, "/scratch: cannot be written (No space left on device); make room", stop=True)
    slow = float(rest) if word == b"slow" else 0.02
    time.sleep(slow + 0.001 * (data[0][-1] % 50))
    digest = hashlib.sha256(b"".join(data)).hexdigest()
    document = {"parameters": {"c": {"value": int(digest[:12], 16) / 7}}, "note": job.note}
    files = {"fit.json": json.dumps(document).encode(), "fitted.wav": data[0] * 5000}
    return JobResult(files, detail=str(os.getpid()), seconds=slow, memory=1)


def library(folder: Path, contents: Sequence[str]) -> list[Job]:
    """One job for each text, from A0 upwards. Its only recording contains the text."""
    folder.mkdir(exist_ok=True)
    jobs = []
    for i, text in enumerate(contents):
        note = f"{NOTES[(9 + i) % 12]}{(9 + i) // 12}"
        file = folder / f"{note.replace('#', 's')}.wav"
        if not file.exists() or file.read_text(encoding="utf-8") != text:  # leaves no partial file if killed
            file.write_text(text, encoding="utf-8")
        source = Source(str(file), file.name, hashlib.sha256(text.encode()).hexdigest())
        jobs.append(Job(file.stem, note, (source,), Settings(), versions()))
    return jobs


def results(out: Path) -> dict[str, dict[str, bytes]]:
    """Contents of the folder of every key. Times and machine figures are removed from the record."""
    found = {}
    for folder in sorted((out / "keys").iterdir()):
        files = {p.name: p.read_bytes() for p in sorted(folder.iterdir())}
        record = json.loads(files.pop("record.json"))
        for name in ("seconds", "memory", "finished"):
            record.pop(name)
        assert record["files"] == {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
        files["record"] = json.dumps(record, sort_keys=True).encode()
        found[folder.name] = files
    return found


def python(code: str, *arguments: object, **more) -> subprocess.Popen:
    """Run `code` in another Python process that can import the modules of the tests."""
    where = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-c", code, *map(str, arguments)]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, env=os.environ | {"PYTHONPATH": where}, stdout=pipe, stderr=pipe, text=True, **more
    )


def drive(source: str, out: str, scheduler: str = "") -> None:
    """Run a batch over the files in `source` with `quick_work`, in a driver process."""
    from pianofit.batch import DaskPool, ProcessPool, run_batch

    # If the tests run in the background, Ctrl-C may be ignored, and child processes inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    texts = [p.read_text(encoding="utf-8") for p in _in_order(Path(source))]
    jobs = library(Path(source), texts)

    def workers(store):
        if scheduler:
            return DaskPool(scheduler, by_value=True, work=quick_work)
        return ProcessPool(2, 2**31, 60.0, store.scratch, work=quick_work)

    found = run_batch(jobs, Path(out), workers, tell=lambda p: print(p.event, flush=True) if p.event else None)
    print(json.dumps(found.counts))


def _in_order(folder: Path) -> list[Path]:
    """Files of the library in the order of their notes."""
    from pianofit.batch.manifest import read_keys

    return [key.samples[0].file for key in read_keys(folder, pattern="{note}")[0]]


DRIVE = "import sys, batch_cases; batch_cases.drive(*sys.argv[1:])"
CLI = "import sys; from pianofit.cli import main; sys.exit(main())"


def killed(process: subprocess.Popen) -> None:
    """Kill a process by SIGKILL, and wait for its end."""
    process.kill()
    process.communicate()


def struck(
    file: Path, midi: float, velocity: float, *, seconds: float = 1.5, rate: int = 22_050, seed: int = 0
) -> None:
    """Write a synthetic recording of a typical string, struck at `velocity` m/s, with noise 60 dB below."""
    from pianofit.io.files import encode_wav
    from pianofit.literature import typical
    from pianofit.model import simulate

    piano = typical(midi)
    hammer = piano.hammer._replace(v_H0=velocity)
    strike = simulate(piano.string, hammer, piano.geometry, rate=rate, quantity="bridge-force")
    samples = np.pad(strike.waveform(rate, int(seconds * rate)), (rate // 20, 0))
    random = np.random.default_rng([seed, round(10 * midi), round(100 * velocity)])
    samples += random.normal(0.0, 1e-3 * np.sqrt(np.mean(samples[rate // 20 :][:rate] ** 2)), len(samples))
    file.write_bytes(encode_wav(0.7 * samples / np.abs(samples).max(), rate))
