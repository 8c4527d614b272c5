"""One blow heard by two microphones: one velocity and one pitch, two paths, and nothing told twice."""

from __future__ import annotations

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pianofit.fit import Result, fit_takes
from pianofit.fit.joint import in_tune
from pianofit.fit.path import path_of
from pianofit.fit.recipe import _prepared
from pianofit.fit.residuals import CENT
from pianofit.fit.space import LOG, Layout
from pianofit.fit.state import search_space
from pianofit.fit.takes import arranged
from pianofit.fit.target import Spreads
from test_takes import VELOCITIES, setup, through_a_room
from twin_cases import FIRST, record

from pianofit.analysis import analyse
from pianofit.errors import FitError
from pianofit.predict import cross_validate
from pianofit.recording import Recording
from pianofit.setup_file import Setup, Take
from pianofit.summary import cross_validation

# Blow 1 is heard by both microphones, which stand behind two rooms; the last one's velocity was measured.
HEARD = ((0, "close"), (1, "close"), (2, "close"), (1, "room"))
ROOMS = {"close": 7, "room": 8}


@functools.cache
def takes() -> tuple[list[Recording], list]:
    """Three blows by brute force at one microphone, the middle one also at another, and their analyses."""
    recordings = []
    for blow, mic in HEARD:
        truth = FIRST._replace(hammer=FIRST.hammer._replace(v_H0=VELOCITIES[blow]))
        sound = record(truth, quantity="bridge-force", seed=10 * blow + ROOMS[mic])
        recordings.append(through_a_room(sound, f"{blow}-{mic}.wav", ROOMS[mic]))
    return recordings, [analyse(r, f0=FIRST.f0) for r in recordings]


def known(measured: bool = True) -> Setup:
    said = [Take(f"{b}-{m}.wav", VELOCITIES[2] if b == 2 and measured else None, m, None, str(b)) for b, m in HEARD]
    return setup(*said)


@functools.cache
def fitted() -> Result:
    return fit_takes(*takes(), known())


def test_takes_of_a_strike_share_coordinates():
    layout = Layout((0, 0, 1, 1), (0, 1, 2, 3), (0, 1, 0, 1))
    np.testing.assert_array_equal(layout.ratio, LOG + np.array([0, 3, 0, 3]))
    np.testing.assert_array_equal(layout.cents, layout.ratio + 2)
    assert len({*layout.ratio, *layout.cents, *layout.gain}) == 2 + 2 + 4
    assert layout.size == Layout((0, 0, 1, 1), (0, 1, 2, 3), (0, 1, 2, 3)).size


def test_only_a_path_with_two_velocities_compares_anything():
    assert Layout((0, 0), (0, 1), (0, 1)).compared
    assert Layout((0, 1, 0), (0, 1, 2), (0, 0, 2)).compared
    assert not Layout((0, 1), (0, 1), (0, 0)).compared  # one blow at two microphones
    assert not Layout((0, 1), (0, 1), (0, 1)).compared  # a path for each
    assert not Layout().compared


@pytest.mark.parametrize("blow", ["1", "2"])
def test_what_a_blow_has_is_free_once_and_the_first_takes_stays_held(blow):
    said = known(measured=False)
    said = replace(said, takes=(*said.takes[:3], replace(said.takes[3], strike=blow)))
    ordered, start, layout, order = arranged(*takes(), said)
    assert abs(order.index(3) - order.index(int(blow))) == 1  # beside the other take of its blow
    space = search_space(start, ordered, layout)
    own = np.unique(layout.ratio[np.array(layout.strikes) > 0])
    assert len(own) == 2
    assert space.free[[own, own + 2]].all()
    assert not space.free[[layout.ratio[0], layout.cents[0]]].any()
    # Two ratios and two pitches have a prior each, however many takes share them; what nobody has is held at 0.
    mine = np.arange(LOG, LOG + 3 * 4)
    assert (space.free[mine] & np.isfinite(space.spread[mine])).sum() == 4
    nobody = np.setdiff1d(LOG + 3 * np.arange(4), layout.ratio)
    assert not space.free[[nobody, nobody + 2]].any()
    assert not space.start[[nobody, nobody + 2]].any()


def test_a_measured_velocity_is_that_of_all_takes_of_the_blow():
    said = [replace(t, v_H0=1.5 if t.file == "1-room.wav" else t.v_H0) for t in known().takes]
    ordered, _, layout, order = arranged(*takes(), setup(*said))
    place = [order.index(i) for i in (1, 3)]
    assert [ordered[p].ratio for p in place] == pytest.approx([1.5 / VELOCITIES[2]] * 2)
    assert all(ordered[p].ratio_known for p in place)
    assert layout.strikes[place[0]] == layout.strikes[place[1]]


def test_the_shared_velocity_is_found_and_told_alike():
    rows = fitted().document["takes"]
    np.testing.assert_allclose([row["v_H0"] for row in rows], [VELOCITIES[b] for b, _ in HEARD], rtol=0.1)
    one, other = rows[1], rows[3]
    for name in ("v_H0", "v_H0_interval", "v_H0_status", "cents", "strike"):
        assert one[name] == other[name]
    assert one["v_H0_interval"][0] < one["v_H0"] < one["v_H0_interval"][1]
    assert [row["strike"] for row in rows].count(one["strike"]) == 2
    assert one["group"] != other["group"]
    assert one["levels"]["fitted_db"] < 0.5 > other["levels"]["fitted_db"]


def test_a_string_out_of_tune_goes_back_to_its_partials():
    """Ten cents and κ by a tenth, as the string's stage can leave a bass note; nothing else moves."""
    ordered, start, layout, _ = arranged(*takes(), known())
    state = _prepared(ordered, start, layout)
    true = state.space.z(state.space.start[None])
    z = true.copy()
    z[0, :2] += -10 * CENT, 0.1
    found, _ = in_tune(state, z)
    assert abs(found[0, 0] - true[0, 0]) < 0.3 * CENT
    assert abs(found[0, 1] - true[0, 1]) < 0.01
    np.testing.assert_array_equal(found[0, 2:], z[0, 2:])


def test_a_microphone_keeps_the_decays_that_it_heard(monkeypatch):
    law = np.ones((3, 3, 2))
    decay = np.array([[1.0, 2.0], [1.0, 2.0], [4.0, 2.0]])  # the third take, at another microphone, hears otherwise
    data = SimpleNamespace(
        found=np.ones((3, 2), bool), decay=decay, decay_error=0.01 * decay, frequency=np.full((3, 2), 100.0), rows=2,
        way=np.zeros((3, 2), int),
        layout=Layout((0, 0, 1), (0, 1, 2), (0, 1, 0)),
    )  # fmt: skip
    fit = SimpleNamespace(
        data=data, spread=Spreads(1.0, 1.0, 1.0), target=SimpleNamespace(basis=np.zeros((3, 2, data.layout.size))),
        cfg=None, z=np.zeros((1, data.layout.size)), values=np.zeros(data.layout.size),
    )  # fmt: skip
    monkeypatch.setattr("pianofit.fit.path.predicted", lambda *_: law)
    close, room = (path_of(fit, take, SimpleNamespace(quantity="pressure")).decay for take in (0, 2))  # type: ignore
    np.testing.assert_allclose(close, [1.0, 2.0], rtol=0.03)
    np.testing.assert_allclose(room, [4.0, 2.0], rtol=0.03)


@pytest.mark.slow
def test_one_blow_at_two_microphones_does_not_fix_the_felt():
    recordings, analyses = ([x[i] for i in (1, 3)] for x in takes())
    document = fit_takes(recordings, analyses, known()).document
    assert "2 uncalibrated takes, but none shares a path with a take of another strike" in document["verdict"]
    assert {document["parameters"][n]["status"] for n in ("K_H", "p")} <= {"not-identifiable", "at-bound"}
    assert document["takes"][0]["v_H0"] == document["takes"][1]["v_H0"]


def test_leaving_a_take_out_leaves_out_its_blow(monkeypatch):
    """With the voices of the fit of all instead of four more fits: who is left out, and what is compared with whom."""
    recordings, analyses = takes()
    fits = []

    def instead(some, *_, **__):
        fits.append([r.path for r in some])
        return replace(fitted(), takes=tuple(h for h in fitted().takes if h.recording.path in fits[-1]), first=0)

    monkeypatch.setattr("pianofit.predict.fit_takes", instead)
    found, _ = cross_validate(recordings, analyses, known())
    everything = {f"{b}-{m}.wav" for b, m in HEARD}
    assert [everything - set(files) for files in fits] == [
        set(), {"0-close.wav"}, {"1-close.wav", "1-room.wav"}, {"2-close.wav"},
    ]  # fmt: skip
    rows = {row["file"]: row for row in found["takes"]}
    assert len(rows) == 4
    middle, lone = rows["1-close.wav"], rows["1-room.wav"]
    assert [row["file"] for row in found["takes"] if row["inner"]] == ["1-close.wav"]
    assert middle["predicted_db"] == found["median_inner_db"] < 0.5 * middle["nearest_db"]
    # The other microphone heard nothing else: its path is unknown, and so is what its levels would be.
    assert [lone[n] for n in ("predicted_v_H0", "predicted_db", "partials", "nearest_db", "blend_db")] == [None] * 5
    said = "1-room.wav is not predicted: no other strike was heard through its path, which is therefore unknown."
    assert found["messages"] == [said]
    assert said in (printed := cross_validation(found))
    assert "  -        -      -  (beyond the others)" in printed


def test_without_a_take_between_others_there_is_no_median(monkeypatch):
    """Three blows, each at a microphone of its own, as in a setup that gives every take its group."""
    recordings, analyses = ([x[i] for i in range(3)] for x in takes())
    rows = [row | {"group": i} for i, row in enumerate(fitted().document["takes"][:3])]
    whole = replace(fitted(), document=fitted().document | {"takes": rows})
    fits = iter([whole, *[replace(whole, takes=whole.takes[:2])] * 3])
    monkeypatch.setattr("pianofit.predict.fit_takes", lambda *_, **__: next(fits))
    found, _ = cross_validate(recordings, analyses, known())
    assert [found["median_inner_db"], found["worst_inner_db"]] == [None, None]
    assert len(found["messages"]) == 3
    assert "between the others" not in cross_validation(found)


def test_too_few_blows_to_leave_one_out(monkeypatch):
    recordings, analyses = ([x[i] for i in (1, 2, 3)] for x in takes())
    rows = [fitted().document["takes"][i] for i in (1, 2, 3)]
    whole = replace(fitted(), document=fitted().document | {"takes": rows})
    monkeypatch.setattr("pianofit.predict.fit_takes", lambda *_, **__: whole)
    with pytest.raises(FitError, match="3 takes of 2 strikes are too few to leave one strike out"):
        cross_validate(recordings, analyses, known())
