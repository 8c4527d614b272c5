// Real-time synthesis of a fitted instrument: strokes on strings that may still move, dampers, pedals and resonance.
//
// Time advances in blocks of 128 samples, and events take effect at the beginning of a block. Each sounding key is a
// voice. A stroke's drive T, or its force F with a measured modal response, excites resonators and is convolved with a
// short kernel (see prepare.js). Between strokes the state is one complex amplitude per mode. All numbers are 64-bit.
// This module uses no DOM and no libraries.

import { BLOCK, Contact, FreeMotion, Release, addDamped, addDriven, expPole, grown, reversedDot, unitAtStrike, workspace }
  from "./contact.js";
import { Dampers, softHammer, unaCorda } from "./pedals.js";
import { atVelocity, scaled } from "./prepare.js";
import { releaseGain } from "./release.js";
import { HOP_BLOCKS, Resonance } from "./resonance.js";

const FAINT = 1e-8; // of full scale, -160 dB; smaller modes are not computed
const STOP_RATE = 2000; // 1/s, decay of a string that a finger stops before it plucks it again, see playback/voice.py
const GONE = 1e-40; // squared state, m² or (N s)², that counts as zero

/** Freely vibrating modes with amplitudes re + i im. The output of a channel is Re(gain · amplitude). */
class ModeBank {
  constructor({ pole, gain, damping }, rate, ratio) {
    const count = pole.re.length;
    Object.assign(this, { count, gain, damping, rate, re: new Float64Array(count), im: new Float64Array(count) });
    Object.assign(this, { atRest: true, contact: 0 });
    this.free = { sample: expPole(pole, 1 / rate), block: expPole(pole, BLOCK / rate) };
    this.sample = { re: this.free.sample.re.slice(), im: this.free.sample.im.slice() };
    this.block = { re: this.free.block.re.slice(), im: this.free.block.im.slice() };
    this.step = expPole(pole, 1 / (rate * ratio));
    this.work = workspace(count);
  }

  /** Set the contact of the damper, 0 to 1. */
  setContact(contact) {
    if (contact === this.contact) return;
    const { free, sample, block, damping, rate } = this;
    for (let k = 0; k < this.count; k++) {
      const added = (contact * damping[k]) / rate, one = Math.exp(-added), many = Math.exp(-added * BLOCK);
      [sample.re[k], sample.im[k]] = [one * free.sample.re[k], one * free.sample.im[k]];
      [block.re[k], block.im[k]] = [many * free.block.re[k], many * free.block.im[k]];
    }
    this.contact = contact;
  }

  stop() {
    this.re.fill(0);
    this.im.fill(0);
    this.atRest = true;
  }

  /** Add a block of output to `out` [channels] and advance the state. */
  ring(out, contact) {
    if (this.atRest) return;
    this.setContact(contact);
    const { re, im, gain, sample: z } = this, [a, b, c, d] = this.work;
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
    if (audible) this.advance(contact);
    else this.stop();
  }

  /** Advance the state by a block without output. */
  advance(contact) {
    if (this.atRest) return;
    this.setContact(contact);
    const { re, im, block: z } = this;
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
    const { string, response } = table;
    const gain = table.isMeasured ? [] : response.gain; // with a measured response the string itself has no output
    this.string = new ModeBank({ ...string, gain }, rate, string.ratio);
    this.modes = table.isMeasured ? new ModeBank(response, rate, 1) : this.string;
    this.kernel = new FreeMotion(string, unitAtStrike(string));
    Object.assign(this, { table, rate, delayBlocks, hammer: table.hammer, contact: null, strokes: [], waiting: [] });
    this.delayed = [delayBlocks, response.lead / BLOCK].map((n) => new Array(n).fill(0)); // contacts of the damper
    this.damper = 0; // contact of the damper
    this.stopped = []; // motions that a finger ends
  }

  get silent() {
    return this.modes.atRest && ![this.contact, ...this.strokes, ...this.waiting, ...this.stopped].some(Boolean);
  }

  _begin({ velocity, soft, onBegin }) {
    const { table, rate, string } = this, state = string.atRest ? null : string;
    const pedal = unaCorda(table.strings, table.hammer ? soft : 0);
    this.contact = table.hammer
      ? new Contact(table.string, this.kernel, softHammer(this.hammer, pedal), velocity, state)
      : new Release(table.string, velocity);
    if (!table.hammer && !table.isMeasured) this._stop();
    const impulses = table.isMeasured ? new Impulses(table, rate) : null, { excitation } = table.string;
    const drive = pedal.share === 1 ? excitation : scaled(excitation, pedal.share);
    const response = atVelocity(table.response, velocity, pedal.share);
    this.strokes.push({ contact: this.contact, impulses, at: 0, drive, ...response });
    onBegin?.(this.contact, response.velocityFactor, pedal.share);
  }

  /** Let a finger end the motion of the string, from the next block that sounds on. */
  _stop() {
    const { modes, table, rate } = this, { pole } = table.isMeasured ? table.response : table.string;
    if (modes.atRest) return;
    const old = new ModeBank({ pole, gain: modes.gain, damping: modes.re.map(() => STOP_RATE) }, rate, 1);
    old.re.set(modes.re);
    old.im.set(modes.im);
    old.atRest = false;
    modes.stop();
    this.stopped.push(old);
  }

  /** Add a block to out [channels]. */
  render(out) {
    const { string, modes, table } = this, { ratio } = table.string, [ofString, ofOutput] = this.delayed;
    this.waiting.forEach((stroke) => stroke.blocks--);
    if (!this.contact && this.waiting[0]?.blocks < 0) this._begin(this.waiting.shift());
    const damper = delay(ofString, this.damper), contactNow = this.contact ? 0 : damper;
    if (table.isMeasured) string.advance(contactNow);
    this.stopped.forEach((old) => old.ring(out, 1));
    this.stopped = this.stopped.filter((old) => !old.atRest);
    modes.ring(out, delay(ofOutput, contactNow));
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
    if (!table.hammer && table.isMeasured && end === response.lead) this._stop();
    // A measured string that is plucked has no contact for which it must be known.
    if (table.hammer || !table.isMeasured) string.excite(stroke.drive, contact.drive, at * ratio, end * ratio);
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

/** A release noise that sounds. */
class ReleaseSound {
  constructor({ sound, gain }, factor, blocks) {
    Object.assign(this, { sound, gain: gain * factor, at: -blocks * BLOCK });
  }

  get isOver() {
    return this.at >= this.sound[0].length;
  }

  render(out) {
    const { sound, gain, at } = this, count = Math.min(BLOCK, sound[0].length - at);
    if (at >= 0) out.forEach((y, i) => {
      const x = sound[Math.min(i, sound.length - 1)];
      for (let n = 0; n < count; n++) y[n] += gain * x[at + n];
    });
    this.at += BLOCK;
  }
}

/** The whole instrument: tables of `prepare` by key, sounding voices, dampers, free strings and release noises. */
export class Engine {
  constructor(rate) {
    Object.assign(this, { rate, tables: new Map(), voices: new Map(), released: [], lead: 0, dampers: new Dampers() });
    Object.assign(this, { resonance: null, ending: null, releases: new Map(), noises: [], struck: new Map(), blocks: 0 });
    Object.assign(this, { mono: new Float64Array(BLOCK), history: [], hasResonance: true });
  }

  /** Set the table of a key. A voice of the previous table is damped. */
  setKey(midi, table) {
    const old = this.voices.get(midi);
    if (old && !old.silent) this.released.push(Object.assign(old, { damper: 1, waiting: [] }));
    this.voices.delete(midi);
    this.tables.set(midi, table);
    this.lead = Math.max(...[...this.tables.values()].map(({ response }) => response.lead));
  }

  /** Replace the hammer of a key: {K_H, mu, p, M_H}. */
  setHammer(midi, hammer) {
    if (this.tables.has(midi)) this.tables.set(midi, { ...this.tables.get(midi), hammer });
    if (this.voices.has(midi)) this.voices.get(midi).hammer = hammer;
  }

  /** Set the free strings, `data` of FreeStrings; null for none. The sound of earlier ones ends within a hop. */
  setStrings(strings) {
    if (this.resonance) this.ending = Object.assign(this.resonance, { isOn: false });
    this.resonance = strings && new Resonance(strings, this.rate);
    if (this.resonance) this.resonance.isOn = this.hasResonance;
    this.history = [];
  }

  /** Set the amplitudes that a stroke on a key leaves on other keys, `response` of FreeStrings. */
  setResponse(midi, response) {
    this.resonance?.responses.set(midi, response);
  }

  /** Set the release noises, `releaseNoises` of release.js. */
  setReleases(releases) {
    this.releases = releases;
  }

  /** Whether free strings sound. */
  setResonance(isOn) {
    this.hasResonance = isOn;
    if (this.resonance) this.resonance.isOn = isOn;
  }

  /** A stroke of a hammer at `velocity`, m/s. */
  noteOn(midi, velocity) {
    const table = this.tables.get(midi);
    if (!table) return;
    this.dampers.held.add(midi);
    if (!this.struck.has(midi)) this.struck.set(midi, this.blocks);
    const delayBlocks = (this.lead - table.response.lead) / BLOCK;
    if (!this.voices.has(midi)) this.voices.set(midi, new Voice(table, this.rate, delayBlocks));
    const voice = this.voices.get(midi), onBegin = (contact, factor, share) =>
      this.resonance?.strike(midi, voice, contact, this.blocks - voice.delayBlocks, factor, share);
    voice.waiting.push({ velocity, soft: this.dampers.soft, blocks: voice.delayBlocks, onBegin });
    this._moveDampers();
  }

  /** A key is let go, at a MIDI release velocity. */
  noteOff(midi, velocity = 64) {
    if (!this.dampers.held.delete(midi)) return;
    const seconds = ((this.blocks - this.struck.get(midi)) * BLOCK) / this.rate, noise = this.releases.get(midi);
    if (noise) this.noises.push(new ReleaseSound(noise, releaseGain(velocity, seconds), this.lead / BLOCK));
    this.struck.delete(midi);
    this._moveDampers();
  }

  /** Move a pedal: MIDI controller 64, 66 or 67, value 0 to 127. */
  control(controller, value) {
    this.dampers.move(controller, value);
    this._moveDampers();
  }

  /** Set the values of controller 64 between which dampers are lifted. */
  setRange(range) {
    this.dampers.range = range;
    this._moveDampers();
  }

  /** Silence all strings immediately. */
  panic() {
    [this.voices, this.dampers.held, this.dampers.caught, this.struck].forEach((all) => all.clear());
    Object.assign(this, { released: [], noises: [], ending: null, history: [] });
    this.resonance?.reset();
  }

  _moveDampers() {
    for (const [midi, voice] of this.voices) voice.damper = this.dampers.of(midi);
  }

  /** Number of sounding strings, without those that only resonate. */
  get sounding() {
    return [...this.voices.values(), ...this.released].filter((voice) => !voice.silent).length;
  }

  /** One block of both channels [128]. */
  render(left, right) {
    left.fill(0);
    right.fill(0);
    if (this.resonance || this.ending) this._advance();
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
    this.resonance?.render([left, right]);
    this.ending?.render([left, right]);
    this.noises.forEach((noise) => noise.render([left, right]));
    this.noises = this.noises.filter((noise) => !noise.isOver);
    this.released = this.released.filter((voice) => !voice.silent);
    this.blocks++;
  }

  /** Advance the free strings, which are late by the lead. */
  _advance() {
    const { history, resonance } = this, late = this.lead / BLOCK, block = this.blocks - late;
    if (block % HOP_BLOCKS === 0) {
      if (this.ending && !this.ending.isAudible) this.ending = null;
      this.ending?.advance(block, this.ending.contact);
      const hop = Array.from({ length: HOP_BLOCKS }, (_, i) => history.at(-late - 1 - i) ?? history[0]);
      const mean = (_, i) => hop.reduce((sum, contacts) => sum + contacts[i], 0) / HOP_BLOCKS;
      resonance?.advance(block, history.length ? resonance.contact.map(mean) : resonance.contact.map(() => 1));
    }
    if (!resonance) return;
    history.push(Float64Array.from(resonance.strings.midis, (midi) => this.dampers.of(midi)));
    if (history.length > late + HOP_BLOCKS) history.shift();
  }
}
