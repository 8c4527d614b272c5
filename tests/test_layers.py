"""Rooms and files import in one direction, only what the plan of the package names, and only declared packages."""

from __future__ import annotations

import ast
import functools
import graphlib
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from pianofit import deferred

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src" / "pianofit"
FILES = sorted(SOURCE.rglob("*.py"))
# The rooms that each room may import, besides itself and `EVERYWHERE`.
USES = {
    "io": "",
    "dsp": "",
    "progress": "",
    "threads": "",
    "program_folder": "",
    "complex_step": "",
    "conversions": "",
    "deferred": "",
    "errors": "",
    "key_prior": "",
    "parameters": "io",
    "recording": "dsp io",
    "excitation": "io parameters",
    "transducer": "",
    "monotone_cubic": "",
    "sobol": "",
    "x64": "io parameters threads",
    "analysis": "dsp io recording threads",
    "criterion": "analysis",
    "literature": "analysis monotone_cubic parameters",
    "felt": "excitation io literature parameters x64",
    "model": "deferred dsp excitation felt io parameters transducer x64",
    "setup": "excitation felt io key_prior parameters transducer",
    "schema": "excitation felt io key_prior model parameters transducer",
    "inference": "analysis complex_step excitation felt io key_prior literature model parameters progress recording"
    " setup sobol threads transducer x64",
    "synthetic": "felt io literature model parameters recording setup transducer",
    "result": "analysis complex_step criterion deferred dsp excitation felt inference io literature model parameters"
    " progress recording schema setup sobol threads transducer",
    "modal_response": "analysis dsp model recording result schema threads",
    "fitting": "analysis inference modal_response parameters progress recording result setup threads",
    "report": "analysis dsp excitation felt io modal_response model result schema",
    "bensa2005": "analysis criterion dsp felt fitting inference model parameters progress recording result"
    " schema setup",
    "batch": "analysis fitting instrument io parameters program_folder recording report schema threads",
    "instrument": "analysis complex_step dsp excitation felt io key_prior literature model parameters report schema"
    " threads transducer",
    "library": "batch io setup synthetic threads",
    "listening": "io recording report schema",
    "dataset": "analysis batch felt inference instrument io literature model parameters program_folder progress schema"
    " threads",
    "playback": "dsp felt instrument io literature model parameters threads",
    "export": "analysis dsp felt instrument io model playback report schema threads",
    "mend": "analysis batch dsp instrument io modal_response model recording",
    "tuner": "analysis instrument io literature modal_response model report schema",
    "web": "analysis dsp felt instrument io literature model parameters playback recording report schema",
    "cli": "analysis batch bensa2005 dataset excitation export felt fitting instrument io library listening literature"
    " mend model parameters playback program_folder progress recording report result schema setup synthetic threads"
    " transducer tuner web",
    "__main__": "cli io",
}
EVERYWHERE = {"conversions", "errors"}
# Files that import modules by name: public names, felt laws, optional packages, calls of `deferred.TARGETS`.
BY_NAME = ("__init__.py", "deferred.py", "felt/__init__.py", "io/table_output.py")
WITH_JAX = ("bensa2005", "felt", "inference", "model", "x64")
HEAVY = ("jax", "scipy", "matplotlib", "soundfile", "jinja2")
LONGEST = 400  # lines of a file


def module_of(file: Path) -> str:
    """Name of a module, such as "pianofit.model.note"; a package has its own name."""
    return ".".join(("pianofit", *file.relative_to(SOURCE).with_suffix("").parts)).removesuffix(".__init__")


def room_of(file: Path) -> str:
    return file.relative_to(SOURCE).parts[0].removesuffix(".py")


@functools.cache
def tree_of(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def imports(file: Path, typed: bool = True) -> Iterator[str]:
    """Full names of imports, such as "pianofit.model.note.Note", inside functions too; for types only if `typed`."""
    package = ("pianofit", *file.relative_to(SOURCE).parts)[:-1]
    nodes = {*ast.walk(tree_of(file))}
    blocks = [node for node in nodes if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    for node in nodes if typed else nodes.difference(*map(ast.walk, blocks)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            parts = (*base, *(node.module or "").split("."))
            yield from (".".join(part for part in (*parts, alias.name) if part) for alias in node.names)


def rooms_used(file: Path) -> set[str]:
    names = [name.split(".") for name in imports(file)]
    return {parts[1] for parts in names if parts[0] == "pianofit" and not parts[1].startswith("__")} - {room_of(file)}


def test_rooms_import_in_one_direction_and_only_what_the_plan_names():
    assert {room_of(file) for file in FILES} == {*USES, "__init__"}
    order = graphlib.TopologicalSorter({room: others.split() for room, others in USES.items()})
    assert {*order.static_order()} == {*USES}  # raises if rooms import each other in a circle
    for room, others in USES.items():
        used = set().union(*(rooms_used(file) for file in FILES if room_of(file) == room)) - EVERYWHERE
        assert used == {*others.split()}, f"{room}: {used ^ {*others.split()}} is not imported, or not in the plan"


def test_no_files_import_each_other_in_a_circle():
    modules = {module_of(file): file for file in FILES}

    def files_used(file: Path) -> set[str]:
        names = (name if name in modules else name.rpartition(".")[0] for name in imports(file, typed=False))
        return {name for name in names if name in modules} - {module_of(file)}

    graph = {module: files_used(file) for module, file in modules.items()}
    graphlib.TopologicalSorter(graph).prepare()  # raises an error that names the circle


def test_only_declared_packages_are_imported_and_jax_only_in_its_rooms():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = (project["optional-dependencies"][name] for name in ("bayes", "cluster", "notebook", "widget"))
    needed = [*project["dependencies"], *(requirement for extra in extras for requirement in extra)]
    declared = {"dask", *(requirement.split(">")[0].lower() for requirement in needed)}
    for file in FILES:
        packages = {name.split(".")[0] for name in imports(file)}
        assert packages <= {*sys.stdlib_module_names, "pianofit", *declared}, file
        assert "jax" not in packages or room_of(file) in WITH_JAX, file


def test_nothing_is_executed_that_is_only_to_be_read_and_calls_by_name_are_listed():
    for file in FILES:
        assert not {name.split(".")[0] for name in imports(file)} & {"pickle", "marshal", "shelve", "dill", "yaml"}, (
            file
        )
        nodes = [*ast.walk(tree_of(file))]
        calls = {node.func.id for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
        assert not calls & {"eval", "exec", "compile", "__import__"}, file
        names = {node.id for node in nodes if isinstance(node, ast.Name)}
        assert "import_module" not in names or file.relative_to(SOURCE).as_posix() in BY_NAME, file
    called = {
        tuple(ast.literal_eval(argument) for argument in node.args[:2])
        for file in FILES
        for node in ast.walk(tree_of(file))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "deferred.call"
    }
    assert called == {(module, name) for module, names in deferred.TARGETS.items() for name in names}
    assert all(callable(getattr(import_module(f"pianofit.{module}"), name)) for module, name in called)


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
