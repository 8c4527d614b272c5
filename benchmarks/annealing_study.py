"""Success rates of the annealing and of other global searches on standard functions with many minima.

    python benchmarks/annealing_study.py                    20 seeds, 10,000 evaluations a run
    python benchmarks/annealing_study.py --seeds 50 --evaluations 20000 --json study.json
    python benchmarks/annealing_study.py --variants         the annealing with one setting changed at a time

Every method has the same number of evaluations. A run succeeds if L-BFGS-B from its end comes within 1e-3 of the least
value, because pianofit also runs a descent after a search. The number in brackets is without L-BFGS-B. The position of
the minimum and the axes of rotated functions depend on the seed and are the same for all methods. The last four
functions were not used to choose the defaults.

- ASA: `pianofit.bensa2005.annealing`, 1 chain or 16
- DA: SciPy's `dual_annealing` (generalised annealing), with default settings, and without its local search
- CMA-ES: the package `cma`, restarted with twice the population whenever it stops (IPOP). It is not a dependency: if
  it is missing, its column is left out
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import dual_annealing, minimize

from pianofit.bensa2005.annealing import Schedule, anneal

NEAR = 1e-3
COLUMNS = {"asa1": "ASA, 1 chain", "asa16": "ASA, 16 chains", "da_plain": "DA, no local", "da": "DA", "cma": "CMA-ES"}


class Problem(NamedTuple):
    """A function of points [..., D] in a cubic box, and its least value in the box."""

    name: str
    function: Callable[[np.ndarray], np.ndarray]
    dimensions: int
    low: float
    high: float
    least: float = 0.0
    shifted: float = 0.0  # largest shift of the minimum, half-widths of the box
    rotated: bool = False

    def drawn(self, seed: int) -> Callable[[np.ndarray], np.ndarray]:
        """Return the function with the position of the minimum and the axes of this seed."""
        rng = np.random.default_rng((seed, 1989))
        shift = rng.uniform(-self.shifted, self.shifted, self.dimensions) * (self.high - self.low) / 2
        axes = np.linalg.qr(rng.normal(size=(self.dimensions, self.dimensions)))[0] if self.rotated else None
        return lambda z: self.function((z - shift) @ axes if axes is not None else z - shift)


# --- the functions ---------------------------------------------------------------------------------------------------


def rastrigin(z, weight: float | np.ndarray = 1.0):  # noqa: D103
    return (weight * (z**2 - 10 * np.cos(2 * np.pi * z) + 10)).sum(-1)


def ackley(z):  # noqa: D103
    bowl, egg_box = np.exp(-0.2 * np.sqrt((z**2).mean(-1))), np.exp(np.cos(2 * np.pi * z).mean(-1))
    return 20 - 20 * bowl + np.e - egg_box


def griewank(z):  # noqa: D103
    return (z**2).sum(-1) / 4000 - np.cos(z / np.sqrt(np.arange(1, z.shape[-1] + 1))).prod(-1) + 1


def rosenbrock(z):  # noqa: D103
    return (100 * (z[..., 1:] - z[..., :-1] ** 2) ** 2 + (1 - z[..., :-1]) ** 2).sum(-1)


def levy(z):  # noqa: D103
    w = 1 + (z - 1) / 4
    middle = ((w[..., :-1] - 1) ** 2 * (1 + 10 * np.sin(np.pi * w[..., :-1] + 1) ** 2)).sum(-1)
    return np.sin(np.pi * w[..., 0]) ** 2 + middle + (w[..., -1] - 1) ** 2 * (1 + np.sin(2 * np.pi * w[..., -1]) ** 2)


def schwefel(z):  # noqa: D103
    return 418.9828872724338 * z.shape[-1] - (z * np.sin(np.sqrt(np.abs(z)))).sum(-1)


SHEKEL = np.array(
    [[4, 4, 4, 4], [1, 1, 1, 1], [8, 8, 8, 8], [6, 6, 6, 6], [3, 7, 3, 7],
     [2, 9, 2, 9], [5, 5, 3, 3], [8, 1, 8, 1], [6, 2, 6, 2], [7, 3.6, 7, 3.6]]
)  # fmt: skip
SHEKEL_WIDTH = np.array([0.1, 0.2, 0.2, 0.4, 0.4, 0.6, 0.3, 0.7, 0.5, 0.5])


def shekel(z):  # noqa: D103
    return -(1 / (((z[..., None, :] - SHEKEL) ** 2).sum(-1) + SHEKEL_WIDTH)).sum(-1)


def corana(z):
    """Ingber's own test of ASA: Corana et al., ACM Trans. Math. Softw. 13 (1987) 262; some 1e20 flat minima."""
    scale = np.array([1.0, 1000.0, 10.0, 100.0])
    lattice = np.floor(np.abs(z / 0.2) + 0.49999) * 0.2 * np.sign(z)
    hole = 0.15 * (lattice - 0.05 * np.sign(lattice)) ** 2 * scale
    return np.where(np.abs(z - lattice) < 0.05, hole, scale * z**2).sum(-1)


def styblinski_tang(z):  # noqa: D103
    return 0.5 * (z**4 - 16 * z**2 + 5 * z).sum(-1)


HARTMANN = np.array(
    [[10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14], [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14]]
)
HARTMANN_AT = 1e-4 * np.array(
    [[1312, 1696, 5569, 124, 8283, 5886], [2329, 4135, 8307, 3736, 1004, 9991],
     [2348, 1451, 3522, 2883, 3047, 6650], [4047, 8828, 8732, 5743, 1091, 381]]
)  # fmt: skip


def hartmann(z):  # noqa: D103
    inside = (HARTMANN * (z[..., None, :] - HARTMANN_AT) ** 2).sum(-1)
    return -(np.array([1.0, 1.2, 3.0, 3.2]) * np.exp(-inside)).sum(-1)


def michalewicz(z):  # noqa: D103
    return -(np.sin(z) * np.sin(np.arange(1, z.shape[-1] + 1) * z**2 / np.pi) ** 20).sum(-1)


TUNED_ON = (
    Problem("Rastrigin", rastrigin, 5, -5.12, 5.12, shifted=0.25),
    Problem("Rastrigin, scaled", partial(rastrigin, weight=np.logspace(0, 4, 5)), 5, -5.12, 5.12, shifted=0.25),
    Problem("Rastrigin, rotated", rastrigin, 5, -5.12, 5.12, shifted=0.25, rotated=True),
    Problem("Ackley", ackley, 5, -32.768, 32.768, shifted=0.25),
    Problem("Griewank", griewank, 5, -600.0, 600.0, shifted=0.25),
    Problem("Rosenbrock", rosenbrock, 4, -5.0, 10.0),
    Problem("Levy", levy, 5, -10.0, 10.0, shifted=0.25),
    Problem("Schwefel", schwefel, 5, -500.0, 500.0),
    Problem("Shekel 10", shekel, 4, 0.0, 10.0, least=-10.536409816692046),
    Problem("Corana (ASA's test)", corana, 4, -1e3, 1e3),
)
HELD_OUT = (
    Problem("Styblinski–Tang", styblinski_tang, 5, -8.0, 8.0, least=-5 * 39.16616570377142, shifted=0.1),
    Problem("Styblinski–Tang, rotated", styblinski_tang, 5, -8.0, 8.0, least=-5 * 39.16616570377142, rotated=True),
    Problem("Hartmann 6", hartmann, 6, 0.0, 1.0, least=-3.322368011415515),
    Problem("Michalewicz", michalewicz, 5, 0.0, np.pi, least=-4.687658179088),
)
PROBLEMS = {problem.name: problem for problem in (*TUNED_ON, *HELD_OUT)}

# --- the methods -----------------------------------------------------------------------------------------------------


class _Spent(Exception):  # noqa: N818
    pass


class Counted:
    """A function that keeps its lowest point and raises `_Spent` after its number of evaluations."""

    def __init__(self, function: Callable, evaluations: int) -> None:
        self.function, self.left = function, evaluations
        self.z, self.cost = np.empty(0), np.inf

    def batch(self, z: np.ndarray) -> np.ndarray:
        """Return values [n] at points [n, D]."""
        if self.left < len(z):
            raise _Spent
        self.left -= len(z)
        cost = np.asarray(self.function(z))
        best = int(np.argmin(cost))
        if cost[best] < self.cost:
            self.z, self.cost = z[best].copy(), float(cost[best])
        return cost

    def __call__(self, z: np.ndarray) -> float:
        """Return the value at one point [D]."""
        return float(self.batch(np.asarray(z)[None])[0])


def by_asa(problem: Problem, counted: Counted, seed: int, chains: int = 1, schedule: Schedule | None = None) -> None:
    """Run pianofit's annealing."""
    low, high = np.full(problem.dimensions, problem.low), np.full(problem.dimensions, problem.high)
    anneal(counted.batch, low, high, chains=chains, evaluations=counted.left, seed=seed, schedule=schedule)


def by_dual_annealing(problem: Problem, counted: Counted, seed: int, local: bool = True) -> None:
    """Run SciPy's annealing, with its local search if `local`."""
    box = [(problem.low, problem.high)] * problem.dimensions
    dual_annealing(counted, box, maxiter=10**6, maxfun=10**9, no_local_search=not local, rng=seed)


def by_cma(problem: Problem, counted: Counted, seed: int) -> None:
    """Run CMA-ES from random points, first step 0.25 of the box, restarted with twice the population."""
    import cma

    rng, population = np.random.default_rng(seed), 4 + int(3 * np.log(problem.dimensions))
    while True:
        options = {"bounds": [problem.low, problem.high], "seed": int(rng.integers(1, 2**31)), "verbose": -9}
        first = rng.uniform(problem.low, problem.high, problem.dimensions)
        es = cma.CMAEvolutionStrategy(first, 0.25 * (problem.high - problem.low), {**options, "popsize": population})
        while not es.stop():
            points = es.ask()
            es.tell(points, [float(x) for x in counted.batch(np.array(points))])
        population *= 2


METHODS: dict[str, Callable] = {
    "asa": by_asa,
    "asa1": by_asa,
    "asa16": partial(by_asa, chains=16),
    "da_plain": partial(by_dual_annealing, local=False),
    "da": by_dual_annealing,
    "cma": by_cma,
}
VARIANTS = {
    "as it is": {},
    "no sensitivities": {"exponent": 0.0},
    "exponent 1": {"exponent": 1.0},
    "no re-annealing": {"reanneal": 0},
    "end 1e-5": {"end": 1e-5},
    "end 1e-9": {"end": 1e-9},
    "acceptance to 1e-5": {"cost_end": 1e-5},
    "acceptance to 1e-15": {"cost_end": 1e-15},
    "no exchanges": {"exchanges": 0.0},
    "20 exchanges": {"exchanges": 20.0},
    "320 exchanges": {"exchanges": 320.0},
}


def run(name: str, method: str, seed: int, evaluations: int, change: dict | None = None) -> tuple[bool, bool, float]:
    """Return two flags (ended in the deepest basin, ended near its minimum) and the cost above the least value."""
    warnings.simplefilter("ignore")
    problem = PROBLEMS[name]
    function = problem.drawn(seed)
    counted = Counted(function, evaluations)
    with contextlib.suppress(_Spent):
        METHODS[method](problem, counted, seed, **(change or {}))
    box = [(problem.low, problem.high)] * problem.dimensions
    polished = minimize(lambda z: float(function(z)), counted.z, method="L-BFGS-B", bounds=box).fun
    above = counted.cost - problem.least
    return bool(min(polished - problem.least, above) < NEAR), bool(above < NEAR), above


def rates(pool: ProcessPoolExecutor, method: str, seeds: int, evaluations: int, change: dict | None = None) -> dict:
    """Run one method: for every problem the shares in the basin and near its minimum, and all costs, [seeds]."""
    names = [name for name in PROBLEMS for _ in range(seeds)]
    all_seeds = [seed for _ in PROBLEMS for seed in range(seeds)]
    single = partial(run, evaluations=evaluations, change=change)
    begun = time.perf_counter()
    runs = list(pool.map(single, names, [method] * len(names), all_seeds, chunksize=4))
    results = {}
    for i, name in enumerate(PROBLEMS):
        basin, near, above = zip(*runs[i * seeds : (i + 1) * seeds], strict=True)
        results[name] = {"basin": sum(basin) / seeds, "near": sum(near) / seeds, "above": above}
    print(f"{method}: {time.perf_counter() - begun:.0f} s", file=sys.stderr)
    return results


def table(columns: dict[str, dict]) -> str:
    """Return the shares in per cent as Markdown: in the basin, and in brackets near its minimum without L-BFGS-B."""
    lines = ["| | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    groups = {"mean": TUNED_ON, "mean, held out": HELD_OUT}
    for label, group in groups.items():
        lines += [_row(p.name, [[results[p.name]] for results in columns.values()]) for p in group]
        lines.append(_row(f"**{label}**", [[results[p.name] for p in group] for results in columns.values()]))
    return "\n".join(lines)


def _row(name: str, cells: list[list[dict]]) -> str:
    shares = [(np.mean([c["basin"] for c in cell]), np.mean([c["near"] for c in cell])) for cell in cells]
    return f"| {name} | " + " | ".join(f"{100 * basin:.0f} ({100 * near:.0f})" for basin, near in shares) + " |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="success rates of global searches on standard functions")
    parser.add_argument("--seeds", type=int, default=20, help="runs per function and method (20)")
    parser.add_argument("--evaluations", type=int, default=10_000, help="evaluations per run (10,000)")
    parser.add_argument("--methods", nargs="+", default=list(COLUMNS), choices=COLUMNS, help="only these columns")
    parser.add_argument("--chains", type=int, default=16, help="chains of the variants (16)")
    parser.add_argument("--variants", action="store_true", help="the annealing with one setting changed at a time")
    parser.add_argument("--json", type=Path, help="write the results of every run to this file")
    arguments = parser.parse_args()
    methods = {name: COLUMNS[name] for name in arguments.methods}
    if "cma" in methods and find_spec("cma") is None and not arguments.variants:
        print("the package cma is not installed: its column is left out (pip install cma)", file=sys.stderr)
        methods.pop("cma", None)
    columns = {}
    with ProcessPoolExecutor() as pool:
        if arguments.variants:
            for label, change in VARIANTS.items():
                change = {"chains": arguments.chains, "schedule": Schedule(**change)}
                columns[label] = rates(pool, "asa", arguments.seeds, arguments.evaluations, change)
        else:
            for method, label in methods.items():
                columns[label] = rates(pool, method, arguments.seeds, arguments.evaluations)
    runs = f"{arguments.seeds} runs of {arguments.evaluations} evaluations"
    print(f"Per cent of {runs}: in the deepest basin (at its minimum)\n")
    print(table(columns))
    if arguments.json:
        settings = {"seeds": arguments.seeds, "evaluations": arguments.evaluations, "schedule": asdict(Schedule())}
        arguments.json.write_text(json.dumps({**settings, "found": columns}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
