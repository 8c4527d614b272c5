"""Programs cached between runs give the same numbers, from a complete file or traced again."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pianofit.model.program_cache import MAX_LOADED, persistent_jit
from pianofit.program_folder import cache_folder

pytestmark = pytest.mark.usefixtures("float64")


class _Cfg(NamedTuple):
    power: int


class _Data(NamedTuple):
    scale: object
    row: object


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Set the cache folder of JAX during a test."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def _traced():
    """Return a function like those of a fit, and the list of its traces."""
    calls = []

    @persistent_jit
    def function(z, data, cfg):
        calls.append(z)
        return data.scale * z**cfg.power, z[data.row].sum()

    return function, calls


Z, DATA = np.linspace(0.0, 1.0, 5), _Data(np.float64(2.0), np.array([1, 3], np.int32))


def _right(found) -> None:
    np.testing.assert_allclose(found[0], 2 * Z**3, rtol=1e-15)
    assert float(found[1]) == Z[1] + Z[3]
    assert found[0].dtype == np.float64


def _programs(folder: Path) -> list[Path]:
    return list(folder.glob("*.program"))


def test_a_kept_program_is_not_traced_again(folder):
    first, traced = _traced()
    _right(first(jnp.asarray(Z), DATA, _Cfg(3)))
    _right(first(jnp.asarray(Z), DATA, _Cfg(3)))
    assert len(traced) == 1
    assert len(_programs(folder)) == 1
    again, traced = _traced()
    _right(again(jnp.asarray(Z), DATA, _Cfg(3)))
    assert not traced


def test_other_shapes_and_settings_are_other_programs(folder):
    function, traced = _traced()
    function(Z, DATA, _Cfg(3))
    np.testing.assert_allclose(function(Z, DATA, _Cfg(2))[0], 2 * Z**2)
    assert function(np.append(Z, 1.0), DATA, _Cfg(3))[0].shape == (6,)
    assert len(traced) == 3
    assert len(_programs(folder)) == 3


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("where", ["in a folder", "nowhere"])
def test_a_process_that_meets_many_shapes_does_not_run_out_of_memory_mappings(folder, where):
    if where == "nowhere":  # as in a notebook
        jax.config.update("jax_compilation_cache_dir", None)
    function, _ = _traced()

    def mappings_after(sizes: range) -> int:
        for size in sizes:
            function(np.linspace(0.0, 1.0, size), DATA, _Cfg(3))
        gc.collect()
        return len(Path("/proc/self/maps").read_text(encoding="utf-8").splitlines())

    full = mappings_after(range(5, 5 + MAX_LOADED))
    assert mappings_after(range(20, 20 + 2 * MAX_LOADED)) < full + 10


@pytest.mark.parametrize("content", [b"", b"x" * 20, b"y" * 5000, "cut"])
def test_a_file_that_is_not_whole_is_made_anew(folder, content):
    function, _ = _traced()
    function(Z, DATA, _Cfg(3))
    (file,) = _programs(folder)
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] if content == "cut" else content)
    again, traced = _traced()
    _right(again(Z, DATA, _Cfg(3)))
    assert traced
    assert file.read_bytes()[:32] != content[:32]
    assert len(file.read_bytes()) > 500


def test_without_a_folder_it_is_traced_once_and_nothing_is_written(folder):
    jax.config.update("jax_compilation_cache_dir", None)
    function, traced = _traced()
    _right(function(Z, DATA, _Cfg(3)))
    _right(function(Z, DATA, _Cfg(3)))
    assert len(traced) == 1
    assert not list(folder.iterdir())


def test_a_folder_that_cannot_be_written_does_no_harm(folder):
    (folder / "file").write_bytes(b"")
    jax.config.update("jax_compilation_cache_dir", str(folder / "file"))
    function, _ = _traced()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX warns if the folder is new to it
        _right(function(Z, DATA, _Cfg(3)))


def test_inside_another_transformation(folder):
    function, _ = _traced()
    slope = jax.jacfwd(lambda z: function(z, DATA, _Cfg(3))[0])(jnp.asarray(Z))
    np.testing.assert_allclose(slope, np.diag(6 * Z**2), atol=1e-15)
    assert not _programs(folder)


def test_the_folder_can_be_chosen(monkeypatch):
    monkeypatch.setenv("PIANOFIT_CACHE", "/somewhere")
    assert cache_folder() == Path("/somewhere")


@pytest.mark.parametrize("first", ["import jax", "pass"])
def test_a_folder_is_set_before_and_after_jax_is_imported(tmp_path, first):
    """In a process without settings of its own, which does not import JAX for it."""
    script = f"""
import sys
{first}
before = "jax" in sys.modules
from pianofit.program_folder import enable_program_cache
enable_program_cache()
assert before == ("jax" in sys.modules)
import jax
from pianofit.model.program_cache import persistent_jit
persistent_jit(lambda x, cfg: (2 * x,))(jax.numpy.ones(3, float), None)
"""
    environment = {name: x for name, x in os.environ.items() if not name.startswith("JAX_")}
    subprocess.run([sys.executable, "-c", script], check=True, env=environment | {"PIANOFIT_CACHE": str(tmp_path)})
    assert len([*tmp_path.glob("*.program")]) == 1
    assert [*tmp_path.glob("jit_*")]


@pytest.mark.parametrize(("chosen", "folder"), [({}, None), ({"XDG_CACHE_HOME": "cache"}, "cache/pianofit")])
def test_without_a_home_folder_programs_are_kept_only_in_a_given_one(tmp_path, chosen, folder):
    """As in a container without HOME whose user has no entry in passwd."""
    script = """
import os, pathlib
def home():
    raise RuntimeError("Could not determine home directory.")
pathlib.Path.home = home
from pianofit.program_folder import enable_program_cache
enable_program_cache()
print(os.environ.get("JAX_COMPILATION_CACHE_DIR"))
"""
    removed = ("JAX_", "XDG_CACHE_HOME", "PIANOFIT_CACHE", "LOCALAPPDATA")
    environment = {name: x for name, x in os.environ.items() if not name.startswith(removed)}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=environment | chosen, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == f"{folder}\n"
