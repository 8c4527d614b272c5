// What sounds: the engine in the audio thread, the tables it needs, and a record of what was played.

const RATE = 48000; // Hz, whatever the device has: the browser converts
const LONGEST = 600; // s of what was played that can be saved as MIDI
const LONGEST_SOUND = 60; // s of it that can be saved as a sound
const TAIL = 6; // s that it rings on in the file
const PAUSE = 20; // ms between tables that are sent while it may play

/** An element of `kind` with `properties`, in `parent`. */
function put(parent, kind, properties = {}) {
  const element = Object.assign(document.createElement(kind), properties);
  parent.append(element);
  return element;
}

const blob = (...parts) => URL.createObjectURL(new Blob(parts, { type: "text/javascript" }));

/** Hand a file to the user. */
function save(name, content, type) {
  const link = document.createElement("a");
  Object.assign(link, { href: URL.createObjectURL(new Blob([content], { type })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60e3);
}

/** Give the audio thread its code: by a blob or, for Chromium takes none of a page from a file, within the address. */
async function addModule(context, code) {
  try {
    await context.audioWorklet.addModule(blob(code));
  } catch {
    await context.audioWorklet.addModule(`data:text/javascript;charset=utf-8,${encodeURIComponent(code)}`);
  }
}

class Player {
  /** code: the scripts `engine` and `worklet`, as text. */
  static async open(instrument, code) {
    return new Player(instrument, code, await import(blob(code.engine)));
  }

  constructor({ name, keys, velocity }, code, modules) {
    Object.assign(this, modules, { code, name, velocity, pedal: false, volume: 1, tables: new Map(), sent: new Set(),
      own: new Map(), sounding: 0, port: null, record: new modules.Record(LONGEST) });
    this.keys = new Map(keys.map((entry) => [entry.midi, this.decode(entry)]));
    this.now = { ...Object.fromEntries(this.keys) }; // with the workbench's changes
  }

  /** Hammer velocity, m/s, of MIDI velocity 1 to 127. */
  speed(midiVelocity) {
    const { at_64: middle, rise } = this.velocity;
    return Math.min(Math.max(middle * Math.exp((rise * (midiVelocity - 64)) / 63), 0.01), 20);
  }

  /** MIDI velocity, 1 to 127, of a hammer velocity, m/s. */
  midiVelocity(speed) {
    const { at_64: middle, rise } = this.velocity;
    return Math.min(Math.max(Math.round(64 + (63 * Math.log(speed / middle)) / rise), 1), 127);
  }

  /** A key's table, computed if need be. */
  table(midi) {
    if (!this.tables.has(midi)) this.tables.set(midi, this.prepare(this.now[midi], RATE));
    return this.tables.get(midi);
  }

  /** Compute tables of keys, of all by default, from the middle outwards; `progress` gets how many are ready. */
  async prepareAll(progress, keys = [...this.keys.keys()]) {
    const order = [...keys].sort((a, b) => Math.abs(a - 60) - Math.abs(b - 60));
    for (const [done, midi] of order.entries()) {
      await new Promise((go) => setTimeout(go));
      this.send(midi);
      progress(done + 1, order.length);
    }
  }

  /** Begin to sound; only after a user's gesture. Throws what the browser has against it. */
  start() {
    return (this.started ??= this._start());
  }

  async _start() {
    if (!window.AudioWorkletNode) throw new Error("this browser has no AudioWorklet; take a newer one");
    const context = new AudioContext({ sampleRate: RATE, latencyHint: "interactive" });
    await addModule(context, this.code.engine + this.code.worklet);
    const node = new AudioWorkletNode(context, "piano", { numberOfInputs: 0, outputChannelCount: [2] });
    node.connect(context.destination);
    node.port.onmessage = ({ data }) => (this.sounding = data.sounding);
    node.onprocessorerror = () => this.onerror?.(new Error("the audio thread has stopped; open the page again"));
    Object.assign(this, { context, node, port: node.port });
    this.port.postMessage({ do: "volume", volume: this.volume });
    await context.resume();
    this._sendAll();
  }

  /** Be silent for ever. */
  close() {
    this.context?.close();
  }

  /** What is ready, one by one: the audio thread is not to be kept from its work. */
  async _sendAll() {
    for (const midi of [...this.tables.keys()]) {
      await new Promise((go) => setTimeout(go, PAUSE));
      this.send(midi);
    }
  }

  /** Give the audio thread a key. */
  send(midi) {
    const table = this.table(midi);
    if (!this.port || this.sent.has(midi)) return;
    this.sent.add(midi);
    this.port.postMessage({ do: "key", midi, table });
  }

  async act(message) {
    if (message.do === "on") {
      await this.start();
      if (this.context.state !== "running") this.context.resume(); // a telephone call may have stopped it
      this.send(message.midi);
    } else if (this.started) {
      await this.started.catch(() => {}); // what comes after a stroke stays after it
    }
    this.log(message);
    this.port?.postMessage(message);
  }

  /** A message that takes effect at a time of the audio context, s. It is not recorded; see `log`. */
  schedule(message, when) {
    if (message.do === "on") this.send(message.midi);
    this.port.postMessage({ ...message, when });
  }

  /** Drop what was scheduled and has not begun. */
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

  off(midi) {
    return this.act({ do: "off", midi });
  }

  setPedal(down) {
    this.pedal = down;
    return this.act({ do: "pedal", down });
  }

  setVolume(db) {
    this.volume = 10 ** (db / 20);
    return this.act({ do: "volume", volume: this.volume });
  }

  panic() {
    this.cancel();
    return this.act({ do: "panic" });
  }

  /** A key as it is played now, as a document; see note.js. */
  noteOf(midi, velocity, touched) {
    const { note, recorded } = this.keys.get(midi);
    const claims = `${note} of ${this.name || "a piano"}, ${recorded ? "recorded" : "a guess"}, as the page plays it, ` +
      `${touched ? "changed by hand" : "unchanged"}. No fit: intervals are in the instrument and its fits.`;
    return this.noteDocument(this.now[midi], { velocity, rate: RATE, claims });
  }

  /** A key with changes; only the hammer's need no new table. */
  change(midi, changes) {
    const before = this.now[midi], key = this.changed(this.keys.get(midi), changes);
    const string = ({ string: s, geometry: g }) => JSON.stringify([s, g]);
    this.now[midi] = key;
    if (string(before) === string(key) && this.tables.has(midi)) {
      this.tables.set(midi, { ...this.tables.get(midi), hammer: key.hammer });
      this.port?.postMessage({ do: "hammer", midi, hammer: key.hammer });
    } else {
      this.tables.delete(midi);
      this.sent.delete(midi);
    }
  }

  /** The instrument as it is played now, as a document; `changesOf` gives what was changed of a key. */
  document(changesOf) {
    const keys = [...this.keys.keys()].map((midi) => ({ key: this.now[midi], changes: changesOf(midi) }));
    return this.instrumentDocument(this, keys, this.volume);
  }

  /** What was played, as a MIDI file. */
  midi() {
    return this.record.midi((speed) => this.midiVelocity(speed));
  }

  /** What was played last, as a WAV file by the same engine; `progress` gets the part that is done. Null without a stroke. */
  async render(progress) {
    const engine = new this.Engine(RATE), output = new this.Output(RATE, this.BLOCK);
    const record = this.record.recent(LONGEST_SOUND);
    if (!record.length) return null;
    const first = record[0].at, seconds = record.at(-1).at - first + TAIL;
    const blocks = Math.ceil((seconds * RATE) / this.BLOCK);
    const sound = [0, 1].map(() => new Float32Array(blocks * this.BLOCK));
    const block = [0, 1].map(() => new Float64Array(this.BLOCK));
    for (const { midi } of record) if (midi && !engine.tables.has(midi)) engine.setKey(midi, this.table(midi));
    for (let i = 0, next = 0; i < blocks; i++) {
      for (; next < record.length && record[next].at - first <= (i * this.BLOCK) / RATE; next++) {
        const event = record[next];
        if (event.do === "on") engine.noteOn(event.midi, event.velocity);
        if (event.do === "off") engine.noteOff(event.midi);
        if (event.do === "pedal") engine.setPedal(event.down);
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
