"""An instrument whose recorded keys have modal responses, from which those of the other keys follow."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import mido
import numpy as np
import pytest
import soundfile
from instrument_cases import ERRORS, PARTS, RATE, document_of, fit_document, rung, true_note, write_fit
from scipy import stats
from typer.testing import CliRunner

from pianofit.cli import app
from pianofit.dsp.damped_sums import sum_damped_modes
from pianofit.dsp.level import level_energy
from pianofit.errors import FitError
from pianofit.export import ExportOptions, export_sampler
from pianofit.felt import law_of
from pianofit.instrument import fields, find_fits, load_instrument, load_keys
from pianofit.instrument.fields import FACTOR, SPREADS, Field, FieldPoints, FieldShape, field_shape
from pianofit.instrument.guessed_knocks import static_part
from pianofit.instrument.guessed_responses import guess_response
from pianofit.instrument.key_quantities import stroke_level
from pianofit.instrument.measured_fields import RecordedKey, StringLaw, measure_fields, measure_path, string_partials
from pianofit.model.modal_response import PRE_ONSET_S, ModalResponse
from pianofit.model.modes import mode_table
from pianofit.model.output_path import OutputPath
from pianofit.schema.decode import builtins_of
from pianofit.schema.modal_response import FittedModalResponse, ModalResponseEntry, encode_knock
from pianofit.transducer import QUANTITIES


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Fits of D3, with a modal response, and of G5, without."""
    place = tmp_path_factory.mktemp("fits")
    note = rung(50)
    fitted = builtins_of(FittedModalResponse(response=ModalResponseEntry.of(note.modal_response)))
    file = write_fit(place, 50, fit_document(note, ERRORS) | {"modal_response": fitted})
    (file.parent / "knock.flac").write_bytes(encode_knock(note.modal_response))
    write_fit(place, 79, fit_document(true_note(79), ERRORS))
    return place


@pytest.fixture(scope="module")
def built(folder):
    return load_instrument(folder)


@pytest.fixture(scope="module")
def document(built):
    return document_of(built)


@pytest.fixture(scope="module")
def file(document, tmp_path_factory):
    path = tmp_path_factory.mktemp("built") / "instrument.json"
    path.write_text(json.dumps(document))
    return path


def test_a_recorded_key_sounds_as_its_fit(folder, built, file):
    """To the quantisation of a 24-bit knock, at any velocity on the instrument's scale."""
    fit = load_keys(find_fits([folder]))[0]
    own, played = (piano.keys[50] for piano in (built, load_instrument(file)))
    scale = own.fit.velocities[-1] / fit.summary.velocities[-1]
    for velocity in (0.5, 4.0):
        expected = fit.note.render(velocity, seconds=1.0, mono=False)
        for note in (own.note, played.note):
            sound = note.render(velocity * scale, seconds=1.0, mono=False)
            assert np.abs(sound - expected).max() < 1e-6 * np.abs(expected).max()


def test_every_key_that_was_not_recorded_has_modes_in_all_channels(built, file):
    made, read = (piano.keys for piano in (built, load_instrument(file)))
    for keys in (made, read):
        assert all(keys[midi].note.modal_response.channels == 2 for midi in keys if midi != 79)
        assert keys[79].note.modal_response is None
        assert keys[51].note.pre_onset_s > 0
    own, again = made[52].note.modal_response, read[52].note.modal_response
    assert own.pole == pytest.approx(again.pole, rel=1e-9)
    assert own.pattern == pytest.approx(again.pattern, rel=1e-9)
    # Guessed knocks follow from those of the recorded keys, which are the same in the file.
    assert np.abs(again.knock - own.knock).max() < 1e-9 * np.abs(own.knock).max()


def test_neighbouring_guessed_keys_are_equally_loud(built):
    keys = built.keys
    for velocity, most in ((4.0, 0.5), (1.0, 1.5)):
        level = np.array([stroke_level(keys[midi].note, velocity) for midi in (24, 25, 58, 59, 60, 61, 96, 97)])
        assert np.abs(np.diff(level)[[0, 2, 3, 4, 6]]).max() < most


def alike(midi: int, gain_db: float | np.ndarray = 0.0, phase: float = 0.4) -> RecordedKey:
    """A key whose 20 partials have these levels and one phase relative to the string model, and decays of `PARTS`."""
    note, law = true_note(midi)._replace(path=None, gain=1.0), StringLaw(0.0, 0.0, 0.01)
    law = law._replace(b1=note.string.b1, d2=note.string.b2 * (np.pi / note.geometry.length) ** 2)
    string, k = string_partials(note, law.strike_sd, 20), np.arange(1, 21)
    rate, (ratio, part) = law.decay(k), np.array(PARTS).T
    # The modes of a partial have one frequency and interfere.
    energy = np.einsum("i,kij,j->k", part, level_energy(rate[:, None, None] * (ratio[:, None] + ratio)), part)
    size = string.impulse * np.sqrt(level_energy(2 * rate) / energy) * 10 ** (gain_db / 20) * np.exp(1j * phase)
    pole = -np.outer(rate, ratio) + 2j * np.pi * string.frequency[:, None]
    pattern = (size[:, None] * part).ravel() * np.array([[1.5], [0.5]])
    knock = np.zeros((2, 0))
    response = ModalResponse(np.repeat(k, 2), pole.ravel(), np.zeros(40), pattern, knock, RATE)
    return RecordedKey(midi, note._replace(modal_response=response), note, law, (1.0, 4.0))


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_an_impulse_excites_partials_as_the_model_of_a_fit_does(quantity):
    note, k = true_note(45)._replace(quantity=quantity), np.arange(1, 21)
    found = string_partials(note, 0.0, len(k))
    modes = mode_table(note.string, note.geometry, rate=1e6, n_modes=len(k), quantity=quantity)
    # After a unit impulse the displacement is γ/ω and the signal what the pickup reads of it.
    expected = np.abs(modes.free_pickup) * modes.modal_gain / (2 * np.pi * found.frequency)
    excited = law_of(note.hammer).mode_excitation(2 * np.pi * found.frequency)
    np.testing.assert_allclose(np.abs(found.impulse), np.abs(excited * expected), rtol=1e-3)


def energy_of(response: ModalResponse, part: np.ndarray) -> float:
    """Energy of the level of one partial."""
    pole, amplitude = response.pole[part], response.pattern.mean(axis=0)[part]
    return float(np.real(amplitude @ level_energy(-(pole[:, None] + pole.conj())) @ amplitude.conj()))


def test_a_guess_between_keys_that_are_alike_is_like_them():
    """Levels relative to the string model, decay curve, phase and channels are those that all recorded keys share."""
    fields, wanted = measure_fields([alike(midi, 5.0) for midi in (44, 48, 52, 60)]), alike(50, 5.0)
    found = guess_response(wanted.note, 50, wanted.law, fields)
    times, rate = np.array([0.0, 0.1, 0.3, 1.0, 3.0]), wanted.law.decay(np.arange(1, 21))
    ratio, part = np.array(PARTS).T
    truth = 20 * np.log10(np.exp(-np.outer(times, ratio)) @ part)
    string = string_partials(wanted.note, wanted.law.strike_sd, 20)
    for k in range(1, 19):
        at, own = found.partial == k, wanted.note.modal_response.partial == k
        assert np.imag(found.pole[at]) / (2 * np.pi) == pytest.approx(string.frequency[k - 1], rel=1e-9)
        parts = np.exp(np.outer(times, np.real(found.pole[at]) / rate[k - 1]))
        curve = 20 * np.log10(np.abs(parts @ found.pattern.mean(axis=0)[at]))
        assert curve - curve[0] == pytest.approx(truth - truth[0], abs=0.02)
        assert 10 * np.log10(energy_of(found, at) / energy_of(wanted.note.modal_response, own)) == pytest.approx(
            0.0, abs=0.1
        )
        shares = found.pattern.mean(axis=0)[at]
        assert found.pattern[0, at] / found.pattern[1, at] == pytest.approx(3.0, rel=1e-3)
        assert np.angle(shares.sum() * np.sign(string.impulse[k - 1])) == pytest.approx(0.4, abs=0.05)


def test_a_guess_has_the_mean_power_of_partials_that_scatter():
    """Also where a cell holds several partials: a mean of their powers would count the scatter twice."""
    errors = []
    for seed in range(3):
        scatter = 5.0 * np.random.default_rng(seed).normal(size=(36, 20))
        fields = measure_fields([alike(midi, own) for midi, own in zip(range(36, 72), scatter, strict=True)])
        excess = []
        for midi in (43, 47, 51, 55, 59, 63):
            wanted = alike(midi)
            found, plain = guess_response(wanted.note, midi, wanted.law, fields), wanted.note.modal_response
            own = [(found.partial == k, plain.partial == k) for k in range(1, 21)]
            excess.append([10 * np.log10(energy_of(found, at) / energy_of(plain, same)) for at, same in own])
        errors.append(np.mean(excess) - 10 * np.log10(np.mean(10 ** (scatter / 10))))
    assert np.mean(errors) == pytest.approx(0.0, abs=0.3)


def with_knock(key: RecordedKey, knock: np.ndarray) -> RecordedKey:
    """A recorded key with this knock, besides that which cancels the static deflection of its modes."""
    response = key.note.modal_response
    response = response._replace(knock=static_part(response) + knock)
    return replace(key, note=key.note._replace(modal_response=response))


def guessed_noise(keys: list[RecordedKey], midi: int) -> np.ndarray:
    """The noise in the knock of a key that is guessed from others [channels, samples]."""
    wanted = alike(midi)
    found = guess_response(wanted.note, midi, wanted.law, measure_fields(keys))
    return found.knock - static_part(found)


def test_a_knock_that_cancels_modes_is_not_guessed_as_noise():
    """Noise would add its power where the knock takes it away. Independent noise keeps its power."""
    cancelling, noisy, random = [], [], np.random.default_rng(2)
    for midi in (44, 48, 52, 56):
        key = alike(midi)
        response = key.note.modal_response
        static, lead = static_part(response), round(PRE_ONSET_S * RATE)
        modes = sum_damped_modes(response.pole, response.pattern, RATE, static.shape[1] - lead)
        ringing = static + np.pad(modes, ((0, 0), (lead, 0)))
        cancelling.append(with_knock(key, -0.5 * ringing))
        fading = np.exp(-np.arange(static.shape[1]) / (0.1 * RATE))
        noise = random.normal(size=static.shape) * ringing.std() * fading
        noisy.append((with_knock(key, noise), noise, ringing))
    noise = guessed_noise([key for key, *_ in noisy], 50)
    # The partials of the higher key are above many of those that the recorded knocks cancel.
    for midi in (50, 74):
        assert np.sum(guessed_noise(cancelling, midi) ** 2) < 0.01 * np.sum(noisy[0][2] ** 2)
    own = np.mean([np.sum(wave[:, lead:] ** 2) for _, wave, _ in noisy])
    assert 10 * np.log10(np.sum(noise**2) / own) == pytest.approx(0.0, abs=1.5)


def test_a_guessed_knock_is_as_silent_below_a_band_as_the_recorded_ones():
    """Frames as short as its beginning would not separate 40 Hz from 100 Hz."""
    random, recorded, band = np.random.default_rng(4), [], (80.0, 160.0)

    def power(wave: np.ndarray, least: float, most: float) -> float:
        frequency = np.fft.rfftfreq(wave.shape[1], 1 / RATE)
        return float(np.sum(np.abs(np.fft.rfft(wave)[:, (frequency > least) & (frequency < most)]) ** 2))

    for midi in (44, 48, 52, 56):
        key = alike(midi)
        shape = static_part(key.note.modal_response).shape
        time, frequency = np.arange(shape[1]) / RATE, np.fft.rfftfreq(shape[1], 1 / RATE)
        within = np.exp(-0.5 * (np.log2(frequency.clip(1.0) / np.sqrt(np.prod(band))) / 0.25) ** 2)
        noise = np.fft.irfft(np.fft.rfft(random.normal(size=shape)) * within, shape[1])
        recorded.append(with_knock(key, noise * np.clip((time - PRE_ONSET_S) / 0.02, 0, 1) * np.exp(-time / 0.1)))
    guessed = guessed_noise(recorded, 50)
    assert power(guessed, *band) > 1000 * power(guessed, 20.0, 40.0)


def test_the_drawn_channels_of_a_guess_differ_as_much_as_the_recorded_ones():
    random = np.random.default_rng(5)
    size = 0.8

    def wide(midi: int) -> RecordedKey:
        key = alike(midi)
        response = key.note.modal_response
        side = np.repeat(size * np.exp(2j * np.pi * random.uniform(size=20)), 2)
        pattern = response.pattern.mean(axis=0) * np.array([1 + side, 1 - side])
        return replace(key, note=key.note._replace(modal_response=response._replace(pattern=pattern)))

    wanted = alike(50)
    found = guess_response(wanted.note, 50, wanted.law, measure_fields([wide(midi) for midi in range(40, 62, 3)]))
    deviation = found.pattern / found.pattern.mean(axis=0) - 1
    assert np.sqrt(np.mean(np.abs(deviation) ** 2)) == pytest.approx(size, abs=0.02)


def test_a_key_without_a_knock_may_have_the_highest_rate():
    key, silent = alike(44), alike(56)
    noise = np.random.default_rng(0).normal(size=static_part(key.note.modal_response).shape)
    fast = silent.note.modal_response._replace(rate=2 * RATE)
    silent, wanted = replace(silent, note=silent.note._replace(modal_response=fast)), alike(50)
    found = guess_response(wanted.note, 50, wanted.law, measure_fields([with_knock(key, noise), silent]))
    assert found.rate == 2 * RATE
    assert found.knock.shape == static_part(found).shape


def test_the_difference_of_two_hammers_is_not_a_level():
    """A hammer of half the weight, with a path that makes up for it, gives the same field."""
    at = 4.0
    key = replace(alike(50), velocities=(at,))
    light = key.note._replace(hammer=key.note.hammer._replace(M_H=0.5 * key.note.hammer.M_H))
    own, law = (
        np.abs(x) for x in (drive(light, key.note.modal_response, at), drive(key.note, key.note.modal_response, at))
    )
    response = key.note.modal_response._replace(pattern=key.note.modal_response.pattern * law / own)
    made_up = RecordedKey(50, light._replace(modal_response=response), key.note, key.law, (at,))
    unaware = replace(made_up, law_note=made_up.note)
    one, other, wrong = (measure_fields([x]).cells.level for x in (key, made_up, unaware))
    # Below the first zeros of the two forces.
    assert np.abs(other - one)[:2].max() < 0.2
    assert np.abs(wrong - one)[:2].min() > 4.0


def drive(note, response, velocity) -> np.ndarray:
    """Drive of the modes by a stroke, from the simulated force."""
    stroke = note.with_velocity(velocity).strike(RATE)
    force, step = np.asarray(stroke.pulse.force), float(stroke.modes.step)
    return step * force @ np.exp(-np.outer(step * np.arange(len(force)), response.pole))


def test_a_guess_without_modes_takes_the_smooth_path_of_the_recorded_keys():
    frequency = 40.0 * 2.0 ** np.arange(0, 8, 0.1)
    path = OutputPath(frequency, 5 * np.sin(np.log2(frequency)))
    keys = [replace(alike(midi), note=true_note(midi)._replace(path=path, gain=2.0)) for midi in (30, 40, 50, 60)]
    found = measure_path([replace(key, law_note=key.note) for key in keys]).at(45)
    inside = (found.frequency > 200) & (found.frequency < 4000)
    assert found.db[inside] == pytest.approx(path.at(found.frequency[inside]) + 20 * np.log10(2.0), abs=0.7)


def test_a_constant_force_has_no_sound_in_a_guess():
    """A slow force displaces modes quasi-statically, which would be a thump. The knock of a guess cancels it."""
    fields, wanted = measure_fields([alike(midi) for midi in (26, 30, 34)]), alike(28)
    response = guess_response(wanted.note, 28, wanted.law, fields)
    modes = np.real(response.pattern @ (1 / (1 - np.exp(response.pole / RATE))))
    assert np.abs(modes).min() > 0
    assert modes + response.knock.sum(axis=1) == pytest.approx(np.zeros(2), abs=1e-3 * np.abs(modes).max())
    assert response.knock.shape[-1] > round(PRE_ONSET_S * RATE)


def test_a_field_passes_through_exact_points_and_returns_to_its_mean_far_away():
    random = np.random.default_rng(2)
    octave, key = (axis.ravel() for axis in np.meshgrid(np.arange(6.0, 13.0), [30.0, 50.0, 70.0]))
    points = FieldPoints(octave, key, np.ones(21))
    shape = FieldShape(3.0, 0.7, 2.0, 20.0, 2.0, 0.4, 6.0, 0.0, 1e-4)
    values = random.normal(size=21)
    assert Field(points, shape).weights(points) @ values == pytest.approx(values, abs=1e-3)
    far = FieldPoints(np.array([40.0]), np.array([900.0]), np.ones(1))
    assert Field(points, shape).weights(far) @ values == pytest.approx(0.0, abs=1e-9)


def test_the_spreads_of_a_field_are_found():
    random = np.random.default_rng(4)
    octave, key = (axis.ravel() for axis in np.meshgrid(np.linspace(5, 13, 20), np.arange(22.0, 109.0, 6)))
    points = FieldPoints(octave, key, random.integers(1, 20, len(key)).astype(float))
    true = FieldShape(5.0, 0.8, 2.0, 20.0, 3.0, 0.5, 8.0, 1.5, 3.0)
    covariance = true.covariance(points, points) + np.diag(1.5**2 + 3.0**2 / points.size)
    found = field_shape(points, np.linalg.cholesky(covariance) @ random.normal(size=len(key)))
    assert (found.cell_sd, found.residual) == pytest.approx((1.5, 3.0), rel=0.4)
    assert found.common_sd + found.drift_sd == pytest.approx(8.0, rel=0.5)
    assert found.drift_keys == pytest.approx(8.0, rel=0.5)


@pytest.mark.parametrize(("seed", "higher"), [(26, 0.2), (79, 0.5), (71, 0.0), (160, 0.0)])
def test_the_highest_of_several_maxima_is_found(seed, higher, monkeypatch):
    """By an independent density: no lower than from the medians, and higher where these end in another maximum."""
    random = np.random.default_rng(seed)
    count = random.integers(2, 5)
    keys, octaves = (
        np.sort(random.choice(np.arange(21, 109), count, replace=False)).astype(float),
        np.linspace(5, 13, 14),
    )
    if seed % 2:
        octave, key = np.tile(octaves, count), np.repeat(keys, 14)
        values = np.cumsum(random.normal(size=(14, count)), axis=0).T.ravel()
    else:
        octave, key = np.repeat(octaves, count), np.tile(keys, 14)
        common = np.cumsum(random.normal(size=(14, 1)), axis=0)
        values = (common + 0.7 * np.cumsum(random.normal(size=(14, count)), axis=1)).ravel()
    points = FieldPoints(octave, key, np.ones(len(key)))

    def density(shape: FieldShape) -> float:
        relative = shape._replace(**{name: getattr(shape, name) / values.std() for name in SPREADS})
        away = (np.log(relative) - np.log(FieldShape())) / FACTOR
        total = shape.covariance(points, points) + shape.white(1.0) * np.eye(len(key))
        return stats.multivariate_normal(cov=total).logpdf(values - values.mean()) - 0.5 * away @ away

    both = density(field_shape(points, values))
    monkeypatch.setattr(fields, "START_FACTORS", (1.0, 1.0 + 1e-9))
    assert both >= density(field_shape(points, values)) + higher - 0.01


def test_a_partial_of_two_guessed_keys_is_drawn_alike():
    """Keys that the fields predict alike differ in nothing else, whatever number of partials they have."""
    phases = [alike(midi, phase=midi) for midi in (26, 30, 34)]
    fields = measure_fields(phases)
    low, high = (guess_response(alike(midi).note, midi, alike(midi).law, fields) for midi in (28, 29))
    count = min(low.partial.max(), high.partial.max())
    angle = [
        np.angle(one.pattern.mean(axis=0)[np.searchsorted(one.partial, range(1, count + 1))]) for one in (low, high)
    ]
    turned = np.exp(1j * (angle[0] - angle[1]))
    assert turned.real.mean() > 0.7


BAD = {
    "modes": ({"modes": 1}, r"modal_response\.modes = 1 must be a table"),
    "uneven": ({"modes": {"partial": [1]}}, r"modal_response\.modes\.frequency is missing"),
    "no base64": ({"knock": {"flac": "?", "scale": 1.0}}, "base64"),
    "no sound": ({"knock": {"flac": "AAAA", "scale": 1.0}}, "FLAC"),
    "truncated": ({"knock": {"flac": "ZkxhQwAAAA==", "scale": 1.0}}, "cannot be read"),
    "text": ({"knock": {"flac": 7, "scale": 1.0}}, r"modal_response\.knock\.flac = 7 must be a text"),
    "scale": ({"knock": {"flac": "", "scale": None}}, "knock.scale"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_hostile_ringing_is_refused(name, document, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    change, message = BAD[name]
    bad = copy.deepcopy(document)
    bad["keys"][50 - 21]["modal_response"] |= change
    (tmp_path / "bad.json").write_text(json.dumps(bad))
    with pytest.raises(FitError, match=message) as caught:
        load_instrument("bad.json")
    assert str(caught.value).startswith("bad.json: ")


@pytest.mark.parametrize("law", ["d2", "mu"])
def test_guessed_keys_need_the_laws_of_string_and_hammer(law, document, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bad = copy.deepcopy(document)
    del bad["laws"][law]
    (tmp_path / "bad.json").write_text(json.dumps(bad))
    with pytest.raises(FitError, match=f"bad.json: laws must have {law}, "):
        load_instrument("bad.json")


def test_a_song_is_written_in_as_many_channels(file, tmp_path):
    track = mido.MidiTrack([mido.Message("note_on", note=50, velocity=80), mido.Message("note_off", note=50, time=480)])
    mido.MidiFile(tracks=[track]).save(tmp_path / "a.mid")
    words = ["play", file, tmp_path / "a.mid", "--out", tmp_path / "a.wav", "--json"]
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["channels"] == 2
    sound, _ = soundfile.read(tmp_path / "a.wav")
    assert sound.shape[1] == 2
    assert np.abs(sound[:, 0] - sound[:, 1]).max() > 0.1 * np.abs(sound).max()


def test_samples_are_the_models_strokes_in_stereo_with_their_contacts_aligned(file, tmp_path):
    """Each sample is the stroke shifted by whole samples, the soft one to earlier. A player plays both channels."""
    from pysfizz import Synth

    piano = load_instrument(file)
    export_sampler(piano, tmp_path / "out", [50, 79], ExportOptions(2, 0.3, RATE, "wav"))
    shifts, first = [], round(0.1 * RATE)
    for velocity in (1, 127):
        sound = soundfile.read(tmp_path / "out" / "samples" / f"050-D3-v{velocity:03}.wav")[0].T
        note = piano.note(50, velocity)
        expected = note.render_channels(note.strike(RATE), RATE, 2 * first, round(note.pre_onset_s * RATE))
        trial = range(-RATE // 500, RATE // 500)
        products = [np.vdot(np.roll(expected, m, axis=1)[:, :first], sound[:, :first]) for m in trial]
        shifts.append(trial[int(np.argmax(products))])
        part = slice(abs(shifts[-1]), first)
        same = np.roll(expected, shifts[-1], axis=1)[:, part]
        gain = np.vdot(same, sound[:, part]) / np.vdot(same, same)
        step = 2.0**-23  # 24 bits
        assert np.abs(sound[:, part] - gain * same).max() < max(1e-5 * np.abs(sound).max(), 1.1 * step)
        assert len(sound) == 2
    assert -RATE // 1000 <= shifts[0] - shifts[1] <= 0
    synth = Synth(sample_rate=RATE, block_size=512)
    assert synth.load_sfz_file(tmp_path / "out" / "twin.sfz", quiet=False)
    played = synth.render_note(50, 127, 0.3, 0.3)[:, :first]
    alike = np.corrcoef(np.concatenate([played, sound[:, :first]]))
    assert min(alike[0, 2], alike[1, 3]) > 0.999
    assert alike[0, 1] < 0.9
    assert soundfile.info(tmp_path / "out" / "samples" / "079-G5-v127.wav").channels == 1


def test_a_key_without_a_knock_takes_none_from_the_others():
    """One fit can have modes alone. Unrecorded keys then follow the knocks of the other keys."""
    keys, wanted = [alike(midi) for midi in (26, 30, 34)], alike(28)
    bare = keys[1].note._replace(modal_response=keys[1].note.modal_response.without_knock())
    others, mixed = (
        guess_response(wanted.note, 28, wanted.law, measure_fields(known)).knock
        for known in ([keys[0], keys[2]], [keys[0], replace(keys[1], note=bare), keys[2]])
    )
    assert np.sum(mixed**2) == pytest.approx(np.sum(others**2), rel=0.2)
