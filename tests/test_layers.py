"""The house keeps its order: a room imports only from the rooms its plan names, and only packages it declares."""

from __future__ import annotations

import ast
import graphlib
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
# Which rooms each may use, beside its own, `errors`, `numbers`, `powers` and `units`.
USES = {
    "threads": "",
    "errors": "",
    "units": "",
    "numbers": "",
    "powers": "",
    "io": "",
    "parameters": "",
    "felt": "parameters published",
    "progress": "",
    "tables": "io",
    "containers": "io",
    "decode": "containers io",
    "onset": "",
    "recording": "decode io onset",
    "published": "analysis parameters",
    "setup": "felt io parameters",
    "analysis": "recording tables",
    "criterion": "analysis",
    "model": "decode felt io parameters threads",
    "synthetic": "felt io model parameters recording setup",
    "ringing_file": "decode io model",
    "fit_file": "decode felt io model parameters ringing_file",
    "inference": "analysis felt io model parameters progress published recording setup tables threads",
    "result": "analysis criterion felt fit_file inference io model onset parameters recording setup tables threads",
    "ringing": "analysis model recording result ringing_file threads",
    "report": "analysis felt fit_file io model parameters result ringing ringing_file tables",
    "listening": "io recording report",
    "paper": "analysis criterion felt inference io listening model parameters published recording report result setup"
    " tables",
    "keyboard": "analysis fit_file io model parameters published report ringing_file",
    "fitting": "analysis inference paper parameters progress recording result ringing setup threads",
    "play": "analysis decode felt io keyboard model parameters recording report tables threads",
    "batch": "analysis fitting io model parameters recording report tables",
    "cli": "analysis batch felt fit_file fitting io keyboard listening model paper parameters play progress"
    " published recording report result setup synthetic threads",
    "__main__": "cli",
}
# What a method of a public type enters when it is called, against these arrows, by an import of its own.
CALLS = {"felt": "model", "model": "play", "result": "report"}
EVERYWHERE = {"errors", "numbers", "powers", "units"}
# Who loads modules by names: the public names, the felt's laws, packages that only some need.
BY_NAME = ("__init__.py", "felt/__init__.py", "tables.py")
WITH_JAX = ("model", "inference", "paper")
HEAVY = ("jax", "scipy", "matplotlib", "soundfile", "jinja2")
LONGEST = 400  # lines


def by_file() -> pytest.MarkDecorator:
    return pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(SOURCE)))


def imports(file: Path, called: bool = True) -> Iterator[str]:
    """Imported names in full, such as "jax.numpy" or "pianofit.model.note.Note"; those in functions too if `called`."""
    package = ("pianofit", *file.relative_to(SOURCE).parts)[:-1]
    tree = ast.parse(file.read_text(encoding="utf-8"))
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    within = set() if called else {inner for function in functions for inner in ast.walk(function)}
    for node in {*ast.walk(tree)} - within:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            yield from (".".join((*base, *(node.module or "").split("."), alias.name)) for alias in node.names)


def room_of(file: Path) -> str:
    return file.relative_to(SOURCE).parts[0].removesuffix(".py")


def clean(name: str) -> tuple[str, ...]:
    return tuple(part for part in name.split(".") if part)


def used(file: Path, called: bool = True) -> Iterator[str]:
    """The rooms a file imports from, with those that its functions enter if `called`."""
    for name in imports(file, called):
        parts = clean(name)
        if parts[0] == "pianofit" and not parts[1].startswith("__"):
            yield parts[1]


def test_every_module_has_its_room():
    assert {room_of(file) for file in FILES} == {*USES, "__init__"}


def test_rooms_are_entered_in_one_direction():
    order = graphlib.TopologicalSorter({room: others.split() for room, others in USES.items()})
    assert {*order.static_order()} == {*USES}  # raises where rooms use each other in a circle


@by_file()
def test_a_module_imports_only_from_the_rooms_it_may_use(file):
    own = room_of(file)
    if own == "__init__":
        return  # the package lists the public names of all rooms
    downward = {own, *EVERYWHERE, *USES[own].split()}
    assert {*used(file, called=False)} <= downward
    assert {*used(file)} <= {*downward, *CALLS.get(own, "").split()}


@by_file()
def test_no_room_is_entered_by_a_name_that_is_put_together(file):
    names = {node.id for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, ast.Name)}
    assert "import_module" not in names or file.relative_to(SOURCE).as_posix() in BY_NAME


def test_no_room_may_use_what_it_does_not():
    for room in USES:
        others = f"{USES[room]} {CALLS.get(room, '')}"
        found = {name for file in FILES if room_of(file) == room for name in used(file)}
        assert {*others.split()} <= found, f"{room} no longer uses {', '.join({*others.split()} - found)}"


@by_file()
def test_a_module_uses_only_declared_packages(file):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = [
        *project["dependencies"],
        *project["optional-dependencies"]["bayes"],
        *project["optional-dependencies"]["cluster"],
        *project["optional-dependencies"]["notebook"],
        *project["optional-dependencies"]["widget"],
    ]
    declared = {"dask", *(requirement.split(">")[0].lower() for requirement in needed)}
    for name in imports(file):
        package = clean(name)[0]
        assert package in {*sys.stdlib_module_names, "pianofit", *declared}
        assert package != "jax" or room_of(file) in WITH_JAX, f"{room_of(file)} may not need JAX"


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


@pytest.mark.parametrize(
    "module", ["", ".cli", ".felt", ".parameters", ".published", ".recording", ".setup", ".analysis"]
)
def test_what_needs_no_jax_does_not_load_it(module):
    assert "jax" not in loaded_by(f"import pianofit{module}")


def test_the_default_estimate_does_not_load_the_papers_room():
    program = (
        "import sys, pianofit, pianofit.fitting, pianofit.report.page\n"
        "for name in pianofit.__all__: getattr(pianofit, name)\n"
        "assert not [name for name in sys.modules if name.startswith('pianofit.bensa2005')]"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize("arguments", [["--help"], ["fit", "--help"], ["--version"], ["fit", "--speed"]])
def test_help_loads_nothing_heavy(arguments):
    assert not loaded_by(f"from pianofit.cli import main; main({arguments})")
