"""What all tests share: compiled programs that are kept, the same examples every time, real notes."""

from __future__ import annotations

import functools
import gc
import hashlib
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook
from threadpoolctl import threadpool_limits

from pianofit.program_folder import enable_program_cache

# Modules that write shapes in their signatures: every call is checked against them. An int is a float too (PEP 484).
CHECKED = [
    "pianofit.felt.steps",
    "pianofit.model",
    "pianofit.inference.batched_model",
    "pianofit.inference.nuts",
    "pianofit.inference.recording_objective",
    "pianofit.inference.density",
    "pianofit.bensa2005.spectral_criterion",
    "pianofit.x64",
]
install_import_hook(CHECKED, "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

settings.register_profile("pianofit", derandomize=True, deadline=None)
settings.load_profile("pianofit")

# Files that begin first, the longest first, so that no worker is left with one of them at the end.
FIRST = (
    "gate", "plucked_instrument", "docs", "batch_cluster", "examples", "counts", "api", "batch", "instrument_even",
    "cli", "instrument_commands", "recipes", "analysis", "mend", "reproduce", "felt_fit", "batch_fit", "dataset",
    "views", "analysis_recordings", "coverage", "felt_outside", "felt_laws", "felt_own",
)  # fmt: skip
# Files whose tests share the fits of `twin_cases`, which are kept in memory: one worker runs them all.
SHARED = ("gate", "fit", "fit_recordings", "microphones", "measured", "compare", "derived", "result")

# Results of one function that are kept: the keys of a few instruments, some 10 MB.
LARGEST_KEPT = 400

RECORDINGS = Path(os.environ.get("PIANOFIT_RECORDINGS", Path(__file__).parents[2] / "shared" / "recordings"))


def pytest_configure(config: pytest.Config) -> None:
    """Leave the studies out, unless `-m` asks for something.

    Keep what JAX compiles, as the command line does: a second run of the tests compiles nothing. JAX is not imported
    yet, so the processes that the tests start keep and find it too.
    """
    enable_program_cache()
    _keep_bytecode()
    gc.disable()
    if not config.option.markexpr:
        config.option.markexpr = "not slow"


def _keep_bytecode() -> None:
    """Write `__pycache__` even if the environment forbids it.

    Without it every process compiles the package again, and every worker rewrites the assertions of all tests.
    """
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


def pytest_collection_finish() -> None:
    """Leave all that is imported out of the garbage collector, and let it run less often.

    It walked through millions of objects of the libraries, none of them garbage, for a tenth of the time of the tests.
    """
    gc.freeze()
    gc.set_threshold(20_000, 10, 50)
    gc.enable()


def pytest_sessionfinish() -> None:
    """Write the coverage that was measured in this process while it still may.

    pytest-xdist kills a worker that takes more than 10 s to exit, and with it what a worker would write at its exit.
    """
    if (coverage := sys.modules.get("coverage")) and (running := coverage.Coverage.current()):
        running.stop()
        running.save()


def _name(node: str) -> str:
    """What a test's file is of: tests/test_gate.py -> gate."""
    return Path(node.partition("::")[0]).stem.removeprefix("test_")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The long files first, in their order, then the others."""

    def place(item: pytest.Item) -> int:
        name = "gate" if _name(item.nodeid) in SHARED else _name(item.nodeid)
        return FIRST.index(name) if name in FIRST else len(FIRST)

    items.sort(key=place)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """A file, or files that share fits, is one worker's: two would both make what its tests share."""
    from xdist.scheduler import LoadScopeScheduling

    class Files(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return "shared" if _name(nodeid) in SHARED else _name(nodeid)

    config.option.loadscopereorder = False
    return Files(config, log)


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread() -> Iterator[None]:
    """One thread for BLAS: the tests run in as many processes as there are cores, and would wait for each other."""
    import numpy  # noqa: F401 - loaded before they are limited
    import scipy.linalg  # noqa: F401

    with threadpool_limits(limits=1, user_api="blas"):
        yield


@pytest.fixture(scope="session", autouse=True)
def _commands_are_built_once() -> None:
    """Typer builds all commands from their functions at every call, which takes longer than most refusals.

    A test that imports `get_command` at its top still builds its own: a command keeps the names of its help option.
    """
    import typer.main
    import typer.testing

    typer.main.get_command = typer.testing._get_command = functools.cache(typer.main.get_command)


def _kept(function: Callable[..., Any]) -> Callable[..., Any]:
    """Keep results by the content of the arguments."""
    results: dict[bytes, Any] = {}

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        try:
            key = hashlib.sha256(pickle.dumps(arguments)).digest()
        except (AttributeError, pickle.PicklingError):  # a felt law of a test
            return function(*arguments)
        if key not in results:
            if len(results) >= LARGEST_KEPT:
                results.clear()
            results[key] = function(*arguments)
        return results[key]

    call.cache_clear = results.clear  # pyright: ignore[reportFunctionMemberAccess]
    return call


@pytest.fixture(scope="session", autouse=True)
def _keys_are_guessed_once() -> None:
    """Tests build instruments of the same fits again and again, each time with 80 guessed keys and their levels."""
    from pianofit.instrument import build, guessed_responses

    build.stroke_level = _kept(build.stroke_level)
    build.guess_response = guessed_responses.guess_response = _kept(guessed_responses.guess_response)


@pytest.fixture
def float64() -> Iterator[None]:
    """JAX in float64 for what a test computes itself; the others run in a caller's ordinary float32."""
    import jax

    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real notes, which is not part of the repository."""
    if not RECORDINGS.is_dir():
        pytest.skip(f"no recordings at {RECORDINGS}; set PIANOFIT_RECORDINGS to their folder")
    return RECORDINGS
