"""The engine of the page in node: its sound is that of the model, and its tables fit into a page."""

from __future__ import annotations

import base64
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from instrument_cases import (
    ERRORS,
    fit_document,
    library,
    piano_of,
    true_instrument,
    true_note,
    uneven_note,
    write_fit,
)
from page_cases import BLOCK, RATE, early, error_db, play, ringing_note, run

from pianofit.cli import main
from pianofit.dsp.filters import resample
from pianofit.errors import FitError, ParameterError
from pianofit.felt import RelaxingHammer
from pianofit.instrument import Instrument, write_instrument
from pianofit.model.modal_response import PRE_ONSET_S, VelocityGain, force_pulse
from pianofit.model.modes import mode_frequencies
from pianofit.playback import PlayOptions, Song, render_song
from pianofit.playback.voice import StringVoice
from pianofit.schema.dampers import Dampers
from pianofit.schema.instrument import KeyValue
from pianofit.schema.notes import load_note
from pianofit.web import write_playable_page
from pianofit.web.knock_encoding import BEST, KnockEncoding, encoded_knock
from pianofit.web.payload import encode_instrument, encode_note, slider_intervals

BLOCKS = 375  # 1 s
WITHIN = -80.0  # dB
CHANGES = {"force": 2.0, "p": 0.3, "mu": 0.5, "mass": 1.3, "strike": 0.8, "loss": 2.0, "inharmonicity": 1.7}


def job(entry: dict, *events: list, **more: object) -> dict:
    return {"keys": {60: entry}, "events": list(events), "blocks": BLOCKS, **more}


def struck(velocity: float, block: int = 0) -> list:
    return [block, "noteOn", 60, velocity]


@pytest.mark.parametrize("velocity", [0.8, 4.0])
@pytest.mark.parametrize("midi", [24, 60, 96])
def test_a_key_that_rings_by_its_law_sounds_as_the_model_does(midi, velocity):
    note = uneven_note(midi)
    (sound,) = play([job(encode_note(note, midi), struck(velocity))])
    assert error_db(sound, note.render(velocity, seconds=1.0, rate=RATE)) < WITHIN


@pytest.mark.parametrize("quantity", ["velocity", "bridge-force"])
def test_every_pickup_sounds_as_the_model_does(quantity):
    note = true_note(52)._replace(quantity=quantity, path=None, gain=0.1)
    (sound,) = play([job(encode_note(note, 52), struck(2.0))])
    assert error_db(sound, note.render(2.0, seconds=1.0, rate=RATE)) < WITHIN


@pytest.mark.parametrize("velocity", [0.8, 4.0])
@pytest.mark.parametrize("midi", [28, 72])
def test_a_key_with_its_own_ringing_sounds_as_the_model_does(midi, velocity):
    note = ringing_note(midi)
    (sound,) = play([job(encode_note(note, midi), struck(velocity))])
    assert error_db(sound[:, early(note) :], note.render(velocity, seconds=1.0, rate=RATE, mono=False)) < WITHIN


@pytest.mark.parametrize("strokes", [slice(None), slice(1)])
@pytest.mark.parametrize("velocity", [0.2, 0.5, 8.0])
def test_strokes_beyond_those_that_say_how_modes_take_part_do_as_the_last(strokes, velocity):
    """Below the slowest stroke, at it, and above the fastest; also with a single stroke."""
    note = ringing_note(52)
    assert note.modal_response is not None
    part = note.modal_response.velocity_gain
    assert part is not None
    assert 0.2 < part.velocity[0] == 0.5 < part.velocity[-1] < 8.0
    part = VelocityGain(part.velocity[strokes], part.factor[strokes])
    note = note._replace(modal_response=note.modal_response._replace(velocity_gain=part))
    (sound,) = play([job(encode_note(note, 52), struck(velocity))])
    expected = note.render(velocity, seconds=1.0, rate=RATE, mono=False)
    assert error_db(sound[:, early(note) :], expected) < WITHIN
    without = note._replace(modal_response=note.modal_response._replace(velocity_gain=None))
    assert error_db(expected, without.render(velocity, seconds=1.0, rate=RATE, mono=False)) > -40


@pytest.mark.parametrize("midi", [28, 60])
def test_a_stroke_on_a_moving_string_is_the_players(midi):
    note, again = uneven_note(midi), 40
    string = StringVoice(note, midi, RATE)
    head = string.strike(4.0)
    rest = string.ring(again * BLOCK - head.shape[-1])
    second = string.strike(1.5)
    last = string.ring(RATE - again * BLOCK - second.shape[-1])
    expected = string.through_path(np.concatenate([head, rest, second, last], axis=-1))[..., :RATE]
    (sound,) = play([job(encode_note(note, midi), struck(4.0), struck(1.5, again))])
    assert error_db(sound, expected) < WITHIN
    # It differs from the sum with a stroke at rest.
    apart = play([job(encode_note(note, midi), struck(4.0)), job(encode_note(note, midi), struck(1.5, again))])
    assert error_db(sum(apart), expected) > -60


def test_a_stroke_within_a_contact_waits_for_its_end():
    (sound,) = play([job(encode_note(true_note(30), 30), *[struck(3.0, block) for block in range(8)])])
    assert np.isfinite(sound).all()
    assert np.abs(sound).max() > 0.1 * np.abs(true_note(30).render(3.0, seconds=1.0, rate=RATE)).max()


def test_a_damper_adds_its_rate_and_does_not_click():
    note, at = true_note(50)._replace(path=None), 150
    entry = encode_note(note, 50, dampers=Dampers(slope=0.0))  # all modes at one rate
    free, damped, caught = play([
        job(entry, struck(3.0)), job(entry, struck(3.0), [at, "noteOff", 60]),
        job(entry, struck(3.0), [at - 1, "control", 64, 127], [at, "noteOff", 60]),
    ])  # fmt: skip
    after = np.arange(RATE - at * BLOCK) / RATE
    np.testing.assert_allclose(damped[:, : at * BLOCK], free[:, : at * BLOCK], rtol=1e-6, atol=1e-12)
    expected = free[:, at * BLOCK :] * np.exp(-entry["damper"]["rate"] * after)
    # Modes end where they are inaudible.
    np.testing.assert_allclose(damped[:, at * BLOCK :], expected, rtol=1e-6, atol=1e-6)
    assert (caught == free).all()
    bend = np.abs(np.diff(damped[0], 2))
    assert bend[at * BLOCK - 3 : at * BLOCK + 24].max() <= 1.05 * bend[at * BLOCK - 2400 : at * BLOCK - 3].max()


def test_keys_sound_together_as_they_do_alone_and_silence_is_silent():
    low, high = encode_note(true_note(40), 40), encode_note(true_note(47), 47)
    both = {"keys": {40: low, 47: high}, "blocks": 100}
    first, second = [0, "noteOn", 40, 3.0], [7, "noteOn", 47, 1.0]
    together, a, b, stopped = play([
        {**both, "events": [first, second]}, {**both, "events": [first]}, {**both, "events": [second]},
        {**both, "events": [first, second, [50, "panic"]]},
    ])  # fmt: skip
    np.testing.assert_allclose(together, a + b, rtol=1e-6, atol=1e-12)
    assert not stopped[:, 50 * BLOCK :].any()


def test_a_piece_with_strings_struck_again_dampers_and_pedal_is_the_players():
    """Keys with a knock, which begins before its stroke, and softer keys without. Events lie on the blocks of the page.

    With an output path the dampers of the page are approximate, because the gain is that at the pole of the free mode.
    """
    notes = {k: true_note(k)._replace(gain=1e-3) for k in (45, 52, 60, 64)}
    notes |= {k: uneven_note(k)._replace(gain=1.0, modal_response=ringing_note(k).modal_response) for k in (52, 64)}
    piano, random, at = piano_of(notes), np.random.default_rng(3), BLOCK / RATE
    keys = {k: [] for k in notes}
    events = [[500, "control", 64, 127], [900, "control", 64, 0]]
    for key, found in keys.items():
        for begin in np.arange(10, 1100, 90) + random.integers(0, 30, 13):
            velocity, end = int(random.integers(30, 110)), int(begin + random.integers(20, 55))
            found += [(begin * at, velocity), (end * at, 0)]
            struck_at = piano.note(key, velocity).hammer.v_H0
            events += [[int(begin), "noteOn", key, struck_at], [end, "noteOff", key]]
    song = Song(keys, [(500 * at, 127), (900 * at, 0)], 1200 * at, 52)
    expected = render_song(piano, song, RATE, options=PlayOptions(resonance=0.0))
    assert expected.limited_db == expected.gain_db == 0
    entries = {key: encode_note(note, key) for key, note in notes.items()}
    (sound,) = play([{"keys": entries, "events": sorted(events), "blocks": 1200}])
    assert expected.restrikes > 20
    assert error_db(sound[:, early(notes[52]) :], expected.samples) < -60


def test_a_damper_through_a_path_is_nearly_the_players():
    """In the page a mode keeps the gain of its free decay. The path of `render_song` filters the damped sound."""
    note, at, end = uneven_note(52), BLOCK / RATE, 150
    piano = piano_of({52: note})
    song = Song({52: [(0.0, 90), (end * at, 0)]}, [], 400 * at, 52)
    expected = render_song(piano, song, RATE).samples
    events = [[0, "noteOn", 52, piano.note(52, 90).hammer.v_H0], [end, "noteOff", 52]]
    (sound,) = play([{"keys": {52: encode_note(note, 52)}, "events": events, "blocks": 400}])
    assert error_db(sound[:, : end * BLOCK], expected[:, : end * BLOCK]) < WITHIN
    assert error_db(sound, expected) < -40


def test_a_key_without_knock_waits_for_those_that_have_one():
    own, law = ringing_note(60), true_note(72)
    (sound,) = play([{"keys": {60: encode_note(own, 60), 72: encode_note(law, 72)}, "events": [[0, "noteOn", 72, 2.0]],
                      "blocks": 40}])  # fmt: skip
    begin = np.flatnonzero(sound[0])[0]
    assert abs(begin - own.pre_onset_s * RATE) <= BLOCK


@pytest.mark.parametrize("loud", [0.3, 30.0])
def test_the_output_never_passes_its_ceiling_and_leaves_alone_what_fits(loud):
    entry = encode_note(true_note(60)._replace(gain=loud), 60)
    free, limited = play([job(entry, struck(4.0)), job(entry, struck(4.0), output=True)])
    if loud > 1:
        assert 0.5 < np.abs(limited).max() <= 0.892 < np.abs(free).max()
    if np.abs(free).max() <= 0.892:
        np.testing.assert_allclose(limited[:, BLOCK:], free[:, :-BLOCK], rtol=1e-6, atol=1e-12)


def test_a_saved_sound_is_a_wav_file():
    entry = encode_note(true_note(60), 60)
    ((data,),), (sound,) = run([job(entry, struck(2.0), wav=True)]), play([job(entry, struck(2.0))])
    read, rate = sf.read(io.BytesIO(data))
    assert rate == RATE
    assert np.abs(read.T - sound).max() < 1e-6


def test_a_changed_key_is_the_changed_note():
    note = true_note(52)._replace(path=None)
    entry, c = encode_note(note, 52), CHANGES
    s, h, g = note.string, note.hammer, note.geometry
    p = h.p + c["p"]
    other = note._replace(
        string=s._replace(b1=2 * s.b1, b2=2 * s.b2, kappa=s.kappa * np.sqrt(1.7)),
        hammer=h._replace(
            p=p, mu=0.5 * h.mu, M_H=1.3 * h.M_H, K_H=2 * h.K_H * entry["compression"] ** (h.p - p)
        ),
        geometry=g._replace(strike_position=0.8 * g.strike_position),
    )  # fmt: skip
    (sound,) = play([job(entry, struck(2.0), changes=c)])
    assert error_db(sound, other.render(2.0, seconds=1.0, rate=RATE)) < WITHIN


def saved(entry: dict, folder: Path, **more: object) -> Path:
    """Save a key of the page as note.json."""
    about = {"velocity": 2.5, "rate": RATE, "origin": "A note."}
    (folder / "note.json").write_bytes(run([{"keys": {60: entry}, "note": about, **more}])[0][0])
    return folder / "note.json"


@pytest.mark.parametrize("changes", [None, CHANGES])
@pytest.mark.parametrize("make", [uneven_note, ringing_note])
def test_a_saved_note_is_rendered_as_the_page_plays_it(tmp_path, make, changes):
    entry, more = encode_note(make(52), 52), {} if changes is None else {"changes": changes}
    (sound,) = play([job(entry, struck(2.5), **more)])
    note, rate = load_note(saved(entry, tmp_path, **more))
    assert (rate, note.hammer.v_H0, note.quantity) == (RATE, 2.5, "pressure")
    assert error_db(sound[:, early(note) :], note.render(seconds=1.0, rate=RATE, mono=False)) < WITHIN
    if changes is None:
        assert note.gain == make(52).gain


@pytest.mark.parametrize("velocity", [0.2, 8.0])
def test_a_saved_note_keeps_how_its_modes_take_part(tmp_path, velocity):
    """A note.json gives the same sound as its key at velocities outside its measured strokes."""
    note, _ = load_note(saved(encode_note(ringing_note(52), 52), tmp_path))
    expected = ringing_note(52).render(velocity, seconds=0.5, rate=RATE, mono=False)
    assert error_db(note.render(velocity, seconds=0.5, rate=RATE, mono=False), expected) < WITHIN


def test_the_render_command_takes_a_saved_note(tmp_path, capsys):
    file = saved(encode_note(ringing_note(60), 60), tmp_path)
    assert main(["render", str(file), "--velocity", "3", "--seconds", "0.5", "--out", str(tmp_path / "note.wav")]) == 0
    assert "0.5 s at 3 m/s" in capsys.readouterr().out
    assert sf.info(tmp_path / "note.wav").samplerate == RATE


@pytest.mark.parametrize("changes", [dict.fromkeys(CHANGES, 50.0) | {"strike": 1.0}, dict.fromkeys(CHANGES, 1e-3)])
def test_no_slider_leads_where_a_note_is_refused(tmp_path, changes):
    load_note(saved(encode_note(true_note(90), 90), tmp_path, changes=changes))


def test_a_knock_in_a_note_is_checked(tmp_path):
    file = saved(encode_note(ringing_note(60), 60), tmp_path)
    document = json.loads(file.read_text())
    for knock in ("no base64", "AAAA"):
        document["modal_response"]["response"]["knock"]["wav"] = knock
        file.write_text(json.dumps(document))
        with pytest.raises(FitError, match=r"modal_response\.knock\.wav"):
            load_note(file)


def test_the_sliders_have_the_intervals_of_the_instrument():
    values = {"F/M_S": (100.0, 50.0, 200.0), "p": (2.5, 2.4, 2.7), "B": (1e-3, 9e-4, 1.2e-3), "x0/L": (0.1, 0.2, 0.3)}
    assert slider_intervals({name: KeyValue(x, (low, high)) for name, (x, low, high) in values.items()}) == {
        "force": (0.5, 2.0),
        "p": pytest.approx((-0.1, 0.2)),
        "inharmonicity": pytest.approx((0.9, 1.2)),
    }
    even = dict.fromkeys(("b1", "d2"), KeyValue(0.3, (0.3 / 1.5, 0.3 * 1.5)))
    # Two equal errors add in quadrature.
    assert slider_intervals(even)["loss"][1] == pytest.approx(1.5 ** (1 / np.sqrt(2)))
    keys = {midi: replace(key, values={"mu": KeyValue(0.2, (0.1, 0.4))}) for midi, key in two_keys().keys.items()}
    payload, _ = encode_instrument(replace(two_keys(), keys=keys), 1_000_000)
    assert payload["keys"][1]["intervals"] == {"mu": [0.5, 2.0]}
    assert payload["keys"][1]["values"] == {"mu": [0.2, 0.1, 0.4]}


def test_changes_of_the_string_move_measured_partials_with_it():
    note = true_note(52)
    f0, count = note.string.c / (2 * note.geometry.length), 12
    stiffer = note.string._replace(kappa=note.string.kappa * np.sqrt(3))
    before, after = (mode_frequencies(s, note.geometry.length, count) for s in (note.string, stiffer))
    ringing = ringing_note(52, channels=1).modal_response
    pattern = np.zeros((1, 2), complex)
    pattern[0, 0] = 1.0
    one = ringing._replace(partial=np.array([count, 1]), pole=-0.01 + 2j * np.pi * np.array([before[-1], f0]),
                           pattern=pattern, knock=ringing.knock[:, :0])  # fmt: skip
    (sound,) = play(
        [job(encode_note(note._replace(modal_response=one), 52), struck(2.0), changes={"inharmonicity": 3.0})]
    )
    spectrum = np.abs(np.fft.rfft(sound[0] * np.hanning(sound.shape[-1])))
    assert np.argmax(spectrum) * RATE / sound.shape[-1] == pytest.approx(after[-1], abs=1.0)
    assert after[-1] > 1.01 * before[-1]


def test_a_page_of_88_keys_with_knocks_keeps_its_size(tmp_path):
    piano = true_instrument()
    law = write_playable_page(tmp_path / "law.html", piano)
    assert law.knock_error_db is None
    assert (tmp_path / "law.html").stat().st_size < 500_000
    rung = piano_of({midi: ringing_note(midi) for midi in piano.keys}, recorded=(60,))
    done = write_playable_page(tmp_path / "rung.html", rung)
    assert (tmp_path / "rung.html").stat().st_size <= 1_500_000
    assert done.knock_error_db is not None
    assert done.knock_error_db < -20
    _, alone = encode_instrument(piano_of({60: rung.keys[60].note}), 1_000_000)
    assert alone is not None
    assert alone < -75
    with pytest.raises(ParameterError, match=r"the page has room for 0\.10 MB"):
        encode_instrument(rung, 100_000)


@pytest.mark.parametrize("midi", [33, 93])
@pytest.mark.parametrize("error", [-60.0, -40.0, -20.0])
def test_a_knock_is_as_near_as_its_encoding_states(midi, error):
    """Decoded by another program than the page's: the differences of a stroke, and the characters that it takes."""
    note = ringing_note(midi)
    assert note.modal_response is not None
    response = note.modal_response.scale_gain(note.gain)
    fade = np.ones(response.knock.shape[-1])
    fade[:400] = np.hanning(800)[:400]  # real knocks do not begin abruptly, which a filter would spread
    response = response._replace(knock=fade * response.knock)
    note = note._replace(modal_response=response, gain=1.0)
    force = force_pulse(note.strike(response.rate), note.hammer)
    encoding, characters = encoded_knock(response, force).smallest(error)
    entry = encode_note(note, midi, encoding)["modal_response"]
    assert sum(len(row[name]) for row in entry["knock"] for name in ("blocks", "packed")) == characters
    knock = resample(np.stack([unpacked(**row) for row in entry["knock"]]), entry["rate"], response.rate)
    knock[:, round(PRE_ONSET_S * response.rate)] -= 0.5 * response.pattern.real.sum(axis=1)
    count = round(0.03 * response.rate)
    again, played = (
        np.diff(x.sound(force, response.rate, 20 * count))
        for x in (response._replace(knock=knock[:, : response.knock.shape[-1]]), response)
    )
    found = 10 * np.log10(((again - played) ** 2).sum() / (played[:, :count] ** 2).sum())
    assert error - 12 < found < error + 3  # a rate keeps more than `PASS_BAND`


def unpacked(step: float, blocks: str, packed: str) -> np.ndarray:
    """The samples of a channel."""
    bits, out = np.unpackbits(np.frombuffer(base64.b64decode(packed), np.uint8)), []
    for head in base64.b64decode(blocks):
        width, bits, own = head % 16, bits[64 * (head % 16) :], bits[: 64 * (head % 16)]
        whole = own.reshape(64, width) @ 2.0 ** np.arange(width - 1, -1, -1) - (2 ** (width - 1) if width else 0)
        out.append(whole * step / 2 ** (head // 16))
    return np.concatenate(out)


def test_a_knock_in_fewer_bits_is_the_same_below_its_rate():
    note = ringing_note(60, channels=1)
    assert note.modal_response is not None
    knock = np.zeros_like(note.modal_response.knock)
    knock[0, 600:900] = np.hanning(300)  # below 1 kHz
    note = note._replace(
        modal_response=note.modal_response._replace(pattern=0 * note.modal_response.pattern, knock=40 * knock)
    )
    step = note.gain * 40 / 127
    kept = BEST, KnockEncoding(8000, step)
    best, least = (x[:, early(note) :] for x in play([job(encode_note(note, 60, how), struck(3.0)) for how in kept]))
    assert error_db(best, note.render(3.0, seconds=1.0, rate=RATE, mono=False)) < WITHIN
    assert -80 < error_db(least, best) < -40


def test_a_felt_that_the_page_does_not_know_is_refused():
    note = true_note(60)
    with pytest.raises(ParameterError, match="RelaxingHammer"):
        encode_note(note._replace(hammer=RelaxingHammer(*note.hammer, 0.3, 1e-4)), 60)


def two_keys() -> Instrument:
    """An instrument of two keys, the lower recorded."""
    return piano_of({midi: true_note(midi) for midi in (59, 60)}, recorded=(59,), name="</script><b>")


def test_a_batchs_folder_becomes_a_page_that_counts_its_guesses(tmp_path, capsys):
    library(tmp_path, [40, 45])
    assert main(["page", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert (
        f"{tmp_path / 'piano.html'}: 88 keys, 2 of them recorded; 86 are guesses: 4 between recorded keys, 82" in said
    )
    html = (tmp_path / "piano.html").read_text()
    assert "86 are guesses: 4 between recorded keys, 82 beyond them." in html
    library(tmp_path, [50])
    assert main(["page", str(tmp_path), "--prefix", "twin", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["guesses"] == {"between": 8, "beyond": 77}
    assert main(["page", str(tmp_path)]) == 1
    assert "--force" in capsys.readouterr().err
    assert (tmp_path / "piano.html").read_text() == html
    assert main(["page", str(tmp_path), "--force"]) == 0
    assert "3 of them recorded" in capsys.readouterr().out
    write_fit(tmp_path, 60, fit_document(true_note(60), ERRORS), "other")
    for more, said in (
        ([], "other, twin"),
        (["--prefix", "a/b"], "'oth"),
    ):
        assert main(["page", str(tmp_path), *more]) == 1
        assert said in capsys.readouterr().err


def test_an_instrument_in_a_folder_is_taken_as_it_is(tmp_path, capsys):
    write_instrument(tmp_path / "instrument.json", two_keys())
    assert main(["page", str(tmp_path)]) == 0
    assert "2 keys, 1 of them recorded; 1 is a guess: 1 beyond them" in capsys.readouterr().out
    assert main(["page", str(tmp_path), "--prefix", "cp80"]) == 1
    assert "--prefix" in capsys.readouterr().err


def test_the_command_writes_a_page_and_replaces_none_unasked(tmp_path, capsys):
    built, out = tmp_path / "instrument.json", tmp_path / "piano.html"
    write_instrument(built, two_keys())
    assert main(["page", str(built), "--out", str(out)]) == 0
    assert "2 keys, 1 of them recorded; 1 is a guess: 1 beyond them" in capsys.readouterr().out
    html = out.read_text()
    assert "</script><b>" not in html
    assert html.count("</script>") == html.count("<script")
    assert main(["page", str(built), "--out", str(out)]) != 0
    assert "--force" in capsys.readouterr().err
    assert main(["page", str(built), "--out", str(out), "--force"]) == 0
    assert main(["page", str(built), "--out", str(tmp_path / "piano.txt")]) != 0
    assert ".html" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["instrument.json", "piano.html"]
