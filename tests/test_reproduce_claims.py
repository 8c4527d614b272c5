"""The rules of the reproduction: the outcome of each claim for given findings."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pianofit.parameters import FIT_NAMES
from studies.bensa2005 import claims, limits
from studies.bensa2005.direct import ROUND_TRIP
from studies.bensa2005.findings import PRINTED, STRINGS


def ns(**fields: Any) -> Any:
    """The part of the findings that a rule uses."""
    return SimpleNamespace(**fields)


def strikes_of(**columns: list) -> list:
    return [ns(**dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]


def contacts(contact: list[float], needed: float = 0.006) -> Any:
    return ns(strikes=strikes_of(velocity=[1.0, 2.0, 4.0][: len(contact)], contact=contact), needed_mass=needed)


def maxima(*at: list[float]) -> Any:
    return ns(strikes=strikes_of(velocity=[1.0, 2.0], maxima=[np.array(x) * ROUND_TRIP for x in at]))


def loop(area: float, balance: float) -> Any:
    return ns(strikes=strikes_of(loop=[area], balance=[balance], hammer_energy=[0.024]))


def biased(kappa: float) -> Any:
    fit = limits.DispersionError("finite_difference", 100, 44_100.0, 2, 8, 304.0, kappa, 1.737, 0.1)
    return ns(dispersion_errors={"fitted to band 2": [fit]}, inverse=fit)


def compared(**measured: Any) -> Any:
    """A stroke whose sounds all have the same comparison with the measured one."""
    return ns(closeness=dict.fromkeys(("measured", "paper", "read"), ns(**measured)))


def over_b2(change: float, end: float) -> Any:
    """The criterion of band 2 over b2, above its minimum: `change` at almost no b2, `end` at the largest b2."""
    result = ns(true=1e-6, b2=np.array([1e-10, 1e-6, 1e-3]), spread={"band2": 1e-9})
    result.criterion = {"band2": np.array([1e-6 + change, 1e-6, 1e-6 + end])}
    return ns(b2_sensitivity=result, origin=compared(criterion={"band2": 1e-2}))


def minima(*costs: list[float]) -> Any:
    plane, search_comparison = (ns(minima=[ns(cost=cost) for cost in row]) for row in costs)
    return ns(plane=plane, search_comparison=search_comparison)


def searched(gradient: int, annealed: int) -> Any:
    successes = {"gradient": gradient, "squares": 5, "annealed": annealed, "polished": 8}
    return ns(plan=ns(starts=8), search_comparison=ns(ends=successes, successes=successes.get))


def by_bands(attack: list[float], centroid: list[float]) -> Any:
    """Relative errors of three bands at two velocities, and those of a global criterion."""
    exact, whole = ns(attack=1.0, centroid=1.0), zip([1.2, 0.7], [0.9, 0.8], strict=True)
    return ns(strokes={
        v: ns(closeness=dict.fromkeys(("paper", "read"), ns(attack=1 + a, centroid=1 + c))
              | {"measured": exact, "global": ns(attack=w, centroid=x)})
        for v, a, c, (w, x) in zip([0.8, 1.1], attack, centroid, whole, strict=True)
    })  # fmt: skip


def results_of(values: dict[str, float]) -> dict:
    return dict.fromkeys(STRINGS, ns(parameters={name: ns(value=x) for name, x in values.items()}))


def tabled(**values: float) -> Any:
    """Fits that found the true values, the paper's final ones, except for `values`."""
    final, origin = PRINTED["final"], ns(shares=lambda: {"band2": {2: 0.9, 3: 0.1}})
    return ns(tables={"full": ns(results=results_of(final | values))}, true=final, origin=origin)


def levels(low: float, high: float) -> Any:
    """Level errors of the first seven partials and of those above, dB."""
    partial = np.arange(1, 15)
    sounds = dict.fromkeys(STRINGS, np.zeros(1))
    return ns(origin=ns(sounds=sounds, level_differences=lambda _: (partial, np.where(partial > 7, high, low))))


def waves(before: float, after: float) -> Any:
    wave = np.sin(np.arange(1000.0))
    sounds = {"measured": wave, "initial": (1 + before) * wave} | dict.fromkeys(STRINGS, (1 + after) * wave)
    return ns(plan=ns(waveform=1.1), strokes={1.1: ns(recording=ns(rate=8000), sounds=sounds)})


def predictions(predicted: list[float], nearest: list[float]) -> Any:
    """Errors of levels, dB. Those of the initial values are 20 dB."""
    strokes = {
        v: ns(
            closeness=dict.fromkeys(STRINGS, ns(level_db=p)) | {"initial": ns(level_db=20.0), "nearest": ns(level_db=n)}
        )
        for v, p, n in zip([0.6, 1.3], predicted, nearest, strict=True)
    }
    return ns(predictions=strokes, plan=ns(origin=0.8))


def repeated(c: float, others: float) -> Any:
    """Two fits per recipe. The logarithms of their parameters have these standard deviations."""
    spread = np.array([c if name == "c" else others for name in FIT_NAMES]) / math.sqrt(2)
    rows = [dict(zip(FIT_NAMES, np.exp(sign * spread), strict=True)) for sign in (-1, 1)]
    return ns(repeated=dict.fromkeys(STRINGS, rows), plan=ns(repeats=2))


def remaining(bridge: float, felt: float, nothing: float) -> Any:
    criterion = {"none": nothing, "bridge": bridge, "felt": felt, "all": 0.12}
    return ns(effects={name: compared(criterion={"band3": x}) for name, x in criterion.items()})


# Every parameter changed in the opposite direction to the paper.
OPPOSITE = {name: x * (0.8 if PRINTED["final"][name] > x else 1.25) for name, x in PRINTED["initial"].items()}
CASES = [
    ("yes", claims.contact_lasts(contacts([3.1e-3, 2.7e-3]))),
    ("part", claims.contact_lasts(contacts([3.1e-3, 2.1e-3]))),
    ("no", claims.contact_lasts(contacts([2.3e-3, 3.6e-3]))),
    ("yes", claims.contact_shortens(contacts([3e-3, 2e-3, 1e-3]))),
    ("part", claims.contact_shortens(contacts([3e-3, 2e-3, 2.5e-3]))),
    ("no", claims.contact_shortens(contacts([3e-3, 4e-3]))),
    ("yes", claims.reflections(maxima([1.0], [0.4, 1.42, 2.4]))),
    ("no", claims.reflections(maxima([1.0], [0.4, 1.0, 1.6]))),
    ("no", claims.reflections(maxima([0.4, 1.4, 2.4], [1.0]))),
    ("yes", claims.felt_loses(loop(6e-4, 6e-4))),
    ("part", claims.felt_loses(loop(6e-4, 7e-4))),
    ("no", claims.felt_loses(loop(-6e-4, 7e-4))),
    ("yes", claims.brighter(ns(strikes=strikes_of(velocity=[1.0, 2.0], centroid=[700.0, 800.0])))),
    ("no", claims.brighter(ns(strikes=strikes_of(velocity=[1.0, 2.0], centroid=[800.0, 700.0])))),
    ("yes", claims.kappa_of_string(biased(1.740))),
    ("no", claims.kappa_of_string(biased(2.142))),
    ("yes", claims.b2_found(over_b2(3e-9, 1e-6))),
    ("no", claims.b2_found(over_b2(3e-10, 1e-10))),
    ("yes", claims.local_minima(minima([0.01, 0.05], [0.002, 0.008, 0.1]))),
    ("part", claims.local_minima(minima([0.01], [0.002, 0.008]))),
    ("no", claims.local_minima(minima([0.01], []))),
    ("yes", claims.annealing_escapes(searched(3, 8))),
    ("part", claims.annealing_escapes(searched(3, 7))),
    ("part", claims.annealing_escapes(searched(8, 8))),
    ("no", claims.annealing_escapes(searched(8, 7))),
    ("yes", claims.three_bands_better(by_bands([0.1, -0.1], [0.01, 0.0]), "paper")),
    ("part", claims.three_bands_better(by_bands([0.1, -0.1], [0.3, 0.3]), "paper")),
    ("no", claims.three_bands_better(by_bands([0.9, 0.9], [0.3, 0.3]), "paper")),
    ("yes", claims.changes_as_printed(tabled(), "paper")),
    ("part", claims.changes_as_printed(tabled(p=2.9), "paper")),
    ("no", claims.changes_as_printed(tabled(**OPPOSITE), "paper")),
    ("yes", claims.string_found(tabled())),
    ("part", claims.string_found(tabled(kappa=2.2))),
    ("no", claims.string_found(tabled(c=310.0, kappa=2.2, b1=0.9))),
    ("yes", claims.high_partials_differ(levels(0.4, 2.0), "paper")),
    ("part", claims.high_partials_differ(levels(1.4, 2.0), "paper")),
    ("no", claims.high_partials_differ(levels(1.4, 1.0), "paper")),
    ("yes", claims.waveforms_nearer(waves(0.6, 0.1), "paper")),
    ("no", claims.waveforms_nearer(waves(0.6, 0.4), "paper")),
    ("yes", claims.predicts(predictions([0.5, 0.6], [5.0, 5.0]), "paper")),
    ("part", claims.predicts(predictions([0.5, 6.0], [5.0, 5.0]), "paper")),
    ("no", claims.predicts(predictions([21.0, 6.0], [25.0, 5.0]), "paper")),
    ("yes", claims.repeats(repeated(1e-5, 0.04), "paper")),
    ("part", claims.repeats(repeated(1e-5, 0.4), "paper")),
    ("no", claims.repeats(repeated(0.06, 0.4), "paper")),
    ("yes", claims.explained(remaining(0.01, 0.1, 1e-4), "paper")),
    ("part", claims.explained(remaining(0.01, 0.1, 0.1), "paper")),
    ("no", claims.explained(remaining(1e-4, 1e-3, 0.1), "paper")),
]


@pytest.mark.parametrize(("outcome", "verdict"), CASES)
def test_verdicts_follow_the_findings(outcome, verdict):
    assert verdict.outcome == outcome
    assert verdict.word == claims.WORDS[outcome]


def test_verdicts_contain_their_numbers():
    assert claims.repeats(repeated(1e-5, 0.4), "read").numbers["spread"]["K_H"] == pytest.approx(0.4)
    assert claims.kappa_of_string(biased(2.142)).numbers["biased"].off == pytest.approx(0.23, abs=0.005)
    assert claims.b2_found(over_b2(3e-9, 1e-6)).numbers["visible"] == 1e-3
    assert claims.b2_found(over_b2(3e-9, 1e-10)).numbers["visible"] is None
    assert claims.waveforms_nearer(waves(0.6, 0.5), "paper").numbers == pytest.approx({"before": 0.6, "after": 0.5})


def test_a_claim_that_is_not_confirmed_is_tested_with_the_string_read(monkeypatch):
    monkeypatch.setattr(claims, "CLAIMS", {claims.waveforms_nearer: ("V, Figure 7", "The waveform comes nearer.")})
    findings = waves(0.6, 0.5)
    stroke = findings.strokes[1.1]
    stroke.sounds["read"] = 1.1 * stroke.sounds["measured"]
    claim = claims.judge(findings)["waveforms_nearer"]
    assert claim.verdict.outcome == "no"
    assert claim.read is not None
    assert claim.read.outcome == "yes"
    assert claim.read.numbers["after"] == pytest.approx(0.1)
    assert claims.judge(waves(0.6, 0.1))["waveforms_nearer"].read is None
