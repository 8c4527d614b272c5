"""Pedals, dampers, resonance and release noise of the page's engine in node, against `render_song`."""

from __future__ import annotations

import functools
import json
from dataclasses import replace

import numpy as np
import pytest
from instrument_cases import piano_of, rung, true_note
from page_cases import (
    CONTROLLERS,
    RATE,
    STEP,
    early,
    error_db,
    on_block,
    page_job,
    play,
    ringing_note,
    run,
    walk,
)

from pianofit.instrument import Instrument
from pianofit.instrument.release_noise import ReleaseNoise
from pianofit.playback import PlayOptions, Song, render_song
from pianofit.schema.decode import builtins_of
from pianofit.web.payload import encode_instrument

WITHIN = -60.0  # dB
SECONDS = 8.0
KEYS = (33, 40, 45, 48, 52, 55, 57, 60, 64, 67, 72, 76, 79, 84, 95, 100)


def piece(seed: int = 4) -> Song:
    """Notes on all keys, some of them on strings that still move, while every controller moves."""
    random, keys = np.random.default_rng(seed), {}
    for key in KEYS:
        for t in np.arange(0.1, SECONDS - 1, 1.0):
            begin = t + random.uniform(0, 0.3)
            if random.random() < 0.6:
                end = (on_block(begin + random.uniform(0.1, 0.6)), 0)
                keys.setdefault(key, []).extend([(on_block(begin), int(random.integers(20, 120))), end])
    count = sum(len(events) // 2 for events in keys.values())
    moves = {name: walk(i, 0.03 * (i + 1), SECONDS) for i, name in enumerate(CONTROLLERS.values())}
    return Song(keys, moves.pop("pedal"), on_block(SECONDS), count, **moves)


def played(piano: Instrument, song: Song, **more: object) -> np.ndarray:
    (sound,) = play([page_job(piano, song, **more)])
    return sound[:, max(early(key.note) for key in piano.keys.values()) :]


def rendered(piano: Instrument, song: Song, resonance: bool = True) -> np.ndarray:
    options = PlayOptions() if resonance else PlayOptions(resonance=0.0)
    done = render_song(piano, song, RATE, options=options)
    assert done.gain_db == done.limited_db == 0
    return done.samples


def quiet(make: object, gain: float) -> Instrument:
    return piano_of({key: make(key)._replace(gain=gain) for key in KEYS})


PIANO = quiet(rung, 2e-4)  # modes of two decays, velocity gains and knocks
FEW = replace(PIANO, keys={key: PIANO.keys[key] for key in (48, 60, 72)})


@functools.cache
def played_piece(resonance: bool = True) -> np.ndarray:
    return played(PIANO, piece(), resonance=resonance)


def test_every_controller_moves_as_in_the_player():
    song = piece()
    expected, dry = rendered(PIANO, song), rendered(PIANO, song, resonance=False)
    assert error_db(dry, expected) > -30  # resonance is no detail
    assert error_db(played_piece(), expected) < WITHIN
    assert error_db(played_piece(resonance=False), dry) < WITHIN


@pytest.mark.parametrize(
    "make", [lambda key: true_note(key)._replace(path=None), lambda key: ringing_note(key, channels=1)]
)
def test_strings_of_other_instruments_resonate_as_in_the_player(make):
    """Keys of the string model, in real time without lead, and measured keys in one channel."""
    keys = {48: [(0.1, 90), (1.0, 0)], 60: [(0.5, 100), (0.8, 0)], 64: [(1.5, 60), (1.6, 0)]}
    keys = {key: [(on_block(t), velocity) for t, velocity in events] for key, events in keys.items()}
    song, piano = Song(keys, [(0.0, 127), (on_block(2.0), 0)], 3.0, 3), quiet(make, 1e-2)
    expected = rendered(piano, song)
    assert error_db(rendered(piano, song, resonance=False), expected) > -30
    assert error_db(played(piano, song), expected) < WITHIN


def test_release_noises_are_those_of_the_player():
    random = np.random.default_rng(0)
    sounds = {key: 0.1 * random.normal(size=(2, 3000)) * np.exp(-np.arange(3000) / 500) for key in (40, 60)}
    piano = replace(PIANO, release=ReleaseNoise(sounds, 24_000))
    keys = {48: [(0.0, 2), (0.2, 0)], 60: [(0.1, 2), (0.15, 0)], 100: [(0.3, 2), (0.6, 0)]}
    keys = {key: [(on_block(t), velocity) for t, velocity in events] for key, events in keys.items()}
    song = Song(keys, (), 1.0, 3, release_velocities={(48, keys[48][1][0]): 100})
    expected = rendered(piano, song)
    assert error_db(rendered(PIANO, song), expected) > -20
    assert error_db(played(piano, song), expected) < WITHIN


@pytest.mark.parametrize("resonance", [True, False])
def test_half_pedal_is_monotone_in_the_page(resonance):
    at, jobs = 150, []
    for value in range(16, 80, 8):
        job = page_job(FEW, Song({48: [(0.0, 90), (at * STEP, 0)]}, [(0.0, value)], 1.0, 1), resonance)
        jobs.append(job)
    left = [10 * np.log10(np.mean(sound[0, -12_000:] ** 2) + 1e-30) for sound in play(jobs)]
    assert (np.diff(left) >= -1e-6).all()
    assert left[-1] - left[0] > 40


def test_nothing_clicks_where_a_pedal_or_the_switch_of_resonance_moves():
    """High frequencies, where the chord has none, do not rise when a pedal moves."""
    piano = quiet(lambda key: true_note(key)._replace(path=None), 1e-2)
    keys = {key: [(0.0, 90), (on_block(0.8), 0)] for key in (48, 52, 55)}
    moves = [(1.0, 40), (1.1, 60), (1.2, 30), (1.3, 127), (1.5, 0), (1.55, 127), (2.0, 50), (2.2, 0)]
    song = Song(keys, [(0.0, 127), *((on_block(t), value) for t, value in moves)], 3.0, 3)
    job = page_job(piano, song)
    job["events"] += [[round(1.4 / STEP), "setResonance", False], [round(1.45 / STEP), "setResonance", True]]
    (sound,) = play([job])
    flux = np.abs(np.diff(sound[0], 4))
    stroke = 2e-2 * flux.max()
    for at in [t for t, _ in moves] + [1.4, 1.45]:
        here = round(at * RATE)
        assert flux[here - 48 : here + 480].max() <= 1.5 * flux[here - 4800 : here - 48].max() + stroke


def test_the_switch_of_resonance_leaves_the_strings_alone():
    job = page_job(PIANO, piece())
    job["events"].insert(0, [0, "setResonance", False])
    (off,), dry = play([job]), played_piece(resonance=False)
    np.testing.assert_allclose(off[:, -dry.shape[-1] :], dry, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("bars", [200, pytest.param(1000, marks=pytest.mark.slow)])
def test_bars_of_controllers_do_not_let_the_state_grow(bars):
    """One bar is 0.1 s. A key is struck in every tenth, and all are let go at the end."""
    seconds = 0.1 * bars
    keys = {48: [(on_block(t + d), v) for t in np.arange(0, seconds, 1.0) for d, v in ((0.0, 70), (0.05, 0))]}
    moves = {name: walk(i, 0.01, seconds) for i, name in enumerate(CONTROLLERS.values())}
    ends = [(on_block(seconds), 0)]
    song = Song(keys, [*moves["pedal"], *ends], seconds + 3, bars // 10, sostenuto=[*moves["sostenuto"], *ends])
    ((text,),) = run([page_job(FEW, song, sizes=True)])
    sizes = json.loads(text)
    assert sizes == {
        "sounding": 0,
        "noises": 0,
        "history": 9,
        "pending": 0,
        "atRest": True,
        "struck": 0,
        "strokes": [0],
    }


def test_the_loudest_modes_are_kept():
    """With fewer modes than strings have, the difference lies below the resonance, and falls with their number."""
    whole, song = played_piece(), piece()
    without = error_db(played_piece(resonance=False), whole)
    some = [error_db(played(PIANO, song, most=count), whole) for count in (100, 200)]
    assert some[1] < some[0] < without


def test_the_bridge_of_the_page_is_the_instruments():
    document, _ = encode_instrument(PIANO, 10**9)
    assert document["bridge"] == builtins_of(PIANO.bridge)
    assert document["keys"][0]["damper"]["slope"] == PIANO.dampers.slope
    assert document["keys"][-1]["damper"] is None
