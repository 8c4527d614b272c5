"""How much of the time that it has the page's engine takes, under node: strings that ring, and the contacts of strokes.

    python benchmarks/page.py [--voices 32] [--modes 200]

A block of 128 samples lasts 2.67 ms at 48 kHz. Counted is the processor's time; the least of several runs is printed.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import numpy as np

from pianofit.model.modal import Ringing
from pianofit.model.note import Note
from pianofit.play.page.payload import encode_note
from pianofit.published import typical

PROGRAM = """
import { readFileSync } from "node:fs";
const { decode, prepare } = await import(process.argv[1] + "/prepare.js");
const { BLOCK } = await import(process.argv[1] + "/contact.js");
const { Engine } = await import(process.argv[1] + "/engine.js");
const { keys, runs, seconds } = JSON.parse(readFileSync(0, "utf8")), rate = 48000, budget = (1e3 * BLOCK) / rate;
const tables = keys.map((entry) => prepare(decode(entry), rate)), block = [0, 1].map(() => new Float64Array(BLOCK));
const best = { ringing: Infinity, chord: Infinity, stroke: Infinity };
for (let run = 0; run < runs; run++) {
  const engine = new Engine(rate);
  tables.forEach((table, i) => engine.setKey(i, table));
  const render = (count) => {
    const begin = process.cpuUsage();
    for (let i = 0; i < count; i++) engine.render(...block);
    const { user, system } = process.cpuUsage(begin);
    return (user + system) / 1e3 / count / budget;
  };
  engine.noteOn(0, 4);
  best.stroke = Math.min(best.stroke, render(8));
  tables.forEach((_, i) => engine.noteOn(i, 4));
  best.chord = Math.min(best.chord, render(8)); // 21 ms: the contacts
  render(Math.ceil((0.6 * rate) / BLOCK)); // knocks and transients are over
  const sounding = engine.sounding;
  best.ringing = Math.min(best.ringing, render(Math.ceil((seconds * rate) / BLOCK)));
  if (sounding !== tables.length) throw new Error(`${sounding} strings sound`);
}
console.log(JSON.stringify(best));
"""
RATE = 48_000


def rung(midi: int, modes: int) -> Note:
    """A key with so many modes, which all ring for long, and a knock of 0.4 s."""
    random, it = np.random.default_rng(midi), typical(midi)
    pole = -random.uniform(0.2, 0.5, modes) + 2j * np.pi * np.sort(random.uniform(60, 9000, modes))
    pattern = random.normal(size=(1, modes)) + 1j * random.normal(size=(1, modes))
    knock = random.normal(size=(1, round(0.412 * RATE))) * np.exp(-np.arange(round(0.412 * RATE)) / 5000)
    ringing = Ringing(np.arange(1, modes + 1), pole, np.zeros(modes), pattern, knock, RATE)
    return Note(it.string, it.hammer, it.geometry, "bridge-force", 0.1, None, ringing)


def by_law(midi: int, _: int) -> Note:
    """The literature's key; it has as many modes as it has."""
    it = typical(midi)
    return Note(it.string, it.hammer, it.geometry, "bridge-force", 0.1)


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--voices", type=int, default=32)
    options.add_argument("--modes", type=int, default=200)
    options.add_argument("--runs", type=int, default=8)
    asked = options.parse_args()
    node = shutil.which("node")
    if node is None:
        raise SystemExit("node is not installed (Debian: apt-get install nodejs)")
    scripts = str(Path(str(files("pianofit.play.page"))))
    for name, kind in (("measured modes", rung), ("the string's own", by_law)):
        keys = [encode_note(kind(midi, asked.modes), midi) for midi in range(30, 30 + asked.voices)]
        given = json.dumps({"keys": keys, "runs": asked.runs, "seconds": 1.0})
        command = [node, "--input-type=module", "-e", PROGRAM, scripts]
        done = subprocess.run(command, input=given, capture_output=True, text=True, check=True)
        part = json.loads(done.stdout)
        print(
            f"{name}: {asked.voices} strings that ring {100 * part['ringing']:.1f} % of the time, struck at once "
            f"{100 * part['chord']:.0f} %, one stroke {100 * part['stroke']:.0f} %"
        )


if __name__ == "__main__":
    main()
