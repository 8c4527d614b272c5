"""What an exported SFZ file holds of dampers, pedals and noises, as sfizz plays it, against the engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from instrument_cases import true_instrument
from sfz_player import RATE, play

from pianofit.dsp.filters import fractional_lag
from pianofit.export import ExportOptions, export_sampler
from pianofit.export.samples import render_stroke
from pianofit.instrument.release_noise import ReleaseNoise
from pianofit.playback.midi import Song
from pianofit.playback.pedals import PedalRange
from pianofit.playback.song import PlayOptions, render_song
from pianofit.playback.voice import StringVoice
from pianofit.schema.dampers import Dampers

KEYS = [52, 58]
LAYERS = 3
Play = Callable[..., np.ndarray]


def noise(midi: int) -> np.ndarray:
    """A short noise, louder for higher keys."""
    sound = np.random.default_rng(midi).normal(size=(1, 3_000)) * np.exp(-np.arange(3_000) / 600)
    sound = np.convolve(sound[0], np.hanning(24), mode="same")[None]  # players interpolate
    return 1e-3 * 2 ** (midi / 12) * sound


DAMPERS = Dampers(bass=20.0, treble=60.0)
PIANO = replace(true_instrument(), dampers=DAMPERS, release=ReleaseNoise({m: noise(m) for m in (50, 62)}, RATE))


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> tuple[Path, float]:
    """The file, and the one gain of its samples and of sfizz, from a stroke."""
    pytest.importorskip("pysfizz")
    out = tmp_path_factory.mktemp("out") / "sampler"
    export_sampler(PIANO, out, KEYS, ExportOptions(LAYERS, 3.0, una_corda=True))
    sound = play(out / "twin.sfz", [(0.0, "note_on", 58, 127)], 1.0)
    return out / "twin.sfz", float(np.sqrt(np.mean(sound**2) / np.mean(stroke(58, 0.0)[:RATE] ** 2)))


def stroke(midi: int, soft: float) -> np.ndarray:
    """The loudest stroke by the engine."""
    return render_stroke(PIANO, StringVoice(PIANO.note(midi, 64), midi, RATE), 127, 1.0, soft)[0]


@pytest.fixture(scope="module")
def strings(file) -> Play:
    """(events, seconds) -> sound of the struck strings alone, by sfizz."""
    return lambda events, seconds: play(file[0], events, seconds, without=("-release", "-resonance"))


@pytest.fixture(scope="module")
def held(strings) -> np.ndarray:
    """A stroke on 52 that is not let go."""
    return strings([(0.0, "note_on", 52, 100)], 2.6)


def added_rate(sound: np.ndarray, held: np.ndarray, begin: float, end: float) -> float:
    """Rate at which a sound decays faster than a held one, 1/s."""
    level = [np.sqrt(np.mean(x[round(t * RATE) :][:2_400] ** 2)) for t in (begin, end) for x in (sound, held)]
    return float(np.log(level[0] / level[1] * level[3] / level[2])) / (end - begin)


@pytest.mark.parametrize("value", [0, 24, 30, 40, 50, 60])
def test_half_pedal_damps_as_the_engine(strings, held, value):
    """Below 64 the rate is that of the damper at the fundamental, times its contact."""
    sound = strings([(0.0, "cc", 64, value), (0.0, "note_on", 52, 100), (1.0, "note_off", 52, 0)], 2.0)
    expected = PedalRange().contact(value) * DAMPERS.rates(52, np.array([164.81]))[0]
    assert added_rate(sound, held, 1.02, 1.12) == pytest.approx(expected, rel=0.03)


def test_a_pedal_that_moves_is_followed(strings, held):
    """Down, half way, and down again: the string keeps what the damper left it."""
    pedal = [(0.0, "cc", 64, 127), (1.0, "cc", 64, 40), (1.1, "cc", 64, 127)]
    sound = strings([*pedal, (0.0, "note_on", 52, 100), (0.5, "note_off", 52, 0)], 2.5)
    rate = PedalRange().contact(40) * DAMPERS.rates(52, np.array([164.81]))[0]
    assert added_rate(sound, held, 0.5, 0.9) == pytest.approx(0.0, abs=1e-3)
    assert added_rate(sound, held, 1.01, 1.04) == pytest.approx(rate, rel=0.03)
    # The longest release of the format replaces a damper that does not touch the string.
    assert added_rate(sound, held, 1.2, 2.2) < 0.1
    assert added_rate(sound, held, 0.9, 1.2) * 0.3 == pytest.approx(0.1 * rate, rel=0.1)


def test_sostenuto_holds_the_keys_that_are_down(strings, held):
    down, up = (0.5, "cc", 66, 127), (1.5, "cc", 66, 0)
    caught = strings([(0.0, "note_on", 52, 100), down, (1.0, "note_off", 52, 0), up], 2.5)
    rate = DAMPERS.rates(52, np.array([164.81]))[0]
    assert added_rate(caught, held, 1.0, 1.4) == pytest.approx(0.0, abs=1e-3)
    assert added_rate(caught, held, 1.52, 1.6) == pytest.approx(rate, rel=0.03)
    later = strings([(0.0, "cc", 66, 127), (0.0, "note_on", 52, 100), (1.0, "note_off", 52, 0)], 2.0)
    assert added_rate(later, held, 1.02, 1.1) == pytest.approx(rate, rel=0.03)


def test_the_left_pedal_is_that_of_the_stroke(strings, file):
    """Its samples equal the strokes of the engine, and moving it during a note changes nothing."""
    soft = strings([(0.0, "cc", 67, 127), (0.0, "note_on", 52, 127), (0.3, "cc", 67, 0)], 1.0)
    assert distance_db(file[1] * stroke(52, 1.0), soft) < -40
    assert distance_db(file[1] * stroke(52, 0.0), soft) > -20


def distance_db(expected: np.ndarray, found: np.ndarray) -> float:
    """Energy of the difference after alignment to a sample, relative to the expected sound, dB."""
    late = round(fractional_lag(expected, found[: len(expected)]))
    size = min(len(expected), len(found)) - abs(late) - 1
    a, b = expected[max(-late, 0) :][:size], found[max(late, 0) :][:size]
    return 10 * np.log10(np.mean((a - b)[2_400:] ** 2) / np.mean(a[2_400:] ** 2))


def song(pedal: Sequence[tuple[float, int]]) -> Song:
    return Song({52: [(0.0, 64), (9.0, 0)]}, pedal, 9.0, 1)


def test_free_strings_sound_under_the_right_pedal(file):
    """A stroke with the pedal down is that of `render_song`; with the pedal up, nothing is added.

    In the engine the strings above the last damper resonate with the pedal up, too. The samples leave them out.
    """
    stroke = (0.01, "note_on", 52, 64)
    with_pedal = play(file[0], [(0.0, "cc", 64, 127), stroke], 2.5)
    without = play(file[0], [stroke], 2.5)
    resonant = file[1] * render_song(PIANO, song([(0.0, 127)])).samples[0][: round(2.4 * RATE)]
    alone = PlayOptions(resonance=0.0)
    dry = file[1] * render_song(PIANO, song([]), options=alone).samples[0][: round(2.4 * RATE)]
    assert distance_db(resonant, with_pedal) < -30
    assert distance_db(dry, without) < -40
    assert distance_db(dry, with_pedal) > -20
    # Pressed after the stroke, the pedal finds the strings in motion; let go, it ends the resonance of a held key.
    moved = play(file[0], [stroke, (0.5, "cc", 64, 127), (1.5, "cc", 64, 0)], 2.5)
    alike = [np.mean((moved - x)[round(a * RATE) : round(b * RATE)] ** 2)
             for x, a, b in ((without, 0.0, 0.5), (with_pedal, 0.6, 1.5), (without, 1.6, 2.5))]  # fmt: skip
    assert max(alike) < 1e-4 * np.mean(without[: RATE // 2] ** 2)


def test_keys_that_are_let_go_make_their_noise(file):
    """The level is the engine's for a long note at release velocity 64. No pedal suppresses the noise."""

    def released(midi: int, velocity: int, *pedals: tuple) -> np.ndarray:
        stroke = (0.1, "note_on", midi, velocity)
        return play(file[0], [*pedals, stroke, (0.5, "note_off", midi, 64)], 1.0, without=("-v", "-resonance"))

    assert PIANO.release is not None
    for midi in (52, 55, 58):
        expected = file[1] * PIANO.release.sound(midi, 64, 9.0, RATE)[0]
        for velocity in (20, 127):
            found = released(midi, velocity)[RATE // 2 :]
            assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(expected), rel=0.03)
    assert np.abs(released(52, 90)[: RATE // 2]).max() < 1e-6
    for pedal in (64, 66):
        assert released(52, 90, (0.2, "cc", pedal, 127))[RATE // 2 :] == pytest.approx(
            released(52, 90)[RATE // 2 :], abs=1e-6
        )


def test_levels_over_velocity_survive_without_curves(tmp_path):
    """Crossfades of the player keep the level of the model within 0.5 dB. Plain layers sound one at a time."""
    pytest.importorskip("pysfizz")
    options = ExportOptions(8, 1.0, resonance=False)
    levels: dict[str, np.ndarray] = {}
    for blend in ("curves", "xfade", "plain"):
        export_sampler(true_instrument(), tmp_path / blend, [52], options._replace(blend=blend))
        sounds = [play(tmp_path / blend / "twin.sfz", [(0.0, "note_on", 52, v)], 0.4) for v in range(1, 128, 6)]
        levels[blend] = np.array([10 * np.log10(np.mean(sound**2)) for sound in sounds])
    assert np.ptp(levels["xfade"] - levels["curves"]) < 0.5
    assert np.ptp(levels["plain"] - levels["curves"]) < 5.0
    text = (tmp_path / "plain" / "twin.sfz").read_text()
    regions = [dict(word.split("=") for word in line.split()[1:]) for line in text.splitlines() if "<region>" in line]
    played = [v for region in regions for v in range(int(region["lovel"]), int(region["hivel"]) + 1)]
    assert played == list(range(1, 128))
    assert "amp_velcurve" not in text + (tmp_path / "xfade" / "twin.sfz").read_text()
