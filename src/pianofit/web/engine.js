// Real-time synthesis of a fitted instrument: strokes on strings that may still move, dampers and pedal.
//
// Time advances in blocks of 128 samples, and events take effect at the beginning of a block. Each sounding key is a
// voice. A stroke's drive T, or its force F with a measured modal response, excites resonators and is convolved with a
// short kernel (see prepare.js). Between strokes the state is one complex amplitude per mode. All numbers are 64-bit.
// This module uses no DOM and no libraries.

import { BLOCK, Contact, FreeMotion, addDamped, addDriven, expPole, grown, reversedDot, unitAtStrike, workspace }
  from "./contact.js";
import { atVelocity } from "./prepare.js";

const FAINT = 1e-8; // of full scale, -160 dB; smaller modes are not computed
const GONE = 1e-40; // squared state, m² or (N s)², that counts as zero

/** Freely vibrating modes with amplitudes re + i im. The output of a channel is Re(gain · amplitude). */
class ModeBank {
  constructor({ pole, gain }, rate, ratio, damper) {
    const count = pole.re.length;
    Object.assign(this, { count, gain, re: new Float64Array(count), im: new Float64Array(count), atRest: true });
    // Without and with damper.
    this.sample = [0, damper].map((decay) => expPole(pole, 1 / rate, decay));
    this.block = [0, damper].map((decay) => expPole(pole, BLOCK / rate, decay));
    this.step = expPole(pole, 1 / (rate * ratio));
    this.work = workspace(count);
  }

  stop() {
    this.re.fill(0);
    this.im.fill(0);
    this.atRest = true;
  }

  /** Add a block of output to `out` [channels] and advance the state. */
  ring(out, damped) {
    if (this.atRest) return;
    const { re, im, gain } = this, z = this.sample[Number(damped)], [a, b, c, d] = this.work;
    let audible = 0;
    gain.forEach((g, channel) => {
      let n = 0;
      for (let k = 0; k < g.re.length; k++) {
        const x = g.re[k] * re[k] - g.im[k] * im[k], y = g.re[k] * im[k] + g.im[k] * re[k];
        if (x * x + y * y < FAINT * FAINT) continue;
        // Re(A z^i) by the recursion x_i = 2 Re(z) x_{i-1} - |z|² x_{i-2}.
        a[n] = x;
        b[n] = x * z.re[k] - y * z.im[k];
        c[n] = 2 * z.re[k];
        d[n++] = -(z.re[k] * z.re[k] + z.im[k] * z.im[k]);
      }
      audible = Math.max(audible, n);
      addDamped(this.work, n, out[channel], BLOCK);
    });
    if (audible) this.advance(damped);
    else this.stop();
  }

  /** Advance the state by a block without output. */
  advance(damped) {
    if (this.atRest) return;
    const z = this.block[Number(damped)], { re, im } = this;
    let size = 0;
    for (let k = 0; k < this.count; k++) {
      const x = re[k] * z.re[k] - im[k] * z.im[k], y = re[k] * z.im[k] + im[k] * z.re[k], power = x * x + y * y;
      re[k] = power < GONE ? 0 : x; // arithmetic with subnormal numbers is slow
      im[k] = power < GONE ? 0 : y;
      size += power;
    }
    if (size < GONE) this.stop();
  }

  /** Excite the modes by the steps of a drive from `first` to before `last`; see `addDriven`. */
  excite(excitation, drive, first, last) {
    if (addDriven(this, excitation, this.step, drive, first, last)) this.atRest = false;
  }
}

/** Band-limited impulse of the force per sample, N s, from `edge` samples before the contact on. */
class Impulses {
  constructor({ smooth, response, string }, rate) {
    Object.assign(this, { smooth, edge: response.edge, ratio: string.ratio, rate, done: 0 });
    this.values = new Float64Array(BLOCK);
  }

  upTo(count, contact) {
    const { smooth, ratio } = this, half = (smooth.length - 1) / 2;
    this.values = grown(this.values, count);
    for (let k = this.done; k < count; k++) {
      const at = (k - this.edge) * ratio + half, first = Math.max(at - 2 * half, 0);
      let sum = 0;
      for (let n = first; n <= Math.min(at, contact.last); n++) sum += contact.force[n] * smooth[at - n];
      this.values[k] = sum / this.rate;
    }
    this.done = Math.max(this.done, count);
  }
}

/** A delay line with as many blocks as `queue` is long. */
function delay(queue, value) {
  queue.push(value);
  return queue.shift();
}

/** One sounding key. Its events take effect `delayBlocks` late; the lead of the response is in addition. */
class Voice {
  constructor(table, rate, delayBlocks) {
    const { string, response, damper } = table;
    const gain = table.isMeasured ? [] : response.gain; // with a measured response the string itself has no output
    this.string = new ModeBank({ pole: string.pole, gain }, rate, string.ratio, damper);
    this.modes = table.isMeasured ? new ModeBank(response, rate, 1, damper) : this.string;
    this.kernel = new FreeMotion(string, unitAtStrike(string));
    Object.assign(this, { table, rate, delayBlocks, hammer: table.hammer, contact: null, strokes: [], waiting: [] });
    this.dampers = [delayBlocks, response.lead / BLOCK].map((n) => new Array(n).fill(false));
    this.damped = false;
  }

  get silent() {
    return this.modes.atRest && !this.contact && !this.strokes.length && !this.waiting.length;
  }

  _begin(velocity) {
    const { table, rate, string } = this, state = string.atRest ? null : string;
    this.contact = new Contact(table.string, this.kernel, this.hammer, velocity, state);
    const impulses = table.isMeasured ? new Impulses(table, rate) : null;
    this.strokes.push({ contact: this.contact, impulses, at: 0, ...atVelocity(table.response, velocity) });
  }

  /** Add a block to out [channels]. */
  render(out) {
    const { string, modes, table } = this, { ratio } = table.string, [stringDamper, outputDamper] = this.dampers;
    this.waiting.forEach((stroke) => stroke.blocks--);
    if (!this.contact && this.waiting[0]?.blocks < 0) this._begin(this.waiting.shift().velocity);
    const damped = delay(stringDamper, this.damped) && !this.contact;
    if (table.isMeasured) string.advance(damped);
    modes.ring(out, delay(outputDamper, damped));
    for (const stroke of this.strokes) this._stroke(stroke, out);
    const { contact } = this, current = contact && this.strokes.find((stroke) => stroke.contact === contact);
    if (contact?.isOver && current.at * ratio > contact.last) this.contact = null;
    this.strokes = this.strokes.filter((stroke) => !stroke.isOver);
  }

  /** Add the output of a stroke in the block from its sample `at` on. */
  _stroke(stroke, out) {
    const { table, string, modes } = this, { response } = table, { contact, impulses, at } = stroke;
    const { ratio } = table.string, end = at + BLOCK;
    if (!contact.isOver) contact.advance((end + (impulses ? BLOCK : 0)) * ratio);
    string.excite(table.string.excitation, contact.drive, at * ratio, end * ratio);
    if (impulses) {
      impulses.upTo(end + response.edge, contact);
      const shift = response.edge - response.lead;
      modes.excite(stroke.excitation, impulses.values, at + shift, end + shift);
    }
    const drive = impulses ? impulses.values : contact.drive, r = response.ratio;
    const last = impulses ? Math.ceil(contact.last / ratio) + 2 * response.edge : contact.last;
    out.forEach((channel, i) => {
      addConvolved(channel, drive, (at - response.lead + response.edge) * r, last, stroke.direct[i], r, true);
      addConvolved(channel, drive, (at + response.edge) * r, last, stroke.kernel[i], r, false);
    });
    stroke.at = end;
    const tail = Math.max(response.kernel[0].length / r, response.lead + BLOCK);
    stroke.isOver = contact.isOver && (end - tail) * r > last + r;
  }
}

/** Add drive ∗ kernel to a block that begins at step `first`. `withinBlock`: ignore the drive before the block. */
function addConvolved(out, drive, first, last, kernel, ratio, withinBlock) {
  for (let i = 0; i < BLOCK; i++) {
    const n = first + i * ratio, begin = Math.max(withinBlock ? first : 0, n - kernel.length + 1, 0);
    out[i] += reversedDot(drive, begin, kernel, n - begin, Math.min(n, last) - begin + 1);
  }
}

/** The whole instrument: tables of `prepare` by key, and the sounding voices. */
export class Engine {
  constructor(rate) {
    Object.assign(this, { rate, tables: new Map(), voices: new Map(), released: [], held: new Set(), lead: 0 });
    this.mono = new Float64Array(BLOCK);
  }

  /** Set the table of a key. A voice of the previous table is damped. */
  setKey(midi, table) {
    const old = this.voices.get(midi);
    if (old && !old.silent) this.released.push(Object.assign(old, { damped: true, waiting: [] }));
    this.voices.delete(midi);
    this.tables.set(midi, table);
    this.lead = Math.max(...[...this.tables.values()].map(({ response }) => response.lead));
  }

  /** Replace the hammer of a key: {K_H, mu, p, M_H}. */
  setHammer(midi, hammer) {
    if (this.tables.has(midi)) this.tables.set(midi, { ...this.tables.get(midi), hammer });
    if (this.voices.has(midi)) this.voices.get(midi).hammer = hammer;
  }

  /** A stroke of a hammer at `velocity`, m/s. */
  noteOn(midi, velocity) {
    const table = this.tables.get(midi);
    if (!table) return;
    this.held.add(midi);
    const delayBlocks = (this.lead - table.response.lead) / BLOCK;
    if (!this.voices.has(midi)) this.voices.set(midi, new Voice(table, this.rate, delayBlocks));
    const voice = this.voices.get(midi);
    voice.waiting.push({ velocity, blocks: voice.delayBlocks });
    this._dampers();
  }

  noteOff(midi) {
    if (this.held.delete(midi)) this._dampers();
  }

  setPedal(down) {
    this.pedal = down;
    this._dampers();
  }

  /** Silence all voices immediately. */
  panic() {
    [this.voices, this.held].forEach((all) => all.clear());
    this.released = [];
  }

  _dampers() {
    for (const [midi, voice] of this.voices) voice.damped = !(this.pedal || this.held.has(midi));
  }

  /** Number of sounding strings. */
  get sounding() {
    return [...this.voices.values(), ...this.released].filter((voice) => !voice.silent).length;
  }

  /** One block of both channels [128]. */
  render(left, right) {
    left.fill(0);
    right.fill(0);
    for (const voice of [...this.voices.values(), ...this.released]) {
      if (voice.silent) continue;
      if (voice.table.response.gain.length > 1) {
        voice.render([left, right]);
        continue;
      }
      const mono = this.mono.fill(0);
      voice.render([mono]);
      for (let i = 0; i < BLOCK; i++) {
        left[i] += mono[i];
        right[i] += mono[i];
      }
    }
    this.released = this.released.filter((voice) => !voice.silent);
  }
}
