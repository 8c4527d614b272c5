"""The documentation keeps its word: its Python runs, its commands parse, its links lead somewhere, its tables hold."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib
import json
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

import pianofit
from pianofit.felt import ALL_PARAMETERS, LAWS
from pianofit.schema.decode import builtins_of
from pianofit.schema.fit import FIT_SCHEMA
from pianofit.schema.modal_response import ModalResponseEntry
from pianofit.setup import KEYS, RANGES, Setup
from pianofit.transducer import QUANTITIES

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)\)")
FIT = pianofit.fit
STUDY = ["python", "-m", "studies.bensa2005"]
IN_THE_CODE = re.compile(r"`([\w/]+\.py)`\s+\(((?:`\w+`(?:,\s+)?)+)\)")


def by_page(pages: list[Path]) -> Any:
    return pytest.mark.parametrize("page", pages, ids=lambda page: page.name)


def fenced(page: Path, language: str) -> list[str]:
    """Return the contents of the page's blocks in one language."""
    return [content for kind, content in FENCE.findall(page.read_text(encoding="utf-8")) if kind == language]


@functools.cache
def run(page: Path) -> dict[str, Any]:
    """Run the page's Python, in order and in one namespace, which is returned."""
    space: dict[str, Any] = {"__name__": f"docs.{page.stem}"}
    for number, block in enumerate(fenced(page, "python"), 1):
        exec(compile(block, f"{page.name}, block {number}", "exec"), space)  # noqa: S102
    return space


def commands(page: Path) -> list[list[str]]:
    """Return the commands of the page's sh blocks as words, those of `pianofit` and of the study of the paper."""
    lines = "\n".join(fenced(page, "sh")).replace("\\\n", " ").splitlines()
    parts = [part for line in lines for part in re.split(r"&&|;|\|", re.sub(r"(^|\s)#.*", "", line))]
    words = [shlex.split(part) for part in parts]
    return [line for line in words if line and (Path(line[0]).name == "pianofit" or line[:3] == STUDY)]


FITS: dict[tuple[str, ...], pianofit.Result] = {}


def fit_once(*files: Any, **given: Any) -> pianofit.Result:
    """Fit as `pianofit.fit`. Pages that fit the same files with the same arguments share the result."""
    if not all(isinstance(file, str) for file in files):
        return FIT(*files, **given)
    key = (*(hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files), *files, repr(given))
    if key not in FITS:
        FITS[key] = FIT(*files, **given)
    return FITS[key]


@by_page([page for page in PAGES if fenced(page, "python")])
def test_the_python_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pianofit, "fit", fit_once)
    run(page)


@by_page([page for page in PAGES if commands(page)])
def test_the_commands_of_a_page_parse(page):
    """Options, values and arguments are read as for a real run, and nothing is run."""
    known = get_command(importlib.import_module("pianofit.cli").app).commands
    study = get_command(importlib.import_module("studies.bensa2005.__main__").app)
    for words in commands(page):
        if words[:3] == STUDY:
            study.make_context("", words[3:]).close()
            continue
        _, name, *rest = words
        assert name in known, words
        known[name].make_context(name, rest).close()


@by_page(PAGES)
def test_the_links_of_a_page_lead_somewhere(page):
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if not link.startswith(("http://", "https://")):
            target, _, anchor = link.partition("#")
            there = page.parent / target if target else page
            assert there.exists(), link
            if anchor:
                assert anchor in headings(there), link


def headings(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as they are made of their words."""
    lines = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}


@by_page([page for page in PAGES if IN_THE_CODE.search(page.read_text(encoding="utf-8"))])
def test_what_a_page_places_in_the_code_is_there(page):
    for path, names in IN_THE_CODE.findall(page.read_text(encoding="utf-8")):
        folder = ROOT if path.startswith("studies/") else ROOT / "src" / "pianofit"
        source = (folder / path).read_text(encoding="utf-8")
        for name in re.findall(r"`(\w+)`", names):
            assert re.search(rf"^(def|class) {name}\b|^{name}\b.* = ", source, re.MULTILINE), f"{path}: {name}"


# --- docs/files.md ---------------------------------------------------------------------------------------------------

FILES = ROOT / "docs" / "files.md"


def rows(columns: int) -> list[list[str]]:
    """Return the cells of the page's tables of so many columns."""
    lines = re.findall(r"^\| (.*) \|$", FILES.read_text(encoding="utf-8"), re.MULTILINE)
    cells = [[cell.strip("` ") for cell in line.split(" | ")] for line in lines]
    return [row for row in cells if len(row) == columns]


def test_every_key_of_a_setup_is_in_its_table_with_its_range():
    found = {(table, key): span for table, key, span, *_ in rows(5)}
    for table, keys in KEYS.items():
        if keys == tuple(ALL_PARAMETERS):
            assert f"`[{table}]`" in FILES.read_text(encoding="utf-8")
            continue
        for key in keys:
            assert (f"[{table}]" if table != "recording" else "[[recording]]", key) in found
    assert found["[felt]", "law"].split(", ") == sorted(LAWS)
    for table in ("string", "strike", "pickup"):
        for key in set(KEYS[table]) & set(RANGES):
            lower, upper, _ = RANGES[key]
            assert [float(x) for x in found[f"[{table}]", key].split(" to ")] == [lower, upper], key


def test_every_parameter_is_in_its_table_with_its_unit_and_range():
    found = {name: (unit, span) for name, unit, span, _ in rows(4)}
    for name, parameter in ALL_PARAMETERS.items():
        unit, span = found[name]
        assert unit == parameter.unit
        assert [float(x) for x in span.split(" to ")] == [parameter.lower, parameter.upper], name


def test_the_setups_shown_can_be_read(tmp_path):
    shown = [block for page in PAGES for block in fenced(page, "toml")]
    assert shown
    for block in shown:
        path = tmp_path / "setup.toml"
        path.write_text(block, encoding="utf-8")
        assert Setup.from_toml(path).pickup_quantity in QUANTITIES


def missing(shown: Any, real: Any, where: str = "") -> list[str]:
    """Return what is shown and is not in the real document, key by key."""
    if isinstance(shown, dict):
        return [k for key, value in shown.items() for k in missing(value, (real or {}).get(key, ...), f"{where}/{key}")]
    return [where] if real is ... else []


def ringing_of_a_fit() -> dict[str, Any]:
    """What a fit says of ringing, with the knock that was found, whether or not it was kept."""
    result = run(ROOT / "docs" / "modal-response.md")["result"]
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        found = importlib.import_module("measuring").modal_response_of(result)
    finally:
        sys.path.pop(0)
    assert found is not None
    return builtins_of(replace(result.fit.modal_response, response=ModalResponseEntry.of(found)))


def test_the_fits_shown_have_the_keys_of_real_ones(tmp_path, monkeypatch):
    """The whole of one that is calibrated, and how a key rings of one that is not."""
    monkeypatch.chdir(tmp_path)
    whole, ringing = map(json.loads, fenced(FILES, "json"))
    assert missing(whole, run(ROOT / "docs" / "fitting.md")["result"].to_dict()) == []
    real = ringing_of_a_fit()
    assert missing(ringing, real) == []
    assert {*ringing["layers"][0]} == {*real["layers"][0]}
    assert {*ringing["response"]["modal_amplitudes"][0]} == {*real["response"]["modal_amplitudes"][0]}
    assert whole["schema"] == FIT_SCHEMA


CONSTANTS = re.compile(r"<!-- constants -->\n(.*?)<!-- end of constants -->", re.DOTALL)
TABLES = [page for page in PAGES if CONSTANTS.search(page.read_text(encoding="utf-8"))]


def constants_of(page: Path) -> dict[str, list[str]]:
    """Return the cells of each row of the page's table of constants, by its first cell."""
    (table,) = CONSTANTS.findall(page.read_text(encoding="utf-8"))
    lines = re.findall(r"^\| (`.*) \|$", table, re.MULTILINE)
    return {cells[0]: cells for cells in (line.split(" | ") for line in lines)}


def varied(page: Path) -> dict[str, tuple[Any, str]]:
    """Return module and attribute of each constant that the study of the page varies, by the first cell of its row."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        if page.stem == "fitting":
            return {
                cell: (module, name)
                for cell, (module, name, _) in importlib.import_module("constants").constants().items()
            }
        modules = importlib.import_module("realism").CONSTANTS.items()
    finally:
        sys.path.pop(0)
    found = [(importlib.import_module(f"pianofit.modal_response.{module}"), names) for module, names in modules]
    return {f"`{name}`": (module, name) for module, names in found for name in names}


def defined() -> set[str]:
    """Return all constants that a module of the package defines."""
    found = set()
    for file in (ROOT / "src" / "pianofit").rglob("*.py"):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            found |= {
                name.id for target in targets if target for name in ast.walk(target) if isinstance(name, ast.Name)
            }
    return found


@by_page(TABLES)
def test_a_table_of_constants_has_the_constants_of_its_study_with_their_values(page):
    """A constant that goes takes its row with it, a new one of the study needs a row, and a changed value shows."""
    rows_, known, study = constants_of(page), defined(), varied(page)
    assert len(rows_) > 20
    assert [name for row in rows_ for name in re.findall(r"`([A-Z_]+)`", row) if name not in known] == []
    assert list(rows_) == list(study)
    for row, (module, name) in study.items():
        value = getattr(module, name)
        if isinstance(value, int | float):
            shown = next(cell for cell in rows_[row][1:] if re.match(r"-?[\d.]", cell))
            assert float(shown) == pytest.approx(value, rel=1e-3), name


def test_the_study_of_a_fit_changes_every_constant():
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        constants = importlib.import_module("constants").constants()
    finally:
        sys.path.pop(0)
    for module, attribute, scaled in constants.values():
        value = getattr(module, attribute)
        assert repr(scaled(value, 2.0)) != repr(value)


def test_every_key_of_a_fit_is_explained(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = FILES.read_text(encoding="utf-8")
    document = run(ROOT / "docs" / "fitting.md")["result"].to_dict()
    whole = ("invariants", "parameters", "pickup", "derived", "criterion", "levels", "diagnostics", "versions")
    parts = [document, *(document[part] for part in whole), document["diagnostics"]["excess_sd"]]
    parts += [document["recordings"][0], document["minima"][0]]
    parts += [document["parameters"]["c"], document["invariants"]["f0"]]
    ringing = ringing_of_a_fit()
    response = ringing["response"]
    parts += [ringing, response, response["modes"], response["knock"], ringing["leave_one_out_db"]]
    parts += [ringing["layers"][0], response["modal_amplitudes"][0], {"modal_response": ringing}]
    assert sorted({key for part in parts for key in part if f"`{key}`" not in text}) == []


# --- docs/faq.md -----------------------------------------------------------------------------------------------------

ENTRIES = re.compile(r"^\*\*(.+?)\*\*", re.MULTILINE | re.DOTALL)


def messages() -> str:
    """Return all string literals of the package, with NUL in place of what is filled in."""
    texts = []
    for file in (ROOT / "src" / "pianofit").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                texts.append(
                    "".join(
                        getattr(part, "value", "\0") if isinstance(part, ast.Constant) else "\0" for part in node.values
                    )
                )
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return "\0".join(texts)


def test_every_message_that_the_faq_explains_is_in_the_program():
    entries = " ".join(ENTRIES.findall((ROOT / "docs" / "faq.md").read_text(encoding="utf-8")))
    quoted = [part.strip() for message in re.findall(r'"([^"]+)"', entries) for part in message.split("...")]
    assert len(quoted) > 40
    program = messages()
    assert [part for part in quoted if part and " ".join(part.split()) not in program] == []
