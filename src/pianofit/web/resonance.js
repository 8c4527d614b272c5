// The sound of free strings that others excite over the bridge (playback/resonance.py, playback/coupled_modes.py).
//
// The amplitudes that the strings have alone, and what other strings add to them, advance in hops of four blocks. The
// sound of the added amplitudes is computed at a quarter of the rate. From hop to hop every amplitude changes linearly
// in the frame that turns with its mode, so nothing clicks.

import { BLOCK, STRIDE, addDamped, expPole } from "./contact.js";
import { TAPER, zeros } from "./free_strings.js";
import { times } from "./prepare.js";
import { lowpass } from "./signal.js";

export const HOP_BLOCKS = 4;
const RATIO = 4; // of the rate to that of the sound
const REDUCED = BLOCK / RATIO; // samples of a block at the reduced rate
const HOP = HOP_BLOCKS * REDUCED; // and of a hop
const REACH = 10; // samples at the reduced rate: reach of the filter for the full rate, and delay of the amplitudes
const SILENT = 1e-8; // of full scale, -160 dB: smaller modes are not computed
const MASKED = 1e-5; // of the loudest mode, -100 dB: nor are these
const NOTHING = 1e-20; // root of energy, √J, that counts as zero
const FORCE_SPACING = 20; // Hz, between the frequencies of the transform of a force
const FORCE_END = 5000 + 2 * FORCE_SPACING; // Hz, the last of them

/**
 * Transform of a force, N s, at multiples of `FORCE_SPACING` about its centre, which is in samples at the reduced rate.
 */
class ForceSpectrum {
  constructor(force, first, last, step, ratio) {
    const count = Math.ceil((last + 1 - first) / ratio), samples = new Float64Array(count);
    let total = 0, moment = 0;
    for (let n = first; n <= last; n++) {
      samples[Math.floor((n - first) / ratio)] += force[n] * step;
      total += force[n];
      moment += force[n] * n * step;
    }
    const sample = RATIO * ratio * step; // s, at the reduced rate
    this.centre = Math.round(moment / Math.max(total, 1e-300) / sample);
    const bins = Math.ceil(FORCE_END / FORCE_SPACING) + 1;
    Object.assign(this, zeros(bins));
    const begin = (first + (ratio - 1) / 2) * step - this.centre * sample, width = ratio * step;
    for (let k = 0; k < bins; k++) {
      const omega = 2 * Math.PI * FORCE_SPACING * k, c = Math.cos(omega * width), s = -Math.sin(omega * width);
      const narrow = Math.sin((omega * step) / 2); // within a sample the force is nearly constant
      const size = k ? Math.sin((omega * width) / 2) / (ratio * narrow) : 1;
      let x = size * Math.cos(omega * begin), y = -size * Math.sin(omega * begin), re = 0, im = 0;
      for (let n = 0; n < count; n++) {
        re += samples[n] * x;
        im += samples[n] * y;
        const turned = x * c - y * s;
        y = x * s + y * c;
        x = turned;
      }
      this.re[k] = re;
      this.im[k] = im;
    }
  }
}

/** Added amplitudes of all free modes, and their sound. */
export class Resonance {
  /** strings: `data` of FreeStrings; rate: Hz. */
  constructor(strings, rate) {
    const count = strings.drive.length, { pole } = strings, reduced = RATIO / rate;
    Object.assign(this, { strings, rate, count, seconds: (HOP_BLOCKS * BLOCK) / rate, isOn: true, responses: new Map() });
    Object.assign(this, { alone: zeros(count), added: zeros(count), first: zeros(count), second: zeros(count) });
    this.omega = pole.im.map((x) => x / TAPER);
    this.freeHalf = expPole(pole, this.seconds / 2);
    this.half = { re: this.freeHalf.re.slice(), im: this.freeHalf.im.slice() };
    const place = pole.im.map((x) => x / (2 * Math.PI * FORCE_SPACING)); // in the transform of a force
    this.bin = Int32Array.from(place, Math.floor);
    this.part = place.map((x, k) => x - this.bin[k]);
    [this.turn, this.z] = [this.seconds, reduced].map((t) => expPole(pole, t));
    this.powers = [this.z]; // z, z², z⁴, ...
    const delay = expPole(pole, REACH * reduced);
    this.sound = strings.sound.map((g) => times(g, delay));
    this.loudness = this.omega.map((_, k) => Math.max(...strings.sound.map((g) => g.re[k] ** 2 + g.im[k] ** 2)));
    this.lift = new Float64Array(count);
    this.coupling = new Float64Array(count); // drive of strings as far as they are free
    this.contact = new Float64Array(strings.midis.length).fill(-1);
    this.hasDamper = strings.midis.map((midi) => this._modes(midi).some((k) => strings.damping[k] > 0));
    this.sums = new Float64Array(4 * (count + 1));
    this.driven = zeros(count);
    this.out = strings.sound.map(() => new Float64Array(REDUCED + 2 * REACH));
    [this.steady, this.rising] = [0, 1].map(() => new Recursions(count, strings.sound.length));
    this.filter = lowpass(RATIO, 1);
    this.reset();
  }

  _modes(midi) {
    return this.strings.ofKey.get(midi)?.modes ?? [];
  }

  /** Set all strings to rest, and discard the output. */
  reset() {
    const { alone, added } = this;
    for (const pair of [alone, added]) for (const x of [pair.re, pair.im]) x.fill(0);
    Object.assign(this, { last: zeros(this.count), most: 0, pending: [], phase: 0, isAtRest: true });
    Object.assign(this, { isAudible: false, wasAudible: false });
    this.out.forEach((x) => x.fill(0));
  }

  /** Take over a stroke once its force has ended. voice: its `modes` are those of the key; touch: block of the touch. */
  strike(midi, voice, contact, touch, velocityFactor, share = 1) {
    this.pending.push({ midi, voice, contact, touch, velocityFactor, share, taken: 0 });
  }

  /** Advance to the hop that begins with `block`. contacts: mean over the last hop by index of the key. */
  advance(block, contacts) {
    this._setContacts(contacts);
    const areMet = contacts.reduce((count, x, i) => count + (x < 1 || !this.hasDamper[i]), 0) > 1;
    if (!this.isAtRest) this._step(areMet && this.isOn);
    for (const x of [this.first.re, this.first.im]) x.fill(0);
    const hasStroke = this.pending.filter((stroke) => this._take(stroke, block, areMet && this.isOn)).length > 0;
    if (hasStroke && areMet && this.isOn) {
      // The exchange during the rest of this hop, to first order.
      this._exchange(this.first, this.second);
      addScaled(this.added, -1, this.second, this.count);
    }
    this.pending = this.pending.filter(({ contact, taken }) => !contact.isOver || taken <= contact.last);
    if (!this.isAtRest || this.isAudible) this._setSound();
  }

  _setContacts(contacts) {
    const { contact, strings, freeHalf, half, lift, coupling } = this;
    if (contacts.every((x, i) => x === contact[i])) return;
    const isChanged = contacts.map((x, i) => Number(x !== contact[i]));
    contact.set(contacts);
    for (let k = 0; k < this.count; k++) {
      const i = strings.key[k];
      if (!isChanged[i]) continue;
      const size = Math.exp(-0.5 * this.seconds * contact[i] * strings.damping[k]);
      [half.re[k], half.im[k]] = [size * freeHalf.re[k], size * freeHalf.im[k]];
      lift[k] = this.hasDamper[i] ? 1 - contact[i] : 1;
      coupling[k] = strings.drive[k] * lift[k];
    }
  }

  /** Advance all amplitudes by a hop; see `CoupledModes.step` in Python. */
  _step(areMet) {
    const { alone, added, half, first, second, seconds, count } = this;
    turned(alone, half, count);
    turned(added, half, count);
    if (areMet) {
      summed(second, alone, added, count);
      this._exchange(second, first);
      this._exchange(first, second);
      addScaled(added, -seconds, first, count);
      addScaled(added, 0.5 * seconds ** 2, second, count);
    }
    turned(alone, half, count);
    turned(added, half, count);
  }

  /** v_i Σ_j v_j τ_ij a_j over modes j of other strings, by running sums over the modes in order of frequency. */
  _exchange({ re, im }, out) {
    const { sums, omega, count, coupling } = this, { left, right, own, received } = this.strings, { start, column, weight } = own;
    const { re: drivenRe, im: drivenIm } = this.driven, { re: outRe, im: outIm } = out;
    for (let k = 0, at = 4; k < count; k++, at += 4) {
      const v = coupling[k], w = omega[k], x = v * re[k], y = v * im[k];
      drivenRe[k] = x;
      drivenIm[k] = y;
      sums[at] = sums[at - 4] + x;
      sums[at + 1] = sums[at - 3] + y;
      sums[at + 2] = sums[at - 2] + w * x;
      sums[at + 3] = sums[at - 1] + w * y;
    }
    for (let k = 0; k < count; k++) {
      const v = received[k] * coupling[k];
      if (v === 0) {
        outRe[k] = outIm[k] = 0;
        continue;
      }
      const l = 4 * left[k], r = 4 * right[k], here = 4 * (k + 1), w = omega[k];
      let x = sums[r] - sums[l] + w * (sums[l] + sums[r] - 2 * sums[here]);
      let y = sums[r + 1] - sums[l + 1] + w * (sums[l + 1] + sums[r + 1] - 2 * sums[here + 1]);
      x += 2 * sums[here + 2] - sums[l + 2] - sums[r + 2];
      y += 2 * sums[here + 3] - sums[l + 3] - sums[r + 3];
      for (let j = start[k], end = start[k + 1]; j < end; j++) {
        x -= weight[j] * drivenRe[column[j]];
        y -= weight[j] * drivenIm[column[j]];
      }
      outRe[k] = v * x;
      outIm[k] = v * y;
    }
  }

  /**
   * Take over the state of a struck key whose hammer is off the string at the begin of `block`; return whether it is.
   * `first` gets what this adds to its amplitudes, times the time since the touch.
   */
  _take(stroke, block, areMet) {
    const { contact, voice, midi, taken } = stroke, { ratio, step } = voice.table.string, { last } = contact;
    const end = stroke.touch + (last + 1) / ratio / BLOCK, isPressing = !contact.isOver && last + 1 >= contact.steps;
    if (last < taken || end > block || isPressing) return false;
    const { alone, strings, first } = this, since = ((block - stroke.touch) * BLOCK) / this.rate;
    const { modes, chosen } = strings.ofKey.get(midi) ?? { modes: [], chosen: [] }, { perState } = strings;
    for (let i = 0; i < modes.length; i++) {
      const k = modes[i], x = voice.modes.re[chosen[i]], y = voice.modes.im[chosen[i]];
      const re = perState.re[k] * x - perState.im[k] * y, im = perState.re[k] * y + perState.im[k] * x;
      first.re[k] += since * (re - alone.re[k]);
      first.im[k] += since * (im - alone.im[k]);
      alone.re[k] = re;
      alone.im[k] = im;
    }
    stroke.taken = last + 1;
    this.isAtRest = false;
    const response = this.responses.get(midi);
    if (areMet && response) {
      this._excite(response, new ForceSpectrum(contact.force, taken, last, step, ratio), since, stroke);
    }
    return true;
  }

  /** Add the amplitudes that a force leaves on modes far from those of its key, `since` s after the touch. */
  _excite({ re, im }, spectrum, since, { velocityFactor, voice, share = 1 }) {
    const { added, lift, strings, contact, bin, part, count } = this, { pole, damping, key } = strings;
    const { re: a, im: b } = spectrum, { re: addedRe, im: addedIm } = added;
    const turn = this._turnBy(Math.round((since * this.rate) / RATIO) - spectrum.centre);
    const gain = velocityFactor ? sizesAt(velocityFactor, voice.table.response.pole.im) : null;
    for (let k = 0; k < count; k++) {
      if (lift[k] === 0) continue;
      const n = bin[k], f = a[n] + part[k] * (a[n + 1] - a[n]), g = b[n] + part[k] * (b[n + 1] - b[n]);
      const c = re[k] * f - im[k] * g, d = re[k] * g + im[k] * f, x = turn.re[k], y = turn.im[k];
      let size = share * (gain ? lift[k] * gain(pole.im[k]) : lift[k]);
      if (contact[key[k]] > 0) size *= Math.exp(-contact[key[k]] * damping[k] * since);
      addedRe[k] += size * (x * c - y * d);
      addedIm[k] += size * (x * d + y * c);
    }
  }

  /** Factors by which free modes change over `samples` at the reduced rate. */
  _turnBy(samples) {
    const out = this.second, { powers, count } = this;
    out.re.fill(1);
    out.im.fill(0);
    for (let i = 0, rest = Math.abs(samples); rest; i++, rest >>= 1) {
      if (i === powers.length) powers.push(times(powers[i - 1], powers[i - 1]));
      if (rest & 1) turned(out, powers[i], count);
    }
    return out;
  }

  /** Set the sound of the hop that begins now: each amplitude goes from its value at the last hop to that of now. */
  _setSound() {
    const { added, alone, last, turn, loudness, count } = this, { re, im } = added;
    let most = 0, energy = 0;
    for (let k = 0; k < count; k++) {
      most = Math.max(most, (re[k] * re[k] + im[k] * im[k]) * loudness[k]);
      energy = Math.max(energy, alone.re[k] ** 2 + alone.im[k] ** 2);
    }
    const isSilent = !(most > SILENT * SILENT) || !this.isOn;
    if (isSilent) for (const x of [re, im]) x.fill(0);
    if (energy < NOTHING * NOTHING) for (const x of [alone.re, alone.im]) x.fill(0);
    this.isAtRest = isSilent && energy < NOTHING * NOTHING;
    this.isAudible = !isSilent || this.wasAudible;
    this.wasAudible = !isSilent;
    this.phase = 0;
    if (!this.isAudible) return;
    turned(last, turn, count);
    this._setModes(Math.max(MASKED * MASKED * Math.max(most, this.most), SILENT * SILENT));
    this.most = most;
    last.re.set(re);
    last.im.set(im);
  }

  /** Set the recursions of all modes whose sound exceeds `least`, a square. */
  _setModes(least) {
    const { added, last, loudness, z, count, sound, steady, rising } = this;
    steady.count = rising.count = 0;
    for (let k = 0; k < count; k++) {
      const x = last.re[k], y = last.im[k], p = added.re[k] - x, q = added.im[k] - y;
      const before = (x * x + y * y) * loudness[k], change = (p * p + q * q) * loudness[k];
      if (before < least && change < least) continue;
      // A linear change of less than a fifth is an exponential one, up to its square over eight.
      if (change < 0.04 * before && change * change < 64 * least * before) {
        const power = x * x + y * y, a = (p * x + q * y) / power, b = (q * x - p * y) / power; // change over amplitude
        const l = (a - 0.5 * (a * a - b * b) + (a * a * a - 3 * a * b * b) / 3) / HOP;
        const m = (b - a * b + (3 * a * a * b - b * b * b) / 3) / HOP; // logarithm of the factor of a sample
        const c = 1 + l + 0.5 * (l * l - m * m), d = m + l * m;
        steady.add(sound, k, x, y, z.re[k] * c - z.im[k] * d, z.re[k] * d + z.im[k] * c);
      } else {
        steady.add(sound, k, x, y, z.re[k], z.im[k]);
        rising.add(sound, k, p, q, z.re[k], z.im[k]);
      }
    }
  }

  /** Add a block of the sound to all channels. */
  render(out) {
    const { phase } = this;
    if (!this.isAudible && !this.out.some((x) => x.some(Boolean))) return;
    this.out.forEach((x, channel) => {
      x.copyWithin(0, REDUCED);
      const here = x.subarray(2 * REACH).fill(0);
      if (!this.isAudible) return;
      this.rising.next(channel, here);
      for (let n = 0; n < REDUCED; n++) here[n] *= (phase + n) / HOP;
      this.steady.next(channel, here);
    });
    out.forEach((y, i) => upsampled(this.out[Math.min(i, this.out.length - 1)], this.filter, y));
    this.phase += REDUCED;
  }
}

/** Sums of damped modes, by recursions that continue from block to block. */
class Recursions {
  constructor(count, channels) {
    const column = () => new Float64Array(count + STRIDE);
    Object.assign(this, { count: 0, c: column(), d: column() });
    this.states = Array.from({ length: channels }, () => [column(), column()]);
  }

  /** Add Re(sound_k (x + jy) z^n) of all channels. */
  add(sound, k, x, y, c, s) {
    const n = this.count++;
    this.c[n] = 2 * c;
    this.d[n] = -(c * c + s * s);
    for (let i = 0; i < sound.length; i++) {
      const g = sound[i], p = g.re[k] * x - g.im[k] * y, q = g.re[k] * y + g.im[k] * x, [a, b] = this.states[i];
      a[n] = p;
      b[n] = p * c - q * s;
    }
  }

  /** Add the next samples of a channel to `out`. */
  next(channel, out) {
    const [a, b] = this.states[channel];
    addDamped([a, b, this.c, this.d], this.count, out, out.length);
  }
}

/** Multiply amplitudes by factors in place. */
function turned({ re, im }, { re: c, im: s }, count) {
  for (let k = 0; k < count; k++) {
    const x = re[k], y = im[k];
    re[k] = x * c[k] - y * s[k];
    im[k] = x * s[k] + y * c[k];
  }
}

function summed({ re, im }, { re: a, im: b }, { re: c, im: d }, count) {
  for (let k = 0; k < count; k++) {
    re[k] = a[k] + c[k];
    im[k] = b[k] + d[k];
  }
}

function addScaled({ re, im }, factor, { re: a, im: b }, count) {
  for (let k = 0; k < count; k++) {
    re[k] += factor * a[k];
    im[k] += factor * b[k];
  }
}

/** A function of ω, called with ascending values: the size of factors of modes at frequencies `omega`, interpolated. */
function sizesAt({ re, im }, omega) {
  const order = Array.from(omega.keys()).sort((a, b) => omega[a] - omega[b]), last = order.length - 1;
  const size = order.map((k) => Math.hypot(re[k], im[k])), at = order.map((k) => omega[k]);
  let above = 0;
  return (w) => {
    while (above <= last && at[above] < w) above++;
    if (above === 0 || above > last) return size[Math.min(above, last)];
    return size[above - 1] + ((w - at[above - 1]) / (at[above] - at[above - 1])) * (size[above] - size[above - 1]);
  };
}

/** Add samples at the full rate to `out`. The last 2 `REACH` samples of `x` are ahead of it by the reach of the filter. */
function upsampled(x, filter, out) {
  const half = (filter.length - 1) / 2;
  for (let n = 0; n < out.length; n++) {
    const first = Math.ceil((n - half) / RATIO), last = Math.floor((n + half) / RATIO);
    let sum = 0;
    for (let m = first; m <= last; m++) sum += x[m + REACH] * filter[n - RATIO * m + half];
    out[n] += sum;
  }
}
