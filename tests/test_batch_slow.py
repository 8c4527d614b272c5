"""Whole libraries: real notes with a batch killed twenty times, four workers of a cluster, and all 88 keys.

`PIANOFIT_BATCH_KEYS` and `PIANOFIT_BATCH_KILLS` make them smaller, for a machine with other work to do.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from batch_cases import CLI, killed, python, results
from instrument_cases import law_errors, record_key
from test_batch import check_remains
from test_instrument_twin import ALLOWED

from pianofit.instrument import build_instrument, find_fits, load_keys

KILLS = int(os.environ.get("PIANOFIT_BATCH_KILLS", "20"))
KEYS = os.environ.get("PIANOFIT_BATCH_KEYS", "")
VELOCITIES = (0.6, 1.2, 2.2, 4.0)  # of the layers of the synthetic library, m/s
NAMES = "{instrument}-{note}-{layer}[-{group}].flac"


@pytest.fixture(scope="module")
def library(recordings, tmp_path_factory) -> Path:
    """The recordings of all keys, or of the requested keys."""
    folder = tmp_path_factory.mktemp("library")
    for file in recordings.glob("*.flac"):
        if not KEYS or "-".join(file.name.split("-")[:2]) in KEYS.split(","):
            shutil.copy(file, folder)
    return folder


def command(library: Path, out: Path, *more: object) -> tuple:
    return "batch", library, "--pattern", NAMES, "--out", out, "--no-page", "--json", *more


def finish(*arguments: object) -> dict:
    process = python(CLI, *arguments)
    output, errors = process.communicate()
    assert process.returncode in (0, 3), errors
    return json.loads(output)


@pytest.fixture(scope="module")
def whole(library, tmp_path_factory) -> tuple[dict, float]:
    """Results of an uninterrupted batch, and the median seconds of a key."""
    out = tmp_path_factory.mktemp("whole") / "out"
    began = time.monotonic()
    document = finish(*command(library, out))
    seconds = time.monotonic() - began
    print(f"\n{len(document['keys'])} keys in {seconds:.0f} s, median {document['median_seconds']:.1f} s a key, "
          f"{document['largest_memory'] / 2**30:.2f} GiB a process")  # fmt: skip
    print([(k["key"], k["reason"]) for k in document["keys"] if k["state"] == "failed"])
    return results(out), document["median_seconds"]


@pytest.mark.slow
@pytest.mark.recordings
def test_real_notes_killed_at_random_moments_come_out_identical(library, whole, tmp_path):
    """Every kill interrupts a running batch. A batch that ended by itself is compared, and a new one is started."""
    found, median = whole
    moments = random.Random(11)  # noqa: S311
    kills, batches, kept = 0, 1, set()
    while kills < KILLS:
        out = tmp_path / f"out-{batches}"
        process = python(CLI, *command(library, out))
        time.sleep(moments.uniform(0.5, 1.5 * median))
        if process.poll() is not None:
            assert results(out) == found
            batches, kept = batches + 1, set()
            continue
        killed(process)
        kills += 1
        finished = check_remains(out)
        assert kept <= finished
        kept = finished
    print(f"\n{kills} kills in {batches} batches; {len(kept)} of {len(found)} keys of the last were done by then")
    out = tmp_path / f"out-{batches}"
    finish(*command(library, out))
    assert results(out) == found


@pytest.mark.slow
@pytest.mark.recordings
def test_real_notes_through_a_cluster_of_which_a_worker_dies_come_out_identical(library, whole, tmp_path):
    pytest.importorskip("distributed")
    from test_batch_cluster import cluster

    found, median = whole
    with cluster(tmp_path / "dask", 4) as machines:
        address = machines.address
        process = python(CLI, *command(library, tmp_path / "out", "--scheduler", address, "--files", "shared"))
        time.sleep(median + 5.0)
        killed(machines.workers[1])
        _, errors = process.communicate()
    assert process.returncode in (0, 3), errors
    assert results(tmp_path / "out") == found


@pytest.mark.slow
def test_all_88_keys_of_a_made_library(tmp_path):
    """A synthetic library by the piano of `instrument_cases`. Prints the cost and the errors of the keyboard laws."""
    (tmp_path / "in").mkdir()
    keys = range(21, 109, max(88 // int(KEYS), 1)) if KEYS.isdigit() else range(21, 109)
    for midi in keys:
        record_key(tmp_path / "in", midi, np.random.default_rng(midi), layers=VELOCITIES)
    began = time.monotonic()
    arguments = ("batch", tmp_path / "in", "--pattern", "{note}-{layer}", "--out", tmp_path / "out", "--processes", 2)
    process = python(CLI, *arguments, "--no-page", "--json")
    output, errors = process.communicate()
    minutes = (time.monotonic() - began) / 60
    document = json.loads(output)
    done = document["counts"]["done"]
    print(f"\n{done} of {len(keys)} keys in {minutes:.1f} min, {done / minutes:.1f} a minute on two processes")
    print(f"median {document['median_seconds']} s a key, {document['largest_memory'] / 2**30:.2f} GiB a process")
    print(errors)
    laws = law_errors(build_instrument(load_keys(find_fits([tmp_path / "out"])), "synthetic"), ALLOWED, list(keys))
    for name, (law, literature) in laws.items():
        print(f"{name:9} rms error of the law {law:.4f}, of the literature {literature:.4f}")
    # In the highest half octave fewer than three partials exceed the noise, so those keys fail.
    assert done >= 0.9 * len(keys)
