"""Posterior draws: the likelihood of each observation, saving and loading, and rejected files."""

from __future__ import annotations

import hashlib
import io
import json
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm
from table_cases import PHI, SHAPES, noise, point, shared, table

import pianofit.model  # noqa: F401  (float64)
from pianofit import Result
from pianofit.errors import FitError
from pianofit.inference import ObservedValues
from pianofit.inference.likelihood import pointwise
from pianofit.result.draws import DRAWS_FILE, Draws, encode_draws, read_draws
from pianofit.schema.fit import DrawsFile

pytestmark = pytest.mark.usefixtures("float64")


def draws(chains: int = 2, count: int = 30) -> Draws:
    """Random draws of an invented fit."""
    random = np.random.default_rng(3)
    values = {name: random.normal(size=(chains, count)) for name in ("c", "v_H0", "v_H0 2", "f0", "M_H/M_S")}
    seen = {kind: ObservedValues(random.normal(size=n), np.ones(n, int), np.arange(1, n + 1))
            for kind, n in (("level", 5), ("frequency", 3), ("absent", 0))}  # fmt: skip
    likelihood = {kind: random.normal(size=(chains, count, len(own.value))) for kind, own in seen.items()}
    return Draws(values, likelihood, seen)


def entry(data: bytes) -> DrawsFile:
    return DrawsFile(DRAWS_FILE, hashlib.sha256(data).hexdigest())


def written(folder: Path, data: bytes) -> Draws | None:
    """Draws read from a file that holds `data`, with a matching entry of a fit."""
    (folder / DRAWS_FILE).write_bytes(data)
    return read_draws(entry(data), folder)


# --- the likelihood of each observation -------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_an_observation_is_as_likely_as_it_makes_all_the_others(shape):
    """With dense covariances: log p(y) - log p(y without it), summed over nodes, and P(below its bound | y)."""
    t, (residual, w, theta) = table(shape), point(shape)
    detected, y = np.asarray(t.detected).ravel() > 0, residual.ravel()
    full = {
        node: shared(t, PHI, node, theta) + np.diag((noise(t, PHI) / w).ravel())
        for node in np.ndindex(t.log_weight.shape)
    }

    def log_density(at: np.ndarray) -> float:
        by_node = [
            t.log_weight[n] + multivariate_normal(np.zeros(len(at)), C[np.ix_(at, at)]).logpdf(y[at])
            for n, C in full.items()
        ]
        return float(logsumexp(by_node))

    density, below = pointwise(t, residual, PHI, w, theta)
    inside = np.flatnonzero(detected)
    for i in inside[:: max(1, len(inside) // 6)]:
        alone = log_density(inside) - log_density(inside[inside != i])
        assert density.ravel()[i] == pytest.approx(alone, abs=1e-8)
    assert not density.ravel()[~detected].any()
    for (r, k), probability in zip(np.asarray(t.censored), below, strict=True):
        at, own = r * t.value.shape[1] + k, noise(t, PHI).ravel()
        by_node = []
        for n in full:
            latent, C = shared(t, PHI, n, theta), full[n][np.ix_(inside, inside)]
            pull = np.linalg.solve(C, latent[inside, at])
            sd = np.sqrt(latent[at, at] + own[at] - pull @ latent[inside, at])
            weight = t.log_weight[n] + multivariate_normal(np.zeros(len(inside)), C).logpdf(y[inside])
            by_node.append(weight - log_density(inside) + norm.logcdf((y[at] - pull @ y[inside]) / sd))
        assert probability == pytest.approx(logsumexp(by_node), abs=1e-8)


# --- a file, and back -------------------------------------------------------------------------------------------------


def test_draws_are_read_as_they_were_written(tmp_path):
    first = draws()
    back = written(tmp_path, encode_draws(first))
    assert back is not None
    assert list(back) == list(first)
    for name, values in first.items():
        np.testing.assert_array_equal(back[name], values)
    for kind, own in first.observed.items():
        np.testing.assert_array_equal(back.log_likelihood[kind], first.log_likelihood[kind])
        for mine, theirs in zip(own, back.observed[kind], strict=True):
            np.testing.assert_array_equal(mine, theirs)
    assert encode_draws(back) == encode_draws(first)
    assert len([*back.values()]) == len(first)
    assert len(repr(back)) < 300
    with np.load(tmp_path / DRAWS_FILE, allow_pickle=False) as file:  # and NumPy reads it
        np.testing.assert_array_equal(file["posterior/M_H/M_S"], first["M_H/M_S"])


def test_a_fit_without_draws_has_none(tmp_path):
    data = encode_draws(draws())
    assert read_draws(entry(data), tmp_path) is None, "the file was deleted"
    (tmp_path / DRAWS_FILE).write_bytes(data)
    assert read_draws(None, tmp_path) is None, "the file of an earlier fit"


def archive(arrays: dict[str, np.ndarray], compression: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as file:
        for name, values in arrays.items():
            own = io.BytesIO()
            np.save(own, values)
            file.writestr(name + ".npy", own.getvalue())
    return stream.getvalue()


ONE = np.ones((2, 3))
SEEN = {"log_likelihood/level": np.ones((2, 3, 4)), "value/level": np.ones(4), "partial/level": np.ones(4)}
HUGE = b"\x93NUMPY\x01\x00" + (118).to_bytes(2, "little") + (
    b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117) + b"\n"
)  # fmt: skip


def hostile(name: str) -> bytes:
    """Files with the right hash and other content."""
    own = io.BytesIO()
    with zipfile.ZipFile(own, "w") as file:
        file.writestr("posterior/c.npy", HUGE)
    return {
        "text": b"no archive", "empty": archive({}), "cut": encode_draws(draws())[:-300], "huge": own.getvalue(),
        "pickled": archive({"posterior/c": np.array([[{}]], object)}),
        "bomb": archive({"posterior/c": np.zeros((1000, 1000))}, compression=zipfile.ZIP_DEFLATED),
        "single": archive({"posterior/c": ONE.astype(np.float32)}), "column": archive({"posterior/c": ONE[0]}),
        "uneven": archive({"posterior/c": ONE, "posterior/p": ONE.T}), "other": archive({"posterior/c": ONE, "a": ONE}),
        "infinite": archive({"posterior/c": np.inf * ONE}), "half": archive({"posterior/c": ONE} | SEEN),
        "short": archive({"posterior/c": ONE, "recording/level": np.ones(3)} | SEEN),
        "none": archive({"posterior/c": ONE[:, :0]}),
    }[name]  # fmt: skip


@pytest.mark.parametrize(
    "name",
    ["text", "empty", "cut", "huge", "pickled", "bomb", "single", "column", "uneven", "other", "infinite", "half",
     "short", "none"],
)  # fmt: skip
def test_a_file_that_holds_no_draws_is_refused_in_one_line(name, tmp_path):
    data = hostile(name)
    tracemalloc.start()
    try:
        with pytest.raises(FitError, match=r"draws\.npz: .*fit again") as caught:
            written(tmp_path, data)
        assert tracemalloc.get_traced_memory()[1] < 1e6 + 8 * len(data)
    finally:
        tracemalloc.stop()
    assert "\n" not in str(caught.value)


def test_a_broken_archive_is_refused_or_holds_draws(tmp_path):
    """Single bytes are changed in the arrays and the archive's directory, or the end is cut off."""
    data, random = encode_draws(draws(2, 4)), np.random.default_rng(0)
    directory = data.index(b"PK\x01\x02")
    for turn in range(300):
        broken = bytearray(data)
        broken[random.integers(directory * (turn % 2), len(data))] = random.integers(256)
        try:
            written(tmp_path, bytes(broken[: None if turn % 7 else random.integers(1, len(data))]))
        except FitError as refused:
            assert DRAWS_FILE in str(refused)  # noqa: PT017


def test_another_file_than_the_fit_s_is_refused(tmp_path):
    data = encode_draws(draws())
    (tmp_path / DRAWS_FILE).write_bytes(encode_draws(draws(3)))
    with pytest.raises(FitError, match=r"draws\.npz: .*SHA-256"):
        read_draws(entry(data), tmp_path)


def test_a_folder_keeps_the_draws(tmp_path):
    """Saved, loaded, and saved again without draws: none of an earlier fit remain."""
    from test_result import result

    mine = replace(result(), draws=draws())
    folder = mine.save(tmp_path / "fit", page=False)
    back = Result.load(folder)
    assert back.draws is not None
    np.testing.assert_array_equal(back.draws["v_H0 2"], draws()["v_H0 2"])
    again = back.save(tmp_path / "again", page=False)
    assert {f.name: f.read_bytes() for f in again.iterdir()} == {f.name: f.read_bytes() for f in folder.iterdir()}
    (folder / DRAWS_FILE).unlink()
    assert Result.load(folder).draws is None
    result().save(again, page=False, force=True)
    assert not (again / DRAWS_FILE).exists()
    assert json.loads((again / "fit.json").read_text())["draws"] is None


def test_arviz_has_what_a_study_needs():
    pytest.importorskip("arviz_base")
    data = draws().to_arviz()
    assert {*data.posterior.data_vars} == {name.replace("/", " over ") for name in draws()}
    np.testing.assert_array_equal(data.observed_data["level"], draws().observed["level"].value)
    np.testing.assert_array_equal(data.constant_data["level_partial"], [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(data.log_likelihood["frequency"], draws().log_likelihood["frequency"])
    assert data.log_likelihood["level"].dims == ("chain", "draw", *data.observed_data["level"].dims)


@pytest.mark.filterwarnings("ignore:Estimated shape parameter")  # the draws are invented
def test_arviz_compares_models_by_these_draws():
    stats = pytest.importorskip("arviz_stats")
    pytest.importorskip("arviz_base")
    loo = stats.loo(draws().to_arviz(), var_name="level")
    assert np.isfinite(loo.elpd)
