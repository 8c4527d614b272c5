// Strings of all keys as modes on one bridge, with the formulas of playback/free_strings.py and
// playback/coupled_modes.py: poles, drives, and the amplitudes that an impulse on one key leaves on all others.
//
// Everything here is computed once for an instrument, outside the audio thread. `resonance.js` plays it.

import { dampingRates } from "./pedals.js";
import { contactRatio, modeTable, raisedCosineWeights, sampleAtModes } from "./prepare.js";
import { fft } from "./signal.js";

const HIGHEST_FREE = 4500; // Hz, highest frequency of a free mode
const LEAST_STRIKE = 0.1; // smallest strike weight of a partial
const CERTAIN_SIGN = 1e-9; // strike weight whose sign does not depend on rounding errors
export const COMMON = 0.3; // share of the motion of the bridge that strings have in common, as `RESONANCE` in Python
export const TAPER = 2 * Math.PI * 45; // rad/s, difference of frequencies beyond which only strokes couple modes
const MOST_BRIDGE_SHARE = 0.95; // of its loss that a partial can give to the bridge
const KNOCK_PADDING = 4; // zero padding of the transform of a knock
const KNOCK_LEAD = 0.012; // s from the begin of a knock to the contact
// Most free modes, so that the audio thread has room for strokes. A piano with two modes a partial has 5,300.
export const MOST_FREE = 7000;
const HAMMER_CORNER = 2 * Math.PI * 1000; // rad/s, above which the force of a hammer falls by 12 dB an octave

/** Complex zeros. */
export const zeros = (count) => ({ re: new Float64Array(count), im: new Float64Array(count) });

/** Admittance of the bridge, s/kg, at a frequency, Hz. */
function admittance({ hz, value }, f) {
  const above = hz.findIndex((x) => x >= f);
  if (above <= 0) return value.at(above);
  const part = Math.log(f / hz[above - 1]) / Math.log(hz[above] / hz[above - 1]);
  return Math.exp(Math.log(value[above - 1]) + part * Math.log(value[above] / value[above - 1]));
}

/** Sums of a column over modes with the same partial number, at each mode. */
function partialSums(column, partial) {
  const sums = new Map();
  column.forEach((x, k) => sums.set(partial[k], (sums.get(partial[k]) ?? 0) + x));
  return column.map((_, k) => sums.get(partial[k]));
}

/** Modes of a measured response below half of the rate, as the voice has them. */
function measuredModes({ modal_response: measured }, rate) {
  const below = Array.from(measured.pole.im.keys()).filter((k) => measured.pole.im[k] < Math.PI * rate);
  const column = (values) => Float64Array.from(below, (k) => values[k]);
  const pair = ({ re, im }) => ({ re: column(re), im: column(im) });
  const pattern = measured.modal_amplitudes.map(pair), partial = column(measured.partial);
  const size = partial.map((_, k) => Math.sqrt(pattern.reduce((sum, g) => sum + g.re[k] ** 2 + g.im[k] ** 2, 0)));
  const total = partialSums(size, partial);
  return { pole: pair(measured.pole), partial, share: size.map((x, k) => x / Math.max(total[k], 1e-300)), pattern };
}

/** Modes of the string model. Their states are displacements, m. */
function modelledModes(key, rate) {
  const t = modeTable(key, rate * contactRatio(key.string, key.geometry, rate)), count = t.modes;
  const path = key.path ? sampleAtModes(key.path, t.pole) : null;
  const level = (k) => (t.pole.im[k] < Math.PI * rate ? key.gain * (path ? 10 ** (path.db[k] / 20) : 1) : 0);
  const cut = (column) => column.slice(0, count);
  const pole = { re: cut(t.pole.re), im: cut(t.pole.im) }, partial = Float64Array.from({ length: count }, (_, k) => k + 1);
  const pattern = [{ re: cut(t.pickup.re).map((x, k) => x * level(k)), im: cut(t.pickup.im).map((x, k) => x * level(k)) }];
  const root = Math.sqrt((key.strings * key.geometry.mass) / 2);
  const perState = { re: pole.re.map((x, k) => root * Math.hypot(x, pole.im[k])), im: new Float64Array(count) };
  return { pole, partial, share: new Float64Array(count).fill(1), pattern, perState };
}

/** Free modes of one key. Amplitudes are normalised to energy; see `FreeString` in Python. */
export function freeString(key, rate, bridge) {
  const { pole, partial, share, pattern, perState } = key.modal_response ? measuredModes(key, rate) : modelledModes(key, rate);
  const { strings, geometry, string } = key, weights = raisedCosineWeights(geometry, Math.max(1, ...partial));
  const unison = Math.sqrt((2 * strings) / geometry.mass), perMode = strings * geometry.mass * (string.c / geometry.length) ** 2;
  const hz = pole.im.map((x) => x / (2 * Math.PI)), chosen = Array.from(hz.keys()).filter((k) =>
    hz[k] < Math.min(HIGHEST_FREE, rate / 2) && share[k] > 0 && pattern.some((g) => g.re[k] || g.im[k]));
  const column = (of) => Float64Array.from(chosen, of), weight = (k) => weights[partial[k] - 1];
  const rates = column((k) => perMode * admittance(bridge, hz[k]));
  const taken = partialSums(column((k, i) => (share[k] * rates[i]) / -pole.re[k]), column((k) => partial[k]));
  const limited = (k, i) => share[k] * rates[i] * Math.min(1, MOST_BRIDGE_SHARE / Math.max(taken[i], 1e-300));
  // States of measured modes are impulses, N s, and excite amplitudes along -j.
  const size = (k) => -Math.sqrt(share[k]) * unison;
  const clear = (k) => (weight(k) < -CERTAIN_SIGN ? -1 : 1) * Math.max(Math.abs(weight(k)), LEAST_STRIKE);
  const state = perState ? { re: column((k) => perState.re[k]), im: column((k) => perState.im[k]) }
    : { re: new Float64Array(chosen.length), im: column((k) => size(k) * clear(k)) };
  const sound = pattern.map((g) => {
    const power = chosen.map((_, i) => state.re[i] ** 2 + state.im[i] ** 2);
    return { re: column((k, i) => (g.re[k] * state.re[i] + g.im[k] * state.im[i]) / power[i]),
      im: column((k, i) => (g.im[k] * state.re[i] - g.re[k] * state.im[i]) / power[i]) };
  });
  const chosenPole = { re: column((k) => pole.re[k]), im: column((k) => pole.im[k]) };
  return { chosen: Int32Array.from(chosen), pole: chosenPole,
    drive: column((k, i) => (partial[k] % 2 ? 1 : -1) * Math.sqrt(limited(k, i))), perState: state,
    perImpulse: column((k) => size(k) * weight(k)), sound, damping: dampingRates(key.damper, chosenPole) };
}

/** Modes that strokes make the loudest, in order of frequency: key `i`, mode `k` of the key. */
function keptModes(strings, most) {
  const all = strings.flatMap((s, i) => Array.from(s.chosen, (_, k) => ({ i, k, omega: s.pole.im[k], loud: loudness(s, k) })));
  if (all.length > most) all.sort((a, b) => b.loud - a.loud).length = most;
  return all.sort((a, b) => a.omega - b.omega);
}

/** Squared amplitude of the sound of a mode after a stroke on another key. */
function loudness({ sound, drive, pole }, k) {
  const power = sound.reduce((sum, g) => sum + g.re[k] ** 2 + g.im[k] ** 2, 0);
  return (drive[k] ** 2 * power) / (1 + (pole.im[k] / HAMMER_CORNER) ** 4);
}

/** Modes of all keys in ascending order of frequency. */
export class FreeStrings {
  /** keys: Map of MIDI numbers to decoded keys; bridge: {hz, value}; rate: Hz; most: number of modes that are kept. */
  constructor(keys, bridge, rate, most = MOST_FREE) {
    const midis = [...keys.keys()], strings = midis.map((midi) => freeString(keys.get(midi), rate, bridge));
    const kept = keptModes(strings, most), column = (of) => Float64Array.from(kept, of), index = new Map();
    const pair = (of) => ({ re: column(({ i, k }) => of(strings[i]).re[k]), im: column(({ i, k }) => of(strings[i]).im[k]) });
    const channels = Math.max(...strings.map((s) => s.sound.length));
    // In a measured instrument the response of strings without a damper is in the recordings of all keys.
    const isMeasured = [...keys.values()].some((key) => key.modal_response);
    const received = strings.map((s) => (!isMeasured || s.damping.some((x) => x > 0) ? COMMON : 0));
    kept.forEach(({ i, k }, at) => {
      if (!index.has(midis[i])) index.set(midis[i], { modes: [], chosen: [] });
      index.get(midis[i]).modes.push(at);
      index.get(midis[i]).chosen.push(strings[i].chosen[k]);
    });
    this.keys = keys;
    this.rate = rate;
    this.perImpulse = column(({ i, k }) => strings[i].perImpulse[k]); // along j
    // All that the audio thread needs.
    this.data = {
      midis, dropped: strings.reduce((sum, s) => sum + s.chosen.length, 0) - kept.length, pole: pair((s) => s.pole),
      drive: column(({ i, k }) => strings[i].drive[k]), perState: pair((s) => s.perState),
      sound: Array.from({ length: channels }, (_, c) => pair((s) => s.sound[Math.min(c, s.sound.length - 1)])),
      damping: column(({ i, k }) => strings[i].damping[k]), key: Int32Array.from(kept, ({ i }) => i),
      received: column(({ i }) => received[i]), // share of the bridge's motion that acts on each mode
      ofKey: new Map([...index].map(([midi, { modes, chosen }]) =>
        [midi, { modes: Int32Array.from(modes), chosen: Int32Array.from(chosen) }])),
    };
    Object.assign(this.data, { own: ownTaper(this.data), ...windows(this.data) });
  }

  /** Amplitudes that a force of 1 N s on a key leaves on modes far from its own: by its strings, and by its knock. */
  response(midi) {
    const { ofKey, pole } = this.data, own = ofKey.get(midi)?.modes ?? [], out = zeros(pole.re.length);
    this._addStrings(out, own);
    const { knock } = this.keys.get(midi).modal_response ?? {};
    if (knock?.[0]?.length) this._addKnock(out, midi);
    for (const k of own) out.re[k] = out.im[k] = 0;
    const scaled = (column) => Float32Array.from(column, (x, k) => this.data.received[k] * x);
    return { re: scaled(out.re), im: scaled(out.im) };
  }

  /** See `far_response` in playback/coupled_modes.py. The strengths lie along j. */
  _addStrings(out, own) {
    const { pole, drive } = this.data, count = drive.length;
    for (const s of own) {
      const size = drive[s] * this.perImpulse[s], a = pole.re[s], b = pole.im[s];
      for (let t = 0; t < count; t++) {
        const apart = Math.abs(b - pole.im[t]) / TAPER, far = apart < 1 ? apart : 1;
        if (far === 0) continue;
        const x = pole.re[t] - a, y = pole.im[t] - b, z = pole.im[t] + b, near = x * x + y * y, mirrored = x * x + z * z;
        const weight = size * far * drive[t];
        // -(j/(x + jy) - j/(x + jz))
        out.re[t] += weight * (z / mirrored - y / near);
        out.im[t] += weight * (x / mirrored - x / near);
      }
    }
  }

  _addKnock(out, midi) {
    const { pole, drive, sound } = this.data, transforms = knockTransforms(this.keys.get(midi).modal_response, pole);
    for (let t = 0; t < drive.length; t++) {
      let re = 0, im = 0, power = 0;
      sound.forEach((g, c) => {
        const at = transforms[Math.min(c, transforms.length - 1)];
        re += g.re[t] * at.re[t] + g.im[t] * at.im[t];
        im += g.re[t] * at.im[t] - g.im[t] * at.re[t];
        power += g.re[t] ** 2 + g.im[t] ** 2;
      });
      const size = (-2 * drive[t] ** 2) / Math.max(power, 1e-300);
      out.re[t] += size * re;
      out.im[t] += size * im;
    }
  }
}

/** Transforms of a knock at poles, relative to the contact, of each channel; see `_knock_transform` in Python. */
function knockTransforms({ knock, rate }, pole) {
  let energy = 0, moment = 0, size = 1;
  for (const x of knock) x.forEach((y, n) => ((energy += y * y), (moment += n * y * y)));
  while (size < KNOCK_PADDING * knock[0].length) size *= 2;
  const centre = moment / Math.max(energy, 1e-300) / rate;
  return knock.map((x) => {
    const spectrum = zeros(size);
    spectrum.re.set(x);
    fft(spectrum.re, spectrum.im);
    const out = spectrumAt(spectrum, rate / size, centre, pole);
    for (let t = 0; t < pole.re.length; t++) {
      const angle = pole.im[t] * (KNOCK_LEAD - centre), c = Math.cos(angle) / rate, s = Math.sin(angle) / rate;
      [out.re[t], out.im[t]] = [out.re[t] * c - out.im[t] * s, out.re[t] * s + out.im[t] * c];
    }
    return out;
  });
}

/** A spectrum at the frequencies of poles, interpolated about the time `centre` of its signal, s. */
function spectrumAt({ re, im }, spacing, centre, pole) {
  const out = zeros(pole.re.length), last = re.length / 2 - 1;
  for (let t = 0; t < pole.re.length; t++) {
    const place = pole.im[t] / (2 * Math.PI * spacing), below = Math.floor(place);
    if (below > last) continue; // beyond the rate of the knock
    for (const [bin, part] of [[below, 1 - place + below], [below + 1, place - below]]) {
      const angle = 2 * Math.PI * spacing * centre * bin, c = part * Math.cos(angle), s = part * Math.sin(angle);
      out.re[t] += re[bin] * c - im[bin] * s;
      out.im[t] += re[bin] * s + im[bin] * c;
    }
  }
  return out;
}

/** Ends [modes] of the window of modes within `TAPER` of each mode. */
function windows({ pole: { im: omega } }) {
  const count = omega.length, left = new Int32Array(count), right = new Int32Array(count);
  for (let k = 0, l = 0, r = 0; k < count; k++) {
    while (omega[l] < omega[k] - TAPER) l++;
    while (r < count && omega[r] <= omega[k] + TAPER) r++;
    [left[k], right[k]] = [l, r];
  }
  return { left, right };
}

/** Taper between modes of one string as rows of a sparse matrix: {start [modes + 1], column, weight}. */
function ownTaper({ pole: { im: omega }, ofKey, key, midis }) {
  const start = new Int32Array(omega.length + 1), column = [], weight = [];
  for (let k = 0; k < omega.length; k++) {
    for (const j of ofKey.get(midis[key[k]]).modes) {
      const taper = 1 - Math.abs(omega[k] - omega[j]) / TAPER;
      if (taper <= 0) continue;
      column.push(j);
      weight.push(taper);
    }
    start[k + 1] = column.length;
  }
  return { start, column: Int32Array.from(column), weight: Float64Array.from(weight) };
}
