"""The house keeps its order: a module imports only from its own layer or those above it, and only what it declares."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src" / "pianofit"
FILES = sorted(SOURCE.rglob("*.py"))
LAYERS = (
    "errors", "threads", "parameters", "published", "recording", "json_file", "setup_file", "analysis", "initial",
    "model", "criterion", "voice", "inference", "paper", "fitting", "render", "predict", "report", "twin", "laboratory",
    "reproduce", "workflow", "batch", "instrument", "demo", "summary", "options", "terminal", "commands_batch",
    "commands_instrument", "cli", "__main__",
)  # fmt: skip
WITH_JAX = ("model", "criterion", "inference", "paper", "render", "predict")
HEAVY = ("jax", "scipy", "matplotlib", "soundfile", "jinja2")
LONGEST = 400  # lines


def by_file() -> pytest.MarkDecorator:
    return pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(SOURCE)))


def imports(file: Path) -> Iterator[str]:
    """Every imported name in full, such as "jax.numpy" or "pianofit.voice.Voice", wherever the import stands."""
    package = ("pianofit", *file.relative_to(SOURCE).parts)[:-1]
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            yield from (".".join((*base, *(node.module or "").split("."), alias.name)) for alias in node.names)


def layer_of(file: Path) -> str:
    return file.relative_to(SOURCE).parts[0].removesuffix(".py")


def clean(name: str) -> tuple[str, ...]:
    return tuple(part for part in name.split(".") if part)


def test_every_module_has_its_layer():
    assert {layer_of(file) for file in FILES} == {*LAYERS, "__init__"}


@by_file()
def test_a_module_imports_only_from_those_above_it(file):
    own = layer_of(file)
    if own == "__init__":
        return  # the package lists the public names of all layers
    above = LAYERS[: LAYERS.index(own) + 1]
    for name in imports(file):
        parts = clean(name)
        if parts[0] == "pianofit" and parts[1] in LAYERS:
            assert parts[1] in above, f"{own} imports {name}"
        elif parts[0] == "pianofit":
            assert parts[1].startswith("__"), f"{own} imports {name}, which no layer holds"


@by_file()
def test_a_module_uses_only_declared_packages(file):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = [
        *project["dependencies"],
        *project["optional-dependencies"]["bayes"],
        *project["optional-dependencies"]["cluster"],
    ]
    declared = {"dask", *(requirement.split(">")[0].lower() for requirement in needed)}
    for name in imports(file):
        package = clean(name)[0]
        assert package in {*sys.stdlib_module_names, "pianofit", *declared}
        assert package != "jax" or layer_of(file) in WITH_JAX, f"{layer_of(file)} may not need JAX"


@by_file()
def test_nothing_is_executed_that_was_only_to_be_read(file):
    assert not {clean(name)[0] for name in imports(file)} & {"pickle", "marshal", "shelve", "dill", "yaml"}
    calls = [node.func for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    assert not {call.id for call in calls if isinstance(call, ast.Name)} & {"eval", "exec", "compile", "__import__"}


@by_file()
def test_a_file_can_be_held_in_mind(file):
    assert len(file.read_text(encoding="utf-8").splitlines()) < LONGEST


def loaded_by(code: str) -> set[str]:
    """Which of the heavy packages a fresh interpreter has loaded after `code`."""
    program = f"import sys, json\n{code}\nprint(json.dumps([m for m in {HEAVY} if m in sys.modules]))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.parametrize("module", ["", ".cli", ".parameters", ".published", ".recording", ".setup_file", ".analysis"])
def test_what_needs_no_jax_does_not_load_it(module):
    assert "jax" not in loaded_by(f"import pianofit{module}")


@pytest.mark.parametrize("arguments", [["--help"], ["fit", "--help"], ["--version"], ["fit", "--speed"]])
def test_help_loads_nothing_heavy(arguments):
    assert not loaded_by(f"from pianofit.cli import main; main({arguments})")
