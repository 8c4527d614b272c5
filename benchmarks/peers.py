"""Pianofit and two published neural nets on the same strokes, and the speed of other programs.

    python benchmarks/peers.py                          both tables
    python benchmarks/peers.py --notes C2 --json peers.json
    python benchmarks/peers.py --docs docs/peers.md     puts the tables of distances there
    python benchmarks/peers.py --from peers.json --docs docs/peers.md         those of an earlier run
    python benchmarks/peers.py --speed                  only how long 1 s of sound takes

Strokes: the folder ../shared/disklavier, or what PIANOFIT_PEERS names, with its `recordings.csv`: four keys of an
upright Disklavier, each at the lowest velocity, MIDI 23, 100 and 111, and what the nets say of two of these strokes.
What each is given, and what may flatter it, stands in docs/peers.md and in `given` of the JSON.

Every sound is brought to one start and one gain with the recording, the same way for all, and then measured:

- level: rms over partials of the levels (energy of the first 0.35 s under exp(-8 t)), dB, the mean taken out
- envelope: mean |dB| of the partials' envelopes over 3 s, while the recording's is above its noise, one gain taken out
- MR: multi-resolution STFT, spectral convergence plus L1 of log magnitudes (Yamamoto et al. 2020), K-weighted gain
- realism: the mean of three log-mel distances, dB (`pianofit.dsp.loudness`); with
  ../shared/tools/realism.py, the distance of that program is the witness
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import realism
from measuring import into_page, modal_response_of
from scipy import signal

FOLDER = Path(__file__).parents[2] / "shared" / "disklavier"
KEYS = ("A0", "C2", "E4", "G6")
MEASURES = ("level", "envelope", "MR", "realism", "witness")
# Of the recording that is kept, s before its onset and after.
LEAD, SPAN = 0.02, 3.0
# Of the levels: how long, s, and what they decay under, 1/s.
EARLY, DAMPING = 0.35, 8.0
# Partials that count lie within so many dB of the strongest, and envelopes so many dB above their noise, dB.
RANGE, ABOVE = 50.0, 10.0
# Rise of log velocity for a MIDI step, 1: what an instrument plays by default, 0.29 m/s at 1 to 5.8 m/s at 127.
RISE = np.log(5.8 / 0.29) / 126
# Of the multi-resolution STFT, samples: windows, and hops as parts of them; least power (Yamamoto et al. 2020).
WINDOWS, HOP, LEAST = (512, 1024, 2048), 4, 1e-7
LAGS = 0.010  # s, either way, that starts may differ by


class Made(NamedTuple):
    """A sound in place of a stroke."""

    what: str
    given: str
    samples: np.ndarray  # [samples], at the recordings' rate


class Target(NamedTuple):
    """A recording that everything is compared with."""

    samples: np.ndarray  # [samples], from LEAD before its onset
    rate: int  # Hz
    partials: np.ndarray  # Hz
    spacing: float  # Hz


def folder() -> Path:
    """Where the strokes are; ends the program if they are nowhere."""
    found = Path(os.environ.get("PIANOFIT_PEERS", FOLDER))
    if not (found / "recordings.csv").is_file():
        raise SystemExit(f"{found}: no recordings.csv here; say where the strokes are with PIANOFIT_PEERS")
    return found


def strokes(key: str) -> Iterator[tuple[str, Target, list[Made]]]:
    """Both strokes of a key that the nets predict, and all sounds that are compared with them."""
    from pianofit import analyse, load_recording

    at = folder()
    names = ("low", "v23", "v100", "v111")
    heard = {name: load_recording(at / f"bivib-{key}-{name}.flac") for name in names}
    analyses = {name: analyse(one, note=key) for name, one in heard.items()}
    for wanted, source in (("v100", "low"), ("v23", "v111")):
        nets = [
            Made(f"{net} net, from {source}", "that stroke and the target's velocity; trained on the target too",
                 load_recording(at / f"bivib-{key}-{wanted}-by-{net}.flac").samples)
            for net in ("S6", "LSTM")
        ]  # fmt: skip
        others = [name for name in names if name != wanted]
        layers = [Made(f"{name} itself", "nothing of the target but its gain", heard[name].samples) for name in others]
        ours = [ringing(heard, analyses, others, wanted), ringing(heard, analyses, [source], wanted)]
        if wanted == "v100":
            ours.append(ringing(heard, analyses, others, wanted, steps=("v111", 100 - 111)))
        yield wanted, target(heard[wanted], analyses[wanted]), [*nets, *layers, *ours]


def ringing(heard: dict, analyses: dict, by: list[str], wanted: str, steps: tuple[str, int] | None = None) -> Made:
    """A stroke as pianofit plays it from others; `steps`: at so many MIDI steps from a layer, or else as it was hit."""
    from pianofit import RecordingInfo, Setup, fit
    from pianofit.model.modal_response import force_pulse

    layers = tuple(RecordingInfo(file=Path(heard[name].path).name, gain_group="machine") for name in by)
    setup = Setup(recordings=layers) if len(by) > 1 else Setup()
    result = fit(*(heard[name] for name in by), analyses=[analyses[name] for name in by], setup=setup)
    rate, count = heard[wanted].rate, round((SPAN + 0.3) * heard[wanted].rate)
    if steps is None:
        note = result.predict(analyses[wanted]).note
        given = "the target's partial levels, for its velocity, and its gain"
    else:
        own = next(row.stroke_value for row in result.fit.recordings if f"-{steps[0]}." in row.file)
        note = result.note.with_velocity(own * float(np.exp(RISE * steps[1])))
        given = "the target's MIDI velocity, and its gain"
    stroke, key = note.strike(rate), modal_response_of(result)
    if key is None:
        raise SystemExit(f"{wanted} from {by}: nothing rings; this is no case of the table")
    sound = key.sound(force_pulse(stroke, note.hammer), rate, count).mean(axis=0)
    how = "velocity found" if steps is None else "velocity by MIDI"
    return Made(f"pianofit, from {' '.join(by)}, {how}", f"{given}; not trained on anything", sound)


def target(recording: Any, analysis: Any) -> Target:
    """A recording from its onset on, and the partials that count."""
    level, frequency = analysis.partials.level, analysis.partials.frequency
    kept = (level > level.max() - RANGE) & (frequency < 0.4 * recording.rate)
    begin = recording.onset - round(LEAD * recording.rate)
    samples = recording.samples[max(begin, 0) :][: round((LEAD + SPAN) * recording.rate)]
    return Target(np.pad(samples, (max(-begin, 0), 0)), recording.rate, frequency[kept], float(frequency[0]))


def aligned(samples: np.ndarray, to: Target) -> np.ndarray:
    """`samples` cut like the target, begun where the two differ least in their first 0.3 s, with the same loudness."""
    from pianofit.dsp.loudness import k_weighted_mean_square, log_mel_distances
    from pianofit.recording.onset import find_onset

    lead, size = round(LEAD * to.rate), len(to.samples)
    start, best = find_onset(samples, to.rate, 1e-7) - lead, (np.inf, 0)
    padded = np.pad(samples, (2 * lead + size, size))
    short = lead + round(0.3 * to.rate)
    for reach, step in ((LAGS, 1e-3), (1e-3, 1.25e-4)):
        lags = best[1] + np.arange(-reach, reach + step / 2, step)
        tried = [padded[round(2 * lead + size + start + lag * to.rate) :][:short] for lag in lags]
        costs = log_mel_distances(to.samples[:short], tried, to.rate, lead)
        best = min(best, (min(costs), float(lags[int(np.argmin(costs))])))
    cut = padded[round(2 * lead + size + start + best[1] * to.rate) :][:size]
    powers = [k_weighted_mean_square(x, to.rate) for x in (to.samples, cut)]
    return cut * np.sqrt(powers[0] / powers[1])


def envelopes(samples: np.ndarray, to: Target) -> np.ndarray:
    """Power of each partial [partials, samples], in a band of half the spacing either way, never wider than 100 Hz."""
    length = round(max(2 / to.spacing, 0.02) * to.rate) | 1
    window = np.hanning(length + 2)[1:-1] / np.hanning(length + 2).sum()
    t = np.arange(len(samples)) / to.rate
    turned = (samples * np.exp(-2j * np.pi * f * t) for f in to.partials)
    return np.stack([np.abs(signal.oaconvolve(x, window, "same")) ** 2 for x in turned])


def measured(samples: np.ndarray, to: Target, tool: Any) -> dict[str, float]:
    """All distances of a sound from the target."""
    from pianofit.dsp.loudness import log_mel_distances

    sound, lead = aligned(samples, to), round(LEAD * to.rate)
    own, other = envelopes(to.samples, to), envelopes(sound, to)
    early = slice(lead, lead + round(EARLY * to.rate))
    weight = np.exp(-DAMPING * np.arange(round(EARLY * to.rate)) / to.rate)
    levels = 10 * np.log10((own[:, early] @ weight) / np.maximum(other[:, early] @ weight, 1e-30))
    gain = levels.mean()
    every = slice(lead, None, round(0.01 * to.rate))
    noise = np.quantile(own[:, lead:], 0.02, axis=1, keepdims=True) * 10 ** (ABOVE / 10)
    there = own[:, every] > noise
    away = np.abs(10 * np.log10(own[:, every] / np.maximum(other[:, every], noise / 100)) - gain)
    found = {
        "level": float(np.sqrt(np.mean((levels - gain) ** 2))),
        "envelope": float(np.mean([a[t].mean() for a, t in zip(away, there, strict=True) if t.any()])),
        "MR": float(np.mean([resolution(to.samples, sound, n) for n in WINDOWS])),
        "realism": log_mel_distances(to.samples, [sound], to.rate, lead)[0],
    }
    if tool is not None:
        by = np.gcd(tool.RATE, to.rate)
        brought = (signal.resample_poly(x, tool.RATE // by, to.rate // by) for x in (to.samples, samples))
        found["witness"] = tool.compare(*brought)["distance_db"]
    return found


def resolution(own: np.ndarray, other: np.ndarray, n: int) -> float:
    """Spectral convergence plus the mean L1 of log magnitudes, windows of `n` samples."""
    stft = signal.ShortTimeFFT(np.hanning(n + 1)[:-1], n // HOP, 1.0)
    a, b = (np.sqrt(np.maximum(np.abs(stft.stft(x)) ** 2, LEAST)) for x in (own, other))
    return float(np.linalg.norm(a - b) / np.linalg.norm(a) + np.mean(np.abs(np.log(a / b))))


def likeness(key: str) -> None:
    """Print how nearly the nets' sounds are their sources with another gain: the correlation, sample by sample."""
    from pianofit import load_recording

    for wanted, source in (("v100", "low"), ("v23", "v111")):
        for net in ("S6", "LSTM"):
            pair = [load_recording(folder() / f"bivib-{key}-{name}.flac").samples
                    for name in (source, f"{wanted}-by-{net}")]  # fmt: skip
            size = min(map(len, pair))
            print(
                f"{key} {wanted} by {net}: correlation with {source} {np.corrcoef([x[:size] for x in pair])[0, 1]:.4f}"
            )


def distances(keys: list[str]) -> dict[str, dict[str, dict]]:
    """Of every key and stroke, printed as they come."""
    tool = realism.measure() if realism.TOOL.is_file() or "PIANOFIT_REALISM" in os.environ else None
    found: dict[str, dict[str, dict]] = {}
    for key in keys:
        likeness(key)
        for wanted, to, made in strokes(key):
            print(f"\n{key} {wanted}, {len(to.partials)} partials" + "".join(f"{m:>10}" for m in MEASURES), flush=True)
            for one in made:
                values = measured(one.samples, to, tool)
                found.setdefault(f"{wanted}: {one.what}", {})[key] = values
                found[f"{wanted}: {one.what}"]["given"] = {"": one.given}
                print(f"  {one.what:48}" + "".join(f"{values.get(m, np.nan):10.2f}" for m in MEASURES), flush=True)
    print("\nmedians over the keys\n" + f"{'':50}" + "".join(f"{m:>10}" for m in MEASURES))
    for what, by in found.items():
        rows = [values for key, values in by.items() if key != "given"]
        medians = [statistics.median(row.get(m, np.nan) for row in rows) for m in MEASURES]
        print(f"{what:50}" + "".join(f"{x:10.2f}" for x in medians))
    return found


def speeds() -> dict[str, dict]:
    """Milliseconds of computing for 1 s of sound of one string, all in turn in one run."""
    import measuring
    import works

    length = 10.0
    struck, scanned, played = works.strikes(), works.plain_scan(), works.sounds(length)
    rows = {
        "pianofit, struck string to its velocity at the pickup": (struck["pianofit"], 1.0),
        "paper's scheme, numba, the same string and stroke": (struck["baseline"], 1.0),
        "plain JAX scan, 64 linear modes, no hammer": (scanned["forward"], 1.0),
        "pianofit, a C2 through a path": (played["pianofit"], length),
    }
    if "csound prepiano" in played:
        rows["csound prepiano, a C2, whole process"] = (played["csound prepiano"], length)
    taken = measuring.paired({name: work for name, (work, _) in rows.items()})
    print(f"\n{measuring.machine()}\n\n{'ms for 1 s of sound':56}{'median':>9}{'fastest':>9}")
    for name, (_, seconds) in rows.items():
        print(f"{name:56}" + "".join(f"{1e3 * taken[name][x] / seconds:9.2f}" for x in ("median", "fastest")))
    return {name: taken[name] | {"seconds": rows[name][1]} for name in rows}


def write_tables(page: Path, distances: dict[str, dict[str, Any]]) -> None:
    """The medians and every key between the page's marks."""
    rows = {name: {key: by for key, by in each.items() if key != "given"} for name, each in distances.items()}
    digits = {measure: 2 if measure == "MR" else 1 for measure in MEASURES}

    def cell(measure: str, value: float) -> str:
        return f"{value:.{digits[measure]}f}"

    medians = ["| stroke | in its place | level | envelope | MR | realism |", "|---|---|---|---|---|---|"]
    for name, by in rows.items():
        level, envelope, mr, mine, witness = (
            cell(measure, statistics.median(one[measure] for one in by.values())) for measure in MEASURES
        )
        medians.append(f"| {name.replace(': ', ' | ', 1)} | {level} | {envelope} | {mr} | {mine} ({witness}) |")
    keys: list[str] = []
    for words, first, second in (("Realism, then level", "realism", "level"), ("Envelope, then MR", "envelope", "MR")):
        there = list(next(iter(rows.values())))
        keys += ["", f"{words} in brackets{', dB' if second == 'level' else ''}:", ""]
        keys += [f"| stroke | in its place | {' | '.join(there)} |", "|---|---|" + "---|" * len(there)]
        for name, by in rows.items():
            cells = [f"{cell(first, one[first])} ({cell(second, one[second])})" for one in by.values()]
            keys.append(f"| {name.replace(': ', ' | ', 1)} | {' | '.join(cells)} |")
    into_page(page, "medians", medians)
    into_page(page, "keys", keys[1:])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--notes", default=",".join(KEYS), help="separated by commas")
    parser.add_argument("--speed", action="store_true", help="only how long things take")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--docs", type=Path, help="the page whose tables of distances are made anew")
    parser.add_argument("--from", dest="source", type=Path, help="measure nothing: take the numbers of an earlier run")
    options = parser.parse_args()
    if options.source:
        found = json.loads(options.source.read_text(encoding="utf-8"))
        if options.docs:
            write_tables(options.docs, found["distances"])
        return
    import works  # noqa: F401 - float64 in this process, before JAX is loaded

    from pianofit.program_folder import enable_program_cache

    enable_program_cache()
    found = {} if options.speed else {"distances": distances(options.notes.split(","))}
    found["speed"] = speeds()
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if options.docs and not options.speed:
        write_tables(options.docs, found["distances"])


if __name__ == "__main__":
    main()
