"""Processor time of the page's engine, under node: strings that ring, and the contacts of strokes.

    python benchmarks/page.py [--voices 32] [--modes 200]
    python benchmarks/page.py --free            free strings: all 88 keys of `synthetic_piano.py`, pedal down
    python benchmarks/page.py --open            a page of 88 keys, in chromium: size, time to the first sound, memory

The keys have so many measured modes, or the modes of the string model, or are those of `synthetic_piano.py`, which all
have modes and a knock in stereo. The page that is opened is that piano's; the time to its first sound goes from the
navigation to the first sample that an analyser behind the engine shows, of a key that is struck as soon as there is
one. Memory is that of the browser's process for the page once all tables are computed, less that of an empty page.

A block of 128 samples lasts 2.67 ms at 48 kHz. Counted is the processor's time; the least of several runs is printed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import tempfile
from importlib.resources import files
from pathlib import Path

import numpy as np
import synthetic_piano

from pianofit.literature import typical
from pianofit.model.modal_response import ModalResponse
from pianofit.model.note import Note
from pianofit.schema.bridge import BridgeAdmittance
from pianofit.schema.decode import builtins_of
from pianofit.web import write_playable_page
from pianofit.web.payload import encode_note

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
# The same with free strings: shares of the time, and times of the precomputation in ms.
FREE_PROGRAM = """
import { readFileSync } from "node:fs";
const { decode, prepare } = await import(process.argv[1] + "/prepare.js");
const { BLOCK } = await import(process.argv[1] + "/contact.js");
const { FreeStrings } = await import(process.argv[1] + "/free_strings.js");
const { Engine } = await import(process.argv[1] + "/engine.js");
const { keys, runs, bridge, most } = JSON.parse(readFileSync(0, "utf8")), rate = 48000, budget = (1e3 * BLOCK) / rate;
const time = (act) => {
  const begin = process.cpuUsage(), result = act(), { user, system } = process.cpuUsage(begin);
  return [(user + system) / 1e3, result];
};
const decoded = new Map(keys.map((entry) => [entry.midi, decode(entry)])), least = {};
const [joined, free] = time(() => new FreeStrings(decoded, bridge, rate, most));
const [answered, responses] = time(() => new Map([...decoded.keys()].map((midi) => [midi, free.response(midi)])));
const tables = new Map([...decoded].map(([midi, key]) => [midi, prepare(key, rate)]));
const block = [0, 1].map(() => new Float64Array(BLOCK));
for (let run = 0; run < 2 * runs; run++) {
  const engine = new Engine(rate), name = run % 2 ? "free" : "alone";
  for (const [midi, table] of tables) engine.setKey(midi, table);
  if (run % 2) engine.setStrings(free.data);
  if (run % 2) for (const [midi, response] of responses) engine.setResponse(midi, response);
  engine.control(64, 127);
  for (const midi of [36, 48, 60, 64]) engine.noteOn(midi, 3);
  const part = (count) => time(() => { for (let i = 0; i < count; i++) engine.render(...block); })[0] / count / budget;
  part(200);
  least[name] = Math.min(least[name] ?? Infinity, part(400));
  if (name === "alone") continue;
  engine.noteOn(55, 3);
  part(10);
  const voice = engine.voices.get(55), [{ contact, velocityFactor }] = voice.strokes;
  const { blocks, resonance } = engine, touch = blocks - 12;
  const stroke = () => resonance._take({ midi: 55, voice, contact, velocityFactor, touch, taken: 0 }, blocks, true);
  least.stroke = Math.min(least.stroke ?? Infinity, time(() => { for (let i = 0; i < 50; i++) stroke(); })[0] / 50);
}
const { drive } = free.data, { dropped } = free.data;
console.log(JSON.stringify({ ...least, joined, answered, modes: drive.length, dropped }));
"""
# In the page: seconds from the navigation until there are keys, and until a key that is then struck sounds.
FIRST_SOUND = """async () => {
  while (!window.pianofitKeyboard) await new Promise((go) => setTimeout(go, 2));
  const ready = performance.now(), keys = window.pianofitKeyboard, heard = new Float32Array(2048);
  await keys.play(60, 90);
  const { player } = keys, listen = new AnalyserNode(player.context, { fftSize: heard.length });
  player.node.connect(listen);
  for (;;) {
    listen.getFloatTimeDomainData(heard);
    if (heard.some((x) => Math.abs(x) > 1e-5)) return [ready / 1e3, performance.now() / 1e3];
    await new Promise((go) => setTimeout(go, 2));
  }
}"""
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
ARGUMENTS = ("--headless", "--no-sandbox", "--disable-gpu", "--autoplay-policy=no-user-gesture-required")
RATE = 48_000


def measured_note(midi: int, modes: int) -> Note:
    """A key with so many modes, which all ring for long, and a knock of 0.4 s."""
    random, it = np.random.default_rng(midi), typical(midi)
    pole = -random.uniform(0.2, 0.5, modes) + 2j * np.pi * np.sort(random.uniform(60, 9000, modes))
    pattern = random.normal(size=(1, modes)) + 1j * random.normal(size=(1, modes))
    knock = random.normal(size=(1, round(0.412 * RATE))) * np.exp(-np.arange(round(0.412 * RATE)) / 5000)
    ringing = ModalResponse(np.arange(1, modes + 1), pole, np.zeros(modes), pattern, knock, RATE)
    return Note(it.string, it.hammer, it.geometry, "bridge-force", 0.1, None, ringing)


def by_law(midi: int, _: int) -> Note:
    """The literature's key; it has as many modes as it has."""
    it = typical(midi)
    return Note(it.string, it.hammer, it.geometry, "bridge-force", 0.1)


def by_fit(midi: int, _: int) -> Note:
    """A key as a fit of five stereo layers leaves it."""
    return synthetic_piano.measured_note(midi)


def free_strings(runs: int, most: int) -> None:
    """Measure what the free strings cost, and print."""
    keys = [{"midi": midi, **encode_note(synthetic_piano.measured_note(midi), midi)} for midi in range(21, 109)]
    given = {"keys": keys, "runs": runs, "bridge": builtins_of(BridgeAdmittance()), **({"most": most} if most else {})}
    command = ["node", "--input-type=module", "-e", FREE_PROGRAM, str(Path(str(files("pianofit.web"))))]
    done = subprocess.run(command, input=json.dumps(given), capture_output=True, text=True, check=True)
    part = json.loads(done.stdout)
    print(
        f"{part['modes']} free modes ({part['dropped']} dropped), four keys struck under the pedal: "
        f"{100 * (part['free'] - part['alone']):.0f} % of the time, and {100 * part['alone']:.0f} % for the keys; "
        f"a stroke {part['stroke']:.2f} ms; "
        f"before playing {part['joined']:.0f} ms, and {part['answered'] / len(keys):.1f} ms a key"
    )


def opened(runs: int) -> None:
    """Measure the page of 88 keys in chromium, and print."""
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        path = Path(folder) / "piano.html"
        piano = synthetic_piano.piano(range(21, 109))
        done = write_playable_page(path, piano)
        times, sizes = [], []
        for _ in range(runs):
            browser = play.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
            page = browser.new_page()
            page.goto("about:blank")
            before = _renderer()
            page.goto(path.as_uri())
            times.append(page.evaluate(FIRST_SOUND))
            page.wait_for_function(
                f"() => window.pianofitKeyboard.player.sent.size === {len(piano.keys)}", timeout=120_000
            )
            sizes.append(_renderer() - before)
            browser.close()
        print(f"{done}\n{path.stat().st_size / 1e6:.2f} MB; memory {max(sizes) / 2**20:.0f} MiB")
    for name, values in zip(("keys", "first sound"), zip(*times, strict=True), strict=True):
        print(f"{name}: {np.median(values):.2f} s after the navigation, {min(values):.2f} to {max(values):.2f}")


def _renderer() -> int:
    """Bytes of the largest of the browser's processes for pages; needs Linux's /proc."""
    parent, size = {}, {}
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            values = dict(line.split(":", 1) for line in status.read_text().splitlines())
            parent[int(values["Pid"])] = int(values["PPid"])
            if b"--type=renderer" in (status.parent / "cmdline").read_bytes():
                size[int(values["Pid"])] = int(values["VmRSS"].split()[0]) * 2**10
        except (OSError, KeyError):  # it has ended
            continue

    def ours(pid: int) -> bool:
        while pid in parent and pid != os.getpid():
            pid = parent[pid]
        return pid == os.getpid()

    return max((bytes_ for pid, bytes_ in size.items() if ours(pid)), default=0)


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--voices", type=int, default=32)
    options.add_argument("--modes", type=int, default=200)
    options.add_argument("--runs", type=int, default=8)
    options.add_argument("--free", action="store_true", help="free strings under the pedal")
    options.add_argument("--most", type=int, default=0, help="free modes, if not the page's own number")
    options.add_argument("--open", action="store_true", help="a page of 88 keys in chromium instead")
    asked = options.parse_args()
    if asked.open:
        opened(asked.runs)
        return
    if asked.free:
        free_strings(asked.runs, asked.most)
        return
    node = shutil.which("node")
    if node is None:
        raise SystemExit("node is not installed (Debian: apt-get install nodejs)")
    scripts = str(Path(str(files("pianofit.web"))))
    for name, kind in (("measured modes", measured_note), ("the string's own", by_law), ("as fitted", by_fit)):
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
