// The page: a keyboard for mouse, touch, letters and MIDI, and its controls.

const SIGNS = "AWSEDFTGYHUJKOLP;"; // computer keys that play, in the layout of a piano
const LETTERS = Array.from(SIGNS, (sign) => (sign === ";" ? "Semicolon" : `Key${sign}`)); // their key codes
const BLACK = [1, 3, 6, 8, 10]; // semitones above C
const ALL_OFF = [120, 123]; // MIDI controllers
const DOWN = 127; // value of a pedal that is fully down

class Keyboard {
  constructor(player, entries) {
    Object.assign(this, { player, keys: new Map(), octave: 60, letters: new Map(), pointers: new Map() });
    // MIDI controllers by the ids of their buttons, and by the codes of their computer keys.
    this.pedals = { pedal: player.SUSTAIN, sostenuto: player.SOSTENUTO, soft: player.SOFT };
    this.pedalKeys = { Space: player.SUSTAIN, KeyV: player.SOSTENUTO, KeyC: player.SOFT };
    this.bench = new Workbench(player, (words) => this.say(words));
    this.song = new SongPlayer(player, (event) => this._show(event), (words) => this.say(words));
    const recordings = byId("recordings");
    if (recordings) {
      this.compare = new Compare(player, JSON.parse(recordings.textContent), (key) => this.bench.changesOf(key));
    }
    player.onerror = (error) => this.refuse(error);
    entries.forEach((entry) => this._key(entry));
    this._pointers();
    this._typed();
    this._controls();
    this._reachable(this.keys.has(60) ? 60 : entries[0].midi);
    this._mark();
    this._view(60);
    this._load();
    setInterval(() => (byId("sounding").textContent = player.sounding), 200);
  }

  say(words) {
    byId("said").textContent = words;
  }

  refuse(error) {
    byId("refused").hidden = false;
    byId("refused").textContent = `No sound: ${error.message}.`;
  }

  /** Compute all tables, then the free strings, and show the progress. */
  async _load() {
    const show = (what) => (done, all) => {
      byId("ready").value = done / all;
      byId("ready-words").textContent = `Computing ${what}: ${done} of ${all} keys`;
    };
    await this.player.prepareAll(show("tables"));
    await this.player.prepareStrings(show("resonance"));
    byId("loading").hidden = true;
  }

  _key({ midi, note, recorded, state }) {
    const black = BLACK.includes(midi % 12), changed = state === "changed" ? ", changed by hand" : "";
    const origin = `${recorded ? "recorded" : "a guess"}${changed}`;
    const className = `key ${black ? "black" : "white"}${recorded ? " recorded" : ""}`;
    const key = put(byId("keys"), "button", { type: "button", className, tabIndex: -1, title: `${note}, ${origin}` });
    key.dataset.midi = midi;
    key.setAttribute("aria-label", `${note.replace("#", " sharp ")}, ${origin}`);
    const letter = put(key, "kbd");
    put(key, "span", { textContent: midi % 12 === 0 || (recorded && !black) ? note : "" });
    this.keys.set(midi, { key, letter, note });
  }

  async play(midi, velocity = Number(byId("velocity").value)) {
    const played = this.keys.get(midi);
    if (!played) return;
    played.key.classList.add("down");
    try {
      await this.player.on(midi, velocity);
      this._recorded();
      this.bench.show(midi, played.note, this.player.speed(velocity));
      this.compare?.show(midi, played.note);
    } catch (error) {
      this.refuse(error);
    }
  }

  /** Enable saving. */
  _recorded() {
    for (const id of ["save", "save-midi"]) byId(id).disabled = false;
  }

  /** Show an event of the song player. */
  _show({ do: kind, midi, controller, value }) {
    if (kind === "control") {
      this.player.pedals.set(controller, value);
      this._showPedals();
    } else this.keys.get(midi).key.classList.toggle("down", kind === "on");
    this._recorded();
  }

  release(midi, velocity) {
    this.keys.get(midi)?.key.classList.remove("down");
    this.player.off(midi, velocity);
  }

  /** Move a pedal to a value from 0 to 127. */
  movePedal(controller, value) {
    this.player.control(controller, value);
    this._showPedals();
  }

  /** Press a pedal fully, or release it. */
  _toggle(controller) {
    this.movePedal(controller, this.player.pedals.get(controller) ? 0 : DOWN);
  }

  _showPedals() {
    for (const [id, controller] of Object.entries(this.pedals)) {
      const value = this.player.pedals.get(controller) ?? 0;
      byId(id).setAttribute("aria-pressed", value === DOWN ? "true" : value ? "mixed" : "false");
      if (controller !== this.player.SUSTAIN) continue;
      const { low, high } = this.player.range, words = value >= high ? "up" : value > low ? "half" : "down";
      byId("half").value = value;
      byId("half-words").textContent = `${value}, dampers ${words}`;
      byId("half").setAttribute("aria-valuetext", `${value}, dampers ${words}`);
    }
  }

  /** Set the range of half pedal; a range that is empty is kept from the player. */
  _setRange() {
    const [low, high] = ["range-low", "range-high"].map((id) => Number(byId(id).value));
    const isRange = low >= 0 && low < high && high <= DOWN;
    if (isRange) this.player.setRange({ low, high });
    else this.say("Half pedal needs two values from 0 to 127, the lower first.");
    this._showPedals();
  }

  /** Make one key reachable by Tab; arrows lead to the others. */
  _reachable(midi) {
    for (const [other, { key }] of this.keys) key.tabIndex = other === midi ? 0 : -1;
  }

  _pointers() {
    const at = ({ clientX, clientY }) => document.elementFromPoint(clientX, clientY);
    const keyAt = (event) => Number(at(event)?.closest(".key")?.dataset.midi);
    const to = (id, midi) => {
      const before = this.pointers.get(id);
      if (before === midi) return;
      if (before) this.release(before);
      this.pointers.set(id, midi);
      if (midi) this.play(midi);
    };
    byId("keys").addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || !keyAt(event)) return;
      event.target.releasePointerCapture(event.pointerId); // so that a finger can slide to other keys
      this._reachable(keyAt(event));
      to(event.pointerId, keyAt(event));
    });
    addEventListener("pointermove", (event) => this.pointers.has(event.pointerId) && to(event.pointerId, keyAt(event)));
    for (const end of ["pointerup", "pointercancel"]) {
      addEventListener(end, ({ pointerId }) => {
        to(pointerId, NaN);
        this.pointers.delete(pointerId);
      });
    }
  }

  _typed() {
    const elsewhere = ({ target }) => target.closest?.("input:not([type=range]), summary, a, button:not(.key)");
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const on = event.target.closest?.(".key"), midi = Number(on?.dataset.midi), { code } = event;
      const at = LETTERS.indexOf(code);
      if (event.target.closest?.("input:not([type=range], [type=checkbox])")) return;
      if (this.pedalKeys[code] && !(code === "Space" && elsewhere(event))) {
        event.preventDefault();
        if (!event.repeat) this._toggle(this.pedalKeys[code]);
      } else if (at >= 0 && !event.repeat) {
        this.letters.set(code, this.octave + at);
        this.play(this.octave + at);
      } else if ((code === "KeyZ" || code === "KeyX") && !event.repeat) {
        this._shift(code === "KeyX" ? 12 : -12);
      } else if (code === "Escape") {
        this.panic();
      } else if (on && code === "Enter") {
        event.preventDefault();
        if (!event.repeat) this.play(midi);
      } else if (on && ["ArrowLeft", "ArrowRight"].includes(code)) {
        event.preventDefault();
        const next = this.keys.get(midi + (code === "ArrowRight" ? 1 : -1));
        if (next) this._reachable(Number(next.key.dataset.midi));
        next?.key.focus();
      }
    });
    addEventListener("keyup", (event) => {
      if (this.letters.has(event.code)) this.release(this.letters.get(event.code));
      this.letters.delete(event.code);
      const on = event.target.closest?.(".key");
      if (on && event.code === "Enter") this.release(Number(on.dataset.midi));
      if (on && event.code === "Space") event.preventDefault();
    });
    addEventListener("blur", () => this._releaseAll());
  }

  _releaseAll() {
    for (const midi of [...this.letters.values(), ...this.pointers.values()]) if (midi) this.release(midi);
    this.letters.clear();
    this.pointers.clear();
  }

  panic() {
    this.song.stop();
    this._releaseAll();
    for (const controller of this.player.PEDALS) this.movePedal(controller, 0);
    this.player.panic();
    for (const { key } of this.keys.values()) key.classList.remove("down");
    this.say("Silence.");
  }

  _shift(by) {
    this.octave = Math.min(Math.max(this.octave + by, 24), 96);
    this._mark();
    this._view(this.octave);
    this.say(`Letters play from ${this.keys.get(this.octave)?.note ?? "C"} on.`);
  }

  /** Label keys with their letters. */
  _mark() {
    for (const [midi, { letter }] of this.keys) letter.textContent = SIGNS[midi - this.octave] ?? "";
  }

  _view(midi) {
    const key = this.keys.get(midi)?.key, frame = byId("frame");
    if (key) frame.scrollLeft = key.offsetLeft - Math.max((frame.clientWidth - 12 * key.offsetWidth) / 2, 8);
  }

  _controls() {
    const velocity = () => {
      const { value } = byId("velocity"), words = `${value}, ${this.player.speed(Number(value)).toPrecision(2)} ${this.player.unit}`;
      byId("velocity-words").textContent = words;
      byId("velocity").setAttribute("aria-valuetext", words);
    };
    const volume = () => {
      byId("volume-words").textContent = `${byId("volume").value} dB`;
      this.player.setVolume(Number(byId("volume").value));
    };
    byId("velocity").addEventListener("input", velocity);
    byId("volume").addEventListener("input", volume);
    velocity();
    volume();
    for (const [id, controller] of Object.entries(this.pedals)) byId(id).onclick = () => this._toggle(controller);
    byId("half").addEventListener("input", ({ target }) => this.movePedal(this.player.SUSTAIN, Number(target.value)));
    for (const id of ["range-low", "range-high"]) byId(id).addEventListener("change", () => this._setRange());
    byId("resonance").addEventListener("change", ({ target }) => this.player.setResonance(target.checked));
    this._showPedals();
    byId("panic").onclick = () => this.panic();
    byId("lower").onclick = () => this._shift(-12);
    byId("higher").onclick = () => this._shift(12);
    byId("midi").onclick = () => this._midi();
    byId("save").onclick = () => this._save();
    byId("save-midi").onclick = () => this._saveMidi();
  }

  async _midi() {
    try {
      if (!navigator.requestMIDIAccess) throw new Error("this browser has no Web MIDI");
      const access = await navigator.requestMIDIAccess();
      const listen = () => {
        for (const input of access.inputs.values()) input.onmidimessage = ({ data }) => this._message(data);
        const names = [...access.inputs.values()].map(({ name }) => name);
        this.say(names.length ? `Connected: ${names.join(", ")}.` : "No MIDI keyboard found; connect one.");
      };
      access.onstatechange = listen;
      listen();
    } catch (error) {
      this.say(`No MIDI: ${error.message}`);
    }
  }

  _message([status, data, value]) {
    const kind = status & 0xf0;
    if (kind === 0x90 && value > 0) this.play(data, value);
    else if (kind === 0x80 || kind === 0x90) this.release(data, kind === 0x80 ? value : undefined);
    else if (kind === 0xb0 && this.player.PEDALS.includes(data)) this.movePedal(data, value);
    else if (kind === 0xb0 && ALL_OFF.includes(data)) this.panic();
  }

  _saveMidi() {
    save("piano.mid", this.player.midi(), "audio/midi");
    this.say("Saved: piano.mid.");
  }

  async _save() {
    byId("save").disabled = true;
    const wav = await this.player.render((part) => this.say(`Rendering, ${Math.round(100 * part)} %.`));
    byId("save").disabled = false;
    if (!wav) return this.say("Nothing was played in the last minute.");
    save("piano.wav", wav, "audio/wav");
    return this.say(`Saved: ${(wav.length / 1e6).toFixed(1)} MB.`);
  }
}

const text = (id) => byId(id).textContent;
const instrument = JSON.parse(text("instrument"));
Player.open(instrument, { engine: text("engine"), worklet: text("worklet") }).then(
  (player) => (window.pianofitKeyboard = new Keyboard(player, instrument.keys)),
  (error) => {
    byId("refused").hidden = false;
    byId("refused").textContent =
      `This page cannot play here: ${error.message}. Allow its scripts to load from blob: addresses.`;
  },
);
