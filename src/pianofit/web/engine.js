// A fitted instrument in real time: strokes on strings that may still move, dampers, a pedal. No DOM, no libraries.
//
// Time goes on in blocks of 128 samples, at whose begin events take effect. Each key that sounds is a voice. A stroke's
// drive T, or force F where the key's ringing is known, sets resonators going and passes through a short kernel
// (prepare.js says which). Between strokes nothing is left but one complex amplitude a mode. All numbers are 64 bit.

import { BLOCK, Contact, Motion, addDamped, addDriven, longer, reversed, struck, turns, workspace } from "./contact.js";
import { driven } from "./prepare.js";

const FAINT = 1e-8; // of full scale, -160 dB: modes below are left out
const GONE = 1e-40; // a state's square, m² or (N s)²

/** Modes that ring: amplitudes re + i im, per mode, of which each channel hears gain · amplitude. */
class Bank {
  constructor({ pole, gain }, rate, ratio, damper) {
    const count = pole.re.length;
    Object.assign(this, { count, gain, re: new Float64Array(count), im: new Float64Array(count), still: true });
    // Free and damped.
    this.sample = [0, damper].map((extra) => turns(pole, 1 / rate, extra));
    this.block = [0, damper].map((extra) => turns(pole, BLOCK / rate, extra));
    this.step = turns(pole, 1 / (rate * ratio));
    this.work = workspace(count);
  }

  stop() {
    this.re.fill(0);
    this.im.fill(0);
    this.still = true;
  }

  /** Add a block of what is heard to `out` [channels], and move on. */
  ring(out, damped) {
    if (this.still) return;
    const { re, im, gain } = this, z = this.sample[Number(damped)], [a, b, c, d] = this.work;
    let loudest = 0;
    gain.forEach((g, channel) => {
      let n = 0;
      for (let k = 0; k < g.re.length; k++) {
        const x = g.re[k] * re[k] - g.im[k] * im[k], y = g.re[k] * im[k] + g.im[k] * re[k];
        if (x * x + y * y < FAINT * FAINT) continue;
        // Re(A z^i) by its own recursion: twice Re z times the last, less |z|² times the one before.
        a[n] = x;
        b[n] = x * z.re[k] - y * z.im[k];
        c[n] = 2 * z.re[k];
        d[n++] = -(z.re[k] * z.re[k] + z.im[k] * z.im[k]);
      }
      loudest = Math.max(loudest, n);
      addDamped(this.work, n, out[channel], BLOCK);
    });
    if (loudest) this.wait(damped);
    else this.stop();
  }

  /** Move on by a block, unheard. */
  wait(damped) {
    if (this.still) return;
    const z = this.block[Number(damped)], { re, im } = this;
    let size = 0;
    for (let k = 0; k < this.count; k++) {
      const x = re[k] * z.re[k] - im[k] * z.im[k], y = re[k] * z.im[k] + im[k] * z.re[k], power = x * x + y * y;
      re[k] = power < GONE ? 0 : x; // numbers near the least there are take long
      im[k] = power < GONE ? 0 : y;
      size += power;
    }
    if (size < GONE) this.stop();
  }

  /** Let steps `first` to before `last` of a drive, of which a unit leaves `left`, set the modes ringing. */
  fold(left, drive, first, last) {
    if (addDriven(this, left, this.step, drive, first, last)) this.still = false;
  }
}

/** A stroke's force as impulses of every sample, band-limited, N s; from `edge` samples before the touch. */
class Impulses {
  constructor({ smooth, heard, string }, rate) {
    Object.assign(this, { smooth, edge: heard.edge, ratio: string.ratio, rate, done: 0 });
    this.values = new Float64Array(BLOCK);
  }

  upTo(count, contact) {
    const { smooth, ratio } = this, half = (smooth.length - 1) / 2;
    this.values = longer(this.values, count);
    for (let k = this.done; k < count; k++) {
      const at = (k - this.edge) * ratio + half, first = Math.max(at - 2 * half, 0);
      let sum = 0;
      for (let n = first; n <= Math.min(at, contact.last); n++) sum += contact.force[n] * smooth[at - n];
      this.values[k] = sum / this.rate;
    }
    this.done = Math.max(this.done, count);
  }
}

/** What was put in as many blocks ago as `queue` is long. */
function later(queue, value) {
  queue.push(value);
  return queue.shift();
}

/** One key while it sounds: all that happens to it happens `delay` blocks later, and is heard later by its own lead. */
class Voice {
  constructor(table, rate, delay) {
    const { string, heard, damper } = table;
    const gain = table.rings ? [] : heard.gain; // a string whose ringing is known is not heard itself
    this.string = new Bank({ pole: string.own, gain }, rate, string.ratio, damper);
    this.modes = table.rings ? new Bank(heard, rate, 1, damper) : this.string;
    this.kernel = new Motion(string, struck(string));
    Object.assign(this, { table, rate, delay, hammer: table.hammer, contact: null, strokes: [], waiting: [] });
    Object.assign(this, { damped: false, dampers: [delay, heard.lead / BLOCK].map((n) => new Array(n).fill(false)) });
  }

  get silent() {
    return this.modes.still && !this.contact && !this.strokes.length && !this.waiting.length;
  }

  _begin(velocity) {
    const { table, rate, string } = this, state = string.still ? null : string;
    this.contact = new Contact(table.string, this.kernel, this.hammer, velocity, state);
    const impulses = table.rings ? new Impulses(table, rate) : null;
    this.strokes.push({ contact: this.contact, impulses, at: 0, ...driven(table.heard, velocity) });
  }

  /** Add a block to out [channels]. */
  render(out) {
    const { string, modes, table } = this, { ratio } = table.string, [onString, asHeard] = this.dampers;
    this.waiting.forEach((stroke) => stroke.blocks--);
    if (!this.contact && this.waiting[0]?.blocks < 0) this._begin(this.waiting.shift().velocity);
    const damped = later(onString, this.damped) && !this.contact;
    if (table.rings) string.wait(damped);
    modes.ring(out, later(asHeard, damped));
    for (const stroke of this.strokes) this._stroke(stroke, out);
    const { contact } = this, now = contact && this.strokes.find((stroke) => stroke.contact === contact);
    if (contact?.over && now.at * ratio > contact.last) this.contact = null;
    this.strokes = this.strokes.filter((stroke) => !stroke.over);
  }

  /** What a stroke adds in the block from its sample `at` on. */
  _stroke(stroke, out) {
    const { table, string, modes } = this, { heard } = table, { contact, impulses, at } = stroke;
    const { ratio } = table.string, end = at + BLOCK;
    if (!contact.over) contact.advance((end + (impulses ? BLOCK : 0)) * ratio);
    string.fold(table.string.left, contact.drive, at * ratio, end * ratio);
    if (impulses) {
      impulses.upTo(end + heard.edge, contact);
      modes.fold(stroke.left, impulses.values, at - heard.lead + heard.edge, end - heard.lead + heard.edge);
    }
    const drive = impulses ? impulses.values : contact.drive, r = heard.ratio;
    const last = impulses ? Math.ceil(contact.last / ratio) + 2 * heard.edge : contact.last;
    out.forEach((channel, i) => {
      addConvolved(channel, drive, (at - heard.lead + heard.edge) * r, last, stroke.direct[i], r, true);
      addConvolved(channel, drive, (at + heard.edge) * r, last, stroke.kernel[i], r, false);
    });
    stroke.at = end;
    const rest = Math.max(heard.kernel[0].length / r, heard.lead + BLOCK);
    stroke.over = contact.over && (end - rest) * r > last + r;
  }
}

/** Add (drive ∗ kernel) to a block that begins at the drive's step `first`; `own`: only what is driven within it. */
function addConvolved(out, drive, first, last, kernel, ratio, own) {
  for (let i = 0; i < BLOCK; i++) {
    const n = first + i * ratio, begin = Math.max(own ? first : 0, n - kernel.length + 1, 0);
    out[i] += reversed(drive, begin, kernel, n - begin, Math.min(n, last) - begin + 1);
  }
}

/** The whole instrument: tables of `prepare` by key, and what is played on them. */
export class Engine {
  constructor(rate) {
    Object.assign(this, { rate, tables: new Map(), voices: new Map(), released: [], held: new Set(), lead: 0 });
    this.own = [new Float64Array(BLOCK), new Float64Array(BLOCK)];
  }

  /** A key's table, new or in place of another, which is damped. */
  setKey(midi, table) {
    const old = this.voices.get(midi);
    if (old && !old.silent) this.released.push(Object.assign(old, { damped: true, waiting: [] }));
    this.voices.delete(midi);
    this.tables.set(midi, table);
    this.lead = Math.max(...[...this.tables.values()].map(({ heard }) => heard.lead));
  }

  /** Another hammer for a key: {K_H, mu, p, M_H}. */
  setHammer(midi, hammer) {
    if (this.tables.has(midi)) this.tables.set(midi, { ...this.tables.get(midi), hammer });
    if (this.voices.has(midi)) this.voices.get(midi).hammer = hammer;
  }

  /** A stroke of a hammer at `velocity`, m/s. */
  noteOn(midi, velocity) {
    const table = this.tables.get(midi);
    if (!table) return;
    this.held.add(midi);
    const delay = (this.lead - table.heard.lead) / BLOCK;
    if (!this.voices.has(midi)) this.voices.set(midi, new Voice(table, this.rate, delay));
    const voice = this.voices.get(midi);
    voice.waiting.push({ velocity, blocks: voice.delay });
    this._dampers();
  }

  noteOff(midi) {
    if (this.held.delete(midi)) this._dampers();
  }

  setPedal(down) {
    this.pedal = down;
    this._dampers();
  }

  /** Silence at once. */
  panic() {
    [this.voices, this.held].forEach((all) => all.clear());
    this.released = [];
  }

  _dampers() {
    for (const [midi, voice] of this.voices) voice.damped = !(this.pedal || this.held.has(midi));
  }

  /** How many strings sound. */
  get sounding() {
    return [...this.voices.values(), ...this.released].filter((voice) => !voice.silent).length;
  }

  /** One block of both channels [128]. */
  render(left, right) {
    left.fill(0);
    right.fill(0);
    for (const voice of [...this.voices.values(), ...this.released]) {
      if (voice.silent) continue;
      if (voice.table.heard.gain.length > 1) {
        voice.render([left, right]);
        continue;
      }
      const [mono] = this.own.map((x) => x.fill(0));
      voice.render([mono]);
      for (let i = 0; i < BLOCK; i++) {
        left[i] += mono[i];
        right[i] += mono[i];
      }
    }
    this.released = this.released.filter((voice) => !voice.silent);
  }
}
