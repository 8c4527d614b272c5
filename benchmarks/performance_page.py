"""From the table's numbers to the end of `docs/performance.md` and its picture; no number is written by hand."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

from measuring import into_page, ratio
from works import ALL_CORES, BATCHES, HAMMERS, MODES, OBJECTIVE, SLOPES, STEPS

# Load of the machine below which nothing else runs.
QUIET_LOAD = 0.5
# Characters of a line of the page.
WIDTH = 120
# Name of the marks of the page.
MARK = "table"
# Targets, by row: of the design, on two idle cores.
CANDIDATES, OVER_PAPER, DERIVATIVES = 100_000.0, 800.0, 5.0
COMMANDS = {"--help": 0.5, "fit": 3.0, "fit with page": 6.0, "fit, cold": 8.0, "joint fit": 7.0, "paper's recipe": 6.0}
# One scalar recursion is this much faster than JAX where a kernel of our own would be worth a thought.
TOO_SLOW = 4.0


def write(document: dict[str, Any], path: Path) -> None:
    """The part of the page between its marks, and the picture of how costs grow next to the page."""
    picture = path.with_name(f"{path.stem}-growth.svg")
    into_page(path, MARK, text(document, picture.name).splitlines())
    draw(document["growth"], picture)


def text(document: dict[str, Any], picture: str) -> str:
    """The part of the page that is made."""
    parts = [
        _opening(document), _side_by_side(document), _commands(document), _growth(document, picture),
        _counts(document), _kernel(document), _accelerator(document),
    ]  # fmt: skip
    return "\n\n".join(_wrapped(block) for part in parts for block in part.split("\n\n") if block) + "\n"


def _wrapped(block: str) -> str:
    """Wrap a paragraph; tables, titles and pictures stay as they are."""
    if block.startswith(("|", "#", "!")):
        return block
    return textwrap.fill(" ".join(block.split()), WIDTH, break_long_words=False, break_on_hyphens=False)


def _opening(document: dict[str, Any]) -> str:
    m = document["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in m["versions"].items() if version)
    is_loaded = max([0, *m["load"][:1]]) > QUIET_LOAD
    busy = " **Other programs ran within the minute before, so times may be too long.**" if is_loaded else ""
    return f"""## Single operations

`python benchmarks/table.py --json benchmarks/results.json --docs docs/performance.md` writes this part of the page. It
needs numba: `pip install -e ".[bench]"`. Times are medians of runs that take turns, next to the fastest run. Ratios are
medians over the turns.

The machine was {m["processor"]} with {m["cores"]} cores, load {_list(m["load"])} before and {_list(m["load after"])}
after, Python {m["python"]}, {versions}. The commit was {m["commit"]}.{busy}

The baseline is an optimised program of the paper's own algorithm, with N = 100, 44.1 kHz and the full duration
(`benchmarks/baseline.py`). Its matrix is pentadiagonal and factored once, and numba compiles it. It differs from
`tests/finite_difference.py` by {document["baseline off reference.py"]:.1e} of full scale."""


def _side_by_side(document: dict[str, Any]) -> str:
    found = document["inner"]
    s, c, k, p, f = (found[x] for x in ("strike", "criterion", "candidates", "sound", "plain scan"))
    search, sizes = found["search"], found["search sizes"]
    size = f"{sizes['partials']} partials, {sizes['modes']} modes, {sizes['steps']} steps"
    step = 1e6 * s["baseline"]["median"] / 44_100
    one = k["baseline, 1 s"]
    rows = [
        ("one strike, 1 s of signal, baseline", s["baseline"], f"{step:.2f} µs a step"),
        ("one strike, 1 s of signal", s["pianofit"], _times(s["baseline"], s["pianofit"])),
        ("criterion (eq. 19), 1 s, baseline", c["baseline, value"], ""),
        ("criterion, 1 s", c["value"], _times(c["baseline, value"], c["value"])),
        ("and nine derivatives, baseline, ten runs", c["baseline, nine derivatives"], ""),
        *((f"and {x.split('and ')[1]}", c[x], _times(c["baseline, nine derivatives"], c[x])
           + (f", target {DERIVATIVES:g} ms" if x.endswith("derivatives") else ""))
          for x in ("value and nine derivatives", "value and nine derivatives, any model")),
        (f"default fit, levels of {sizes['hammers']} hammers ({size}), all cores", search[HAMMERS],
         f"{sizes['hammers'] / search[HAMMERS]['median']:,.0f} hammers a second"),
        (f"default fit, levels and all derivatives of {sizes['lanes']} hammers", search[SLOPES],
         f"{1e3 * search[SLOPES]['median'] / sizes['lanes']:.2f} ms a hammer"),
        (f"default fit, objective and all derivatives at {sizes['points']} points", search[OBJECTIVE],
         f"{1e3 * search[OBJECTIVE]['median'] / sizes['points']:.2f} ms a point"),
        ("rendering from parameters, 10 s at 48 kHz", p["pianofit"], f"{10 / p['pianofit']['median']:.0f} × real time"),
        *((("csound's `prepiano`, 10 s at 48 kHz, a process", p["csound prepiano"],
            f"{10 / p['csound prepiano']['median']:.0f} × real time"),) if "csound prepiano" in p else ()),
        ("linear string, 64 modes, 1 s, plain `lax.scan`", f["forward"], ""),
        ("and its gradient", f["with gradient"], ""),
    ]  # fmt: skip
    csound = "" if "csound prepiano" in p else "\n\ncsound was not installed (`apt install csound`), so it has no row."
    lines = ["| what | median, ms | fastest, ms | comparison |", "|---|---|---|---|"]
    lines += [f"| {n} | {1e3 * x['median']:.2f} | {1e3 * x['fastest']:.2f} | {more} |" for n, x, more in rows]
    rates = ["| hammer candidates | a second | fastest | × baseline of 1 s |", "|---|---|---|---|"]
    sized = {"alone": 1} | {f"{x} together": x for x in BATCHES} | {ALL_CORES: int(ALL_CORES.split()[0])}
    for name, size in sized.items():
        x = k[name]
        rates.append(
            f"| {name} | {size / x['median']:,.0f} | {size / x['fastest']:,.0f} | {size * ratio(one, x):,.0f} |"
        )
    scalar = k["same recursion compiled, 64"]
    rates.append(
        f"| the same recursion compiled, one by one | {64 / scalar['median']:,.0f} | {64 / scalar['fastest']:,.0f} | "
        f"{64 * ratio(one, scalar):,.0f} |"
    )
    best = max(size / k[name]["median"] for name, size in sized.items())
    over = max(size * ratio(one, k[name]) for name, size in sized.items())
    return f"""### Side by side

{chr(10).join(lines)}{csound}

The nine derivatives of the baseline are nine more runs. The paper's sensitivity system costs as much. A hammer
candidate is a contact alone, with {STEPS} steps at 44.1 kHz on a string of {MODES} modes. The string is the same for
all. The paper's algorithm needs the whole second of sound for each candidate.

{chr(10).join(rates)}

The target is {CANDIDATES:,.0f} candidates a second. The best row has {best:,.0f} ({_met(best >= CANDIDATES)}). The
second target is {OVER_PAPER:g} times the baseline. The best ratio is {over:,.0f} ({_met(over >= OVER_PAPER)}). XLA does
not split loops of this size over cores. So each row but the last but one uses one thread."""


def _commands(document: dict[str, Any]) -> str:
    effort, table = document["effort"], document["commands"]
    lines = ["| command | median, s | fastest, s | target, s | memory, MB | |", "|---|---|---|---|---|---|"]
    for name, target in COMMANDS.items():
        x = table[name]
        verdict = _met(x["median"] <= target)
        lines.append(
            f"| {name} | {x['median']:.2f} | {x['fastest']:.2f} | {target:g} | {x['memory_MB']:.0f} | {verdict} |"
        )
    inner = document["inner"]["strike"]["baseline"]["median"]
    evaluations = effort["evaluations"]
    gain = evaluations * inner / table["paper's recipe"]["median"]
    return f"""### Whole commands

The commands fit a synthetic note of {effort["seconds"]:g} s. The joint fit has {effort["recordings"]} recordings of
it. The paper's recipe has {evaluations:,} evaluations by annealing on the demo's recording. Each command is a process
of its own, with Python's start and all imports. Commands write no page unless the row says so. Warm commands have the
compiled programs of earlier fits, and the cold one has an empty folder.

{chr(10).join(lines)}

The baseline would need {evaluations * inner:.0f} s for the annealing alone, at its time of one strike in the table
above. This is {gain:.0f} times the whole command."""


def _growth(document: dict[str, Any], picture: str) -> str:
    growth = document["growth"]
    lines = ["| cost over | from | to | ms, first | ms, last | exponent at the end |", "|---|---|---|---|---|---|"]
    for name, x in growth.items():
        if name != "notes":
            lines.append(
                f"| {name} | {x['sizes'][0]:g} | {x['sizes'][-1]:g} | {1e3 * x['seconds'][0]:.2f} | "
                f"{1e3 * x['seconds'][-1]:.2f} | {x['exponent']:.2f} |"
            )
    notes = [
        "| note | contact's rate, kHz | modes | steps | contact, ms | strike with 1 s, ms |",
        "|---|---|---|---|---|---|",
    ]
    notes += [
        f"| {x['note']} | {x['rate'] / 1e3:.1f} | {x['modes']} | {x['steps']} | {x['contact_ms']:.2f} | "
        f"{1e3 * x['seconds']:.1f} |" for x in growth["notes"]
    ]  # fmt: skip
    return f"""### How cost grows

![Seconds over size]({picture})

{chr(10).join(lines)}

The exponent is the slope of log time over log size through the last three sizes. It is 1 for O(n), and less where a
fixed cost remains. The program chooses the rate of the contact, the modes and the steps for each note:

{chr(10).join(notes)}"""


def _counts(document: dict[str, Any]) -> str:
    lines = ["| of one fit, empty caches | count |", "|---|---|"]
    lines += [f"| {name.replace('_', ' ')} | {x:g} |" for name, x in document["counts"].items()]
    instructions = document["instructions"]
    perf = instructions["perf"]
    said = (
        f"perf counts {perf:,.0f} instructions per step and candidate in a batch of 64." if perf
        else "`perf` could not count instructions on this machine."
    )  # fmt: skip
    flops = instructions["operations XLA counts in the program"]
    more = (
        f" XLA's own analysis counts {flops:,.0f} operations in the program of the batch, with the body of a loop once."
        if flops
        else ""
    )
    return f"""### Counts that do not depend on the machine

`python benchmarks/counts.py` counts them in a fit of one second of sound. `tests/test_counts.py` fails when they grow.

{chr(10).join(lines)}

Most of the time is in the steps of the contact. {said}{more}"""


def _kernel(document: dict[str, Any]) -> str:
    k = document["inner"]["candidates"]
    slower = ratio(k["64 together"], k["same recursion compiled, 64"])
    verdict = (
        f"This is within the factor of {TOO_SLOW:g}, so a compiled kernel of our own is not worth its cost."
        if slower <= TOO_SLOW
        else f"This is beyond the factor of {TOO_SLOW:g}, where a compiled kernel of our own is worth a trial."
    )  # fmt: skip
    return f"""### A compiled kernel of our own

A batch of 64 candidates takes {slower:.2f} times as long in JAX as the same recursion, compiled by numba and run one by
one on one core. {verdict} It would need derivatives of its own, and a wheel for every system. Now one wheel is enough
for all."""


def _accelerator(document: dict[str, Any]) -> str:
    found = document["accelerator"]
    if found is None:
        return ""  # docs/datasets.md has what was measured on one
    lines = ["| batch | candidates a second |", "|---|---|"]
    lines += [f"| {int(size):,} | {rate:,.0f} |" for size, rate in found["rates"].items()]
    return f"""### On an accelerator

The device was {found["device"]}, in float64 with the same code. The largest batch was {found["largest batch"]:,}, ended
by {found["ended by"]}.

{chr(10).join(lines)}"""


def _list(values: list[float]) -> str:
    return ", ".join(f"{x:g}" for x in values)


def _times(slow: dict, fast: dict) -> str:
    return f"{ratio(slow, fast):.2f} × as fast as the baseline"


def _met(met: bool) -> str:
    return "met" if met else "not met"


def draw(growth: dict[str, Any], path: Path) -> None:
    """Milliseconds over size, each axis logarithmic."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    series = {name: x for name, x in growth.items() if name != "notes"}
    with plt.rc_context({"svg.hashsalt": "pianofit", "svg.fonttype": "none", "font.size": 8}):
        figure, axes = plt.subplots(2, -(-len(series) // 2), figsize=(10, 4.5), constrained_layout=True)
        for axis, (name, x) in zip(axes.ravel(), series.items(), strict=False):
            axis.loglog(x["sizes"], [1e3 * s for s in x["seconds"]], "o-", color="#1f5fa8", ms=3)
            axis.set(xlabel=name, ylabel="ms", title=f"exponent {x['exponent']:.2f}")
            axis.grid(True, which="major", alpha=0.3)
        for axis in axes.ravel()[len(series) :]:
            axis.set_axis_off()
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)
