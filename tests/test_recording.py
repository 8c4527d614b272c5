"""Reading of audio: valid files are read unchanged, invalid ones are rejected."""

import contextlib
import csv
import hashlib
import math
import os
import re
from pathlib import Path

import numpy as np
import pytest
import soundfile
from bad_inputs import BAD_INPUTS, BadInput, encoded, note, pcm16, wav
from hypothesis import given, settings
from hypothesis import strategies as st

from pianofit.errors import ParameterError, PianofitError, RecordingError
from pianofit.io.files import printable, read_file
from pianofit.recording.recording import load_recording, recording_from_samples

RECORDINGS = Path(os.environ.get("PIANOFIT_RECORDINGS", Path(__file__).parents[2] / "shared" / "recordings"))
CASES = RECORDINGS.parent / "cases"
STEP = {"PCM_16": 2.0**-15, "PCM_24": 2.0**-23, "PCM_32": 2.0**-31, "FLOAT": 2.0**-24, "DOUBLE": 2.0**-53}


def damped(rate: int, f0: float, seconds: float, phase: float, decay: float = 1.0) -> np.ndarray:
    """Damped partials from their first sample on, peak 0.5; phase π/2 begins with a step."""
    t = np.arange(round(seconds * rate)) / rate
    k = np.arange(1, max(2, min(20, int(0.4 * rate / f0) + 1)))[:, None]
    sound = (np.sin(2 * np.pi * f0 * k * t + phase) * np.exp(-(decay + 0.01 * k * k) * t) / k).sum(axis=0)
    return 0.5 * sound / np.abs(sound).max()


def with_lead(sound: np.ndarray, lead: int, noise: float, seed: int = 0) -> np.ndarray:
    """Put `lead` samples before the sound and white noise of that rms under all of it."""
    whole = np.concatenate([np.zeros(lead), sound])
    return whole + noise * np.random.default_rng(seed).normal(size=len(whole))


# --- round trips ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file_format", "subtype"),
    [
        *[("WAV", subtype) for subtype in STEP],
        *[("WAVEX", subtype) for subtype in STEP],
        ("FLAC", "PCM_16"),
        ("FLAC", "PCM_24"),
    ],
)
def test_every_format_returns_the_samples_it_was_given(tmp_path, file_format, subtype):
    sound = note()
    path = tmp_path / "note"
    path.write_bytes(encoded(sound, file_format, subtype))
    recording = load_recording(path)
    np.testing.assert_allclose(recording.samples + recording.dc, sound, rtol=0, atol=STEP[subtype])
    assert recording.samples.dtype == np.float64
    assert (recording.rate, recording.channels, recording.channel) == (22_050, 1, "mono")
    assert recording.subtype == subtype
    assert recording.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert recording.path == str(path)
    assert recording.clipped == 0
    assert recording.warnings == ()
    assert recording.seconds == len(sound) / 22_050


@pytest.mark.parametrize("file_format", ["WAV", "FLAC"])
@pytest.mark.parametrize("rate", [8_000, 11_025, 44_100, 48_000, 96_000, 192_000, 384_000])
def test_every_rate(tmp_path, file_format, rate):
    sound = with_lead(damped(rate, 440.0, 0.3, 0.0), rate // 100, 1e-5)
    (tmp_path / "note").write_bytes(encoded(sound, file_format, "PCM_24", rate))
    recording = load_recording(tmp_path / "note")
    assert recording.rate == rate
    np.testing.assert_allclose(recording.samples + recording.dc, sound, rtol=0, atol=2.0**-23)


@pytest.mark.parametrize("file_format", ["WAV", "FLAC"])
@pytest.mark.parametrize("channels", range(1, 9))
def test_every_channel_and_their_average(tmp_path, file_format, channels):
    gains = 1.0 - 0.1 * np.arange(channels)
    (tmp_path / "note").write_bytes(encoded(note()[:, None] * gains, file_format, "PCM_24"))
    for number in range(1, channels + 1):
        recording = load_recording(tmp_path / "note", channel=str(number))
        scale = np.abs(recording.samples).max() / np.abs(note()).max()
        assert scale == pytest.approx(gains[number - 1], rel=1e-4)
        assert recording.channels == channels
        assert recording.channel == ("mono" if channels == 1 else str(number))
    average = load_recording(tmp_path / "note")
    assert np.abs(average.samples).max() / np.abs(note()).max() == pytest.approx(gains.mean(), rel=1e-4)
    assert average.channel == ("mono" if channels == 1 else "average")


def test_left_and_right_are_the_first_two(tmp_path):
    (tmp_path / "note.wav").write_bytes(encoded(np.stack([note(), 0.5 * note()], axis=1)))
    left, right = (load_recording(tmp_path / "note.wav", channel=name) for name in ("left", "right"))
    assert (left.channel, right.channel) == ("left", "right")
    np.testing.assert_allclose(right.samples, 0.5 * left.samples, atol=2 * 2.0**-15)


def test_a_flac_that_was_streamed_does_not_say_how_long_it_is(tmp_path):
    data = bytearray(encoded(note(), "FLAC", "PCM_16"))
    data[21] &= 0xF0  # STREAMINFO's 36 bits of total samples
    data[22:26] = bytes(4)
    (tmp_path / "note.flac").write_bytes(bytes(data))
    with pytest.raises(RecordingError, match="no length"):
        load_recording(tmp_path / "note.flac")


def test_chunks_before_and_after_the_sound_are_passed_over(tmp_path):
    plain = encoded(note())
    chunk = b"bext\x05\x00\x00\x00hello\x00"  # odd sizes are padded
    data = plain[:12] + chunk + plain[12:] + b"LIST\x04\x00\x00\x00abcd"
    (tmp_path / "note.wav").write_bytes(data)
    assert len(load_recording(tmp_path / "note.wav").samples) == len(note())


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(50, 2000))
def test_any_truncation_of_a_wav_is_found(tmp_path_factory, seed, missing):
    sound = with_lead(damped(22_050, 440.0, 0.2, 0.0), 100, 1e-4, seed)
    path = tmp_path_factory.mktemp("wav") / "note.wav"
    path.write_bytes(encoded(sound)[:-missing])
    with pytest.raises(RecordingError, match="truncated"):
        load_recording(path)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_bytes_never_raise_anything_else(tmp_path_factory, data):
    content = bytearray(encoded(note(seconds=0.2), data.draw(st.sampled_from(["WAV", "WAVEX", "FLAC"]))))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, min(len(content), 120) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / "note"
    path.write_bytes(bytes(content))
    with contextlib.suppress(RecordingError):
        assert np.isfinite(load_recording(path).samples).all()


# --- recordings from arrays -------------------------------------------------------------------------------------------


def test_samples_become_a_recording_with_the_same_measures(tmp_path):
    (tmp_path / "note.wav").write_bytes(encoded(note(), subtype="DOUBLE"))
    file, array = load_recording(tmp_path / "note.wav"), recording_from_samples(note(), 22_050, name="mine")
    np.testing.assert_array_equal(file.samples, array.samples)
    assert (file.onset, file.dc, file.noise_rms) == (array.onset, array.dc, array.noise_rms)
    assert (array.path, array.channel) == ("mine", "mono")
    with pytest.raises(ValueError, match="read-only"):
        array.samples[0] = 1.0


def test_the_given_array_is_left_alone():
    samples = note().copy()
    recording_from_samples(samples, 22_050)
    np.testing.assert_array_equal(samples, note())
    samples[0] = 0.0  # and still writable


@pytest.mark.parametrize(
    ("samples", "rate", "message"),
    [
        (np.zeros((2, 100)), 44_100, r"shape \(2, 100\)"),
        (np.zeros(44_100, dtype=np.int16), 44_100, "int16"),
        (np.zeros(44_100, dtype=complex), 44_100, "complex128"),
        (np.zeros(0), 44_100, "no samples"),
        (np.zeros(44_100), 44_100, "silent"),
        (np.full(44_100, np.nan), 44_100, "NaN"),
        (np.zeros(44_100), 0, "sample rate of 0 Hz"),
        (np.zeros(44_100), 44_100.5, "44100.5"),
        (np.zeros(44_100), float("nan"), "nan"),
        (np.zeros(8_000 * 601), 8_000, "at most 600"),
    ],
)
def test_bad_samples_are_refused_by_name(samples, rate, message):
    with pytest.raises(RecordingError, match=message) as caught:
        recording_from_samples(samples, rate, name="my\ntake")
    assert str(caught.value).startswith("my\\ntake: ")


# --- onset ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [8_000, 44_100, 192_000])
@pytest.mark.parametrize("f0", [27.5, 262.0, 2_000.0])
@pytest.mark.parametrize("lead", [0.0, 0.004, 0.05, 2.0])
def test_a_step_onset_at_60_db_is_found_to_the_sample(rate, f0, lead):
    lead_samples = round(lead * rate)
    sound = damped(rate, f0, 0.6, math.pi / 2)
    for seed in range(3):
        samples = with_lead(sound, lead_samples, 1e-3 * sound.std(), seed)
        assert abs(recording_from_samples(samples, rate).onset - lead_samples) <= 1


@pytest.mark.parametrize(("noise_db", "lead"), [(20, 0.05), (20, 3.0), (30, 0.01), (40, 0.3), (60, 0.01), (80, 3.0)])
@pytest.mark.parametrize("f0", [55.0, 440.0])
def test_a_gentle_onset_is_found_within_half_a_millisecond(noise_db, lead, f0):
    rate, lead_samples = 44_100, round(lead * 44_100)
    t = np.arange(rate) / rate
    sound = damped(rate, f0, 1.0, 0.0) * (1 - np.exp(-((t / 2e-4) ** 2)))
    samples = with_lead(sound, lead_samples, 10 ** (-noise_db / 20) * sound.std(), 1)
    assert abs(recording_from_samples(samples, rate).onset - lead_samples) <= 0.0005 * rate


def test_the_onset_of_a_bass_note_that_swells_and_rings_on_to_the_end_of_its_file():
    """The quietest tenth of such a file is the note itself, not much softer than its maximum."""
    t = np.arange(4 * 44_100) / 44_100
    sound = damped(44_100, 27.5, 4.0, math.pi / 2, decay=0.05) * (1 - 0.9 * np.exp(-t / 0.02))
    recording = recording_from_samples(with_lead(sound, 4_410, 1e-4), 44_100)
    assert abs(recording.onset - 4_410) <= 0.001 * 44_100


@pytest.mark.parametrize("f0", [55.0, 440.0])
def test_rumble_and_hum_before_the_note_are_not_the_note(f0):
    rate, lead = 44_100, 30_000
    sound = with_lead(damped(rate, f0, 1.0, 0.0), lead, 1e-4)
    t = np.arange(len(sound)) / rate
    sound += 0.02 * np.sin(2 * np.pi * 11 * t) + 0.01 * np.sin(2 * np.pi * 50 * t + 1)
    assert abs(recording_from_samples(sound, rate).onset - lead) <= 0.001 * rate


def test_a_click_long_before_the_note_is_not_the_note():
    sound = with_lead(damped(44_100, 220.0, 1.0, 0.0), 44_100, 1e-4)
    sound[20_000:20_003] = 0.5
    assert abs(recording_from_samples(sound, 44_100).onset - 44_100) <= 20


def test_the_first_of_two_strikes_is_the_onset():
    sound = with_lead(damped(44_100, 220.0, 2.0, 0.0, decay=4.0), 5_000, 1e-4)
    sound[50_000:] += 1.5 * sound[5_000 : 5_000 + len(sound) - 50_000]
    assert abs(recording_from_samples(sound, 44_100).onset - 5_000) <= 20


def test_a_padded_lead_in_ends_exactly_where_the_sound_begins():
    sound = np.concatenate([np.zeros(12_345), damped(44_100, 110.0, 1.0, math.pi / 2)])
    assert recording_from_samples(sound, 44_100).onset == 12_345


def test_a_file_that_begins_inside_the_note_says_so():
    sound = damped(44_100, 110.0, 1.0, math.pi / 2)[200:]
    recording = recording_from_samples(sound, 44_100)
    assert recording.onset == 0
    assert any("begins inside the note" in warning for warning in recording.warnings)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 3_000),
    st.floats(1e-3, 1.0),
    st.floats(-0.3, 0.3),
    st.sampled_from([1, -1]),
)
def test_the_onset_does_not_depend_on_gain_offset_or_sign(lead, gain, offset, sign):
    sound = with_lead(damped(22_050, 330.0, 0.5, 0.0), lead, 1e-4)
    here = recording_from_samples(sound, 22_050).onset
    assert abs(recording_from_samples(sign * gain * sound + offset, 22_050).onset - here) <= 1


@pytest.mark.recordings
def test_real_onsets_come_at_or_before_5_percent_of_the_peak():
    if not (RECORDINGS / "recordings.csv").exists():
        pytest.skip("the folder of recordings is missing")
    late, near = [], 0
    rows = list(csv.DictReader((RECORDINGS / "recordings.csv").read_text().splitlines()))
    for row in rows:
        recording = load_recording(RECORDINGS / row["file"])
        early = float(row["onset_seconds"]) - recording.onset / recording.rate
        late += [(row["file"], early)] if early < -0.0003 else []
        near += early < 0.001
        assert recording.clipped == 0, row["file"]
        assert recording.noise_rms < 0.05 * np.abs(recording.samples).max(), row["file"]
        assert abs(recording.dc) < 1e-4, row["file"]
    assert not late
    assert near >= 0.6 * len(rows)  # the others have audible thumps and precursors some milliseconds before


# --- offset, noise, clipping ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("f0", [27.5, 110.0, 1_000.0])
@pytest.mark.parametrize("offset", [-0.02, 0.0, 0.004])
@pytest.mark.parametrize("lead", [0, 60_000])
def test_the_offset_is_not_the_mean_of_a_decaying_note(f0, offset, lead):
    sound = with_lead(damped(44_100, f0, 2.0, 0.0, decay=2.0), lead, 0.0)
    error = abs(recording_from_samples(sound + offset, 44_100).dc - offset)
    assert error < 1e-6
    if f0 == 27.5 and lead == 0:
        assert abs(sound.mean()) > 1e-3  # a plain mean is not zero


def test_a_large_offset_is_reported():
    recording = recording_from_samples(note() + 0.1, 22_050)
    assert recording.dc == pytest.approx(0.1, abs=1e-4)
    assert any("an offset of 0.1" in warning for warning in recording.warnings)


@pytest.mark.parametrize("rms", [1e-2, 1e-3, 1e-4])
def test_noise_is_measured_before_the_note(rms):
    sound = with_lead(damped(44_100, 220.0, 1.0, 0.0), 20_000, rms)
    sound[8_000:8_200] += 0.03  # a knock
    assert recording_from_samples(sound, 44_100).noise_rms == pytest.approx(rms, rel=0.06)


@pytest.mark.parametrize("rms", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("f0", [55.0, 440.0])
def test_noise_is_measured_under_partials_that_still_ring(rms, f0):
    sound = with_lead(damped(44_100, f0, 4.0, 0.0, decay=0.5), 0, rms)
    assert sound[-44_100:].std() > 1.2 * rms  # the quietest second is not only noise
    assert recording_from_samples(sound, 44_100).noise_rms == pytest.approx(rms, rel=0.12)


def test_a_quantiser_has_noise_even_where_the_lead_in_is_silent(tmp_path):
    sound = np.concatenate([np.zeros(10_000), damped(22_050, 440.0, 1.0, 0.0, decay=30.0)])
    (tmp_path / "note.wav").write_bytes(encoded(sound))
    assert load_recording(tmp_path / "note.wav").noise_rms >= 2.0**-15 / math.sqrt(12)


@pytest.mark.parametrize("subtype", ["PCM_16", "FLOAT"])
@pytest.mark.parametrize("level", [1.0, 0.93])
def test_clipping_is_counted_and_placed(tmp_path, subtype, level):
    rate, t = 44_100, np.arange(44_100) / 44_100
    sound = np.clip(1.15 * np.sin(2 * np.pi * 220 * t) * np.exp(-8 * t), -1, 1) * level * (1 - 2.0**-15)
    sound = np.concatenate([1e-4 * np.random.default_rng(0).normal(size=4_410), sound])
    (tmp_path / "note.wav").write_bytes(encoded(sound, subtype=subtype, rate=rate))
    recording = load_recording(tmp_path / "note.wav")
    at_top = int((np.abs(sound) >= level * (1 - 2.0**-15) - 1e-9).sum())
    assert recording.clipped == at_top > 20
    first = np.argmax(np.abs(sound) >= level * (1 - 2.0**-15) - 1e-9) / rate
    assert "clipped" in recording.warnings[0]
    assert str(at_top) in recording.warnings[0]
    assert f"{first:.3f} s" in recording.warnings[0]


def clipped_note() -> np.ndarray:
    """A note of 16 bits that was recorded 3 dB too loud, steps [samples]."""
    sound = with_lead(damped(44_100, 196.0, 1.0, 0.5, decay=2.0), 4_410, 1e-4)
    return np.round(32_767 * np.clip(2.8 * sound, -1, 1))


@pytest.mark.parametrize("gain", [1.0, 0.5, 0.1, 0.03])
@pytest.mark.parametrize("dither", [0.0, 1.0])
def test_a_note_that_was_clipped_and_then_turned_down_is_clipped(tmp_path, gain, dither):
    sound = clipped_note()
    noise = np.random.default_rng(4).uniform(-0.5, 0.5, (2, len(sound))).sum(axis=0)  # triangular, of two steps
    quiet = np.round(gain * sound + dither * noise) / 32_768
    (tmp_path / "note.wav").write_bytes(encoded(quiet, rate=44_100))
    recording = load_recording(tmp_path / "note.wav")
    assert recording.clipped > 20
    assert any("clipped" in warning for warning in recording.warnings)


@pytest.mark.parametrize("sides", [(-1.0, 0.6), (-0.5, 1.0)])
def test_a_note_whose_sides_were_clipped_at_different_levels_is_clipped_on_both(sides):
    """The levels differ after an offset was removed from a clipped note."""
    low, high = sides
    sound = np.clip(2.4 * with_lead(damped(44_100, 196.0, 1.0, 0.0, decay=12.0), 4_410, 1e-4), low, high)
    runs = [len(run) for side in sides for run in "".join("x" if at else " " for at in sound == side).split()]
    assert recording_from_samples(0.2 * sound, 44_100).clipped == sum(run for run in runs if run >= 3) > 20


@pytest.mark.parametrize("steps", [5, 12, 30, 100, 300])
def test_a_quiet_note_that_is_coarsely_quantised_is_not_clipped(tmp_path, steps):
    rng = np.random.default_rng(steps)
    for f0 in (27.5, 60.0, 196.0, 1_000.0):
        sound = damped(44_100, f0, 0.6, rng.uniform(0, 6))
        quiet = np.round(2 * steps * sound + rng.choice([0.0, 0.5, 2.0]) * rng.normal(size=len(sound)))
        (tmp_path / "note.wav").write_bytes(encoded(np.append(np.zeros(2_000), quiet) / 32_768, rate=44_100))
        with contextlib.suppress(RecordingError):  # some are not above their noise
            assert load_recording(tmp_path / "note.wav").clipped == 0


def test_a_wave_of_one_side_is_not_clipped_at_its_rest():
    """A pulse train is zero between its pulses and never negative."""
    t = np.arange(44_100) / 44_100
    pulses = np.maximum(np.sin(2 * np.pi * 110 * t), 0) ** 2 * np.exp(-2 * t)
    assert recording_from_samples(0.5 * np.append(np.zeros(4_410), pulses), 44_100).clipped == 0


# --- channels that cancel ---------------------------------------------------------------------------------------------


def spaced(correlation: float, level: float = 1.0, channels: int = 2) -> np.ndarray:
    """A note whose last channel has this correlation with the first; the others equal the first [samples, n]."""
    rng, note_ = np.random.default_rng(5), damped(22_050, 330.0, 1.0, 0.5)
    other = damped(22_050, 330.0 * 1.37, 1.0, 1.5)
    other *= np.linalg.norm(note_) / np.linalg.norm(other)
    last = level * (correlation * note_ + math.sqrt(1 - correlation**2) * other)
    sound = np.stack([*[note_] * (channels - 1), last], axis=1)
    return np.append(np.zeros((2_000, channels)), sound, axis=0) + 1e-4 * rng.normal(
        size=(len(sound) + 2_000, channels)
    )


@pytest.mark.parametrize(("correlation", "loss"), [(-0.97, 18.2), (-0.9, 13.0), (-0.8, 10.0), (-0.7, 8.2)])
def test_channels_of_opposite_phase_are_reported_with_what_their_average_loses(tmp_path, correlation, loss):
    (tmp_path / "note.wav").write_bytes(encoded(0.5 * spaced(correlation), subtype="PCM_24"))
    (warning,) = load_recording(tmp_path / "note.wav").warnings
    assert float(re.findall(r"([\d.]+) dB", warning)[0]) == pytest.approx(loss, abs=0.6)
    assert "channel 2" in warning
    assert "--channel" in warning
    assert "invert" in warning
    assert load_recording(tmp_path / "note.wav", channel="left").warnings == ()


@pytest.mark.parametrize("correlation", [1.0, 0.5, 0.0, -0.45])
def test_spaced_microphones_are_not_opposite(tmp_path, correlation):
    (tmp_path / "note.wav").write_bytes(encoded(0.5 * spaced(correlation), subtype="PCM_24"))
    assert load_recording(tmp_path / "note.wav").warnings == ()


@pytest.mark.parametrize("offset", [0.0, 0.2])
def test_channels_whose_average_is_only_noise_are_refused(tmp_path, offset):
    (tmp_path / "note.wav").write_bytes(encoded(0.5 * spaced(-1.0) + offset, subtype="PCM_24"))
    with pytest.raises(RecordingError, match=r"cancel.*channel 2.*--channel"):
        load_recording(tmp_path / "note.wav")


def test_the_one_of_several_channels_that_is_reversed_is_named(tmp_path):
    (tmp_path / "note.wav").write_bytes(encoded(0.5 * spaced(-1.0, 2.0, 4), subtype="PCM_24"))
    (warning,) = load_recording(tmp_path / "note.wav").warnings
    assert "channel 4 is" in warning


@pytest.mark.skipif(not CASES.is_dir(), reason=f"no case files at {CASES}; set PIANOFIT_RECORDINGS")
def test_the_reversed_channel_of_the_case_file_is_reported():
    (warning,) = load_recording(CASES / "stereo-one-reversed.flac").warnings
    assert float(re.findall(r"([\d.]+) dB", warning)[0]) == pytest.approx(10.1, abs=0.2)


@pytest.mark.parametrize("rate", [44_100, 192_000])
@pytest.mark.parametrize("f0", [20.0, 27.5, 60.0, 1_000.0])
def test_a_slow_wave_that_rests_on_its_highest_step_is_not_clipped(tmp_path, rate, f0):
    t = np.arange(rate // 2) / rate
    sound = np.sin(2 * np.pi * f0 * t) * np.exp(-0.01 * t)
    samples = pcm16(sound / np.abs(sound).max())
    (tmp_path / "note.wav").write_bytes(wav(samples, rate=rate))
    longest = np.diff(np.flatnonzero(np.diff(np.frombuffer(samples, "<i2")))).max()
    if f0 < 30:
        assert longest >= 3  # a count of flat runs alone would be wrong
    assert load_recording(tmp_path / "note.wav").clipped == 0


def test_peaks_above_full_scale_in_a_float_file_are_not_clipped(tmp_path):
    (tmp_path / "note.wav").write_bytes(encoded(5 * note(), subtype="FLOAT"))
    recording = load_recording(tmp_path / "note.wav")
    assert recording.clipped == 0
    assert np.abs(recording.samples).max() > 2


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [b for b in BAD_INPUTS if b.gate == "recording"], ids=lambda b: b.id)
def test_every_bad_file_is_refused_in_one_line(tmp_path, bad: BadInput):
    bad.build(tmp_path)
    with pytest.raises(RecordingError) as caught:
        load_recording(bad.bad_file(tmp_path))
    message = str(caught.value)
    assert bad.is_explained_by(message)
    assert message.startswith(printable(bad.bad_file(tmp_path)) + ": ")
    assert message.isprintable()


@pytest.mark.parametrize("channel", ["", "Left", "0", "9", "mid\ndle", "-1"])
def test_an_unknown_channel_is_refused(tmp_path, channel):
    with pytest.raises(ParameterError, match="average, left, right") as caught:
        load_recording(tmp_path / "note.wav", channel=channel)
    assert str(caught.value).isprintable()


def test_a_channel_that_the_file_lacks_is_refused(tmp_path):
    (tmp_path / "note.wav").write_bytes(encoded(np.stack([note(), note()], axis=1)))
    with pytest.raises(RecordingError, match="channel='3'"):
        load_recording(tmp_path / "note.wav", channel="3")


def test_a_zero_byte_in_the_path_is_refused():
    with pytest.raises(RecordingError, match="cannot be read"):
        load_recording("note\0.wav")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission_is_refused(tmp_path):
    (tmp_path / "note.wav").write_bytes(encoded(note()))
    (tmp_path / "note.wav").chmod(0)
    with pytest.raises(RecordingError, match="cannot be read"):
        load_recording(tmp_path / "note.wav")


@settings(max_examples=50, deadline=None)
@given(st.text(max_size=40))
def test_one_line_is_one_printable_line(text):
    assert printable(text).isprintable()
    assert len(printable(text).splitlines()) <= 1


def test_a_short_read_limit(tmp_path):
    (tmp_path / "file").write_bytes(b"12345")
    assert read_file(tmp_path / "file", 5, RecordingError) == b"12345"
    with pytest.raises(PianofitError, match="more than"):
        read_file(tmp_path / "file", 4, RecordingError)


def test_soundfile_is_not_asked_about_what_it_would_let_through(tmp_path):
    """libsndfile reads half a WAV without an error, so the chunks are checked here."""
    (tmp_path / "half.wav").write_bytes(encoded(note())[:20_000])
    samples, _ = soundfile.read(tmp_path / "half.wav")
    assert 0 < len(samples) < len(note())


@pytest.mark.parametrize(("seconds", "count"), [(0.0, 0), (0.05, 0), (1.5, 1)])
def test_digital_silence_at_the_end_is_no_part_of_a_recording(seconds, count):
    """It would count as part of the decay, and as a noise floor of zero."""
    sound = with_lead(damped(44_100, 220.0, 1.0, 0.0), 2_000, 1e-4)
    padded = recording_from_samples(np.append(sound, np.zeros(round(seconds * 44_100))), 44_100)
    np.testing.assert_array_equal(padded.samples, recording_from_samples(sound, 44_100).samples)
    assert sum("digital silence" in warning for warning in padded.warnings) == count
