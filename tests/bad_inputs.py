"""Corpus of invalid inputs. Each must cause a message of one line that names the input, not a traceback.

An entry builds its files in a folder. It has the command line to run there, a part of the message, and the exit code: 1
for an invalid input, 2 for an invalid command line. Entries whose `gate` is "recording" or "setup" are also tested with
`load_recording` and `Setup.from_toml` directly.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
from bad_files import AUDIO, PATHS, SETUPS, BadInput, encoded, file, good, note, pcm16, wav

__all__ = ["BAD_INPUTS", "BadInput", "encoded", "fit_dict", "note", "pcm16", "wav"]


def fit_dict(**values: object) -> dict:
    """Return the content of a fit.json with some parameter values changed."""
    values = {
        "c": 304.1, "kappa": 1.7, "b1": 0.6, "b2": 2e-6, "K_H": 1e10, "mu": 0.2, "p": 2.6, "M_H": 5.7e-3, "v_H0": 0.8,
        "M_S": 6.18e-3, "L": 1.0, "x0": 0.12, "width": 0.02, "pickup": 0.3,
    } | values  # fmt: skip
    facts = {"unit": "", "interval": None, "status": "fitted", "note": ""}
    criterion = {
        "bands": {"global": {"initial": 1.0, "final": 0.1}},
        "excluded_bands": [],
        "sigma": 30,
        "borders": [50.0, 150.0, 850.0, 950.0],
    }
    levels = {"initial_db": 9.0, "fitted_db": 1.0, "initial_hammer_db": None, "partials": 1}
    row = {
        "file": "a.wav", "sha256": "0" * 64, "channel": "mono", "rate": 44100, "onset_s": 0.0, "stroke_value": 0.8,
        "gain": 1.0,
        "stroke_interval": None, "stroke_status": "fitted", "stroke_initial": 0.8, "note": None,
        "gain_status": "fitted",
        "is_reference": True, "pitch_offset_cents": 0.0, "path_group": 0, "stroke": 0, "criterion": criterion,
        "levels": levels, "partials": {n: [1.0] for n in ("number", "measured", "error", "initial", "fitted")},
    }  # fmt: skip
    numbers = ("f0", "B", "f1", "reference_compression_mm", "glide_cents")
    return {
        "schema": 8, "program": "pianofit", "kind": "fit", "recipe": "default", "felt": "hunt-crossley", "seed": 0,
        "converged": True,
        "identifiability_statement": "", "warnings": [], "invariants": {}, "minima": [], "criterion": criterion,
        "parameters": {name: {"value": value, "initial": 1.0, **facts} for name, value in values.items()},
        "recordings": [row], "pickup": {"quantity": "velocity", "path": None}, "levels": levels,
        "derived": dict.fromkeys(numbers, 1.0) | {"recontacts": [], "glide": []},
        "diagnostics": {"evaluations": 1, "partials": 1}, "versions": {},
    }  # fmt: skip


def recording_dict(**values: object) -> dict:
    """Return the content of a fit.json with some values of its recording changed."""
    content = fit_dict()
    return content | {"recordings": [content["recordings"][0] | values]}


def fit_file(content: object) -> Callable[[Path], None]:
    return file("fit.json", content if isinstance(content, bytes) else json.dumps(content).encode())


def render(name: str, content: object, message: str) -> BadInput:
    """Return an entry that renders a bad fit.json."""
    args = ("render", "@/fit.json", "--velocity", "1.0", "--out", "@/sound.wav")
    return BadInput(f"render-{name}", fit_file(content), args, message)


def command(name: str, line: str, message: str, code: int = 1, build: Callable[[Path], None] = good) -> BadInput:
    """Return an entry for a command line. The folder has good.wav."""
    return BadInput(name, build, tuple(shlex.split(line)), message, code)


def occupied(folder: Path) -> None:
    """Build good.wav, fit.json, a file, and the outputs out/ and sound.wav of an earlier run."""
    good(folder)
    fit_file(fit_dict())(folder)
    (folder / "file").write_text("mine")
    (folder / "out").mkdir()
    (folder / "out" / "fit.json").write_text("mine")
    (folder / "sound.wav").write_bytes(encoded(note()))


def slow_hammer(folder: Path) -> None:
    """Build good.wav and a setup that bounds the velocity."""
    good(folder)
    (folder / "setup.toml").write_text("[bounds]\nv_H0 = [0.5, 2.0]\n")


def short_bass(folder: Path) -> None:
    """Build 300 ms of an A0: eight periods."""
    (folder / "short.wav").write_bytes(encoded(note(27.5, 0.3, lead=0.0)))


def two_sides(folder: Path) -> None:
    """Build sides of a listening test. Only a/ and b/ are a valid pair."""
    sides = {
        "a": encoded(note()), "b": encoded(0.5 * note()), "slower": encoded(note(rate=16_000), rate=16_000),
        "stereo": encoded(np.stack([note(), note()], axis=1)), "clipped": encoded(np.clip(3 * note(), -1, 0.95)),
    }  # fmt: skip
    for side, content in sides.items():
        (folder / side).mkdir()
        (folder / side / "note.wav").write_bytes(content)
    (folder / "other").mkdir()
    (folder / "other" / "tone.wav").write_bytes(sides["a"])


def answered(folder: Path) -> None:
    """Build the answers of a listening test."""
    trial = {"condition": "ABX", "chosen": "a", "hit": "b"}
    (folder / "answers.json").write_text(json.dumps({"schema": 2, "trials": [trial]}))


def result(name: str, content: object, message: str) -> BadInput:
    """Return an entry that counts a bad file of answers."""
    return BadInput(f"listen-result-{name}", fit_file(content), ("listen", "--result", "@/fit.json"), message)


def rings(imag: float, knock: dict | None = None, mode: float = 1.0) -> dict:
    """Return the content of a fit.json with one mode of one channel."""
    columns = {name: [mode] for name in ("partial", "frequency", "frequency_error", "decay", "decay_error")}
    response = {"modes": columns, "modal_amplitudes": [{"real": [1.0], "imag": [imag]}], "knock": knock}
    return fit_dict() | {"modal_response": {"response": response}}


def participates(velocity: list[float], parts: int = 1, size: float = 1.0) -> dict:
    """Return the content of a fit.json with one mode, whose velocity gain is given at these velocities."""
    content = rings(0.0)
    strokes = [{"real": [size] * parts, "imag": [0.0] * parts} for _ in velocity]
    content["modal_response"]["response"]["velocity_gain"] = {"velocity": velocity, "strokes": strokes}
    return content


def foreign_knock(folder: Path) -> None:
    """Build a fit.json with a knock that is named FLAC but is an MP3."""
    fit_file(rings(0.0, {"file": "knock.flac", "scale": 1.0, "rate": 44_100}))(folder)
    (folder / "knock.flac").write_bytes(b"ID3\x03" + bytes(400))


FALLING = {"frequency": [200.0, 100.0], "db": [0.0, 0.0]}
FIT = "fit @/good.wav --note A4 --out @/out"
SIMULATE = "simulate --preset bensa-final --out @/a.wav"
RENDER = "render @/fit.json --out @/a.wav"
COMMANDS = [
    command("fit-note-nonsense", "fit @/good.wav --note H9 --out @/out", "H9"),
    command("fit-note-empty", "fit @/good.wav --note '' --out @/out", "note"),
    command("fit-note-not-there", "fit @/good.wav --note F#2 --out @/out", "F#2"),
    command("fit-too-short-for-its-note", "fit @/short.wav --note A0 --out @/out", "give 0.36 s", build=short_bass),
    command("fit-velocity-zero", f"{FIT} --velocity 0", "velocity"),
    command("fit-velocity-negative", f"{FIT} --velocity -1", "velocity"),
    command("fit-velocity-absurd", f"{FIT} --velocity 1000", "velocity"),
    command("fit-velocity-nan", f"{FIT} --velocity nan", "velocity"),
    command(
        "fit-velocity-outside-bounds", f"{FIT} --velocity 3 --setup @/setup.toml", "--velocity 3.0", build=slow_hammer
    ),
    command("fit-velocity-word", f"{FIT} --velocity forte", "forte", 2),
    command("fit-seed-word", f"{FIT} --seed lucky", "lucky", 2),
    command("fit-seed-negative", f"{FIT} --seed -1", "seed"),
    command("fit-unknown-option", f"{FIT} --speed", "--speed", 2),
    command("fit-no-out", "fit @/good.wav --note A4", "--out", 2),
    command("fit-no-file", "fit --note A4 --out @/out", "RECORDING", 2),
    command("fit-recording-twice", "fit @/good.wav @/good.wav --note A4 --out @/out", "good.wav are the same"),
    command("fit-several-one-velocity", "fit @/good.wav @/b.wav --note A4 --velocity 2 --out @/out", "[[recording]]"),
    command("fit-several-one-missing", "fit @/good.wav @/none.wav --note A4 --out @/out", "none.wav"),
    command("cross-validate-one", "cross-validate @/good.wav --note A4", "1 recording is too few"),
    command("cross-validate-none", "cross-validate --note A4", "RECORDING", 2),
    command("predict-no-fit", "predict @/none.json @/good.wav", "none.json"),
    command("predict-not-a-fit", "predict @/good.wav @/good.wav", "good.wav"),
    command("predict-out-in-no-folder", "predict @/fit.json @/good.wav --out @/none/a.wav", "does not exist"),
    command("fit-out-not-empty", FIT, "--force", build=occupied),
    command("fit-out-is-a-file", "fit @/good.wav --note A4 --out @/file", "file", build=occupied),
    command("fit-out-under-a-file", "fit @/good.wav --note A4 --out @/file/out", "file/out", build=occupied),
    command("analyse-note-nonsense", "analyse @/good.wav --note Q4", "Q4"),
    command("analyse-note-out-of-range", "analyse @/good.wav --note C99", "C99"),
    command("analyse-f0-zero", "analyse @/good.wav --f0 0", "f0"),
    command("analyse-f0-negative", "analyse @/good.wav --f0 -440", "f0"),
    command("analyse-f0-nan", "analyse @/good.wav --f0 nan", "f0"),
    command("analyse-f0-above-the-file", "analyse @/good.wav --f0 30000", "30000"),
    command("analyse-f0-word", "analyse @/good.wav --f0 low", "low", 2),
    command("analyse-channel-missing", "analyse @/good.wav --note A4 --channel right", "has 1 channel"),
    command("analyse-channel-number", "analyse @/good.wav --note A4 --channel 9", "--channel 9"),
    command("analyse-channel-word", "analyse @/good.wav --note A4 --channel middle", "--channel middle"),
    command("dataset-keys", "dataset --out @/notes --keys C6-C2", "--keys C6-C2"),
    command("dataset-count", "dataset --out @/notes --count 0", "--count 0"),
    command("dataset-noise", "dataset --out @/notes --noise loud", "--noise loud", 2),
    command("dataset-around", "dataset --out @/notes --around @/absent.json", "absent.json"),
    command("dataset-format", "dataset --out @/notes --sample-format mp3", "mp3", 2),
    command("simulate-preset", "simulate --preset steinway --out @/a.wav", "steinway"),
    command("simulate-preset-near", "simulate --preset bensa-finl --out @/a.wav", "did you mean bensa-final?"),
    command("simulate-set-no-value", f"{SIMULATE} --set c", "set"),
    command("simulate-set-unknown", f"{SIMULATE} --set tension=600", "tension"),
    command("simulate-set-word", f"{SIMULATE} --set c=fast", "fast"),
    command("simulate-set-empty", f"{SIMULATE} --set mu=", "mu"),
    command("simulate-set-negative", f"{SIMULATE} --set M_H=-0.005", "M_H"),
    command("simulate-set-nan", f"{SIMULATE} --set kappa=nan", "kappa"),
    command("simulate-set-outside", f"{SIMULATE} --set p=9", "p=9"),
    command("simulate-set-twice", f"{SIMULATE} --set c=300 --set c=310", "c is set twice"),
    command("simulate-velocity-and-set", f"{SIMULATE} --set v_H0=3 --velocity 2", "v_H0=3.0 are both given"),
    command("simulate-velocity-zero", f"{SIMULATE} --velocity 0", "velocity"),
    command("simulate-velocity-word", f"{SIMULATE} --velocity loud", "loud", 2),
    command("simulate-seconds-zero", f"{SIMULATE} --seconds 0", "seconds"),
    command("simulate-seconds-negative", f"{SIMULATE} --seconds -2", "seconds"),
    command("simulate-seconds-nan", f"{SIMULATE} --seconds nan", "seconds"),
    command("simulate-seconds-absurd", f"{SIMULATE} --seconds 1e9", "seconds"),
    command("simulate-too-many-samples", f"{SIMULATE} --seconds 600 --rate 384000", "--seconds 600.0 at --rate 384000"),
    command("simulate-out-in-no-folder", "simulate --preset bensa-final --out @/none/a.wav", "does not exist"),
    command("simulate-typical-word", "simulate --typical H9 --out @/a.wav", "H9"),
    command("simulate-typical-range", "simulate --typical C9 --out @/a.wav", "--typical 120"),
    command("simulate-neither", "simulate --out @/a.wav", "--typical", 2),
    command("simulate-both", f"{SIMULATE} --typical C4", "--typical", 2),
    command("simulate-scale-zero", f"{SIMULATE} --scale 0", "--scale 0"),
    command("simulate-scale-small", f"{SIMULATE} --scale 1e-6", "--scale 1e-06"),
    command("simulate-noise-negative", f"{SIMULATE} --noise -60", "--noise -60"),
    command("simulate-strike-outside", f"{SIMULATE} --strike 3", "--strike 3"),
    command("simulate-pickup-bridge", f"{SIMULATE} --pickup 0.3", "--pickup 0.3"),
    command("simulate-setup-in-no-folder", f"{SIMULATE} --setup-out @/none/s.toml", "does not exist"),
    command("simulate-rate-word", f"{SIMULATE} --rate 44.1k", "44.1k", 2),
    command("simulate-rate-low", f"{SIMULATE} --rate 100", "rate"),
    command("simulate-rate-absurd", f"{SIMULATE} --rate 100000000", "rate"),
    command("simulate-no-out", "simulate --preset bensa-final", "--out", 2),
    command("simulate-out-is-a-folder", "simulate --preset bensa-final --out @/out", "out", build=occupied),
    command("simulate-out-exists", "simulate --preset bensa-final --out @/sound.wav", "--force", build=occupied),
    command("simulate-out-under-a-file", "simulate --preset bensa-final --out @/file/a.wav", "file", build=occupied),
    command("render-missing", f"{RENDER} --velocity 1", "no such file"),
    command("render-velocity-zero", f"{RENDER} --velocity 0", "velocity", build=occupied),
    command("render-velocity-word", f"{RENDER} --velocity soft", "soft", 2, build=occupied),
    command("render-out-exists", "render @/fit.json --velocity 1 --out @/sound.wav", "--force", build=occupied),
    render("empty", b"", "is empty"),
    render("text", b"not json at all", "fit.json"),
    render("cut", json.dumps(fit_dict()).encode()[:200], "fit.json"),
    render("binary", bytes(range(256)), "fit.json"),
    render("nested", b"[" * 100_000, "fit.json"),
    render("list", [1, 2, 3], "fit.json"),
    render("schema", fit_dict() | {"schema": 99}, "99"),
    render("no-schema", {"parameters": {}}, "schema"),
    render("parameters-list", fit_dict() | {"parameters": []}, "parameters"),
    render("parameter-missing", fit_dict() | {"parameters": {"c": {"value": 304.1}}}, "kappa"),
    render("value-nan", fit_dict(c=float("nan")), "JSON is malformed"),
    render("value-infinite", fit_dict(K_H=1e305), "parameters.K_H.value = 1e+305 must be a number that is finite"),
    render("value-text", fit_dict(p="2.5"), "p"),
    render("value-null", fit_dict(M_H=None), "M_H"),
    render("value-outside", fit_dict(M_H=5.0), "M_H"),
    render("mass-negative", fit_dict(M_S=-1.0), "M_S"),
    render("strike-off-string", fit_dict(x0=2.0), "x0"),
    render("window-past-bridge", fit_dict(x0=0.995), "strike=0.995 m with width=0.02 m"),
    render("pickup-off-string", fit_dict(pickup=1.5), "pickup=1.5"),
    render("length-negative", fit_dict(L=-1.0), "length=-1.0"),
    render("huge-integer", fit_dict(c=10**400), "parameters.c"),
    render("no-pickup", {k: v for k, v in fit_dict().items() if k != "pickup"}, "pickup is missing"),
    render("quantity", fit_dict() | {"pickup": {"quantity": "light"}}, "quantity='light'"),
    render("path-falling", fit_dict() | {"pickup": {"quantity": "pressure", "path": FALLING}}, "pickup.path"),
    render("path-text", fit_dict() | {"pickup": {"quantity": "pressure", "path": "flat"}}, "pickup.path"),
    render("no-recordings", fit_dict() | {"recordings": []}, "recordings is empty"),
    render("gain-null", recording_dict(gain=None), "recordings[0].gain"),
    render("rate-zero", recording_dict(rate=0), "rate = 0 must be"),
    render("rate-absurd", recording_dict(rate=1e12), "rate = 1000000000000.0 must be"),
    render("ringing-infinite", rings(1e305), "finite numbers"),
    render("participation-falls", participates([2.0, 1.0]), "velocities that rise from above 0"),
    render("participation-negative", participates([-1.0, 1.0]), "velocities that rise from above 0"),
    render("participation-empty", participates([]), "1 to 256 vel"),
    render("participation-short", participates([1.0], parts=2), "velocity gain of every mode"),
    render("participation-infinite", participates([1.0], size=1e7), "up to 1e+06"),
    render("ringing-overflows", rings(0.0, mode=1e13), "up to 1e+12"),
    command("render-knock-mp3", f"{RENDER} --velocity 1", "knock.flac: ", build=foreign_knock),
    command("simulate-out-mp3", "simulate --preset bensa-final --out @/x.mp3", ".wav"),
    command("render-out-flac", "render @/good.wav --velocity 1 --out @/x.flac", ".wav"),
    command("predict-out-bare", "predict @/good.wav @/good.wav --out @/x", ".wav"),
    command("play-out-mp3", "play @/good.wav @/good.wav --out @/x.mp3", ".wav"),
    command("export-out-mp3", "export @/good.wav --out @/x.mp3", "called like a file"),
    command("demo-out-not-empty", "demo --out @/out", "--force", build=occupied),
    command("demo-out-under-a-file", "demo --out @/file/out", "file", build=occupied),
    command("demo-noise-nan", "demo --out @/out --noise nan", "--noise nan"),
    command("demo-noise-word", "demo --out @/out --noise much", "much", 2),
    command("demo-unknown-option", "demo --out @/out --loud", "--loud", 2),
    command("listen-nothing", "listen", "--result", 2),
    command("listen-no-out", "listen @/a @/b", "--out", 2, build=two_sides),
    command("listen-missing", "listen @/a @/none --out @/out", "none: is not a folder", build=two_sides),
    command("listen-file-missing", "listen @/good.wav @/none.wav --out @/out", "none.wav: no such file"),
    command("listen-twice", "listen @/a @/a --out @/out", "is given twice", build=two_sides),
    command("listen-no-pair", "listen @/a @/other --out @/out", "no file name in common", build=two_sides),
    command("listen-clipped", "listen @/a @/clipped --out @/out", "note.wav: check clipping", build=two_sides),
    command(
        "listen-none-left", "listen @/a @/clipped --out @/out --exclude-invalid", "check clipping", build=two_sides
    ),
    command("listen-rates", "listen @/a @/slower --out @/out", "note.wav: has 16000 Hz", build=two_sides),
    command("listen-channels", "listen @/a @/stereo --out @/out", "note.wav: has 2 channels", build=two_sides),
    command("listen-trials", "listen @/a @/b --out @/out --trials 0", "--trials 0", build=two_sides),
    command("listen-seconds", "listen @/a @/b --out @/out --seconds nan", "--seconds nan", build=two_sides),
    command("listen-seed", "listen @/a @/b --out @/out --seed -1", "--seed -1", build=two_sides),
    command(
        "listen-out-not-empty",
        "listen @/good.wav @/sound.wav --out @/out",
        "--force to replace a result",
        build=occupied,
    ),
    command("listen-json-alone", "listen @/a @/b --out @/out --json", "--result", 2, build=two_sides),
    command("listen-result-and-out", "listen --result @/fit.json --out @/out", "cannot be combined", build=occupied),
    command("listen-result-missing", "listen --result @/none.json", "none.json: no such file"),
    result("text", b"not json", "not answers"),
    result("list", [1], "schema none"),
    result("schema", {"schema": 1, "trials": []}, "schema 1"),
    result("no-trials", {"schema": 2}, "trials is missing"),
    result("empty-trials", {"schema": 2, "trials": []}, "has no answers"),
    result("trial-number", {"schema": 2, "trials": [7]}, "trials[0] = 7 must be a table"),
    result("chosen", {"schema": 2, "trials": [{"condition": "x", "chosen": ["a"], "hit": "a"}]}, "must be one of a, b"),
    result("nested", b"[" * 100_000, "not answers"),
    command("listen-result-twice", "listen --result @/answers.json --result @/answers.json", "same", build=answered),
    command("tuning-missing", "tuning @/none", "none: no such file"),
    command("tuning-not-a-fit", "tuning @/good.wav", "good.wav"),
    command("tuning-a4", "tuning @/none --a4 4400", "--a4 4400"),
    command("tuning-a4-word", "tuning @/none --a4 high", "high", 2),
    command("tuning-octave", "tuning @/none --octave 3:1", "3:1", 2),
    command("tuning-out-not-empty", "tuning @/fit.json --out @/out", "--force", build=occupied),
    command("unknown-command", "tune", "tune", 2),
]

BAD_INPUTS = [*AUDIO, *PATHS, *SETUPS, *COMMANDS]
