"""Mutation testing: the tests of a module must fail when one node of its code is changed.

    python benchmarks/mutation.py                             25 mutants of every module of WITNESSES
    python benchmarks/mutation.py likelihood --sample 0       all mutants of one module
    python benchmarks/mutation.py voice --only 12,57          these mutants, by number
    python benchmarks/mutation.py voice --list                the mutants, without a run

A mutant has one change: a comparison, an operator, a number, a truth value, a function's counterpart, a keyword that
is left out, a condition that is negated, or a statement that is removed. The tests of the module, listed in WITNESSES,
run until one fails. A mutant that no test kills is printed with its line. Read it: either a test is missing, or the
change has no effect.

The parent process imports the libraries and pytest but not the package. For each mutant it forks a child, whose import
of the module finds the changed code, so nothing is written to the source. `fork` is safe because JAX starts its
threads only in the child. mutmut 3 forks after the tests have run, skips decorated functions, and mutates no constants
of modules. Programs that `persistent_jit` stores on the disk would hide mutants of the functions they hold, so
modules of FRESH get an empty folder for programs.
"""

from __future__ import annotations

import argparse
import ast
import copy
import itertools
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "pianofit"
# The tests of the laws of an instrument without those of whole instruments, which take half a minute.
LAWS = (
    "keyboard_posterior",
    *(f"instrument_laws::test_{name}" for name in (
        "the_density_of_a_shape_has_the_gradient_of_finite_differences", "a_law_is_the_mean_over_all_shapes",
        "a_law_without_error_passes_through_its_keys", "the_scatter_between_keys_is_found",
        "a_key_moves_only_where_its_own_data_leave_it_open", "the_other_keys_decide_between_the_minima_of_a_key",
        "the_scale_of_a_keys_velocities_follows_from_all_its_quantities",
        "the_covariance_of_the_quantities_is_that_of_many_draws", "intervals_cover", "intervals_of_few_keys_cover",
    )), "joint_prior",
)  # fmt: skip
# The tests that witness each module, the quickest first.
WITNESSES = {
    "inference/likelihood.py": ("likelihood", "posterior", "walks", "draws"),
    "inference/parametrisation.py": (
        "coordinates", "joint_prior",
        "search::test_the_searched_force_is_that_of_the_felt_at_the_reference_compression",
        "measured::test_derivatives_by_sizes_are_those_of_the_tables",
        "measured::test_a_longer_or_heavier_string_sounds_the_same",
        "measured::test_invariants_do_not_notice_a_length_or_a_mass",
        "search::test_on_the_edge_of_K_H_the_force_follows_p",
    ),
    "result/posterior.py": ("derived", "draws"),
    "instrument/keyboard_posterior.py": LAWS,
    "instrument/quantity_law.py": LAWS,
    "playback/coupled_modes.py": ("resonance", "pedals"),
    "playback/free_strings.py": ("free_strings", "pedals"),
    "playback/pedals.py": ("pedals", "midi"),
    "playback/cached_strike.py": ("instrument_play", "pedals"),
    "playback/resonance.py": ("free_strings", "resonance", "pedals"),
    "playback/voice.py": ("instrument_play", "pedals"),
}  # fmt: skip
# Modules whose code is in stored programs.
FRESH = ("playback/cached_strike.py",)
# A child may take this many times as long as the unchanged code, and at least so many seconds.
TIMES, LEAST_SECONDS = 4.0, 30.0
KILLED, SURVIVED = "killed", "survived"
# Characters of a printed change.
WIDTH = 150
# Exit codes of pytest: all tests passed, some failed, or the run broke down, mostly at an import.
PASSED, NO_TESTS = 0, 5

COMPARED = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}  # fmt: skip
COMPUTED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.FloorDiv: ast.Div,
    ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift,
}  # fmt: skip
COUNTERPARTS = {
    "maximum": "minimum", "minimum": "maximum", "max": "min", "min": "max", "any": "all", "all": "any", "sin": "cos",
    "cos": "sin", "real": "imag", "imag": "real", "ceil": "floor", "argmin": "argmax", "sqrt": "square", "abs": "real",
    "sum": "prod", "cumsum": "cumprod",
}  # fmt: skip


class Mutant(NamedTuple):
    """One change of a module."""

    line: int
    what: str
    node: int  # number of the changed node
    change: int  # number of the change among those of the node

    def source(self, text: str) -> str:
        """Return the whole module with the change."""
        tree = ast.parse(text)
        node = next(itertools.islice(_places(tree), self.node, None))
        list(_changes(node))[self.change]()
        return ast.unparse(ast.fix_missing_locations(tree))


def mutants(text: str) -> list[Mutant]:
    """Return all mutants of a module in the order of its lines."""
    found = []
    for number, node in enumerate(_places(ast.parse(text))):
        before = ast.unparse(node)
        for which in range(len(list(_changes(node)))):
            changed = copy.deepcopy(node)
            list(_changes(changed))[which]()
            words = " ".join(f"{before} -> {ast.unparse(changed)}".split())
            found.append(Mutant(node.lineno, words[:WIDTH], number, which))
    return sorted(found, key=lambda mutant: mutant.line)


def _places(tree: ast.Module) -> Iterator[ast.expr | ast.stmt]:
    """Nodes that can be changed; not annotations, decorators, docstrings and messages of errors."""
    for node in _code(tree):
        if isinstance(node, ast.expr | ast.stmt) and any(True for _ in _changes(node)):
            yield node


def _code(node: ast.AST) -> Iterator[ast.AST]:
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list") or isinstance(node, ast.Raise | ast.JoinedStr):
            continue
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _code(child)


def _changes(node: ast.AST) -> Iterator[Callable[[], object]]:  # noqa: C901 - one case for each kind of node
    """Functions that change a node in its tree."""
    match node:
        case ast.Compare(ops=ops):
            for i, op in enumerate(ops):
                for other in COMPARED[type(op)]:
                    yield lambda i=i, other=other: ops.__setitem__(i, other())
        case ast.BinOp(op=op) | ast.AugAssign(op=op) if type(op) in COMPUTED:
            yield lambda: setattr(node, "op", COMPUTED[type(op)]())
        case ast.BoolOp(op=op):
            yield lambda: setattr(node, "op", ast.And() if isinstance(op, ast.Or) else ast.Or())
        case ast.UnaryOp(op=ast.USub()):
            yield lambda: setattr(node, "op", ast.UAdd())
        case ast.UnaryOp(op=ast.Not() | ast.Invert(), operand=operand):
            yield lambda: setattr(node, "operand", ast.UnaryOp(type(node.op)(), operand))
        case ast.Constant(value=bool() as value):
            yield lambda: setattr(node, "value", not value)
        case ast.Constant(value=int() as value):
            yield lambda: setattr(node, "value", value + 1)
        case ast.Constant(value=float() as value):
            yield lambda: setattr(node, "value", 2 * value or 1.0)
        case ast.Attribute(attr=name) if name in COUNTERPARTS:
            yield lambda: setattr(node, "attr", COUNTERPARTS[name])
        case ast.Name(id=("min" | "max" | "any" | "all") as name):
            yield lambda: setattr(node, "id", COUNTERPARTS[name])
        case ast.Call(keywords=keywords):
            for i in range(len(keywords)):
                yield lambda i=i: keywords.pop(i)
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test) if not isinstance(test, ast.Compare):
            yield lambda: setattr(node, "test", ast.UnaryOp(ast.Not(), node.test))
    if isinstance(node, ast.AugAssign) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield lambda: _remove(node)


def _remove(statement: ast.stmt) -> None:
    """Turn a statement into one without effect, at its place."""
    line, column = statement.lineno, statement.col_offset
    statement.__class__ = ast.Pass
    statement.__dict__.clear()
    statement.lineno, statement.col_offset = line, column


# --- runs -------------------------------------------------------------------------------------------------------------


def run(module: str, source: str | None, limit: float | None) -> tuple[str, float]:
    """Run the tests of a module with other source in a child process; return what happened and the seconds."""
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        if not (child := os.fork()):
            os._exit(_test(module, source, Path(folder)))
        status = _wait(child, None if limit is None else began + limit)
    happened = KILLED if status is None or os.waitstatus_to_exitcode(status) not in (PASSED, NO_TESTS) else SURVIVED
    return happened, time.perf_counter() - began


def _wait(child: int, until: float | None) -> int | None:
    while True:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return status
        if until is not None and time.perf_counter() > until:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None
        time.sleep(0.02)


def _test(module: str, source: str | None, folder: Path) -> int:
    """Run pytest in the child: its exit code."""
    import pytest

    os.setsid()
    with (folder / "output").open("w") as output:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(output.fileno(), stream.fileno())
    if source is not None:
        _replace(PACKAGE / module, source.encode())
    if module in FRESH:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ["PIANOFIT_CACHE"] = str(folder)
    names = [name.partition("::") for name in WITNESSES[module]]
    files = [f"tests/test_{file}.py{colons}{test}" for file, colons, test in names]
    quiet = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    code = pytest.main([*quiet, *files])
    sys.stdout.flush()
    return int(code)


def _replace(path: Path, source: bytes) -> None:
    """Let the import of a file find other source; its compiled form is neither used nor written."""
    from importlib.machinery import SourceFileLoader

    read, stats = SourceFileLoader.get_data, SourceFileLoader.path_stats

    def get_data(self: SourceFileLoader, where: str) -> bytes:
        return source if Path(where) == path else read(self, where)

    def path_stats(self: SourceFileLoader, where: str):
        if Path(where) == path:
            raise OSError
        return stats(self, where)

    SourceFileLoader.get_data, SourceFileLoader.path_stats = get_data, path_stats  # type: ignore[method-assign]


def _warm() -> None:
    """Import what all children need. JAX starts no thread before its first computation."""
    import jax.numpy
    import jax.scipy.linalg
    import msgspec
    import pytest
    import scipy.integrate
    import scipy.optimize
    import scipy.signal
    import scipy.sparse
    import scipy.special
    import scipy.stats
    import soundfile

    _ = jax, msgspec, pytest, scipy, soundfile
    os.chdir(ROOT)
    sys.path[:0] = [str(ROOT), str(ROOT / "src")]


def main() -> None:
    """Make mutants, run the tests, print the survivors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="modules that contain one of these; all if not given")
    parser.add_argument("--sample", type=int, default=25, help="mutants of each module; 0 for all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="numbers of mutants, separated by commas")
    parser.add_argument("--list", action="store_true", help="print the chosen mutants and run none")
    options = parser.parse_args()
    modules = [m for m in WITNESSES if not options.words or any(word in m for word in options.words)]
    _warm()
    for module in modules:
        text = (PACKAGE / module).read_text(encoding="utf-8")
        every = mutants(text)
        chosen = np.arange(len(every))
        if options.only:
            chosen = np.array([int(number) for number in options.only.split(",")])
        elif options.sample and options.sample < len(every):
            random = np.random.default_rng(options.seed)
            chosen = np.sort(random.choice(len(every), options.sample, replace=False))
        if options.list:
            for number in chosen:
                print(f"{module}:{every[number].line} [{number}] {every[number].what}")
            continue
        _study(module, text, every, chosen)


def _study(module: str, text: str, every: list[Mutant], chosen: np.ndarray) -> None:
    happened, seconds = run(module, None, None)
    if happened != SURVIVED:
        sys.exit(f"{module}: its tests fail without a change")
    limit, counts, began = max(TIMES * seconds, LEAST_SECONDS), Counter[str](), time.perf_counter()
    for number in chosen:
        happened, _ = run(module, every[number].source(text), limit)
        counts[happened] += 1
        if happened == SURVIVED:
            print(f"  {module}:{every[number].line} [{number}] {every[number].what}", flush=True)
    print(
        f"{module}: {counts[KILLED]} of {len(chosen)} mutants killed, {len(every)} possible; "
        f"{seconds:.0f} s for its tests, {time.perf_counter() - began:.0f} s in all",
        flush=True,
    )


if __name__ == "__main__":
    main()
