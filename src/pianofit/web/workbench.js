// Parameters of the last played key: sliders, undo, and plots of the force pulse and the mode levels.

// Changes for `changed` of change.js. Every slider except that of the exponent is a factor on a logarithmic scale.
const SLIDERS = [
  { name: "force", ofHammer: true, words: "Felt force at the reference compression", from: 0.125, to: 8, unit: "N" },
  { name: "p", ofHammer: true, words: "Felt exponent p", from: -1, to: 1, unit: "" },
  { name: "mu", ofHammer: true, words: "Felt loss coefficient μ", from: 0.125, to: 8, unit: "s/m" },
  { name: "mass", ofHammer: true, words: "Hammer mass", from: 0.25, to: 4, unit: "g" },
  { name: "strike", words: "Position of the stroke", from: 0.25, to: 4, unit: "of the length" },
  { name: "loss", words: "String losses", from: 0.125, to: 8, unit: "1/s for partial 1" },
  { name: "inharmonicity", words: "Inharmonicity B", from: 0.125, to: 8, unit: "" },
];
const STEPS = 100; // of a slider in each direction

const byId = (id) => document.getElementById(id);

/** What the label of a slider adds to its words and to its value, from the key and the player. */
const ADDED = {
  force: ({ hammer, compression, geometry }, player) => ({
    words: ` (${shortened(1e3 * compression)} mm)`,
    value: `, ${shortened(player.staticForce(hammer, compression) / geometry.mass)} N/kg`,
  }),
};
const shortened = (x) => Number(x.toPrecision(3));

/** The displayed value of each slider, from the key and the player. */
const SHOWN = {
  force: ({ hammer, compression }, player) => player.staticForce(hammer, compression),
  p: ({ hammer }) => hammer.p,
  mu: ({ hammer }) => hammer.mu,
  mass: ({ hammer }) => 1e3 * hammer.M_H,
  strike: ({ geometry }) => geometry.strike_position / geometry.length,
  loss: ({ string, geometry }) => string.b1 + string.b2 * (Math.PI / geometry.length) ** 2,
  inharmonicity: ({ string, geometry }) => ((string.kappa * Math.PI) / (string.c * geometry.length)) ** 2,
};

class Workbench {
  constructor(player, say) {
    Object.assign(this, { player, say, midi: null, all: {}, single: new Map(), past: [] });
    this.root = byId("workbench");
    this.forAll = byId("for-all");
    this.sliders = SLIDERS.filter(({ ofHammer }) => player.isStruck || !ofHammer);
    byId("pulse").closest("figure").hidden = !player.isStruck;
    this.inputs = new Map(this.sliders.map((slider) => [slider.name, this._slider(slider)]));
    byId("undo").onclick = () => this.undo();
    byId("reset").onclick = () => this.reset();
    byId("save-note").onclick = () => this.save();
    byId("save-instrument").onclick = () => this.saveInstrument();
    this.buttons();
    new ResizeObserver(() => this.draw()).observe(byId("pulse"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  _slider({ name, words, from, to }) {
    const label = put(this.root.querySelector(".sliders"), "label");
    const title = put(label, "span", { textContent: words });
    const value = put(label, "output"), track = put(label, "span", { className: "track" }), interval = put(label, "small");
    const band = put(track, "i"), id = `change-${name}`;
    const input = put(track, "input", { type: "range", min: -STEPS, max: STEPS, step: 1, value: 0, id });
    const scale = (n) => (from < 0 ? (n / STEPS) * to : to ** (n / STEPS));
    input.addEventListener("pointerdown", () => (this.begun = false));
    input.addEventListener("input", () => this._move(name, scale(Number(input.value))));
    input.addEventListener("change", () => (this.begun = false));
    const back = (x) => (from < 0 ? x / to : Math.log(x) / Math.log(to)) * STEPS;
    return { input, title, value, back, band, interval };
  }

  /** Show the 95 % interval of the key: a band on the slider, clipped at its ends, and numbers. */
  _interval(slider, unit) {
    const { band, interval, back } = this.inputs.get(slider), fitted = this.player.keys.get(this.midi);
    const span = fitted.intervals?.[slider];
    band.hidden = interval.hidden = !span;
    if (!span) return;
    const [left, right] = span.map((x) => Math.min(Math.max(back(x) / (2 * STEPS) + 0.5, 0), 1));
    band.style.setProperty("--left", left);
    band.style.setProperty("--right", right);
    const value = SHOWN[slider](fitted, this.player);
    const shown = span.map((x) => Number((slider === "p" ? value + x : value * x).toPrecision(3)));
    interval.textContent = `95 %: ${shown.join(" to ")} ${unit}`.trim();
  }

  /** Apply the movement of a slider. One drag is one step of undo. */
  _move(name, value) {
    if (this.midi === null) return;
    if (!this.begun) this._remember();
    this.begun = true;
    const to = this.forAll.checked ? this.all : this.single.get(this.midi) ?? {};
    to[name] = value;
    if (this.forAll.checked) for (const changes of this.single.values()) delete changes[name];
    else this.single.set(this.midi, to);
    this.apply(this.forAll.checked ? [...this.player.keys.keys()] : [this.midi]);
  }

  _remember() {
    this.past.push(structuredClone({ all: this.all, single: this.single }));
  }

  changesOf(midi) {
    return this.player.altered({ ...this.all, ...this.single.get(midi) });
  }

  apply(keys) {
    for (const midi of keys) this.player.change(midi, this.changesOf(midi));
    this.buttons();
    this.show(this.midi);
  }

  undo() {
    if (this.past.length) Object.assign(this, this.past.pop());
    this.begun = false;
    this.apply([...this.player.keys.keys()]);
    this.say("Last change undone.");
  }

  reset() {
    this._remember();
    Object.assign(this, { all: {}, single: new Map(), begun: false });
    this.apply([...this.player.keys.keys()]);
    this.say("All changes removed.");
  }

  save() {
    const isChanged = Object.keys(this.changesOf(this.midi)).length > 0;
    const content = this.player.noteOf(this.midi, this.velocity, isChanged);
    save("note.json", `${JSON.stringify(content, null, 1)}\n`, "application/json");
    this.say(`Saved: note.json, ${this.name}${isChanged ? ", changed by hand" : ""}.`);
  }

  saveInstrument() {
    const content = this.player.document((midi) => this.changesOf(midi));
    const count = content.keys.filter(({ changes }) => changes).length;
    save("instrument.json", `${JSON.stringify(content)}\n`, "application/json");
    this.say(`Saved: instrument.json, ${count ? `${count} key${count > 1 ? "s" : ""} changed by hand` : "no key changed"}.`);
  }

  buttons() {
    byId("undo").disabled = !this.past.length;
    byId("reset").disabled = !Object.keys(this.all).length && !this.single.size;
  }

  /** Show a key. */
  show(midi, name = this.name, velocity = this.velocity) {
    if (midi === null) return;
    Object.assign(this, { midi, name, velocity });
    this.root.hidden = false;
    byId("which").textContent = name;
    const key = this.player.now[midi], changes = { ...this.player.UNCHANGED, ...this.changesOf(midi) };
    for (const { name: slider, unit, words } of this.sliders) {
      const { input, title, value, back } = this.inputs.get(slider), added = ADDED[slider]?.(key, this.player);
      title.textContent = words + (added?.words ?? "");
      value.textContent = `${shortened(SHOWN[slider](key, this.player))} ${unit}`.trim() + (added?.value ?? "");
      input.value = Math.round(back(changes[slider]));
      this._interval(slider, unit);
      input.setAttribute("aria-valuetext", value.textContent);
    }
    cancelAnimationFrame(this.frame);
    this.frame = requestAnimationFrame(() => this.draw());
  }

  draw() {
    const { player, midi, velocity } = this;
    if (midi === null) return;
    const now = player.stroke(player.table(midi), velocity);
    if (!player.fittedTables.has(midi)) player.fittedTables.set(midi, player.prepare(player.keys.get(midi), RATE));
    const fitted = player.stroke(player.fittedTables.get(midi), velocity);
    const isChanged = Object.keys(this.changesOf(midi)).length > 0;
    const peak = Math.max(...now.force), end = Math.max(now.force.length, fitted.force.length) * now.step;
    const shown = (x) => x.toPrecision(3), lasts = 1e3 * now.force.length * now.step;
    byId("pulse-words").textContent =
      `Force pulse at ${shown(velocity)} ${player.unit}: peak ${shown(peak)} N, contact ends after ${shown(lasts)} ms.`;
    const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);
    const both = [...(isChanged ? [[fitted, colour("--edge")]] : []), [now, colour("--fitted")]];
    const most = 1.05 * Math.max(peak, ...fitted.force);
    if (player.isStruck) paint("pulse", [0, 1e3 * end, "ms"], [0, most, "N"], (pen, x, y) => {
      for (const [{ force, step }, ink] of both) {
        pen.strokeStyle = ink;
        pen.lineWidth = 2;
        pen.beginPath();
        force.forEach((f, n) => pen.lineTo(x(1e3 * n * step), y(f)));
        pen.stroke();
      }
    });
    const top = Math.max(...now.level, ...fitted.level), high = Math.min(20000, 1.1 * Math.max(...now.frequency));
    paint("levels", [0.8 * now.frequency[0], high, "Hz"], [top - 80, top + 4, "dB"], (pen, x, y) => {
      for (const [{ frequency, level }, ink] of both) {
        pen.strokeStyle = pen.fillStyle = ink;
        pen.lineWidth = 1.5;
        frequency.forEach((f, k) => {
          if (level[k] < top - 80) return;
          pen.beginPath();
          pen.moveTo(x(f), y(top - 80));
          pen.lineTo(x(f), y(level[k]));
          pen.stroke();
          pen.fillRect(x(f) - 2, y(level[k]) - 2, 4, 4);
        });
      }
    }, true);
  }
}

/** Draw axes on a canvas, and a plot by `draw(pen, x, y)`. */
function paint(id, [left, right, across], [low, high, up], draw, logarithmic = false) {
  const canvas = byId(id), pen = canvas.getContext("2d"), by = devicePixelRatio;
  const width = canvas.clientWidth, height = canvas.clientHeight, edge = 46, foot = 24;
  [canvas.width, canvas.height] = [width * by, height * by];
  pen.scale(by, by);
  const soft = getComputedStyle(document.documentElement).getPropertyValue("--soft");
  const scale = logarithmic ? Math.log : (v) => v;
  const x = (v) => edge + ((width - edge - 12) * (scale(v) - scale(left))) / (scale(right) - scale(left));
  const y = (v) => 8 + ((height - foot - 8) * (high - v)) / (high - low);
  pen.fillStyle = soft;
  pen.font = "12px system-ui, sans-serif";
  pen.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue("--line");
  pen.lineWidth = 1;
  const line = (...points) => {
    pen.beginPath();
    points.forEach(([a, b]) => pen.lineTo(a, b));
    pen.stroke();
  };
  const ticks = logarithmic
    ? [20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000].filter((v) => v > left && v < right)
    : round(left, right, Math.max(2, width / 90));
  pen.textAlign = "center";
  ticks.forEach((v, i) => {
    line([x(v), 8], [x(v), height - foot]);
    pen.fillText(i === ticks.length - 1 ? `${v} ${across}` : String(v), Math.min(x(v), width - 24), height - 7);
  });
  pen.textAlign = "right";
  round(low, high, 6).forEach((v, i, all) => {
    line([edge, y(v)], [width - 12, y(v)]);
    pen.fillText(i === all.length - 1 ? `${v} ${up}` : String(v), edge - 5, y(v) + 4);
  });
  pen.save();
  pen.beginPath();
  pen.rect(edge, 0, width - edge, height - foot);
  pen.clip();
  draw(pen, x, y);
  pen.restore();
}

/** About `count` round numbers between two limits. */
function round(low, high, count) {
  const rough = (high - low) / count, ten = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((n) => n * ten).find((n) => n >= rough), first = Math.ceil(low / step);
  const length = Math.floor(high / step) - first + 1;
  return Array.from({ length }, (_, i) => Number(((first + i) * step).toPrecision(6)));
}
