"""The engine of the page in node, and a key with a modal response, for comparison with the model."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from instrument_cases import true_note

from pianofit.instrument import Instrument
from pianofit.model.modal_response import ModalResponse, VelocityGain
from pianofit.model.note import Note
from pianofit.playback import Song
from pianofit.web.payload import encode_instrument

RATE = 48_000
BLOCK = 128  # samples; events take effect at the beginning of a block
STEP = BLOCK / RATE  # s, between times at which events take effect
CONTROLLERS = {64: "pedal", 66: "sostenuto", 67: "una_corda"}
SCRIPTS = Path(str(files("pianofit.web")))
# Reads {rate, jobs: [{keys, changes?, events: [[block, what, value]], blocks}]}; writes every job's channels. Jobs with
# `note`, `instrument`, `song` or `record` have one result: a document, or a MIDI file read or written. With
# `bridge` free strings resonate, at most `most` modes. With `sizes` the result is the size of the engine's state.
PROGRAM = """
import { readFileSync } from "node:fs";
const names = ["prepare", "contact", "free_strings", "release", "engine", "output", "change", "note", "instrument",
  "midi", "record"];
const parts = await Promise.all(names.map((name) => import(`${process.argv[1]}/${name}.js`)));
const all = Object.assign({}, ...parts);
const { BLOCK, Engine, FreeStrings, Output, Record, altered, changed, decode, encodeWav, prepare } = all;
const { rate, jobs } = JSON.parse(readFileSync(0, "utf8"));
const base64 = (bytes) => Buffer.from(bytes.buffer).toString("base64");
const text = (value) => [Buffer.from(JSON.stringify(value)).toString("base64")];
const songOf = (bytes) => {
  try {
    return all.readMidi(new Uint8Array(Buffer.from(bytes, "base64")));
  } catch (error) {
    return { error: error.message };
  }
};
const sizesOf = (engine) => ({ sounding: engine.sounding, noises: engine.noises.length, history: engine.history.length,
  pending: engine.resonance.pending.length, atRest: engine.resonance.isAtRest, struck: engine.struck.size,
  strokes: [...engine.voices.values()].map((voice) => voice.strokes.length + voice.waiting.length) });
const saved = (instrument, changes, volume) => {
  const releases = all.decodeReleases(instrument.releases);
  return all.instrumentDocument({ ...instrument, releases }, instrument.keys.map((entry) => {
    const own = altered(changes[entry.midi] ?? {});
    return { key: changed(decode(entry), own), changes: own };
  }), volume);
};
const played = jobs.map((job) => {
  const { keys, changes, events, blocks, output, wav, note, instrument, volume, song, record } = job;
  const { bridge, most, releases, sizes } = job;
  if (song !== undefined) return text(songOf(song));
  if (record) {
    const past = new Record(record.longest);
    for (const { at, ...message } of record.events) past.add(message, at);
    return [base64(past.midi((speed) => speed))];
  }
  if (instrument) return text(saved(instrument, changes, volume));
  if (note) {
    const key = decode(keys[60]);
    return text(all.noteDocument(changes ? changed(key, changes) : key, note));
  }
  const engine = new Engine(rate), out = new Output(rate, BLOCK);
  const sound = [0, 1].map(() => new Float64Array(blocks * BLOCK));
  const decoded = new Map(Object.entries(keys).map(([midi, entry]) =>
    [Number(midi), changes ? changed(decode(entry), changes) : decode(entry)]));
  for (const [midi, key] of decoded) engine.setKey(midi, prepare(key, rate));
  if (bridge) {
    const free = new FreeStrings(decoded, bridge, rate, most);
    engine.setStrings(free.data);
    for (const midi of decoded.keys()) engine.setResponse(midi, free.response(midi));
  }
  if (releases) engine.setReleases(all.releaseNoises(all.decodeReleases(releases), decoded.keys(), rate));
  for (let i = 0; i < blocks; i++) {
    for (const [block, what, ...value] of events) if (block === i) engine[what](...value);
    const here = sound.map((x) => x.subarray(i * BLOCK, (i + 1) * BLOCK));
    engine.render(...here);
    if (output) out.pass(here).forEach((x, c) => here[c].set(x));
  }
  if (sizes) return text(sizesOf(engine));
  return wav ? [base64(encodeWav(sound, rate))] : sound.map(base64);
});
console.log(JSON.stringify(played));
"""


def node() -> str:
    """Path of node; skips the test if it is not installed."""
    found = shutil.which("node")
    if found is None:
        pytest.skip("node is not installed (Debian: apt-get install nodejs)")
    return found


def run(jobs: list[dict], rate: int = RATE) -> list[list[bytes]]:
    """Results of the engine for jobs, see `PROGRAM`."""
    command = [node(), "--input-type=module", "-e", PROGRAM, str(SCRIPTS)]
    done = subprocess.run(command, input=json.dumps({"rate": rate, "jobs": jobs}), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [[base64.b64decode(text) for text in job] for job in json.loads(done.stdout)]


def play(jobs: list[dict], rate: int = RATE) -> list[np.ndarray]:
    """Both channels of every job [2, samples]."""
    return [np.stack([np.frombuffer(data) for data in job]) for job in run(jobs, rate)]


def early(note: Note) -> int:
    """Samples of padding before a sound of the note, because the lead of the engine is in whole blocks."""
    return -round(note.pre_onset_s * RATE) % BLOCK


def error_db(sound: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference relative to the largest sample, dB."""
    size = min(sound.shape[-1], expected.shape[-1])
    return 20 * np.log10(np.abs(sound[..., :size] - expected[..., :size]).max() / np.abs(expected).max())


def ringing_note(midi: int, channels: int = 2, rate: int = 44_100) -> Note:
    """A key with two modes per partial, of different decay rates, and a knock that begins before the contact."""
    random, note = np.random.default_rng(midi), true_note(midi)
    partials = note.frequencies(40)
    partials = partials[partials < 16_000]
    k = np.repeat(np.arange(1, len(partials) + 1), 2)
    pole = -np.tile([1.0, 8.0], len(partials)) * (1 + 0.1 * k) + 2j * np.pi * partials[k - 1] * (
        1 + 1e-3 * random.normal(size=len(k))
    )
    pattern = random.normal(size=(channels, len(k))) + 1j * random.normal(size=(channels, len(k)))
    knock = random.normal(size=(channels, round(0.412 * rate))) * np.exp(-np.arange(round(0.412 * rate)) / rate / 0.05)
    factor = 1 + 0.2 * (random.normal(size=(3, len(k))) + 1j * random.normal(size=(3, len(k))))
    part = VelocityGain(np.array([0.5, 1.5, 4.0]), factor)
    ringing = ModalResponse(k, pole, np.zeros(len(k)), 2 * pattern / k, 40 * knock, rate, part)
    return note._replace(gain=1.5, modal_response=ringing)


def on_block(seconds: float) -> float:
    """The nearest time at which events take effect in the page."""
    return round(seconds / STEP) * STEP


def walk(seed: int, step: float, seconds: float) -> list[tuple[float, int]]:
    """A controller that wanders, and jumps now and then."""
    random, value, moves = np.random.default_rng(seed), 0, []
    for t in np.arange(0.0, seconds, step):
        wander = int(np.clip(value + random.integers(-20, 21), 0, 127))
        value = int(random.integers(0, 128)) if random.random() < 0.15 else wander
        moves.append((on_block(t), value))
    return moves


def page_job(piano: Instrument, song: Song, resonance: bool = True, most_bytes: int = 10**9, **more: object) -> dict:
    """Payload and events of a song for the page's engine."""
    document, _ = encode_instrument(piano, most_bytes)
    rows: list[tuple[float, int, Sequence[object]]] = []
    for controller, name in CONTROLLERS.items():
        rows += [(t, controller, ("control", controller, value)) for t, value in getattr(song, name)]
    for key, events in song.keys.items():
        for t, velocity in events:
            speed = piano.velocity.at(velocity)
            release = song.release_velocities.get((key, t), 64)
            rows.append((t, 128, ("noteOn", key, speed) if velocity else ("noteOff", key, release)))
    rows.sort(key=lambda row: row[:2])
    return {
        "keys": {entry["midi"]: entry for entry in document["keys"]},
        "bridge": document["bridge"] if resonance else None,
        "releases": document["releases"],
        "events": [[round(t * RATE / BLOCK), *words] for t, _, words in rows],
        "blocks": round(song.seconds * RATE / BLOCK),
        **more,
    }
