"""Listening tests of two folders: checks of the sounds, output, and counts of answers."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path

import numpy as np
import pytest
import soundfile
from bad_inputs import encoded, fit_dict, note

from pianofit import load_recording
from pianofit.cli import main
from pianofit.dsp.loudness import k_weighted_mean_square
from pianofit.listening.artefact_checks import CHECKS, JUMP, failures
from pianofit.listening.result import count_answers
from pianofit.recording.recording import recording_from_samples

RATE = 22_050


def folders(tmp_path: Path, *sides: str, names: tuple[str, ...] = ("A3", "A4"), rate: int = RATE) -> list[Path]:
    """Write folders of notes. Sides differ in level, lead-in and length."""
    made = []
    for n, side in enumerate(sides):
        folder = tmp_path / side
        folder.mkdir()
        for k, name in enumerate(names):
            sound = 0.5 ** (n + 1) * note(220.0 * (k + 1), 1.0 + 0.2 * n, rate, lead=0.01 + 0.03 * n)
            (folder / f"{name}.wav").write_bytes(encoded(sound, rate=rate))
        made.append(folder)
    return made


def run(*arguments: object) -> int:
    return main(["listen", *map(str, arguments)])


# --- the checks -------------------------------------------------------------------------------------------------------


def gated(samples: np.ndarray) -> set[str]:
    """Names of the checks that the samples fail."""
    return {line.split(":")[0].removeprefix("check ") for line in failures(recording_from_samples(samples, RATE))}


def clean() -> np.ndarray:
    return 1.8 * note(220.0, 2.0)


def test_a_whole_note_passes():
    assert gated(clean()) == set()
    assert {*CHECKS} == {"clipping", "offset", "onset", "clicks"}


@pytest.mark.parametrize(("gain", "fails"), [(1.0, set()), (1.3, {"clipping"})])
def test_a_clipped_note_fails(gain, fails):
    assert gated(np.clip(gain * clean(), -0.95, 0.95)) == fails


@pytest.mark.parametrize(("share", "fails"), [(0.008, set()), (0.012, {"offset"})])
def test_an_offset_fails_at_a_hundredth_of_the_peak(share, fails):
    assert gated(clean() + share * np.abs(clean()).max()) == fails


def test_a_note_that_was_cut_into_fails():
    peak = int(np.argmax(np.abs(clean())))
    assert "onset" in gated(clean()[peak:])


@pytest.mark.parametrize("at", [0.3, 1.0, 1.8])
@pytest.mark.parametrize("fault", ["sample", "step", "gap"])
def test_a_click_fails_wherever_it_is(at, fault):
    """A wrong sample, a step and a lost millisecond, each a few percent of the peak."""
    samples, here = clean().copy(), round(at * RATE)
    if fault == "sample":
        samples[here] += 0.02
    elif fault == "step":
        samples[here:] += 0.05 * np.exp(-np.arange(len(samples) - here) / 400)
    else:
        tone = 0.3 * np.sin(2 * np.pi * 220 * np.arange(len(samples)) / RATE) * (np.arange(len(samples)) > 500)
        samples = samples + tone
        samples[here : here + RATE // 1000] = 0
    assert gated(samples) == {"clicks"}
    (line,) = failures(recording_from_samples(samples, RATE))
    assert abs(float(line.split(" at ")[1].split(" s")[0]) - at) < 2e-3


def test_noise_is_no_click():
    """The largest of 100,000 normal numbers is about 5 times their rms. The limit is far above, at every level."""
    for level in (1e-4, 1e-2):
        rng = np.random.default_rng(5)
        samples = np.pad(note(220.0, 0.5) * np.linspace(1, 0, len(note(220.0, 0.5))), (0, 100_000))
        assert gated(samples + level * rng.normal(size=len(samples)) * (np.arange(len(samples)) > 2000)) == set()
    assert JUMP > 2 * 5


@pytest.mark.recordings
def test_whole_recordings_pass(recordings):
    files = [recordings / f"{name}.flac" for name in ("headroom-C4-L2-close", "headroom-A0-L5-close", "cp80-Fs2-MP")]
    assert {str(f): failures(load_recording(f)) for f in files} == {str(f): [] for f in files}
    assert "begins inside the note" in failures(load_recording(recordings / "cp80-C5-F.flac"))[0]


# --- the test ---------------------------------------------------------------------------------------------------------


def sounds_of(folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Sounds of the webMUSHRA experiment, which are those of the page, by name and side."""
    key = json.loads((folder / "key.json").read_text())
    found = {}
    for name, sound in key["sounds"].items():
        samples, rate = soundfile.read(folder / f"webmushra/configs/resources/pianofit/{name}.wav")
        assert rate == RATE
        found[sound["case"], sound["what"]] = samples
    return found


def test_sounds_differ_in_nothing_but_how_they_sound(tmp_path, capsys):
    """One note with three levels, lead-ins and lengths gives the same sound three times."""
    a, b, r = folders(tmp_path, "one", "two", "three")
    assert run(a, b, "--reference", r, "--out", tmp_path / "out", "--trials", 5, "--seconds", 0.9) == 0
    assert "20 questions about 2 sounds: A3, A4" in capsys.readouterr().out
    sounds = sounds_of(tmp_path / "out")
    assert {*sounds} == {(name, side) for name in ("A3", "A4") for side in ("one", "two", "three")}
    for name in ("A3", "A4"):
        first = sounds[name, "one"]
        assert len(first) == round(0.9 * RATE)
        for side in ("two", "three"):
            other = sounds[name, side]
            level = 10 * math.log10(k_weighted_mean_square(first, RATE) / k_weighted_mean_square(other, RATE))
            assert abs(level) < 0.01
            assert np.abs(other - first).max() < 3e-3  # noise, 16 bits
    assert max(np.abs(sound).max() for sound in sounds.values()) <= 10 ** (-1 / 20) + 1e-4


def fits(tmp_path: Path, recordings: Path) -> Path:
    """A batch folder with mono sounds of fits: two recordings of one key, one of another."""
    out, digests = tmp_path / "fits", {}
    for file in sorted(recordings.rglob("*.wav")):
        digests[file.stem] = hashlib.sha256(file.read_bytes()).hexdigest()
    for key, names in (("A3", ("A3 p", "A3 f")), ("A4", ("A4 p",))):
        folder = out / "keys" / key
        folder.mkdir(parents=True)
        content = fit_dict()
        own = ({"file": f"/elsewhere/{name}.wav", "sha256": digests[name], "channel": "average"} for name in names)
        content["recordings"] = [content["recordings"][0] | row for row in own]
        (folder / "fit.json").write_text(json.dumps(content))
        for name in [f"fitted-{name}" for name in names] if len(names) > 1 else ["fitted"]:
            (folder / f"{name}.wav").write_bytes(encoded(0.5 * note(220.0, 1.2), rate=RATE))
    return out


def test_recordings_are_paired_with_the_sounds_of_their_fits(tmp_path, capsys):
    """Pairs are found by content, so recordings can be renamed and moved."""
    recordings = tmp_path / "recordings"
    for at, name in enumerate(("A3 p", "A3 f", "A4 p", "B4 p")):
        (recordings / name[:2]).mkdir(parents=True, exist_ok=True)
        sound = (1 + at) * 0.2 * note(220.0, 1.0)
        (recordings / name[:2] / f"{name}.wav").write_bytes(encoded(np.stack([sound, 0.5 * sound], 1), rate=RATE))
    made = fits(tmp_path, recordings)
    (recordings / "A3/A3 p.wav").rename(recordings / "renamed.wav")
    assert run(recordings, made, "--out", tmp_path / "out", "--trials", 3, "--seconds", 0.9) == 0
    output, errors = capsys.readouterr()
    assert "3 sounds: A3 f, A3 p, A4 p" in output
    assert "B4 p" in errors
    sounds = sounds_of(tmp_path / "out")
    assert {*sounds} == {(name, side) for name in ("A3 p", "A3 f", "A4 p") for side in ("recordings", "fits")}
    # Fits are mono, so their recordings are averaged.
    assert all(sound.ndim == 1 or np.ptp(sound, axis=1).max() == 0 for sound in sounds.values())
    assert str(tmp_path) not in (tmp_path / "out/listen.html").read_text()


def test_recordings_that_were_not_fitted_are_refused(tmp_path, capsys):
    (one,) = folders(tmp_path, "one")
    other = tmp_path / "other"
    other.mkdir()
    for name in ("A3 p", "A3 f", "A4 p"):
        (other / f"{name}.wav").write_bytes(encoded(note(330.0) * len(name) / 9, rate=RATE) + name.encode())
    assert run(one, fits(tmp_path, other), "--out", tmp_path / "out") == 1
    assert "content" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text", ["[]", '{"recordings": 3}', '{"recordings": [3, {"file": 1}]}', '{"recordings": "ab"}']
)
def test_a_fit_that_names_no_recording_is_no_pair(tmp_path, text):
    (one,) = folders(tmp_path, "one")
    (tmp_path / "fits").mkdir()
    (tmp_path / "fits/fit.json").write_text(text)
    assert run(one, tmp_path / "fits", "--out", tmp_path / "out") == 1


def test_loudness_is_that_of_the_recommendation():
    """ITU-R BS.1770: a 997 Hz sine of 0 dBFS in one channel reads −3.01 LKFS. The filters here are analogue."""
    sine = np.sin(2 * np.pi * 997 * np.arange(48_000) / 48_000)
    assert -0.691 + 10 * math.log10(k_weighted_mean_square(sine, 48_000)) == pytest.approx(-3.01, abs=0.05)


def test_questions_are_shared_out_evenly(tmp_path):
    a, b = folders(tmp_path, "a", "b", names=("A3", "B3", "C4"))
    assert run(a, b, "--out", tmp_path / "out", "--trials", 7) == 0
    key = json.loads((tmp_path / "out" / "key.json").read_text())
    cases = [(t["kind"], key["sounds"][t["reference"]]["case"]) for t in key["trials"]]
    counts = {kind: sorted(cases.count((kind, name)) for name in ("A3", "B3", "C4")) for kind in ("abx", "nearer")}
    assert counts == {"abx": [2, 2, 3], "nearer": [2, 2, 3]}
    assert run(a, b, "--out", tmp_path / "few", "--trials", 2) == 0
    few = json.loads((tmp_path / "few" / "key.json").read_text())
    assert len(few["sounds"]) == 4  # only sounds of questions are written
    assert {t["condition"] for t in key["trials"]} == {"ABX: a or b", "hidden reference: a next to b"}


def test_an_experiment_for_webmushra(tmp_path):
    a, b, r = folders(tmp_path, "a", "b", "r")
    assert run(a, b, "--reference", r, "--out", tmp_path / "out", "--trials", 2) == 0
    folder = tmp_path / "out" / "webmushra"
    settings = json.loads((folder / "configs" / "pianofit.yaml").read_text())  # YAML that is JSON too
    (order, *pages), end = settings["pages"]
    assert order == "random"
    assert end["type"] == "finish"
    what = {
        name: sound["what"] for name, sound in json.loads((tmp_path / "out/key.json").read_text())["sounds"].items()
    }
    assert sorted(page["type"] for page in pages) == ["bs1116"] * 2 + ["paired_comparison"] * 4
    for page in pages:
        assert what[Path(page["reference"]).stem] == "r"
        assert {what[Path(file).stem] for file in page["stimuli"].values()} <= {"a", "b"}
        assert all((folder / file).is_file() for file in (page["reference"], *page["stimuli"].values()))
    assert len({page["id"] for page in pages}) == len(pages)


def test_a_pair_that_fails_a_gate_can_be_left_out(tmp_path, capsys):
    a, b = folders(tmp_path, "a", "b")
    (b / "A4.wav").write_bytes(encoded(np.clip(4 * note(), -0.9, 0.99)))
    assert run(a, b, "--out", tmp_path / "out") == 1
    words = capsys.readouterr().err
    assert "b/A4.wav: check clipping: " in words
    assert not (tmp_path / "out").exists()
    assert run(a, b, "--out", tmp_path / "out", "--exclude-invalid") == 0
    captured = capsys.readouterr()
    assert "left out: " in captured.err
    assert "about 1 sound: A3" in captured.out


# --- the answers ------------------------------------------------------------------------------------------------------


def answers(path: Path, *counts: tuple[str, int, int]) -> Path:
    trials = [
        {"condition": condition, "chosen": "a" if n < hits else "b", "hit": "a"}
        for condition, hits, of in counts for n in range(of)
    ]  # fmt: skip
    path.write_text(json.dumps({"schema": 2, "trials": trials, "name": path.name}))
    return path


def test_counts_against_published_intervals(tmp_path, capsys):
    """Clopper and Pearson at n = 16 and 12 hits, by definition: both tails have 2.5 %."""
    files = [
        answers(tmp_path / "one.json", ("ABX", 7, 8), ("nearer", 0, 3)),
        answers(tmp_path / "two.json", ("ABX", 5, 8)),
    ]
    abx, nearer = count_answers(files)
    assert (abx.hits, abx.of, nearer.hits, nearer.of) == (12, 16, 0, 3)

    def tail(share: float, at_least: int) -> float:
        return sum(math.comb(16, k) * share**k * (1 - share) ** (16 - k) for k in range(at_least, 17))

    low, high = abx.interval
    assert tail(low, 12) == pytest.approx(0.025, rel=1e-6)
    assert 1 - tail(high, 13) == pytest.approx(0.025, rel=1e-6)
    assert abx.p == pytest.approx(2 * tail(0.5, 12))
    assert nearer.interval[0] == 0
    assert nearer.interval[1] == pytest.approx(1 - 0.025 ** (1 / 3))
    assert run("--result", files[0], "--result", files[1]) == 0
    assert "12   16   0.750" in capsys.readouterr().out
    assert run("--result", files[0], "--result", files[1], "--json") == 0
    found = json.loads(capsys.readouterr().out)["conditions"]
    assert found[0] == {"condition": "ABX", "hits": 12, "of": 16, "p": abx.p, "interval": [low, high]}


def test_sides_of_one_name_are_called_by_their_folders(tmp_path):
    for place in ("one", "two"):
        (tmp_path / place).mkdir()
        folders(tmp_path / place, "sounds")
    assert run(tmp_path / "one/sounds", tmp_path / "two/sounds", "--out", tmp_path / "out") == 0
    key = json.loads((tmp_path / "out/key.json").read_text())
    assert {sound["what"] for sound in key["sounds"].values()} == {"one/sounds", "two/sounds"}
    assert str(tmp_path) not in (tmp_path / "out/listen.html").read_text()
