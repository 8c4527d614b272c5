"""Real notes: independently measured values, and one string recorded in several velocity layers."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import numpy as np
import pytest

from pianofit.analysis import Analysis, analyse
from pianofit.recording.recording import Recording, load_recording

FOLDER = Path(os.environ.get("PIANOFIT_RECORDINGS", Path(__file__).parents[2] / "shared" / "recordings"))
pytestmark = [
    pytest.mark.recordings,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no recordings at {FOLDER}; set PIANOFIT_RECORDINGS"),
]
LAYERS = {
    "cp80-Fs2": ("F#2", ("PP", "MP", "F", "FF")),
    "headroom-A0": ("A0", ("L1-close", "L2-close", "L3-close", "L4-close", "L5-close", "L2-decca", "L4-decca")),
    "headroom-Ds1": ("D#1", ("L1-close", "L2-close", "L3-close", "L4-close", "L5-close")),
    "headroom-Fs1": ("F#1", ("L1-close", "L3-close", "L5-close")),
    "headroom-C4": ("C4", ("L1-close", "L3-close", "L5-close", "L4-decca")),
}


# The softest and the loudest layer of other keys.
OTHERS = (
    *("cp80-Ds1-PP", "cp80-Ds1-FF", "cp80-C4-MP", "cp80-C4-FF", "cp80-C5-PP", "cp80-C5-FF"),
    *("headroom-A6-L2-close", "headroom-A6-L5-close"),
)


def _load(name: str) -> Recording:
    return load_recording(FOLDER / f"{name}.flac")


@functools.cache
def _analysis(name: str, note: str | None = None) -> Analysis:
    return analyse(_load(name), note=note)


def test_the_witness():
    analysis = _analysis("cp80-Fs2-FF", "F#2")
    assert abs(1200 * np.log2(analysis.f0 / 92.33)) < 2
    assert pytest.approx(2.3e-4, rel=0.1) == analysis.B
    assert 2 < analysis.glide_cents < 5  # from about 92.39 Hz to 92.16 Hz
    assert analysis.scatter_cents < 4  # about sixty partials, of which the highest deviate from the law


@pytest.mark.parametrize("name", LAYERS)
def test_layers_agree(name):
    note, layers = LAYERS[name]
    analyses = [_analysis(f"{name}-{layer}", note) for layer in layers]
    # louder layers start sharper: compare the pitch at the end of the glide
    f0 = np.array([analysis.glide[-1][2] for analysis in analyses])
    B = np.array([analysis.B for analysis in analyses])
    assert np.ptp(1200 * np.log2(f0)) < 4
    assert np.ptp(B) < 0.1 * np.mean(B)


def test_none_was_struck_twice_and_two_of_them_in_one_file_were():
    """Beats raise single partials, also the two or three loudest of a treble note."""
    once = [(f"{name}-{layer}", note) for name, (note, layers) in LAYERS.items() for layer in layers]
    for name, note in once + [(name, None) for name in OTHERS]:
        assert not any("second stroke" in warning for warning in _analysis(name, note).warnings), name
    recording = _load("headroom-Fs1-L5-close")
    twice = recording.samples.copy()
    twice[2 * recording.rate :] += 0.5 * recording.samples[: -2 * recording.rate]
    assert any("second stroke" in warning for warning in analyse((twice, recording.rate)).warnings)


def test_levels_against_brute_force():
    recording = _load("cp80-Fs2-FF")
    table = _analysis("cp80-Fs2-FF", "F#2").partials
    count = int(0.35 * recording.rate)
    early = recording.samples[recording.onset :][:count]
    spectrum = np.fft.rfft(early * np.exp(-8 * np.arange(count) / recording.rate), 8 * count) / recording.rate
    step = recording.rate / (8 * count)
    frequency = np.arange(len(spectrum)) * step
    brute = np.array(
        [10 * np.log10(2 * step * np.sum(np.abs(spectrum[np.abs(frequency - f) < 40]) ** 2)) for f in table.frequency]
    )
    strong = (table.level > table.level.max() - 40) & (table.frequency < 6000)
    assert np.median(np.abs(table.level - brute)[strong]) < 0.5


@pytest.mark.parametrize(
    "name", ["cp80-Fs2-MP", "headroom-A0-L3-close", "headroom-C4-L4-close", "headroom-A6-L4-close"]
)
def test_the_pitch_of_real_notes_is_found(name):
    recording = _load(name)
    wanted = {"F": 92.2, "A0": 27.52, "C4": 262.3, "A6": 1768.0}[name.split("-")[1].replace("Fs2", "F")]
    assert abs(1200 * np.log2(analyse(recording).f0 / wanted)) < 10
