"""Hostile files for every reader: valid ones, spoilt by a seeded hand, must be read or refused in one line.

    python benchmarks/fuzz.py                          3,000 of each kind, about four minutes
    python benchmarks/fuzz.py --kinds midi,setup --count 500 --seed 7
    python benchmarks/fuzz.py --keep faults            what went wrong, as files to look at

Of each case the reader may return, or raise a `PianofitError` whose message is one line that names the file. Anything
else is a fault: another exception, a warning, more than LONGEST seconds of processor time, more memory than MOST
allows, a file that was not there before. Text is spoilt by its tokens, JSON by its values too, bytes by bits, cuts,
repeats and lengths.
Kinds: wav, flac, rf64, w64, aiff, aifc, caf, au, vorbis, opus, mp3, setup (TOML), fit, fit-knock, note (of a page to
play) and instrument (JSON, FLAC), midi, sfz, csv, answers, extras and dataset (JSON), keys (fits that an instrument is
made of).
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import copy
import dataclasses
import functools
import io
import json
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

# Processor time of one case, s; and of the process with all its libraries, bytes of address space beyond what it has at
# the begin.
LONGEST, MOST = 5.0, 2**30
IMPORTS = 60.0  # s, for the valid file of a kind: its reader also imports libraries
# What stands in the place of numbers, texts and lengths.
NUMBERS = (
    0, -1, 1, 127, 128, 255, 256, 2**15, 2**16, 2**31, 2**32 - 1, 2**53, 10**400, 0.0, -0.0, 1e-320, 1e308, -1e308,
    float("nan"), float("inf"), float("-inf"), 0.1, 1e9,
)  # fmt: skip
TEXTS = ("", " ", "\0", "a\nb", "\x1b[31m", "../../x", "é" * 300, "9" * 5000, "nan", "[[", "{", "\udc80", "1e999", "-")
VALUES: tuple[Any, ...] = (*NUMBERS, *TEXTS, None, True, [], {}, [[[]]], [None] * 3, {"value": None}, "0x10")


# Containers of sound, the names of libsndfile for them, and for what they hold.
CONTAINERS = (
    ("rf64", "RF64", "PCM_24"), ("w64", "W64", "PCM_24"), ("aiff", "AIFF", "PCM_24"), ("aifc", "AIFF", "FLOAT"),
    ("caf", "CAF", "PCM_24"), ("au", "AU", "PCM_16"), ("vorbis", "OGG", "VORBIS"), ("opus", "OGG", "OPUS"),
    ("mp3", "MP3", "MPEG_LAYER_III"),
)  # fmt: skip


class Kind(NamedTuple):
    """A format: a valid file, and who reads it."""

    name: str  # of the file
    valid: bytes
    read: Callable[[Path], Any]
    text: bool = False
    beside: dict[str, bytes] = {}  # noqa: RUF012 - other files of the folder, never changed


class SlowCaseError(Exception):
    """A case that took too long."""


# --- how files are spoilt ---------------------------------------------------------------------------------------------


def spoilt_bytes(data: bytes, draw: np.random.Generator) -> bytes:
    """One to four changes of bytes, most of them near the begin, where the headers are."""
    out = bytearray(data)
    for _ in range(draw.integers(1, 5)):
        at = int(len(out) * draw.random() ** (6 if draw.random() < 0.7 else 1)) if out else 0
        what, size = draw.integers(7), int(2 ** (draw.random() * 8))
        if what == 0 and out:
            out[at % len(out)] ^= 1 << int(draw.integers(8))
        elif what == 1:
            del out[at : at + size]
        elif what == 2:
            out[at:at] = draw.bytes(size)
        elif what == 3:
            out[at:at] = out[at : at + size] * int(draw.integers(1, 50))
        elif what == 4:
            del out[at:]
        else:
            width = int(draw.choice([1, 2, 4, 8]))
            number = int(draw.choice([0, 1, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**63]))
            out[at : at + width] = (number % 2 ** (8 * width)).to_bytes(width, "little" if what == 5 else "big")
    return bytes(out)


def spoilt_text(data: bytes, draw: np.random.Generator) -> bytes:
    """Tokens replaced, lines moved, repeated or lost."""
    lines = data.decode().split("\n")
    for _ in range(draw.integers(1, 4)):
        at = int(draw.integers(len(lines)))
        what = draw.integers(5)
        if what == 0:
            lines.insert(at, lines[int(draw.integers(len(lines)))])
        elif what == 1 and len(lines) > 1:
            del lines[at]
        elif what == 2:
            lines[at] = lines[at] * min(int(draw.integers(2, 200)), 1 + 2**20 // (1 + len(lines[at])))
        else:
            words = lines[at].replace("=", " = ").replace(",", " , ").split(" ")
            words[int(draw.integers(len(words)))] = str(VALUES[int(draw.integers(len(VALUES)))])
            lines[at] = " ".join(words).replace(" = ", "=" if what == 3 else " = ").replace(" , ", ",")
    return "\n".join(lines).encode("utf-8", errors="surrogateescape")


def spoilt_json(data: bytes, draw: np.random.Generator) -> bytes:
    """Values replaced, moved, repeated or lost, anywhere."""
    document = json.loads(data)
    for _ in range(draw.integers(1, 4)):
        places = list(_places(document))
        if not places:
            break
        # First how deep, then where: else the long columns of a table would have all.
        depth = draw.choice(sorted({len(place[2]) for place in places}))
        of = [place for place in places if len(place[2]) == depth]
        holder, key, _ = of[int(draw.integers(len(of)))]
        what = draw.integers(4)
        if what == 0:
            del holder[key]
        elif what == 1:
            other, name, _ = places[int(draw.integers(len(places)))]
            holder[key] = json.loads(json.dumps(other[name]))
        else:
            holder[key] = copy.deepcopy(VALUES[int(draw.integers(len(VALUES)))])  # else they hold each other
    return json.dumps(document).encode("utf-8", errors="surrogateescape")


def _places(document: Any, path: tuple = ()) -> Iterator[tuple[Any, Any, tuple]]:
    if not isinstance(document, dict | list):
        return
    for key, value in list(document.items() if isinstance(document, dict) else enumerate(document))[:40]:
        yield document, key, (*path, key)
        yield from _places(value, (*path, key))


def spoilt(kind: Kind, draw: np.random.Generator) -> bytes:
    """The file, spoilt in one of the ways that suit it."""
    ways = [spoilt_bytes]
    if kind.text:
        ways = [spoilt_text, spoilt_text, spoilt_bytes]
    if kind.name.endswith(".json"):
        ways = [spoilt_json] * 8 + [spoilt_text, spoilt_bytes]
    return ways[int(draw.integers(len(ways)))](kind.valid, draw)


# --- the formats ------------------------------------------------------------------------------------------------------


def _sound(file_format: str, subtype: str) -> bytes:
    import soundfile

    rate = 8_000
    t = np.arange(rate // 2) / rate
    note = np.pad(0.5 * np.exp(-3 * t) * np.sin(2 * np.pi * 220 * t), (100, 0))
    stream = io.BytesIO()
    soundfile.write(stream, np.stack([note, 0.9 * note], axis=1), rate, format=file_format, subtype=subtype)
    return stream.getvalue()


def _song() -> bytes:
    import mido

    file = mido.MidiFile(ticks_per_beat=480)
    track = mido.MidiTrack()
    file.tracks.append(track)
    track.append(mido.MetaMessage("set_tempo", tempo=400_000))
    track.append(mido.Message("control_change", control=64, value=127))
    for key in (60, 64, 67):
        track.append(mido.Message("note_on", note=key, velocity=80, time=0))
        track.append(mido.Message("note_off", note=key, velocity=0, time=240))
    stream = io.BytesIO()
    file.save(file=stream)
    return stream.getvalue()


@functools.cache
def _documents() -> tuple[bytes, bytes, bytes, bytes]:
    """A fit.json that rings, its knock, a note.json that holds its own, and an instrument.json."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from instrument_cases import ERRORS, fit_document, library, true_note
    from page_cases import ringing_note

    from pianofit.instrument import build_instrument, find_fits, load_keys
    from pianofit.instrument.files import instrument_record
    from pianofit.io.files import encode_wav
    from pianofit.schema.decode import builtins_of
    from pianofit.schema.modal_response import FittedModalResponse, Knock, ModalResponseEntry, encode_knock

    response = ringing_note(60).modal_response
    assert response is not None  # noqa: S101
    entry, embedded = (ModalResponseEntry.of(response, embed_knock=embed) for embed in (False, True))
    wav = Knock(1.0, response.rate, wav=base64.b64encode(encode_wav(response.knock, response.rate)).decode())
    with_wav = FittedModalResponse(response=dataclasses.replace(entry, knock=wav))
    fit = fit_document(true_note(60), ERRORS)
    note = fit | {"kind": "note", "modal_response": builtins_of(with_wav)}
    fit["modal_response"] = builtins_of(FittedModalResponse(response=entry))
    with tempfile.TemporaryDirectory() as folder:
        keys = load_keys(find_fits([library(Path(folder), [48, 60])]))
    instrument = builtins_of(instrument_record(build_instrument(keys, "fuzz")))
    instrument["keys"] = instrument["keys"][36:44]
    instrument["keys"][3]["modal_response"] = builtins_of(embedded)
    knock = encode_knock(response) or b""
    return json.dumps(fit).encode(), knock, json.dumps(note).encode(), json.dumps(instrument).encode()


def _extras() -> bytes:
    """An extras.json with a damper, a release noise and a noise floor."""
    from pianofit.schema.decode import builtins_of
    from pianofit.schema.extras import DamperEntry, KeyExtras, NoiseFloor, SoundEntry

    row = np.array([100.0, 1000.0])
    damper = DamperEntry(
        file="a.wav", sha256="0", release_s=1.0, log_rate=4.0, slope=0.2, covariance=0.01 * np.eye(2),
        frequency=row, rate=0.1 * row, rate_error=0.01 * row,
    )  # fmt: skip
    release = SoundEntry.of(np.full((1, 64), 0.1), 8_000)
    extras = KeyExtras(midi=60, dampers=(damper,), releases=(release,), noise=NoiseFloor(row, (1e-12 * row,)))
    return json.dumps(builtins_of(extras)).encode()


def _dataset() -> bytes:
    """A dataset.json as it is written."""
    from pianofit.schema.dataset import Column, DatasetFile, NoteOptions
    from pianofit.schema.decode import builtins_of

    options = NoteOptions(keys=("C3", 72), noise_db=(40.0, 70.0))
    record = DatasetFile(
        pianofit="1.0", seed=1, count=2, format="flac", options=options, around_sha256=None,
        path_frequencies_hz=(100.0, 200.0), columns=(Column("f0", "Hz", "fundamental frequency"),),
    )  # fmt: skip
    return json.dumps(builtins_of(record)).encode()


def kinds() -> dict[str, Kind]:
    """Every format that is read."""
    import pianofit
    from pianofit.batch.manifest import read_keys
    from pianofit.instrument import load_instrument, load_keys
    from pianofit.listening.result import count_answers
    from pianofit.playback import load_song
    from pianofit.schema.dataset import read_dataset_file
    from pianofit.schema.extras import read_extras

    fit, knock, note, instrument = _documents()
    wav, flac = _sound("WAV", "PCM_16"), _sound("FLAC", "PCM_16")
    setup = (
        b'felt.law = "stulov"\n[string]\nlength = 1.2\nmass = 0.006\n[strike]\nposition = 0.12\nwidth = 0.02\n'
        b'[pickup]\nquantity = "velocity"\nposition = 0.3\nscale = 2.0\n[fixed]\nM_H = 0.008\n'
        b"[initial]\nc = 310.0\n[bounds]\n"
        b'K_H = [1e8, 1e12]\n[[recording]]\nfile = "a.wav"\nv_H0 = 2.0\ngroup = "close"\nstroke = "one"\n'
    )
    table = b"file,note,instrument,layer,v_H0,group\na.wav,A3,grand,1,1.5,close\nb.wav,A3,grand,2,3.0,close\n"
    sfz = (
        b"#define $KEY 57\n<control> default_path=./\n<global> amp_veltrack=0\n<group> lovel=1 hivel=64\n"
        b"<region> sample=a.wav key=$KEY\n<group> lovel=65 hivel=127\n<region> sample=b.wav lokey=57 hikey=57 "
        b"pitch_keycenter=57\n// end\n"
    )
    trials = [{"condition": "ABX", "chosen": "a", "hit": "b", "case": "A3"}] * 3
    sounds = {"a.wav": wav, "b.wav": wav}
    answers = {"schema": 2, "trials": trials}
    return {
        "wav": Kind("case.wav", wav, pianofit.load_recording),
        "flac": Kind("case.flac", flac, pianofit.load_recording),
        **{
            name: Kind(f"case.{name}", _sound(container, codec), pianofit.load_recording)
            for name, container, codec in CONTAINERS
        },
        "setup": Kind("case.toml", setup, pianofit.Setup.from_toml, text=True),
        "fit": Kind(
            "case.json", fit, lambda path: (pianofit.load_note(path), repr(pianofit.Result.load(path))),
            beside={"knock.flac": knock},
        ),
        "fit-knock": Kind(
            "knock.flac", knock, lambda path: pianofit.load_note(path.with_name("fit.json")), beside={"fit.json": fit}
        ),
        "note": Kind("case.json", note, pianofit.load_note),
        "keys": Kind("fit.json", fit, lambda path: load_keys([path]), beside={"knock.flac": knock}),
        "instrument": Kind("case.json", instrument, load_instrument),
        "midi": Kind("case.mid", _song(), load_song),
        "sfz": Kind("case.sfz", sfz, read_keys, text=True, beside=sounds),
        "csv": Kind("case.csv", table, read_keys, text=True, beside=sounds),
        "answers": Kind("case.json", json.dumps(answers).encode(), lambda path: count_answers([path])),
        "extras": Kind("extras.json", _extras(), read_extras),
        "dataset": Kind("dataset.json", _dataset(), read_dataset_file),
    }  # fmt: skip


# --- the trial --------------------------------------------------------------------------------------------------------


def fault(kind: Kind, data: bytes, folder: Path, longest: float = LONGEST) -> str | None:
    """What a reader does wrong with a file, in a line; None where it reads or refuses it as it should."""
    from pianofit.errors import PianofitError

    path = folder / kind.name
    path.write_bytes(data)
    before, began = sorted(folder.rglob("*")), time.process_time()
    found = None
    try:
        with warnings.catch_warnings(), _within(longest):
            warnings.simplefilter("error")
            kind.read(path)
    except PianofitError as error:
        words = str(error)
        if not words.isprintable():
            found = f"a message of several lines or with controls: {words!r:.200}"
        elif folder.name not in words and not any(name in words for name in (path.stem, *kind.beside)):
            found = f"a message that names no file: {words:.200}"
    except SlowCaseError:
        found = f"more than {longest} s"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        own = [frame for frame in traceback.extract_tb(error.__traceback__) if "pianofit" in frame.filename]
        at = f"{Path(own[-1].filename).name}:{own[-1].lineno}" if own else "?"
        found = f"{type(error).__name__} at {at}: {str(error)[:150]!r}"
    if found is None and time.process_time() - began > longest:
        found = f"more than {longest} s"
    if found is None and sorted(folder.rglob("*")) != before:
        found = "it wrote something"
    return found


@contextlib.contextmanager
def _within(seconds: float) -> Iterator[None]:
    def late(*_: object) -> None:
        raise SlowCaseError

    signal.signal(signal.SIGPROF, late)  # processor time: other programs may use the machine
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _hold_memory() -> None:
    """Let no case take more than MOST beyond what the process has."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST, used + MOST))


def main() -> None:
    """Spoil, read, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", default="", help="separated by commas; all if not given")
    parser.add_argument("--count", type=int, default=3000, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="a folder for the files that show a fault")
    options = parser.parse_args()
    every = kinds()
    chosen = [x for x in options.kinds.split(",") if x] or list(every)
    _hold_memory()
    total = 0
    for name in chosen:
        kind, faults, slowest, began = every[name], Counter[str](), 0.0, time.perf_counter()
        draw = np.random.default_rng([options.seed, *name.encode()])
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            for other, content in kind.beside.items():
                (folder / other).write_bytes(content)
            if wrong := fault(kind, kind.valid, folder, IMPORTS):
                sys.exit(f"{name}: the valid file is not read: {wrong}")
            for n in range(options.count):
                data = spoilt(kind, draw)
                start = time.process_time()
                found = fault(kind, data, folder)
                slowest = max(slowest, time.process_time() - start)
                if found:
                    faults[found] += 1
                    if options.keep and faults[found] == 1:
                        options.keep.mkdir(parents=True, exist_ok=True)
                        (options.keep / f"{name}-{n}-{kind.name}").write_bytes(data)
        total += faults.total()
        took = time.perf_counter() - began
        print(f"{name}: {options.count} cases, {faults.total()} faults, slowest {slowest:.2f} s, {took:.0f} s in all")
        for words, times in faults.most_common(20):
            print(f"  {times:5} {words}", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print(f"{total} faults; the process had at most {peak:.0f} MiB, {sys.platform}")
    sys.exit(1 if total else 0)


if __name__ == "__main__":
    main()
