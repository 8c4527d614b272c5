"""Verify the model: orders of accuracy, invariants and comparisons with independent methods, as a page with figures.

    python benchmarks/validation.py                 writes docs/validation.md and docs/validation-*.png
    python benchmarks/validation.py --out folder    writes them to the folder

This program computes all numbers of the page. The cases and the slow reference methods are those of the tests, which
check limits of the same numbers.
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from pianofit import model
from pianofit.model.free_response import damped_circle
from pianofit.parameters import FIT_NAMES, Hammer
from pianofit.x64 import x64_scope

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))
cases, references = importlib.import_module("model_cases"), importlib.import_module("reference_cases")
energy, fast_path = importlib.import_module("test_model_energy"), importlib.import_module("test_reference")
STRING, HAMMER, GEOMETRY, RATE = cases.STRING, cases.HAMMER, cases.GEOMETRY, cases.RATE
WIDE, relative = references.WIDE, references.relative

LIGHT = Hammer(K_H=1.1e10, mu=0.1, p=2.5, M_H=1e-3, v_H0=2.0)
LINEAR = Hammer(K_H=5e4, mu=0.0, p=1.0, M_H=1e-3, v_H0=2.0)
MODES, SAMPLES, LINEAR_SAMPLES = 16, 90, 30  # at RATE; the linear felt is still pressed at its last sample
FACTORS = tuple(2**i for i in range(8))  # steps per sample
STEP = 5e-6  # of central differences, in the logarithm: see tests/test_model_gradients.py


def number(x: float) -> str:
    """Two digits."""
    return f"{x:.1e}"


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a Markdown table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ("---",) * len(head), *rows))


def with_orders(errors: list[float] | np.ndarray) -> list[str]:
    """Format each error, from the second on with its order, log2 of the ratio to the previous error."""
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    return [number(errors[0]), *(f"{number(e)} ({o:.2f})" for e, o in zip(errors[1:], orders, strict=True))]


def draw(path: Path, panels: list[tuple[str, dict[str, tuple[np.ndarray, np.ndarray]]]]) -> None:
    """Draw panels of errors: the label of the x axis, and curves of x and y by label."""
    mpl.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    figure = Figure(figsize=(7.2, 3.0), layout="constrained")
    for ax, (xlabel, curves) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for (label, (x, y)), mark in zip(curves.items(), "os^d", strict=False):
            ax.loglog(x, y, f"{mark}-", label=label, markersize=3, linewidth=1)
        ax.set(xlabel=xlabel, ylabel="largest error, relative to full scale")
        ax.tick_params(which="minor", labelbottom=False, labelleft=False)
        ax.grid(alpha=0.3, linewidth=0.5)
        ax.legend(frameon=False)
    figure.savefig(path, dpi=120)


def exact(rows, hammer: Hammer, geometry, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force and pickup velocity of the modal equations of motion, not discretised in time: DOP853 at 1e-12."""
    solution = cases.exact_contact(*rows, hammer, times)
    k = np.arange(1, solution.v.shape[1] + 1)
    return solution.force, solution.v @ np.sin(k * math.pi * geometry.pickup / geometry.length)


def continuous_rows(n: int, geometry, weights=None):
    """Return ω², α, Φ and γ of the first modes [n] of the continuous string."""
    beta = np.arange(1, n + 1) * math.pi / geometry.length
    phi = cases.table(STRING, geometry, rate=RATE * 1024, n_modes=n).strike if weights is None else weights
    omega2, alpha = STRING.c**2 * beta**2 + STRING.kappa**2 * beta**4, STRING.b1 + STRING.b2 * beta**2
    return omega2, alpha, np.asarray(phi), 2 * np.asarray(phi) / geometry.mass


def stepped(hammer: Hammer, factor: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return force and pickup velocity of the model at the samples, with `factor` steps per sample."""
    steps = -(-factor * samples // 32) * 32
    modes, pulse = cases.hit(STRING, hammer, GEOMETRY, RATE * factor, n_modes=MODES, steps=steps)
    velocity = model.waveform(modes, pulse.drive, rate=RATE * factor, samples=steps)
    return np.asarray(pulse.force)[::factor][:samples], np.asarray(velocity)[::factor][:samples]


def extrapolated(signals: list[np.ndarray], truth: np.ndarray) -> list[float]:
    """Return the errors of Romberg's diagonal, in which the even powers of the step are eliminated one by one."""
    diagonal, row = [], []
    for signal in signals:
        new = [signal]
        for j, old in enumerate(row, 1):
            new.append(new[-1] + (new[-1] - old) / (4**j - 1))
        row = new
        diagonal.append(relative(row[-1], truth))
    return diagonal


def in_time(out: Path) -> str:
    """Order in the step, compared with the equations of motion."""
    truth = exact(continuous_rows(MODES, GEOMETRY), LIGHT, GEOMETRY, np.arange(SAMPLES) / RATE)
    errors = [[relative(x, e) for x, e in zip(stepped(LIGHT, f, SAMPLES), truth, strict=True)] for f in FACTORS]
    force, velocity = np.array(errors).T
    truth = exact(continuous_rows(MODES, GEOMETRY), LINEAR, GEOMETRY, np.arange(LINEAR_SAMPLES) / RATE)
    pulses = [stepped(LINEAR, f, LINEAR_SAMPLES)[0] for f in FACTORS]
    linear, floor = [relative(x, truth[0]) for x in pulses], extrapolated(pulses, truth[0])
    columns = (with_orders(list(force)), with_orders(list(velocity)), with_orders(linear), map(number, floor))
    step = 1e6 / RATE / np.array(FACTORS)
    rows = [(f"{s:.3f}", *errors) for s, *errors in zip(step, *columns, strict=True)]
    left = {"force": (step, force), "pickup velocity": (step, velocity)}
    right = {"force": (step, np.array(linear)), "extrapolated": (step, np.array(floor))}
    draw(out / "validation-time.png", [("step, µs (felt of p = 2.5)", left), ("step, µs (linear felt)", right)])
    return f"""## Order in time

The model steps {MODES} modes of the continuous string and the contact. The reference is a Runge–Kutta solution of
order 8 of the same equations, with a tolerance of 1e-12. Errors are the largest, relative to full scale. In brackets is
the observed order of that halving, expected 2.0 ± 0.1. With a linear felt the error is a series in even powers of the
step. Its extrapolation (Romberg) shows the error of rounding and of the solver.

{table(("step, µs", "force, p = 2.5", "pickup velocity, p = 2.5", "force, linear felt", "extrapolated"), rows)}

![Errors over the step](validation-time.png)
"""


def in_space(out: Path) -> str:
    """Accuracy in the number of modes and in the spacing of the grid, both without discretisation in time."""
    times = np.arange(SAMPLES) / RATE
    # A Gaussian is smooth. This one has the width at half height of the raised cosine.
    smooth = model.window_weights(lambda x: jnp.exp(-0.5 * (4.71 * x / WIDE.width) ** 2), WIDE._replace(width=0.2), 192)
    windows = {"raised cosine": continuous_rows(192, WIDE), "smooth window": continuous_rows(192, WIDE, smooth)}
    truth = {name: exact(rows, LIGHT, WIDE, times) for name, rows in windows.items()}
    counts, errors = np.array([8, 16, 32, 48, 64, 96, 128]), {}
    for name, rows in windows.items():
        signals = [exact([x[:n] for x in rows], LIGHT, WIDE, times) for n in counts]
        errors[name] = np.array([[relative(x, e) for x, e in zip(s, truth[name], strict=True)] for s in signals]).T
    modes = [(str(n), *(number(errors[name][j][i]) for name in windows for j in (0, 1))) for i, n in enumerate(counts)]
    spaces = np.array([50, 100, 200, 400])
    on_grid = []
    for n in spaces - 1:
        grid = cases.table(STRING, WIDE, rate=RATE, n_modes=int(n), kind="finite_difference")
        rows = [np.asarray(x) for x in (grid.omega2, grid.alpha, grid.strike, grid.modal_gain)]
        signals = exact(rows, LIGHT, WIDE, times)
        on_grid.append([relative(x, e) for x, e in zip(signals, truth["raised cosine"], strict=True)])
    force, velocity = np.array(on_grid).T
    grids = list(zip(map(str, spaces), with_orders(list(force)), with_orders(list(velocity)), strict=True))
    left = {f"force, {name}": (counts, errors[name][0]) for name in windows}
    right = {"force": (spaces, force), "pickup velocity": (spaces, velocity)}
    draw(out / "validation-space.png", [("modes", left), ("spaces of the grid", right)])
    heads = tuple(f"{kind}, {name}" for name in windows for kind in ("force", "velocity"))
    return f"""## Number of modes, and the grid

This comparison has no discretisation in time. The reference is the continuous string with 192 modes. The convergence
depends on the smoothness of the contact window. For a Gaussian it is spectral, down to the error of the solver. For the
default raised cosine, with a discontinuous curvature at its ends, the error falls with a power of the number of modes.

{table(("modes", *heads), modes)}

The paper's grid of N + 1 spaces is of second order (in brackets; expected 2 if the grid resolves the window).

{table(("spaces", "force", "pickup velocity"), grids)}

![Errors over the number of modes and over the grid](validation-space.png)
"""


def drift(kind: str) -> float:
    """Largest relative change of the energy of a free lossless string in ten seconds at 44.1 kHz, at 700 times."""
    n = 24
    modes = cases.table(energy.LOSSLESS, GEOMETRY, rate=44_100.0, n_modes=n, kind=kind)
    start = (1e-3 / np.arange(1, n + 1) ** 2, np.zeros(n))
    columns = [energy._step(modes, q, v, 0.0) for q, v in ((np.ones(n), np.zeros(n)), (np.zeros(n), np.ones(n)))]
    block = np.linalg.matrix_power(np.stack([np.stack(c, axis=-1) for c in columns], axis=-1), 630)
    state, worst = np.stack(start, axis=-1)[..., None], 0.0
    for _ in range(700):
        state = block @ state
        now = energy._energy(modes, state[:, 0, 0], state[:, 1, 0])
        worst = max(worst, abs(now / energy._energy(modes, *start) - 1))
    return worst


def largest_rise(steps: int = 10_000) -> float:
    """Largest relative change of the energy in a single step of a lossy free string; a decrease is negative."""
    modes, random = cases.table(STRING, GEOMETRY, rate=RATE, n_modes=64), np.random.default_rng(0)
    states = [(random.normal(size=64) * 1e-3, random.normal(size=64))]
    for _ in range(steps):
        states.append(energy._step(modes, *states[-1], 0.0))
    values = np.array([energy._energy(modes, *state) for state in states])
    return float(np.max(values[1:] / values[:-1] - 1))


def energies() -> str:
    """Energy: conserved, falling, and lost in the felt."""
    losses = (0.0, 0.01, 0.1, 1.0)
    work = [[energy._felt_work(HAMMER._replace(mu=mu), RATE * f, 8192) for f in (1, 4)] for mu in losses]
    rows = [(f"{mu:g}", *map(number, pair)) for mu, pair in zip(losses, work, strict=True)]
    return f"""## Energy

- Free lossless string, ten seconds at 44.1 kHz: the largest relative drift of the energy is
  {number(drift("continuous"))}, on the paper's grid {number(drift("finite_difference"))}.
- Free string with losses, 10,000 steps from a random state: the largest relative change of the energy in a step is
  {number(largest_rise())}. It must not be above 0.

The table gives the net work of the felt from first to last contact, relative to the energy of the hammer. Without
losses it is the error of the scheme, which falls with the square of the step. With losses it must be positive.

{table(("μ, s/m", f"at {RATE / 1e3:g} kHz", f"at {4 * RATE / 1e3:g} kHz"), rows)}
"""


def reciprocity() -> str:
    """Exchange strike and pickup positions."""
    k, first, second = np.arange(1, 65) * math.pi / GEOMETRY.length, 0.12, 0.37
    tables = [
        cases.table(STRING, GEOMETRY._replace(pickup=pickup), rate=RATE, n_modes=64, strike_weights=np.sin(strike * k))
        for strike, pickup in ((first, second), (second, first))
    ]
    zeta = damped_circle(jnp.linspace(20, 15_000, 300), 30.0, tables[0].step)
    forth, back = (model.mobility(modes, zeta) for modes in tables)
    return f"""## Reciprocity

The response at {second:g} m to a point force at {first:g} m is compared with the response at {first:g} m to a force at
{second:g} m, from 20 Hz to 15 kHz. They differ by {number(relative(back, forth))} of the largest value.
"""


def central_differences(case: dict, window: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
    """Derivatives of the model's signals by the logarithm of each parameter."""

    def at(name: str, sign: int) -> dict:
        part = "string" if name in case["string"]._fields else "hammer"
        moved = case[part]._replace(**{name: getattr(case[part], name) * math.exp(sign * STEP)})
        return fast_path._fast(case | {part: moved}, window)[0]

    return {name: jax.tree.map(lambda a, b: (a - b) / (2 * STEP), at(name, 1), at(name, -1)) for name in FIT_NAMES}


def comparisons() -> str:
    """Gradients by three methods, and the model compared with the paper's scheme."""
    case, kinds = references.CASES["paper"][0], ("velocity", "force")
    slow = references.solve(case, derivatives=True)
    tangents, differences = fast_path._fast(case, slow.window)[1], central_differences(case, slow.window)
    values = case["string"]._asdict() | case["hammer"]._asdict()
    gradients = []
    for name in FIT_NAMES:
        fast, other = tangents[name], slow.derivatives[name]
        row = [relative(fast[kind], getattr(other, kind)) for kind in kinds]
        row += [relative(fast[kind] * values[name], differences[name][kind]) for kind in kinds]
        row += [np.abs(fast[kind]).max() * values[name] / np.abs(getattr(slow.signals, kind)).max() for kind in kinds]
        gradients.append((f"`{name}`", *map(number, row)))
    shown, signals = (*kinds, "compression"), []
    for name, (case, _) in references.CASES.items():
        slow = references.solve(case)
        fast = fast_path._fast(case, slow.window)[0]
        signals.append((name, *(number(relative(fast[kind], getattr(slow.signals, kind))) for kind in shown)))
    against = tuple(f"{kind}, {other}" for other in ("appendix", "differences", "size") for kind in kinds)
    return f"""## Gradients by three methods

Derivatives of the pickup velocity and of the force by the nine parameters, for a string like the paper's on a grid of
{references.POINTS} points, {references.STEPS} steps. Forward mode through the model (`jax.jvp`) is compared with the
paper's appendix (`tests/finite_difference.py`), and with central differences of {STEP:g} in the logarithm. The
table gives the largest difference, relative to the largest value of that derivative. The size is that of the derivative
by the logarithm, relative to full scale. The error of central differences is rounding divided by their step. It is
large for a parameter with little effect.

{table(("by", *against), gradients)}

## Modal model against finite differences

The modal model with one scalar equation per step is compared with the paper's grid, its matrices and a Newton iteration
over the whole system. They share only the parameters' names. The table gives the largest difference, relative to full
scale.

{table(("case", *shown), signals)}
"""


def main() -> None:
    """Compute all parts and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    head = """# Validation

`python benchmarks/validation.py` computes every number and figure of this page. Run it again after a change of the
model. Rounding differs slightly between machines. The tests check limits of the same quantities.
"""
    source = "[annealing.md](annealing.md), computed by `benchmarks/annealing_study.py`"
    annealing = f"## Annealing\n\nThe success rates of the annealing are in {source}.\n"
    parts = [head, in_time(out), in_space(out), energies(), reciprocity(), comparisons(), annealing]
    (out / "validation.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    with x64_scope():
        main()
