"""Fits of a whole sample library in one call, as `pianofit batch` makes them on this machine."""

import os
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

from .batch import Job, Key, ProcessPool, Progress, Settings, Status, make_job, read_keys, run_batch, run_joint_batch
from .errors import PianofitError, SetupError, check_range
from .io.files import as_path, printable
from .io.number_format import first_of
from .setup import Setup
from .synthetic import setup_text
from .threads import MAX_PROCESSES, MEMORY, TIME_LIMIT, cores


def fit_library(
    library: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    pattern: str | None = None,
    setup: Setup | None = None,
    seed: int = 0,
    page: bool = True,
    joint: bool = False,
    processes: int | None = None,
    retry_failed: bool = False,
    tell: Callable[[Progress], None] = lambda _: None,
) -> Status:
    """Fit every key of a sample library, in processes. The same call continues an interrupted batch.

    In a script, call it under `if __name__ == "__main__":`, because each process imports the script.

    Parameters
    ----------
    library : a CSV with the columns file and note, an SFZ file, or a folder of recordings (docs/batch.md).
    folder : folder of the batch: `keys/KEY/fit.json` and the sounds of every finished key, and `index.html`.
    pattern : for a folder of recordings, the form of the file names, such as "{instrument}-{note}-{layer}.flac".
    setup : what is known of all keys, without recordings.
    seed : seed of all fits.
    page : write a page for every key.
    joint : fit every key twice: alone, then with the prior that the fits of the other keys give.
    processes : number of processes; by default one a core.
    retry_failed : fit keys again that failed before.
    tell : called with the progress.

    Returns
    -------
    The state of the batch: `counts` of keys by state, and `keys` with the reason of each failure.

    Raises
    ------
    SetupError
        If the manifest or the setup cannot be used. Nothing is started then.
    OutputError
        If the folder is in use, holds something else, or cannot be written to.

    Examples
    --------
    >>> import pianofit
    >>> done = pianofit.fit_library("library", "batch", pattern="{instrument}-{note}-{layer}.flac", processes=2)
    >>> done.counts["failed"]
    0
    """
    check_range("processes=", 1 if processes is None else processes, 1, MAX_PROCESSES)
    keys, _ = read_keys(as_path(library), pattern=pattern)
    jobs = library_jobs(as_path(library), keys, library_settings(setup or Setup(), "setup=", joint, seed, page=page))
    run, count = run_joint_batch if joint else run_batch, processes or cores()
    pool = lambda store: ProcessPool(count, int(MEMORY * 2**30), TIME_LIMIT, store.scratch)  # noqa: E731
    return run(jobs, as_path(folder), pool, retry_failed=retry_failed, tell=tell)


def library_settings(
    setup: Setup, name: str, joint: bool, seed: int = 0, channel: str = "average", page: bool = True
) -> Settings:
    """Return the settings that all keys share, with the setup as text.

    Raises a `SetupError` about `name` for a setup with values of one key, or that a joint fit cannot use.
    """
    if joint and not setup.law.has_contact:
        raise SetupError(f"a joint fit (--joint) has no prior for a {setup.excitation}; leave it out")
    if setup == Setup():
        return Settings(seed, channel, page)
    if setup.recordings:
        raise SetupError(f"{name}: has a [[recording]]; the manifest names the recordings, with their velocities")
    if joint and setup.prior is not None:
        raise SetupError(f"{name}: has a [prior], which --joint computes for every key; remove one")
    prior = "" if setup.prior is None else setup.prior.to_toml()
    return Settings(seed, channel, page, setup_text(setup) + prior)


def library_jobs(manifest: Path, keys: Sequence[Key], settings: Settings) -> list[Job]:
    """Read and hash the recordings of all keys. All problems are reported before any fit starts."""
    jobs, problems = [], []
    for key in keys:
        try:
            job = make_job(key, settings)
            Setup.from_dict(tomllib.loads(job.setup), key.name)
            jobs.append(job)
        except PianofitError as error:
            problems.append(str(error))
    if problems:
        raise SetupError(f"{printable(manifest)}: {first_of(problems, '; ')}; nothing was started")
    return jobs
