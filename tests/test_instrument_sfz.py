"""The folder of a sampler: samples, text, and playback by a real player, sfizz."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from instrument_cases import ERRORS, library, true_instrument, true_note

from pianofit.analysis.note_names import midi_to_note, parse_keys
from pianofit.cli import main
from pianofit.dsp.filters import fractional_lag
from pianofit.errors import OutputError, ParameterError
from pianofit.export import ExportOptions, export_sampler
from pianofit.export.layers import crossfade_layers, fill_gaps, format_keys, key_ranges, layer_velocities
from pianofit.instrument import build_instrument, find_fits, load_instrument, load_keys, write_instrument
from pianofit.instrument.dampers import LAST_DAMPER
from pianofit.instrument.key_quantities import LOUDEST_VELOCITY
from pianofit.model.modes import mode_frequencies

RATE = 48_000
KEYS = [28, 55, 79]
LAYERS = 8
SHORT = ExportOptions(layers=1, seconds=0.2, resonance=False)
PIANO = true_instrument()


@pytest.fixture(scope="module")
def piano(tmp_path_factory) -> Path:
    """An instrument whose keys have errors so small that it plays their fits."""
    folder = library(tmp_path_factory.mktemp("library"), [28, 40, 55, 67, 79], errors=dict.fromkeys(ERRORS, 1e-5))
    write_instrument(folder / "instrument.json", build_instrument(load_keys(find_fits([folder])), "a #piano/.."))
    return folder


@pytest.fixture(scope="module")
def sampler(piano, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("out") / "sampler"
    export_sampler(
        load_instrument(piano / "instrument.json"), out, KEYS, ExportOptions(LAYERS, 2.0), licence="CC BY 4.0, \nme"
    )
    return out


@pytest.fixture(scope="module")
def player(sampler) -> Callable[..., np.ndarray]:
    """(key, MIDI velocity, s until release) -> 2.5 s of the output of sfizz, left channel."""
    from pysfizz import Synth

    # sfizz streams samples from the disk in a separate thread; here it must load them before it plays.
    file = sampler / "a-piano.sfz"
    whole = sampler / "whole.sfz"
    whole.write_text("<control> hint_ram_based=1\n" + file.read_text())
    synth = Synth(sample_rate=RATE, block_size=512)
    assert synth.load_sfz_file(whole, quiet=False)
    whole.unlink()
    assert synth.playable_keys == sorted({key for low, high in key_ranges(KEYS) for key in range(low, high + 1)})
    # The release must end before the next note.
    return lambda key, velocity, held=1.3: synth.render_note(key, velocity, held, 2.5)[0]


def levels(sound: np.ndarray, midi: int) -> np.ndarray:
    """Levels of the partials over one second, dB."""
    note = true_note(midi)
    frequency = mode_frequencies(note.string, note.geometry.length, 80)
    size = np.abs(np.fft.rfft(sound[2400 : 2400 + RATE] * np.hanning(RATE)))
    nearest = [size[round(f) - 3 : round(f) + 4].max() for f in frequency[frequency < 12_000]]
    return 20 * np.log10(np.array(nearest) + 1e-12)


def test_a_player_plays_what_render_does(piano, player, tmp_path):
    """Partials within 60 dB of the strongest agree with `pianofit render` of the fit of the key, with one gain."""
    instrument, gains = load_instrument(piano / "instrument.json"), []
    for midi in KEYS:
        # The fit's velocities are on a scale of their own; its loudest is the last of `LAYERS` of the library.
        scale = instrument.keys[midi].fit.velocities[-1] / LOUDEST_VELOCITY
        for velocity in (layer_velocities(LAYERS)[3], 127):
            out = tmp_path / f"{midi}-{velocity}.wav"
            v = instrument.velocity.at(velocity) / scale
            fit = piano / "keys" / f"twin-{midi_to_note(midi).replace('#', 's')}" / "fit.json"
            assert main(["render", str(fit), "--velocity", repr(v), "--out", str(out), "--seconds", "1.5",
                         "--rate", str(RATE)]) == 0  # fmt: skip
            rendered, _ = soundfile.read(out)
            sampled = player(midi, velocity)
            late = round(fractional_lag(rendered, sampled[: len(rendered)]))
            expected, found = levels(rendered, midi), levels(np.roll(sampled, -late), midi)
            strong = expected > expected.max() - 60
            assert strong.sum() >= 4
            off = (found - expected)[strong]
            assert np.abs(off - off.mean()).max() < 0.1, (midi, velocity)  # dB
            gains.append(off.mean())
    assert np.ptp(gains) < 0.1


def test_loudness_follows_velocity_without_steps(piano, player):
    """The level agrees with the model within 0.1 dB at every velocity, with one gain for all keys and even steps."""
    instrument, off = load_instrument(piano / "instrument.json"), []
    for midi in (28, 55):
        loud = np.array([level(player(midi, v)) for v in range(1, 128)])
        steps = np.diff(loud)
        assert steps.min() > 0
        assert steps.max() < 0.5  # dB
        for velocity in range(1, 128, 9):
            note = instrument.note(midi, velocity)
            off.append(loud[velocity - 1] - level(note.render(seconds=1.0, rate=RATE)))
    assert np.ptp(off) < 0.1


def level(sound: np.ndarray) -> float:
    """Level of the first second, dB."""
    return 10 * np.log10(np.mean(sound[:RATE] ** 2))


def test_timbre_follows_velocity(piano, player):
    """Between two layers the partials agree with the model within 1 dB."""
    instrument = load_instrument(piano / "instrument.json")
    for midi in (28, 55):
        for velocity in (46, 82, 118):
            assert min(abs(velocity - v) for v in layer_velocities(LAYERS)) >= 8
            rendered = instrument.note(midi, velocity).render(seconds=1.5, rate=RATE)
            expected, found = levels(rendered, midi), levels(player(midi, velocity), midi)
            strong = expected > expected.max() - 40
            assert strong.sum() >= 5
            off = (found - expected)[strong]
            assert np.abs(off - np.median(off)).max() < 1.0, (midi, velocity)


def test_a_release_is_the_dampers(player):
    """Relative to a held note, the sound decays at the rate of the damper at the fundamental."""
    expected = PIANO.dampers.rates(55, np.array([196.0]))[0]
    held, released = player(55, 100, 2.4), player(55, 100, 1.0)
    at = RATE + np.array([0.02, 0.06]) * RATE
    ratio = [np.sqrt(np.mean(released[int(i) :][:960] ** 2) / np.mean(held[int(i) :][:960] ** 2)) for i in at]
    assert np.log(ratio[0] / ratio[1]) / 0.04 == pytest.approx(expected, rel=0.03)


def test_every_velocity_and_key_is_played(sampler):
    text = (sampler / "a-piano.sfz").read_text()
    lines = [line.split()[1:] for line in text.splitlines() if "<region>" in line]
    regions = [dict(word.split("=", 1) for word in line) for line in lines]
    regions = [region for region in regions if "resonance" not in region["sample"]]
    assert len(regions) == len(KEYS) * LAYERS
    played = [v for region in regions for v in range(int(region["lovel"]), int(region["hivel"]) + 1)]
    assert min(played.count(v) for v in range(1, 128)) == len(KEYS)
    for region in regions:
        info = soundfile.info(sampler / region["sample"])
        assert (info.format, info.subtype, info.samplerate, info.channels) == ("FLAC", "PCM_24", RATE, 1)


def test_the_readme_says_whose_it_is_and_what_is_a_guess(sampler, tmp_path):
    text = (sampler / "README.txt").read_text()
    assert "CC BY 4.0, \\nme\n" in text
    assert "recordings of the key: E1 G3 G5\n" in text
    assert "keyboard laws): none" in text
    done = export_sampler(PIANO, tmp_path / "twin", [60, 64], SHORT)
    assert (done.keys, done.unrecorded, done.transposed) == (2, 2, 6 + 3 + 6)
    text = (tmp_path / "twin" / "README.txt").read_text()
    assert "No licence" in text
    assert "keyboard laws): C4 E4\n" in text


def test_a_key_without_a_sample_is_transposed(player):
    sound = player(57, 100)
    size = np.abs(np.fft.rfft(sound[:RATE] * np.hanning(RATE)))
    f1 = 220.0 * np.sqrt(1 + 1e-4)
    assert np.argmax(size[round(f1) - 8 : round(f1) + 8]) - 8 + round(f1) == pytest.approx(f1, abs=2)


def test_samples_are_as_loud_as_can_be_and_end_in_silence(sampler):
    sounds = [soundfile.read(file)[0] for file in sorted((sampler / "samples").iterdir())]
    assert max(np.abs(sound).max() for sound in sounds) == pytest.approx(10 ** (-1 / 20), rel=1e-5)
    for sound in sounds:
        assert np.abs(sound[-3:]).max() < 1e-5
        assert np.abs(sound[:3]).max() < 1e-3 * np.abs(sound).max()


def test_an_export_replaces_an_export_and_nothing_else(tmp_path):
    out = tmp_path / "sampler"
    export_sampler(PIANO, out, [60], SHORT._replace(kind="wav"))
    before = sorted(out.rglob("*"))
    assert [file.name for file in before] == ["README.txt", "samples", "060-C4-v127.wav", "twin.sfz"]
    with pytest.raises(OutputError, match="not empty"):
        export_sampler(PIANO, out, [60], SHORT)
    export_sampler(PIANO, out, [62], SHORT, force=True)
    assert sorted(file.name for file in (out / "samples").iterdir()) == ["062-D4-v127.flac"]
    (out / "letters.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"letters\.txt"):
        export_sampler(PIANO, out, [60], SHORT, force=True)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="not an export"):
        export_sampler(PIANO, tmp_path / "file", [60], SHORT, force=True)
    (tmp_path / "mine" / "samples").mkdir(parents=True)
    for name in ("samples/kick.wav", "README.txt", "drums.sfz"):
        (tmp_path / "mine" / name).write_text("mine")
    with pytest.raises(OutputError, match="not an export"):
        export_sampler(PIANO, tmp_path / "mine", [60], SHORT, force=True)
    (out / "letters.txt").unlink()
    (out / "samples" / "kick.wav").write_text("mine")
    with pytest.raises(OutputError, match=r"kick\.wav"):
        export_sampler(PIANO, out, [60], SHORT, force=True)
    assert (out / "samples" / "kick.wav").read_text() == "mine"
    with pytest.raises(OutputError, match="does not exist"):
        export_sampler(PIANO, tmp_path / "none" / "sampler", [60], SHORT)
    assert not list(tmp_path.glob(".*"))


def test_what_goes_wrong_leaves_nothing_behind(tmp_path):
    def stop(*_: object) -> None:
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        export_sampler(PIANO, tmp_path / "sampler", [60], SHORT, progress=stop)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("options", "message"), [
    ({"layers": 0}, "layers=0 must be from 1 to 127"), ({"layers": 128}, "layers=128"),
    ({"rate": 10}, "rate=10 Hz"),
    ({"peak_db": 1.0}, "peak_db=1.0"), ({"trim_db": 5.0}, "trim_db=5.0"),
    ({"seconds": 0.0}, "seconds=0.0"), ({"seconds": float("nan")}, "seconds=nan"),
    ({"kind": "mp3"}, "kind='mp3'"), ({"keys": [20]}, "key 20"),
    ({"keys": list(range(21, 109)), "layers": 100}, "more than 40,000 s"),
])  # fmt: skip
def test_what_cannot_be_exported_is_refused(tmp_path, options, message):
    keys = options.pop("keys", [60])
    with pytest.raises(ParameterError, match=message):
        export_sampler(PIANO, tmp_path / "sampler", keys, ExportOptions(**{"layers": 1} | options))
    assert not list(tmp_path.iterdir())


def test_keys_are_named_as_players_name_them():
    assert parse_keys("A0-C8") == list(range(21, 109))
    assert parse_keys("C2, F#2,Bb3") == [36, 42, 58]
    assert parse_keys("every 3")[:3] == [21, 24, 27]
    assert parse_keys("every 12,A0,B0-C1") == [21, 23, 24, *range(33, 109, 12)]
    for text in ("", "H2", "C2-", "C8-A0", "G#0", "C2-D2-E2", "every 0", "every", "C2;D2"):
        with pytest.raises(ParameterError, match="keys="):
            parse_keys(text)


@given(st.integers(1, 127), st.integers(0, 2**32))
def test_layers_that_cross_over_have_the_models_level(count, seed):
    """The sum of samples with given levels and correlations has the requested level."""
    random, velocities = np.random.default_rng(seed), layer_velocities(count)
    assert len(velocities) == len(set(velocities)) == count
    level_db = np.cumsum(random.uniform(0, 1, 128))
    correlation = random.uniform(0, 1, count - 1)
    zones = crossfade_layers(velocities, level_db, correlation)
    for v in range(1, 128):
        active = [(i, zone) for i, zone in enumerate(zones) if zone.low <= v <= zone.high]
        assert 1 <= len(active) <= 2
        a = [10 ** (level_db[z.velocity] / 20) * z.sample_gain * z.gain[v - z.low] for _, z in active]
        power = sum(x**2 for x in a) + (2 * a[0] * a[1] * correlation[active[0][0]] if len(a) == 2 else 0)
        assert 10 * np.log10(power) == pytest.approx(level_db[v], abs=1e-9)


@given(st.sets(st.integers(21, 108), min_size=1))
def test_spans_do_not_meet(keys):
    chosen = sorted(keys)
    spans = key_ranges(chosen)
    assert all(low <= key <= high for key, (low, high) in zip(chosen, spans, strict=True))
    assert all(a[1] < b[0] for a, b in pairwise(spans))


def test_keys_with_and_without_a_damper_have_samples_of_their_own():
    for text in ("every 2", "every 3", "every 5", "every 7"):
        keys = parse_keys(text)
        spans = dict(zip(keys, key_ranges(keys), strict=True))
        assert all((midi <= LAST_DAMPER) == (high <= LAST_DAMPER) for midi, (_, high) in spans.items())
        assert all((midi <= LAST_DAMPER) == (low <= LAST_DAMPER) for midi, (low, _) in spans.items())


@pytest.mark.parametrize("only", [LAST_DAMPER, LAST_DAMPER + 3])
def test_each_key_of_one_sample_has_its_own_damper(piano, tmp_path, only):
    content = load_instrument(piano / "instrument.json")
    summary = export_sampler(content, tmp_path / "out", [only], SHORT)
    text = next((tmp_path / "out").glob("*.sfz")).read_text()
    groups = re.findall(r"<group>.*lokey=(\d+) hikey=(\d+) .*?(loop_mode|ampeg_release)", text)
    damped = {key: end == "ampeg_release" for low, high, end in groups for key in range(int(low), int(high) + 1)}
    assert damped == {key: key <= LAST_DAMPER for key in range(only - 6, only + 7)}
    assert summary.transposed == 12


def test_every_third_key_leaves_no_key_out():
    covered = [key for low, high in key_ranges(parse_keys("every 3")) for key in range(low, high + 1)]
    assert covered == list(range(21, 109))


@given(st.sets(st.integers(21, 108), min_size=1))
def test_keys_in_addition_leave_no_key_between_silent(keys):
    chosen = sorted(keys)
    filled = fill_gaps(chosen)
    assert {*chosen} <= {*filled}
    assert filled == sorted({*filled})
    covered = {key for low, high in key_ranges(filled) for key in range(low, high + 1)}
    assert {*range(chosen[0], chosen[-1] + 1)} <= covered
    whole = all(high - low == 1 for (_, low), (high, _) in pairwise(key_ranges(chosen)))
    assert (filled == chosen) == whole  # no more keys than needed


def test_ranges_of_keys_are_named():
    assert format_keys([21, 22, 23, 60, 107, 108]) == "A0 to B0, C4, B7 to C8"
    assert format_keys([]) == "none"


def test_an_export_says_which_keys_are_silent(tmp_path):
    done = export_sampler(PIANO, tmp_path / "some", KEYS, SHORT)
    played = {key for low, high in key_ranges(KEYS) for key in range(low, high + 1)}
    assert done.silent_keys == [key for key in range(21, 109) if key not in played]
    assert f"Silent: {format_keys(done.silent_keys)}\n" in (tmp_path / "some" / "README.txt").read_text(
        encoding="utf-8"
    )


def test_an_export_of_nothing_is_refused(tmp_path):
    with pytest.raises(ParameterError, match=r"keys=\[\]"):
        export_sampler(PIANO, tmp_path / "none", [], SHORT)


def test_one_layer_is_called_one_layer(tmp_path):
    export_sampler(PIANO, tmp_path / "one", [60], SHORT)
    assert "A key has one layer," in (tmp_path / "one" / "README.txt").read_text()


def test_few_layers_are_raised_in_their_samples_not_by_the_player():
    """Between two strokes 60 dB apart, the soft sample must be far louder than its stroke."""
    level = np.linspace(-60.0, 0.0, 128)
    soft, loud = crossfade_layers([1, 127], level, [0.9])
    assert soft.sample_gain > 10
    assert loud.sample_gain == 1
    assert soft.gain.max() == loud.gain.max() == 1


def test_peak_and_trim_are_as_asked(tmp_path):
    """The loudest sample has the peak, and a sample ends where it is so far below its own peak."""
    lengths = {}
    for trim in (40.0, 80.0):
        options = ExportOptions(layers=2, seconds=8.0, resonance=False, peak_db=-9.0, trim_db=trim)
        export_sampler(true_instrument(), tmp_path / f"{trim:g}", [100], options)
        sounds = [soundfile.read(file)[0] for file in sorted((tmp_path / f"{trim:g}" / "samples").iterdir())]
        peaks = [20 * np.log10(np.abs(sound).max()) for sound in sounds]
        assert max(peaks) == pytest.approx(-9.0, abs=0.01)
        lengths[trim] = [len(sound) for sound in sounds]
    assert all(short < long for short, long in zip(lengths[40.0], lengths[80.0], strict=True))


def test_a_folder_that_appears_meanwhile_is_not_replaced(tmp_path):
    out = tmp_path / "sampler"

    def write_there(*_: object) -> None:
        out.mkdir(exist_ok=True)
        (out / "thesis.txt").write_text("mine")

    with pytest.raises(OutputError, match="not an export"):
        export_sampler(PIANO, out, KEYS, SHORT, progress=write_there)
    assert [path.name for path in tmp_path.iterdir()] == ["sampler"]
    assert (out / "thesis.txt").read_text() == "mine"
