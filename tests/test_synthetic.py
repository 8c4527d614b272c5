"""A simulated stroke as a calibrated measurement: scale, noise, setup, and the parameters that a fit recovers."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest
import soundfile

import pianofit
from pianofit.cli import main
from pianofit.errors import ParameterError
from pianofit.felt import RelaxingHammer
from pianofit.io.files import PEAK_LIMIT
from pianofit.setup import Setup
from pianofit.synthetic import LEAD, setup_of, setup_text, synthetic_recording

RATE = 16_000
TYPICAL = pianofit.typical("F3")
PARTS = (TYPICAL.string, TYPICAL.hammer, TYPICAL.geometry)


@functools.cache
def made(**more) -> pianofit.SyntheticRecording:
    return synthetic_recording(*PARTS, **({"rate": RATE, "seconds": 1.2} | more))


def test_the_samples_are_the_signal_over_the_scale():
    auto, fixed = made(), made(scale=8.0)
    assert np.abs(auto.samples).max() == pytest.approx(PEAK_LIMIT, rel=1e-12)
    np.testing.assert_allclose(8.0 * fixed.samples, auto.scale * auto.samples, rtol=0, atol=1e-12)
    lead = round(LEAD * RATE)
    assert not fixed.samples[:lead].any()
    strike = pianofit.simulate(*PARTS, rate=RATE)
    witness = strike.waveform(RATE, len(fixed.samples) - lead)
    # The contact uses shorter steps than `simulate`, whose error is of the order of 1e-3.
    assert np.abs(8.0 * fixed.samples[lead:] - witness).max() < 5e-3 * np.abs(witness).max()
    assert len(fixed.samples) == round(1.2 * RATE)


def test_steps_as_short_as_these_no_longer_matter():
    """Halving the step changes the force by at most a quarter of its error."""
    force = made().simulation.pulse.force
    step = float(made().simulation.modes.step)
    finer = pianofit.simulate(*PARTS, rate=RATE, oversampling=round(2 / (step * RATE)))
    n = min(len(force), len(finer.pulse.force) // 2)
    assert np.abs(force[:n] - finer.pulse.force[::2][:n]).max() < 3e-4 * force.max()


def test_the_noise_is_as_loud_as_was_asked_for_and_the_seed_decides_it():
    clean, noisy, again, other = made(), made(noise_db=40), made(noise_db=40), made(noise_db=40, seed=1)
    noise = noisy.samples - clean.samples
    lead = round(LEAD * RATE)
    reference = np.sqrt(np.mean(clean.samples[lead : lead + RATE] ** 2))
    assert 20 * np.log10(reference / np.sqrt(np.mean(noise**2))) == pytest.approx(40, abs=0.2)
    assert noisy.scale == clean.scale
    np.testing.assert_array_equal(noisy.samples, again.samples)
    assert not np.array_equal(noisy.samples, other.samples)


@pytest.mark.parametrize("quantity", ["velocity", "displacement", "bridge-force", "pressure"])
@pytest.mark.parametrize("law", ["hunt-crossley", "power", "stulov"])
def test_the_setup_is_read_back_as_it_was(quantity, law, tmp_path):
    elastic = TYPICAL.hammer._replace(mu=0.0)
    hammer = {"hunt-crossley": TYPICAL.hammer, "power": elastic, "stulov": RelaxingHammer(*elastic, 0.3, 5e-5)}[law]
    setup = setup_of(hammer, TYPICAL.geometry, quantity, 8.0, 'a "b"\x7f.wav')
    (tmp_path / "setup.toml").write_text(setup_text(setup), encoding="utf-8")
    assert Setup.from_toml(tmp_path / "setup.toml") == setup
    assert (setup.pickup_scale is None) == (quantity == "pressure")
    assert setup.law.name == law
    assert setup.strike_position == TYPICAL.geometry.strike_position


def test_the_setup_states_no_parameter():
    it = made()
    assert not it.setup.fixed
    assert not it.setup.initial
    assert it.true == {**TYPICAL.string._asdict(), **TYPICAL.hammer._asdict()}
    assert all(f"# {name} = {value!r}" in it.setup_text for name, value in it.true.items())


def test_any_setup_is_written_as_it_is_read(tmp_path):
    setup = pianofit.Setup(
        length=1.0, fixed={"M_H": 5e-3}, initial={"p": 2.5}, bounds={"K_H": (1e8, 1e12)},
        recordings=(pianofit.RecordingInfo("ä.wav", 2.0, "close"), pianofit.RecordingInfo(v_H0=1.0)),
    )  # fmt: skip
    (tmp_path / "setup.toml").write_text(setup_text(setup), encoding="utf-8")
    back = Setup.from_toml(tmp_path / "setup.toml")
    assert (back.fixed, back.initial, back.bounds, back.recordings) == (
        setup.fixed, setup.initial, setup.bounds, setup.recordings,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("more", "named"),
    [
        ({"scale": 1e-3}, "scale"), ({"scale": 0.0}, "scale"), ({"noise_db": -60.0}, "noise_db"),
        ({"noise_db": "loud"}, "noise_db"), ({"seconds": 0.05}, "seconds"), ({"seed": -1}, "seed"),
        ({"quantity": "light"}, "quantity"),
    ],
)  # fmt: skip
def test_what_cannot_be_recorded_is_named(more, named):
    with pytest.raises(ParameterError, match=named):
        made(**more)


def test_a_fit_recovers_what_was_simulated(tmp_path, capsys):
    """Through files only: `simulate` writes sound and setup, `fit` reads them."""
    sound, setup = tmp_path / "note.wav", tmp_path / "setup.toml"
    place = ("--quantity", "velocity", "--pickup", "0.3", "--strike", "0.11", "--scale", "8", "--noise", "60")
    simulated = ("simulate", "--typical", "F3", *place, "--set", "p=2.6", "--set", "K_H=3e9", "--velocity", "1.4")
    assert main([*simulated, "--seconds", "2", "--setup-out", str(setup), "--out", str(sound)]) == 0
    assert "8 m/s" in capsys.readouterr().out
    known = Setup.from_toml(setup)
    assert (known.strike_position, known.pickup_position, known.pickup_scale) == (0.11, 0.3, 8.0)
    assert soundfile.info(sound).frames == 2 * 44_100
    fitted = ("fit", str(sound), "--setup", str(setup), "--note", "F3", "--no-page", "--out", str(tmp_path / "fit"))
    assert main([*fitted]) == 0
    found = json.loads((tmp_path / "fit" / "fit.json").read_text(encoding="utf-8"))["parameters"]
    true = TYPICAL.string._asdict() | TYPICAL.hammer._asdict() | {"p": 2.6, "K_H": 3e9, "v_H0": 1.4, "width": 0.02}
    off = {"c": 1e-6, "kappa": 1e-4, "b1": 0.01, "b2": 0.02, "M_H": 0.005, "p": 0.02, "mu": 0.03, "v_H0": 0.01}
    outside = 0
    for name, value in true.items():
        entry = found[name]
        low, high = entry["interval"]
        assert entry["status"] == "fitted", name
        assert abs(entry["value"] / value - 1) < off.get(name, 0.3), name
        middle, half = np.sqrt(low * high), 0.5 * np.log(high / low)
        assert abs(np.log(value / middle)) < 2 * half, f"{name}: more than four standard deviations"
        outside += not low <= value <= high
    assert outside <= 2


def test_a_skin_is_found():
    """A calibrated stroke determines the skin, and the exponent of the force where it presses the felt far better."""
    hammer = pianofit.SoftHammer(*TYPICAL.hammer._replace(v_H0=1.4), skin=1.5e-4)
    simulated = synthetic_recording(TYPICAL.string, hammer, TYPICAL.geometry, noise_db=60)
    found = pianofit.fit(simulated.recording, setup=simulated.setup, progress=False)
    assert found.fit.felt == "soft-skin"
    for name in ("K_H", "mu", "p", "skin", "M_H", "v_H0"):
        quantity = found.parameters[name]
        assert quantity.status == "fitted"
        low, high = quantity.interval
        middle, half = np.sqrt(low * high), 0.5 * np.log(high / low)
        assert abs(np.log(simulated.true[name] / middle)) < 2 * half, f"{name}: more than four standard deviations"
    u = 1e-3 * found.fit.derived.reference_compression_mm
    true = hammer.p * (1 + hammer.skin / (u + hammer.skin))
    local = found.derived_quantities["local_exponent"]
    assert local.value == pytest.approx(true, rel=0.02)
    assert np.log(local.interval[1] / local.interval[0]) < 0.3 * np.log(np.divide(*found.parameters.p.interval[::-1]))


def test_a_setup_never_replaces_a_file(tmp_path, capsys):
    common = ["simulate", "--typical", "F3", "--seconds", "0.1", "--out", str(tmp_path / "a.wav"), "--setup-out"]
    (tmp_path / "setup.toml").write_text("string.length = 0.9")
    assert main([*common, str(tmp_path / "setup.toml")]) == 1
    assert "--force" in capsys.readouterr().err
    assert main([*common, str(tmp_path / "a.wav")]) == 1
    assert "--out" in capsys.readouterr().err
    assert [path.name for path in Path(tmp_path).iterdir()] == ["setup.toml"]
    assert (tmp_path / "setup.toml").read_text() == "string.length = 0.9"
