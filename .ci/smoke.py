"""A short test of the installed package: public names, commands, one fit with known answers. It needs nothing else.

python .ci/smoke.py PYTHON [EXTRA]    tests the package that is installed for this interpreter, and one extra
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

NAMES = """
import pianofit, pathlib, sys
assert "site-packages" in pianofit.__file__, pianofit.__file__
assert all(getattr(pianofit, name) is not None for name in pianofit.__all__)
print(pianofit.__version__, "on Python", sys.version.split()[0])
"""
TRUE = """
import json, pianofit
p = pianofit.preset("bensa-final")
print(json.dumps({**p.string._asdict(), **p.hammer._asdict()}))
"""
# A command, and a file that it writes.
COMMANDS = [
    (["pianofit", "demo", "--out", "demo"], "demo/report.html"),
    (["pianofit", "simulate", "--typical", "C4", "--noise", "60", "--out", "c4.wav"], "c4.wav"),
    (["pianofit", "render", "demo/fit.json", "--velocity", "3", "--out", "harder.wav"], "harder.wav"),
    (["pianofit", "instrument", "demo/fit.json", "--out", "piano"], "piano/instrument.json"),
    (
        ["pianofit", "export", "piano/instrument.json", "--format", "sfz", "--keys", "G2-G2", "--out", "sampler"],
        "sampler",
    ),
]
# The fit must find the true values of the demo. These are closely determined, see the README.
WITHIN = {"c": 1e-4, "M_H": 1e-3, "p": 2e-3}
SECONDS = 600.0  # allowed for a command, on a slow machine without compiled programs


# For each extra, a program that needs it. It runs in the folder of the demo's fit.
EXTRAS = {
    "bayes": """
from pianofit.cli import main
from pianofit.inference import nuts
nuts.CHAINS, nuts.WARMUP, nuts.DRAWS = 2, 10, 10  # enough to run every function of the sampler, too few for an interval
words = "fit demo/synthetic.wav --setup demo/setup.toml --note D3 --intervals posterior --no-page --out bayes"
assert main(words.split()) == 0
""",
    "cluster": """
import pathlib, shutil
from distributed import LocalCluster
from pianofit.cli import main
if __name__ == "__main__":
    pathlib.Path("library").mkdir()
    shutil.copy("c4.wav", "library/piano-C4.wav")
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        words = ["batch", "library", "--scheduler", cluster.scheduler_address, "--out", "fits"]
        assert main(words) == 0
""",
    "notebook": """
import pianofit
assert len(pianofit.Result.load("demo").to_dataframe()) > 8
import arviz_base
""",
    "widget": "import pianofit; assert pianofit.Result.load('demo').note.play() is not None",
}


def main() -> None:
    """Run everything in an empty folder, and stop at the first failure."""
    python, extras = Path(sys.argv[1]).absolute(), sys.argv[2:]
    with tempfile.TemporaryDirectory() as folder:
        print(run([str(python), "-W", "error", "-c", NAMES], folder), end="", flush=True)
        for (program, *words), written in COMMANDS:
            run([str(python.parent / program), *words], folder)
            print("ok:", program, *words, flush=True)
            if not (Path(folder) / written).exists():
                raise SystemExit(f"{program} {words[0]}: {written} is missing")
        for extra in extras:
            (Path(folder) / "extra.py").write_text(EXTRAS[extra], encoding="utf-8")
            run([str(python), "extra.py"], folder)
            print("ok: extra", extra, flush=True)
        fit = json.loads((Path(folder) / "demo" / "fit.json").read_text(encoding="utf-8"))
        true = json.loads(run([str(python), "-c", TRUE], folder))
    for name, share in WITHIN.items():
        value = fit["parameters"][name]["value"]
        if abs(value / true[name] - 1) > share:
            raise SystemExit(f"{name} = {value:g}, but the true value is {true[name]:g}")


def run(words: list[str], folder: str) -> str:
    """Run a command in a folder and return its output, which is shown if it fails."""
    caches = {"MPLCONFIGDIR": f"{folder}/matplotlib", "PIANOFIT_CACHE": f"{folder}/programs"}  # as on a new machine
    done = subprocess.run(  # noqa: S603
        words, cwd=folder, capture_output=True, text=True, timeout=SECONDS, env={**os.environ, **caches}
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


if __name__ == "__main__":
    main()
