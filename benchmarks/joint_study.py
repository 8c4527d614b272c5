"""Whether the other keys of a keyboard help a key of which one layer was recorded.

    python benchmarks/joint_study.py ../shared/keyboard                 all keys, the middle file of each
    python benchmarks/joint_study.py ../shared/keyboard --keys 5 --layer 1
    python benchmarks/joint_study.py ../shared/recordings --prefix cp80 --json FILE

RECORDINGS has a `recordings.csv`, as in `crossval.py`. One layer of each key is fitted, and all other layers of the key
are predicted: rms over partials, dB, one gain removed, as in `pianofit predict`. The columns are

    recorded   the fitted layer itself in place of the predicted one
    alone      a fit with the literature's prior
    joint      a fit with the prior that such fits of all other keys give
    complete   a fit with the prior that fits of all layers of all other keys give: as much as other keys can determine
    own        the hammer of a fit of all layers of the key itself, without velocity discrepancy, through the path of
               the fitted layer: the part that no prior of the hammer can remove
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from crossval import notes

if TYPE_CHECKING:
    from pianofit import Analysis, KeyPrior, Result

COLUMNS = ("recorded", "alone", "joint", "complete", "own")


def chosen_keys(folder: Path, prefix: str | None, count: int) -> dict[str, tuple[str, list[Path]]]:
    """Note and files of some keys of one instrument, spread over its range."""
    from pianofit.analysis.note_names import note_to_midi

    found = {key: (note, files) for key, (note, files, _) in notes(folder).items()}
    found = {key: own for key, own in found.items() if prefix is None or key.startswith(f"{prefix}-")}
    order = sorted(found, key=lambda key: note_to_midi(found[key][0]))
    places = np.unique(np.linspace(0, len(order) - 1, min(count or len(order), len(order))).round().astype(int))
    return {order[i]: found[order[i]] for i in places}


def level_change(fitted: Analysis, other: Analysis) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the scored partials that both layers have, and their change of level, dB [partials]."""
    from pianofit.result.comparison import audible_partials

    own, p = fitted.partials, other.partials
    number = np.intersect1d(own.number, p.number[audible_partials(p.frequency, p.level)])
    levels = [x.level[np.searchsorted(x.number, number)] for x in (own, p)]
    return number, levels[1] - levels[0]


def recorded_error(fitted: Analysis, other: Analysis) -> float:
    """Level error of one layer in place of another, dB."""
    from pianofit.criterion import level_error_db

    _, change = level_change(fitted, other)
    return level_error_db(np.zeros_like(change), change)


def own_error(result: Result, sounds: Sequence[Analysis], fitted: int, other: int) -> float:
    """Error of the change of level between two layers by the hammer of a fit of both, dB."""
    from pianofit.criterion import level_error_db

    number, change = level_change(sounds[fitted], sounds[other])
    velocities = np.array([result.fit.recordings[i].stroke_value for i in (fitted, other)])
    levels = result.note.levels_of_strokes(velocities, int(number.max()))[0][:, number - 1]
    return level_error_db(levels[1] - levels[0], change)


def errors(result: Result, others: Sequence[Analysis]) -> list[float]:
    """Errors of the predicted layers, dB."""
    return [result.predict(analysis).error_db for analysis in others]


def stored(results: Mapping[str, Result]) -> list[Any]:
    """The fits as an instrument reads them."""
    from pianofit import load_keys

    with tempfile.TemporaryDirectory() as place:
        for key, result in results.items():
            (folder := Path(place) / key).mkdir()
            result.save(folder, page=False)
        return load_keys([Path(place) / key / "fit.json" for key in results])


def fitted_over_loudest(complete: Mapping[str, Result], fitted: Mapping[str, int], without: str) -> float:
    """Velocity of the fitted layer over that of the loudest one: geometric mean over all keys but one."""
    logs = []
    for key, result in complete.items():
        velocities = np.array([recording.stroke_value for recording in result.fit.recordings])
        logs.append(np.log(velocities[fitted[key]] / velocities.max()))
    return float(np.exp(np.mean([x for key, x in zip(complete, logs, strict=True) if key != without])))


def main() -> None:
    """Print the table."""
    from pianofit import Setup, analyse, fit, load_recording, prior_of_key
    from pianofit.analysis.note_names import note_to_midi
    from pianofit.program_folder import enable_program_cache

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--prefix", help="instrument, if the folder has several")
    parser.add_argument("--keys", type=int, default=0, help="number of keys; default: all")
    parser.add_argument("--layer", type=int, default=0, help="fitted file of each key, by name from 1; default: middle")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    enable_program_cache()
    keys = chosen_keys(options.recordings, options.prefix, options.keys)
    sounds = {key: [analyse(load_recording(file), note=note) for file in files] for key, (note, files) in keys.items()}
    fitted = {key: min(options.layer or (len(files) + 1) // 2, len(files)) - 1 for key, (_, files) in keys.items()}

    def fit_one(key: str, prior: KeyPrior | None = None) -> Result:
        (note, files), i = keys[key], fitted[key]
        return fit(files[i], setup=Setup(prior=prior), note=note, analyses=[sounds[key][i]], progress=False)

    alone = {key: fit_one(key) for key in keys}
    complete = {
        key: fit(*files, note=note, analyses=sounds[key], progress=False) for key, (note, files) in keys.items()
    }
    fits = [stored(results) for results in (alone, complete)]
    rows: list[dict[str, Any]] = []
    print(f"{'':28}" + "".join(f"{column:>10}" for column in COLUMNS) + "   m/s", flush=True)
    for key, (note, files) in keys.items():
        priors = [prior_of_key(own, note_to_midi(note)) for own in fits]
        priors[1] = replace(priors[1], velocity=priors[1].velocity * fitted_over_loudest(complete, fitted, key))
        results = [alone[key], *(fit_one(key, prior) for prior in priors)]
        own, others = sounds[key][fitted[key]], [i for i in range(len(files)) if i != fitted[key]]
        analyses = [sounds[key][i] for i in others]
        columns = [[recorded_error(own, other) for other in analyses], *(errors(one, analyses) for one in results)]
        columns.append([own_error(complete[key], sounds[key], fitted[key], other) for other in others])
        velocities = ", ".join(f"{one.fit.reference.stroke_value:.2f}" for one in results)
        for i, found in zip(others, np.transpose(columns).tolist(), strict=True):
            rows.append({"key": key, "file": files[i].name} | dict(zip(COLUMNS, found, strict=True)))
            print(f"{files[i].stem:28}" + "".join(f"{x:10.2f}" for x in found) + f"   {velocities}", flush=True)
    table = np.array([[row[column] for column in COLUMNS] for row in rows])
    for name, statistic in (("mean", np.mean), ("median", np.median), ("worst", np.max)):
        print(f"{name:28}" + "".join(f"{x:10.2f}" for x in statistic(table, axis=0)))
    better = int((table[:, 2] < table[:, 1]).sum())
    print(f"joint is nearer than alone in {better} of {len(rows)} layers")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
