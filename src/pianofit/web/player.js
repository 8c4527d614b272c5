// The player: the engine in the audio thread, the tables of the keys, and a record of all events.

const RATE = 48000; // Hz; the browser converts to the rate of the device
const LONGEST = 600; // s, length of the record that can be saved as MIDI
const LONGEST_SOUND = 60; // s, part of it that can be saved as WAV
const TAIL = 6; // s after the last event in the WAV file
const PAUSE = 20; // ms between tables that are sent during playback
const SETTLED = 300; // ms without a further change of a string, after which free strings are computed

/** Append an element of `kind` with `properties` to `parent`. */
function put(parent, kind, properties = {}) {
  const element = Object.assign(document.createElement(kind), properties);
  parent.append(element);
  return element;
}

const blob = (...parts) => URL.createObjectURL(new Blob(parts, { type: "text/javascript" }));

/** Offer a file as a download. */
function save(name, content, type) {
  const link = document.createElement("a");
  Object.assign(link, { href: URL.createObjectURL(new Blob([content], { type })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60e3);
}

/** Load code into the audio thread from a blob, or from a data address: Chromium blocks blobs of local files. */
async function addModule(context, code) {
  try {
    await context.audioWorklet.addModule(blob(code));
  } catch {
    await context.audioWorklet.addModule(`data:text/javascript;charset=utf-8,${encodeURIComponent(code)}`);
  }
}

class Player {
  /** code: the scripts `engine` and `worklet` as text. */
  static async open(instrument, code) {
    return new Player(instrument, code, await import(blob(code.engine)));
  }

  constructor({ name, keys, velocity, even, bridge, dampers, releases = [], noise = null }, code, modules) {
    Object.assign(this, modules, { code, name, velocity, even, bridge, dampers, noise, volume: 1, tables: new Map(),
      sent: new Set(), fittedTables: new Map(), sounding: 0, port: null, record: new modules.Record(LONGEST) });
    Object.assign(this, { pedals: new Map(), range: modules.PEDAL_RANGE, hasResonance: true, free: null, responses: new Map() });
    this.releases = this.decodeReleases(releases);
    this.keys = new Map(keys.map((entry) => [entry.midi, this.decode(entry)]));
    this.now = { ...Object.fromEntries(this.keys) }; // keys with the changes of the sliders
  }

  /** Whether the strings are struck by hammers, or else plucked. */
  get isStruck() {
    return Boolean([...this.keys.values()][0].hammer);
  }

  /** Unit of the size of a stroke: a velocity or a force. */
  get unit() {
    return this.isStruck ? "m/s" : "N";
  }

  /** Size of a stroke, hammer velocity, m/s, or force of a pluck, N, of MIDI velocity 1 to 127. */
  speed(midiVelocity) {
    const { at_64: middle, rise } = this.velocity;
    return Math.min(Math.max(middle * Math.exp((rise * (midiVelocity - 64)) / 63), 0.01), 20);
  }

  /** MIDI velocity, 1 to 127, of a hammer velocity, m/s. */
  midiVelocity(speed) {
    const { at_64: middle, rise } = this.velocity;
    return Math.min(Math.max(Math.round(64 + (63 * Math.log(speed / middle)) / rise), 1), 127);
  }

  /** Table of a key, computed on first use. */
  table(midi) {
    if (!this.tables.has(midi)) this.tables.set(midi, this.prepare(this.now[midi], RATE));
    return this.tables.get(midi);
  }

  /** Compute the tables of keys, by default of all, from the middle outwards; `progress` gets their number. */
  async prepareAll(progress, keys = [...this.keys.keys()]) {
    const order = [...keys].sort((a, b) => Math.abs(a - 60) - Math.abs(b - 60));
    for (const [done, midi] of order.entries()) {
      await new Promise((go) => setTimeout(go));
      this.send(midi);
      progress(done + 1, order.length);
    }
  }

  /** Free strings with the current changes, computed on first use; null for a note alone. */
  strings() {
    if (!this.bridge || this.keys.size < 2) return null;
    const keys = new Map([...this.keys.keys()].map((midi) => [midi, this.now[midi]]));
    return (this.free ??= new this.FreeStrings(keys, this.bridge, RATE));
  }

  /** What a stroke on a key leaves on free strings, computed on first use. */
  response(midi) {
    if (!this.responses.has(midi)) this.responses.set(midi, this.strings().response(midi));
    return this.responses.get(midi);
  }

  /** Compute the free strings and all responses, and send them; `progress` gets the number of keys. */
  async prepareStrings(progress = () => {}) {
    const free = this.strings(), order = [...this.keys.keys()].sort((a, b) => Math.abs(a - 60) - Math.abs(b - 60));
    if (!free) return;
    this.port?.postMessage({ do: "strings", strings: free.data });
    for (const [done, midi] of order.entries()) {
      await new Promise((go) => setTimeout(go));
      if (this.free !== free) return; // a string was changed
      this.port?.postMessage({ do: "response", midi, response: this.response(midi) });
      progress(done + 1, order.length);
    }
  }

  /** Noises of keys that are let go, computed on first use. */
  noises() {
    return (this.noisesOfKeys ??= this.releaseNoises(this.releases, this.keys.keys(), RATE));
  }

  /** Start the audio, which browsers allow only after a user gesture. Throws the error of the browser. */
  start() {
    return (this.started ??= this._start());
  }

  async _start() {
    if (!window.AudioWorkletNode) throw new Error("this browser has no AudioWorklet; use a newer browser");
    const context = new AudioContext({ sampleRate: RATE, latencyHint: "interactive" });
    await addModule(context, this.code.engine + this.code.worklet);
    const node = new AudioWorkletNode(context, "piano", { numberOfInputs: 0, outputChannelCount: [2] });
    node.connect(context.destination);
    node.port.onmessage = ({ data }) => (this.sounding = data.sounding);
    node.onprocessorerror = () => this.onerror?.(new Error("the audio thread has stopped; reload the page"));
    Object.assign(this, { context, node, port: node.port });
    this.port.postMessage({ do: "volume", volume: this.volume });
    this.port.postMessage({ do: "range", range: this.range });
    this.port.postMessage({ do: "resonance", isOn: this.hasResonance });
    if (this.releases.length) this.port.postMessage({ do: "releases", releases: this.noises() });
    await context.resume();
    this._sendAll();
  }

  /** Stop the audio permanently. */
  close() {
    this.context?.close();
  }

  /** Send all computed tables with pauses, so that the audio thread is not interrupted. */
  async _sendAll() {
    for (const midi of [...this.tables.keys()]) {
      await new Promise((go) => setTimeout(go, PAUSE));
      this.send(midi);
    }
    if (this.free) this.port.postMessage({ do: "strings", strings: this.free.data });
    for (const [midi, response] of this.responses) {
      await new Promise((go) => setTimeout(go, PAUSE));
      this.port.postMessage({ do: "response", midi, response });
    }
  }

  /** Send the table of a key to the audio thread. */
  send(midi) {
    const table = this.table(midi);
    if (!this.port || this.sent.has(midi)) return;
    this.sent.add(midi);
    this.port.postMessage({ do: "key", midi, table });
  }

  async act(message) {
    if (message.do === "on") {
      await this.start();
      if (this.context.state !== "running") this.context.resume(); // a phone call may have suspended it
      this.send(message.midi);
    } else if (this.started) {
      await this.started.catch(() => {}); // keeps the order of events
    }
    this.log(message);
    this.port?.postMessage(message);
  }

  /** Send a message that takes effect at a time of the audio context, s. It is not recorded; see `log`. */
  schedule(message, when) {
    if (message.do === "on") this.send(message.midi);
    this.port.postMessage({ ...message, when });
  }

  /** Drop all scheduled messages. */
  cancel() {
    this.port?.postMessage({ do: "cancel" });
  }

  /** Record a message that takes effect at a time, s; by default now. */
  log(message, at = performance.now() / 1000) {
    this.record.add(message, at);
  }

  on(midi, midiVelocity) {
    return this.act({ do: "on", midi, velocity: this.speed(midiVelocity) });
  }

  off(midi, velocity) {
    return this.act({ do: "off", midi, velocity });
  }

  /** Move a pedal: MIDI controller 64, 66 or 67, value 0 to 127. */
  control(controller, value) {
    this.pedals.set(controller, value);
    return this.act({ do: "control", controller, value });
  }

  /** Set the values of controller 64 between which dampers are lifted, {low, high}. */
  setRange(range) {
    this.range = range;
    this.port?.postMessage({ do: "range", range });
  }

  setResonance(isOn) {
    this.hasResonance = isOn;
    this.port?.postMessage({ do: "resonance", isOn });
  }

  setVolume(db) {
    this.volume = 10 ** (db / 20);
    return this.act({ do: "volume", volume: this.volume });
  }

  panic() {
    this.cancel();
    return this.act({ do: "panic" });
  }

  /** Document of a key with its current changes; see note.js. */
  noteOf(midi, velocity, isChanged) {
    const { note, recorded } = this.keys.get(midi);
    const origin = `${note} of ${this.name || "a piano"}, ${recorded ? "recorded" : "a guess"}, as the page plays it, ` +
      `${isChanged ? "changed by hand" : "unchanged"}. Not a fit: intervals are in the instrument and its fits.`;
    return this.noteDocument(this.now[midi], { velocity, rate: RATE, origin });
  }

  /** Apply changes to a key. Only changes of the hammer need no new table. */
  change(midi, changes) {
    const before = this.now[midi], key = this.changed(this.keys.get(midi), changes);
    const stringOf = ({ string, geometry }) => JSON.stringify([string, geometry]);
    this.now[midi] = key;
    if (stringOf(before) === stringOf(key) && this.tables.has(midi)) {
      this.tables.set(midi, { ...this.tables.get(midi), hammer: key.hammer });
      this.port?.postMessage({ do: "hammer", midi, hammer: key.hammer });
    } else {
      this.tables.delete(midi);
      this.sent.delete(midi);
      this.free = null;
      this.responses.clear();
      clearTimeout(this.changing);
      this.changing = setTimeout(() => this.prepareStrings(), SETTLED);
    }
  }

  /** Document of the instrument with all changes; `changesOf` returns the changes of a key. */
  document(changesOf) {
    const keys = [...this.keys.keys()].map((midi) => ({ key: this.now[midi], changes: changesOf(midi) }));
    return this.instrumentDocument(this, keys, this.volume);
  }

  /** The record as a MIDI file. */
  midi() {
    return this.record.midi((speed) => this.midiVelocity(speed));
  }

  /** Render the end of the record to a WAV file; `progress` gets the finished fraction. Null without a stroke. */
  async render(progress) {
    const engine = new this.Engine(RATE), output = new this.Output(RATE, this.BLOCK);
    const record = this.record.recent(LONGEST_SOUND);
    if (!record.length) return null;
    const first = record[0].at, seconds = record.at(-1).at - first + TAIL;
    const blocks = Math.ceil((seconds * RATE) / this.BLOCK);
    const sound = [0, 1].map(() => new Float32Array(blocks * this.BLOCK));
    const block = [0, 1].map(() => new Float64Array(this.BLOCK));
    const keys = new Set(record.flatMap((event) => (event.do === "on" ? [event.midi] : [])));
    for (const midi of keys) engine.setKey(midi, this.table(midi));
    if (this.hasResonance && this.strings()) {
      engine.setStrings(this.strings().data);
      for (const midi of keys) engine.setResponse(midi, this.response(midi));
    }
    engine.setReleases(this.noises());
    engine.setRange(this.range);
    for (let i = 0, next = 0; i < blocks; i++) {
      for (; next < record.length && record[next].at - first <= (i * this.BLOCK) / RATE; next++) {
        const event = record[next];
        if (event.do === "on") engine.noteOn(event.midi, event.velocity);
        if (event.do === "off") engine.noteOff(event.midi, event.velocity);
        if (event.do === "control") engine.control(event.controller, event.value);
        if (event.do === "volume") output.volume = event.volume;
        if (event.do === "panic") engine.panic();
      }
      engine.render(...block);
      output.pass(block).forEach((x, c) => sound[c].set(x, i * this.BLOCK));
      if (i % 500 === 0) {
        progress(i / blocks);
        await new Promise((go) => setTimeout(go));
      }
    }
    return this.encodeWav(sound, RATE);
  }
}
