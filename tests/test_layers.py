"""Rooms import in one direction, only what the plan of the package names, and only declared packages."""

from __future__ import annotations

import ast
import graphlib
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src" / "pianofit"
FILES = sorted(SOURCE.rglob("*.py"))
# The rooms that each room may import, besides itself and `EVERYWHERE`.
USES = {
    "errors": "",
    "conversions": "",
    "io": "",
    "dsp": "",
    "threads": "",
    "progress": "",
    "parameters": "io",
    "literature": "analysis parameters",
    "felt": "io literature parameters",
    "recording": "io",
    "setup": "felt io parameters",
    "analysis": "dsp io recording",
    "criterion": "analysis",
    "model": "dsp felt io parameters threads",
    "synthetic": "felt io model parameters recording setup",
    "schema": "felt io model parameters",
    "inference": "analysis felt io literature model parameters progress recording setup threads",
    "result": "analysis criterion felt schema inference io model parameters progress recording setup threads",
    "modal_response": "analysis model recording result schema threads",
    "report": "analysis felt schema io modal_response model parameters result",
    "listening": "io recording report schema",
    "bensa2005": "analysis criterion felt inference io listening literature model parameters recording report"
    " result schema setup",
    "fitting": "analysis bensa2005 inference modal_response parameters progress recording result setup threads",
    "instrument": "analysis schema io literature model parameters report",
    "playback": "felt instrument io model parameters threads",
    "export": "analysis instrument io model playback report threads",
    "web": "analysis instrument io model parameters playback recording report schema",
    "batch": "analysis fitting io model parameters recording report schema",
    "cli": "analysis batch bensa2005 export felt schema fitting instrument io listening literature model parameters"
    " playback progress recording report result setup synthetic threads web",
    "__main__": "cli",
}
EVERYWHERE = {"conversions", "errors"}
# A method of a public type may enter a higher room when it is called. Its import stands inside the method.
CALLS = {"felt": "model", "model": "web", "result": "report"}
# Files that import modules by name: public names, felt laws, optional packages.
BY_NAME = ("__init__.py", "felt/__init__.py", "io/table_output.py")
WITH_JAX = ("bensa2005", "inference", "model")
HEAVY = ("jax", "scipy", "matplotlib", "soundfile", "jinja2")
LONGEST = 400  # lines of a file


def room_of(file: Path) -> str:
    return file.relative_to(SOURCE).parts[0].removesuffix(".py")


def tree_of(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def imports(file: Path, called: bool = True) -> Iterator[str]:
    """Full names of imports, such as "pianofit.model.note.Note"; imports inside functions only if `called`."""
    package = ("pianofit", *file.relative_to(SOURCE).parts)[:-1]
    tree = tree_of(file)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    within = set() if called else {inner for function in functions for inner in ast.walk(function)}
    for node in {*ast.walk(tree)} - within:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            parts = (*base, *(node.module or "").split("."))
            yield from (".".join(part for part in (*parts, alias.name) if part) for alias in node.names)


def rooms_used(file: Path, called: bool = True) -> set[str]:
    names = [name.split(".") for name in imports(file, called)]
    return {parts[1] for parts in names if parts[0] == "pianofit" and not parts[1].startswith("__")} - {room_of(file)}


def test_rooms_import_in_one_direction_and_only_what_the_plan_names():
    assert {room_of(file) for file in FILES} == {*USES, "__init__"}
    order = graphlib.TopologicalSorter({room: others.split() for room, others in USES.items()})
    assert {*order.static_order()} == {*USES}  # raises if rooms import each other in a circle
    for room, others in USES.items():
        files = [file for file in FILES if room_of(file) == room]
        allowed, called = {*others.split()}, {*CALLS.get(room, "").split()}
        at_import = set().union(*(rooms_used(file, called=False) for file in files)) - EVERYWHERE
        ever = set().union(*map(rooms_used, files)) - EVERYWHERE
        assert at_import <= allowed, f"{room} imports {at_import - allowed}"
        assert ever == allowed | called, f"{room}: {ever ^ (allowed | called)} is not imported, or not in the plan"


def test_only_declared_packages_are_imported_and_jax_only_in_its_rooms():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = (project["optional-dependencies"][name] for name in ("bayes", "cluster", "notebook", "widget"))
    needed = [*project["dependencies"], *(requirement for extra in extras for requirement in extra)]
    declared = {"dask", *(requirement.split(">")[0].lower() for requirement in needed)}
    for file in FILES:
        packages = {name.split(".")[0] for name in imports(file)}
        assert packages <= {*sys.stdlib_module_names, "pianofit", *declared}, file
        assert "jax" not in packages or room_of(file) in WITH_JAX, file


def test_nothing_is_executed_that_is_only_to_be_read():
    for file in FILES:
        assert not {name.split(".")[0] for name in imports(file)} & {"pickle", "marshal", "shelve", "dill", "yaml"}, (
            file
        )
        nodes = [*ast.walk(tree_of(file))]
        calls = {node.func.id for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
        assert not calls & {"eval", "exec", "compile", "__import__"}, file
        names = {node.id for node in nodes if isinstance(node, ast.Name)}
        assert "import_module" not in names or file.relative_to(SOURCE).as_posix() in BY_NAME, file


def test_no_file_is_long():
    lengths = {file.relative_to(SOURCE).as_posix(): file.read_text(encoding="utf-8").count("\n") for file in FILES}
    assert {name for name, length in lengths.items() if length >= LONGEST} == set()


def loaded_by(code: str, packages: tuple[str, ...]) -> set[str]:
    """Which of `packages` a fresh interpreter has loaded after `code`."""
    program = f"import sys, json\n{code}\nprint(json.dumps([m for m in {packages!r} if m in sys.modules]))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_heavy_packages_are_loaded_only_when_needed():
    rooms = ("cli", "felt", "parameters", "literature", "recording", "setup", "analysis")
    assert not loaded_by("".join(f"import pianofit.{room}\n" for room in rooms), ("jax",))
    for arguments in (["--help"], ["fit", "--help"], ["--version"], ["fit", "--speed"]):
        assert not loaded_by(f"from pianofit.cli import main; main({arguments})", HEAVY), arguments
    public = (
        "import pianofit, pianofit.fitting, pianofit.report.page\nfor name in pianofit.__all__: getattr(pianofit, name)"
    )
    assert not loaded_by(public, ("pianofit.bensa2005",))  # the default fit needs nothing of the paper's method
