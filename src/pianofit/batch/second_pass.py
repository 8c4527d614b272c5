"""A batch in two passes: every key alone, then again with the prior that the first fits of all other keys give.

The first pass is an ordinary batch. Its results are copied to the folder `alone/`, which has the form of a batch. From
there come the priors of the second pass, whose results replace those of the first one by one. A key without a second
fit keeps its first. The hash of a second fit covers its prior. The same call therefore continues an interrupted batch,
and fits all keys again after one of them changed.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from ..errors import SetupError
from ..io.number_format import first_of
from ..threads import numerical_settings
from .job import Job
from .records import Status, Store
from .run import Progress, Workers, plan_jobs, run_batch

ALONE = "alone"  # folder of the first fits
PASSES = ("pass 1 of 2", "pass 2 of 2")


def run_joint_batch(
    jobs: Sequence[Job],
    folder: Path,
    workers: Callable[[Store], AbstractContextManager[Workers]],
    *,
    retry_failed: bool = False,
    tell: Callable[[Progress], None] = lambda _: None,
) -> Status:
    """Fit all keys alone, then each again with the prior that the other keys of its instrument give; see `run_batch`.

    Raises
    ------
    SetupError
        If no instrument of the library has two keys.
    FitError
        If the fits cannot be those of one instrument, such as fits of a relaxing felt.
    """
    require_two_keys(jobs)
    first, second = (_named(tell, name) for name in PASSES)
    alone = Store(folder / ALONE)
    pending = [job for job in jobs if not _is_archived(alone, job)]
    if pending:
        run_batch(pending, folder, workers, retry_failed=retry_failed, tell=first)
        _archive(Store(folder), alone, pending)
    prepared = _with_priors(alone, jobs)
    single = [job.key for job in prepared if not job.prior and _is_archived(alone, job)]
    if single:
        event = f"{first_of(single)}: no other key of the instrument is fitted, so the first fit is kept"
        second(Progress(len(jobs), 0, 0, (), None, event))
    return run_batch(prepared, folder, workers, retry_failed=retry_failed, tell=second)


def plan_joint_jobs(jobs: Sequence[Job], folder: Path, retry_failed: bool = False) -> dict[str, str]:
    """Plan of a run by key, as `plan_jobs`. The priors of a second fit are known after all first fits."""
    require_two_keys(jobs)
    alone = Store(folder / ALONE)
    plans = plan_jobs(jobs, folder, retry_failed)
    pending = [job for job in jobs if not _is_archived(alone, job)]
    if not pending:
        return plan_jobs(_with_priors(alone, jobs), folder, retry_failed)
    waiting = {job.key for job in pending}
    return {key: plan if key in waiting and plan != "done" else "to do: second fit" for key, plan in plans.items()}


def require_two_keys(jobs: Sequence[Job]) -> None:
    """Raise a `SetupError` if no instrument of a library has two keys."""
    if max((len(keys) for keys in _instruments([job.key for job in jobs]).values()), default=0) < 2:
        raise SetupError(
            "--joint needs at least two keys of one instrument, because the prior of a key is what the "
            "others say of it; leave --joint out"
        )


def _instruments(keys: Sequence[str]) -> dict[str, list[str]]:
    """Keys by the name of their instrument."""
    from ..instrument import instrument_name

    found = defaultdict(list)
    for key in keys:
        found[instrument_name(Path(key) / "fit.json")].append(key)
    return found


def _named(tell: Callable[[Progress], None], name: str) -> Callable[[Progress], None]:
    return lambda progress: tell(replace(progress, part=name))


def _is_archived(alone: Store, job: Job) -> bool:
    record = alone.record(job.key)
    return record is not None and record.hash == replace(job, prior="").hash and alone.is_intact(record)


def _archive(store: Store, alone: Store, jobs: Sequence[Job]) -> None:
    """Copy first fits. Each is written in one step, so an interrupted copy is repeated by the next run."""
    alone.open()
    for job in jobs:
        record = store.record(job.key)
        if record is None or record.hash != job.hash:
            continue
        contents = {name: store.verified_content(record, name) for name in record.files}
        alone.commit(record, {name: content for name, content in contents.items() if content is not None})


@numerical_settings()  # the last digits of a prior, and so the hash of a job, must not depend on the number of threads
def _with_priors(alone: Store, jobs: Sequence[Job]) -> list[Job]:
    """The jobs of the second pass. A job without a first fit, or without one of another key, has no prior."""
    from ..instrument import load_keys, prior_of_key

    priors: dict[str, str] = {}
    fitted = [job.key for job in jobs if _is_archived(alone, job)]
    for keys in _instruments(fitted).values():
        loaded = load_keys([alone.keys / key / "fit.json" for key in keys]) if len(keys) > 1 else []
        for key in loaded:
            name = Path(key.summary.file).parent.name
            priors[name] = prior_of_key(loaded, key.midi).to_toml()
    return [replace(job, prior=priors.get(job.key, "")) for job in jobs]
