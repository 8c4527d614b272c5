"""The coverage study's twins are what they say, and the study counts what it should."""

from __future__ import annotations

import itertools
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from pianofit.parameters import FIT_NAMES

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import coverage_table
import coverage_twins as twins
import interval_coverage
from measuring import into_page

# One calibrated recording of C6, which is soon made and fitted.
CHEAP = 40


def test_twins_are_in_every_cell_and_of_every_key():
    for kind in twins.KINDS:
        designs = [twins.design_of(kind, seed) for seed in range(200)]
        cells = {(d.recordings, d.calibrated, d.key) for d in designs}
        assert cells == set(itertools.product(range(1, 6), (True, False), twins.KEYS))
        assert all(d.strike_known for d in designs if d.calibrated)
        effects = {(d.recordings, d.calibrated, d.glide, d.beats) for d in designs}
        assert len(effects) == (10 if kind == "model" else 40)


def test_the_same_seed_gives_the_same_twin_and_another_another():
    one, same, other = (twins.make("model", seed) for seed in (CHEAP, CHEAP, CHEAP + 10))
    assert one.truth == same.truth
    np.testing.assert_array_equal(one.recordings[0].samples, same.recordings[0].samples)
    assert other.truth.string.b1 != one.truth.string.b1
    assert twins.draw("brute-force", CHEAP) != one.truth


def test_strokes_rise_over_the_usual_range():
    for seed in range(60):
        truth = twins.draw("model", seed)
        assert list(truth.velocities) == sorted(truth.velocities)
        assert twins.SLOWEST <= truth.velocities[0] <= truth.velocities[-1] <= twins.FASTEST
        assert truth.hammer.v_H0 == truth.velocities[-1]


def test_the_path_has_the_levels_that_were_drawn():
    truth, rate = twins.draw("model", 1), twins.RATE
    path = twins.output_path(truth, rate, 1)
    f = truth.f0 * np.arange(1, 60)
    found = 20 * np.log10(np.abs(np.exp(-2j * np.pi * np.outer(f, np.arange(path.size)) / rate) @ path))
    drawn = np.interp(f, np.fft.rfftfreq(2 * twins.TAPS, 1 / rate), _drawn(truth, rate))
    np.testing.assert_allclose(found, drawn, atol=0.5)
    assert np.std(np.diff(found)) > 0.5 * truth.rough_db
    # Minimum phase: over all frequencies it does not turn once.
    phase = np.unwrap(np.angle(np.fft.rfft(path, 4 * path.size)))
    assert abs(phase[-1] - phase[0]) < np.pi


def _drawn(truth: twins.Truth, rate: int) -> np.ndarray:
    return twins._path_db(truth, 1, np.fft.rfftfreq(2 * twins.TAPS, 1 / rate))


@pytest.fixture(scope="module")
def plain() -> tuple[twins.Truth, np.ndarray]:
    """A brute-force C6 without glide or beats, at the pickup."""
    truth = twins.draw("brute-force", CHEAP)._replace(glide_cents=0.0, beat_cents=0.0)
    return truth, twins._sounded("brute-force", truth, truth.velocities[-1], True)


def pitch(sound: np.ndarray, f: float, start: float, stop: float) -> float:
    """Mean frequency, Hz, of the partial near `f` between two times after the stroke, by the phases at both."""
    phase, reach, rate = [], 0.02, twins.RATE
    for at in (start, stop):
        n = np.arange(round((at + twins.LEAD - reach) * rate), round((at + twins.LEAD + reach) * rate))
        phase.append(np.angle(np.hanning(n.size) @ (sound[n] * np.exp(-2j * np.pi * f * n / rate))))
    return f + (np.diff(phase)[0] + math.pi) % (2 * math.pi) / (2 * math.pi * (stop - start)) - 0.5 / (stop - start)


def test_a_twin_glides_as_it_was_asked_to(plain):
    truth, sound = plain
    glide = truth._replace(glide_cents=5.0, glide_seconds=0.4)
    bent = twins._sounded("brute-force", glide, truth.velocities[-1], True)
    soft = twins._sounded("brute-force", glide, 0.5 * truth.velocities[-1], True)
    still = twins._sounded("brute-force", truth, 0.5 * truth.velocities[-1], True)
    f1 = truth.f0 * math.sqrt(1 + (truth.string.kappa * math.pi / (truth.string.c * truth.geometry.length)) ** 2)
    for start, stop in ((0.1, 0.2), (0.4, 0.5)):
        mean = 0.4 * (math.exp(-start / 0.4) - math.exp(-stop / 0.4)) / (stop - start)
        cents = 1200 * math.log2(pitch(bent, f1, start, stop) / pitch(sound, f1, start, stop))
        assert cents == pytest.approx(5.0 * mean, abs=0.1)
        quarter = 1200 * math.log2(pitch(soft, f1, start, stop) / pitch(still, f1, start, stop))
        assert quarter == pytest.approx(5.0 * mean / 4, abs=0.1)
    low, high = twins.values_of("brute-force", glide)["c"]
    mean = 5.0 * 0.4 * (math.exp(-0.5) - math.exp(-2.5)) / 0.8
    assert 1200 * math.log2(low / truth.string.c) == pytest.approx(mean, rel=1e-2)
    assert 0 < 1200 * math.log2(high / low) < 0.03 * mean


def test_two_axes_are_one_string_at_the_stroke_and_beat_later(plain):
    truth, sound = plain
    cents, level = 3.0, 0.4
    two = truth._replace(beat_cents=cents, beat_level=level)
    beats = twins._sounded("brute-force", two, truth.velocities[-1], True)
    first = slice(round(twins.LEAD * twins.RATE), round((twins.LEAD + 0.01) * twins.RATE))
    apart = np.linalg.norm(beats[first] - sound[first]) / np.linalg.norm(sound[first])
    assert 0.0 < apart < 0.05
    # Half a beat after the stroke the two are against each other.
    at = twins.LEAD + 0.5 / (truth.f0 * (2 ** (cents / 1200) - 1))
    there = slice(round((at - 0.02) * twins.RATE), round((at + 0.02) * twins.RATE))
    fainter = np.linalg.norm(beats[there]) / np.linalg.norm(sound[there])
    assert fainter == pytest.approx((1 - level) / (1 + level), abs=0.08)
    low, high = twins.values_of("brute-force", two)["c"]
    assert low == pytest.approx(truth.string.c)
    assert 1200 * math.log2(high / low) == pytest.approx(cents * level / (1 + level))


def test_a_miss_is_counted_in_standard_errors():
    low, high = 2.0 / 1.1, 2.0 * 1.1
    row = coverage_table.row("c", 2.0, (low, high), "fitted", high)
    assert row["miss"] == pytest.approx(-1.96)
    assert coverage_table.row("c", 2.0, (low, high), "fitted", 2.5)["held"] is False
    assert coverage_table.row("c", 2.0, (low, high), "fitted", (1.9, 2.5))["miss"] == 0.0
    rows = [
        row,
        coverage_table.row("c", 2.0, (low, high), "fitted", 2.5),
        coverage_table.row("c", 1.0, None, "given", 1.0),
    ]
    entry = coverage_table.entry([*rows, {**rows[1], "status": "not-identifiable"}])
    assert (entry["fitted"], entry["held"], entry["not_identifiable"], entry["beyond_four"]) == (2, 1, 1, 1)


@pytest.mark.slow
def test_a_small_study_from_end_to_end(tmp_path, monkeypatch, capsys):
    kept, found = tmp_path / "runs.jsonl", tmp_path / "coverage.json"
    refused = {
        "kind": "model",
        "seed": CHEAP + 1,
        "recordings": 1,
        "calibrated": False,
        "seconds": 0.0,
        "refused": "noise",
    }
    kept.write_text(json.dumps(refused) + "\n")
    monkeypatch.setattr(
        sys, "argv",
        ["interval_coverage", "--kind", "model", "--first", str(CHEAP), "--seeds", "2", "--workers", "1", "--keep",
         str(kept), "--json", str(found)],
    )  # fmt: skip
    interval_coverage.main()
    printed = capsys.readouterr().out
    assert "fitted 1 of 2" in printed
    assert f"refused, seed {CHEAP + 1}: noise" in printed
    document = json.loads(found.read_text())
    (run,) = (run for run in document["runs"] if "rows" in run)
    assert [row["name"] for row in run["rows"]] == [*FIT_NAMES, "x0", "width"]
    assert document["table"]["all"]["fitted"] >= 6
    # From the truth the search comes to the same place.
    assert abs(run["deeper"]) < coverage_table.DEEPER
    assert len(kept.read_text().splitlines()) == 2


def test_a_table_takes_its_place_in_a_page(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- model -->\nold\n<!-- end of model -->\nafter\n")
    into_page(page, "model", ["one ", "two"])
    into_page(page, "model", ["new "])
    assert page.read_text() == "before\n<!-- model -->\nnew\n<!-- end of model -->\nafter\n"
    with pytest.raises(SystemExit, match="write both"):
        into_page(page, "brute-force", ["new"])
