// Comparison of a key with its recordings: each layer and the instrument at the same velocity and loudness.

const CEILING = 0.891; // full scale: -1 dB
const WAYS = ["Recording", "Instrument"]; // sources of a layer

class Compare {
  constructor(player, recordings, changesOf) {
    Object.assign(this, { player, recordings, changesOf, midi: null, deck: null, layer: 0, way: 0, decoded: new Map() });
    this.root = byId("compare");
    this.find("play").onclick = () => this.toggle();
    this.ways = WAYS.map((words, way) => this._button("ways", words, () => this.choose(this.layer, way)));
    addEventListener("keydown", ({ key, target, ctrlKey, metaKey, altKey }) => {
      const way = ["1", "2"].indexOf(key), typed = target.closest?.("input:not([type=range])");
      if (way >= 0 && this.deck && !(ctrlKey || metaKey || altKey || typed)) this.choose(this.layer, way);
    });
  }

  find(id) {
    return byId(`compare-${id}`);
  }

  _button(where, words, act) {
    return put(this.find(where), "button", { type: "button", textContent: words, onclick: act });
  }

  /** Show a key, if it was recorded. */
  show(midi, name) {
    if (midi === this.midi) return;
    this.deck?.stop();
    const layers = this.recordings[midi];
    this.root.hidden = !layers;
    Object.assign(this, { midi, deck: null, stamp: null, layer: 0 });
    if (!layers) return;
    this.find("which").textContent = name;
    this.find("layers").replaceChildren();
    this.layers = layers.map(({ velocity }, i) =>
      this._button("layers", `${velocity.toPrecision(2)} ${this.player.unit}`, () => this.choose(i, this.way)));
    this.layers.forEach((button, i) => (button.title = layers[i].name));
    this._mark("Press Play.");
  }

  async toggle() {
    if (this.deck?.playing) {
      this.deck.stop();
      return this._mark("Paused.");
    }
    Deck.contextOf(RATE).resume(); // must happen within the user gesture
    const { midi } = this;
    this._mark("Rendering.");
    const deck = await this._ready(midi);
    if (midi !== this.midi) return; // another key was played in the meantime
    this.deck = deck;
    deck.choose(this._index());
    deck.start();
    this._mark();
  }

  choose(layer, way) {
    Object.assign(this, { layer, way });
    if (this.deck && this.stamp !== this._stamp()) { // a slider was moved in the meantime
      const { playing } = this.deck;
      this.deck.stop();
      if (playing) return this.toggle();
    }
    this.deck?.choose(this._index());
    this._mark();
  }

  _stamp() {
    return JSON.stringify(this.changesOf(this.midi));
  }

  _index() {
    return WAYS.length * this.layer + this.way;
  }

  /** A deck of all layers, alternating recording and instrument with its current changes. */
  async _ready(midi) {
    const stamp = this._stamp(), position = this.deck?.position ?? 0;
    if (this.deck && this.stamp === stamp) return this.deck;
    const recorded = await this._decoded(midi), length = Math.min(...recorded.map(([channel]) => channel.length));
    const sounds = recorded.flatMap((channels, i) => [
      channels.map((x) => x.subarray(0, length)), this._render(midi, this.recordings[midi][i].velocity, length),
    ]);
    const gains = this.player.matched(sounds, RATE, CEILING);
    const clips = sounds.map((channels, i) => ({ rate: RATE, length, channels: channels.map((x) => x.map((y) => y * gains[i])) }));
    const deck = new Deck(() => [], (words) => this._mark(`${words}.`), length / RATE);
    Object.assign(deck, { decoded: clips, position });
    this.stamp = stamp;
    return deck;
  }

  async _decoded(midi) {
    if (!this.decoded.has(midi)) {
      const bytes = ({ flac }) => Uint8Array.from(atob(flac), (c) => c.charCodeAt(0)).buffer;
      const reader = new OfflineAudioContext(1, 1, RATE);
      const buffers = await Promise.all(this.recordings[midi].map((layer) => reader.decodeAudioData(bytes(layer))));
      this.decoded.set(midi, buffers.map((b) => Array.from({ length: b.numberOfChannels }, (_, c) => b.getChannelData(c))));
    }
    return this.decoded.get(midi);
  }

  /** Render a stroke of the key at `velocity`, m/s; both channels [length]. */
  _render(midi, velocity, length) {
    const { Engine, BLOCK } = this.player, engine = new Engine(RATE);
    const table = this.player.table(midi), { padding } = table.response;
    const size = Math.ceil((padding + length) / BLOCK) * BLOCK;
    const sound = [0, 1].map(() => new Float32Array(size)), block = [0, 1].map(() => new Float64Array(BLOCK));
    engine.setKey(midi, table);
    engine.noteOn(midi, velocity);
    for (let at = 0; at < size; at += BLOCK) {
      engine.render(...block);
      sound.forEach((x, c) => x.set(block[c], at));
    }
    return sound.map((x) => x.subarray(padding, padding + length));
  }

  _mark(words) {
    const playing = Boolean(this.deck?.playing), { velocity, name } = this.recordings[this.midi]?.[this.layer] ?? {};
    this.find("play").textContent = playing ? "❚❚ Pause" : "▶ Play";
    this.layers?.forEach((button, i) => button.setAttribute("aria-pressed", String(i === this.layer)));
    this.ways.forEach((button, i) => button.setAttribute("aria-pressed", String(i === this.way)));
    const source = this.way ? `the instrument at ${velocity?.toPrecision(2)} ${this.player.unit}` : name;
    this.find("said").textContent = words ?? `${playing ? "Playing" : "Selected"}: ${source}.`;
  }
}
