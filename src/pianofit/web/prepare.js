// Tables of a key for the engine: modes of the string, contact weights, and the response to a stroke.
//
// The formulas are those of model/modes.py, model/contact.py, model/output_path.py and model/modal_response.py, in SI
// units. The sound of a key is the output of a bank of resonators and a short kernel, both driven by the stroke:
//
//   string model              resonators: modes of the string, each with the gain of the output path at its pole
//                             kernel: the remaining part of the response of the path
//   measured modal response   resonators: measured modes; kernel: the knock
//
// This module uses no DOM and no timers, so it also runs in node and in a notebook.

import { BLOCK } from "./contact.js";
import { dampingRates } from "./pedals.js";
import { convolve, fft, lowpass, resample } from "./signal.js";

const LOWEST_RATE = 88000; // Hz, of the contact, see model/simulate.py
const LARGEST_AFTERSOUND = 0.5; // amplitude of an aftersound over that of its whole partial at the begin
const HIGHEST = 0.4; // modes at or above this fraction of the contact rate are left out
const ENOUGH_MODES = 30;
const FAINT_WEIGHT = 1e-3;
const MOST_MODES = 512;
const MOST_DAMPED = 0.9; // largest α/ω
const SAME_PARTIAL = 0.005; // relative, see model/output_path.py
const RESPONSE = 1.0; // s, length of the transform for the impulse response of a path; its first half is kept
// Energy of the truncated tail of a path's impulse response, relative to the whole: -112 dB. The error of the sound is
// then below -80 dB.
const TAIL_ENERGY = 6e-12;
// The gain of a mode through the path sums the impulse response until the mode has decayed by exp of this.
const MOST_DECAY = 12;
export const LEAD = 0.012; // s from the beginning of a knock to the contact, see model/modal_response.py
const STATIC_DECAY = 35; // the correction for static deflection ends where it has decayed by exp of this
const EDGE = 10; // samples from the beginning of the band-limited force to the contact

/** Numbers, little endian, from base64. */
function numbers(text, kind = Float32Array) {
  return Float64Array.from(new kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer));
}

const PACKED_BLOCK = 64; // samples that share a number of bits, see knock_encoding.py

/** Samples of a channel, see `pack` in knock_encoding.py. */
function samples({ step, blocks, packed }) {
  const heads = numbers(blocks, Uint8Array), bytes = numbers(packed, Uint8Array);
  const out = new Float64Array(heads.length * PACKED_BLOCK);
  let bit = 0, n = 0;
  for (const head of heads) {
    const width = head & 15, unit = step / 2 ** (head >> 4);
    for (const end = n + PACKED_BLOCK; n < end; n++) {
      let whole = 0;
      for (let left = width; left > 0; left--, bit++) whole = 2 * whole + ((bytes[bit >> 3] >> (7 - (bit & 7))) & 1);
      if (width) out[n] = unit * (whole - 2 ** (width - 1));
    }
  }
  return out;
}

/** Decode the release noises of payload.py: [{midi, sound: [channels], rate}]. */
export function decodeReleases(releases) {
  return releases.map(({ midi, sound, rate }) => ({ midi, rate, sound: sound.map(samples) }));
}

/** Decode an entry of payload.py to a key for `prepare`. */
export function decode(entry) {
  const { path, modal_response: encoded, ...key } = entry;
  if (path) key.path = Object.fromEntries(Object.entries(path).map(([name, text]) => [name, numbers(text)]));
  if (encoded) key.modal_response = decodeResponse(encoded);
  return key;
}

function decodeResponse({ partial, decay, omega, modal_amplitudes, velocity_gain, knock, rate }) {
  const pair = (column) => ({ re, im }) => ({ re: column(re), im: column(im) });
  const gain = (text) => numbers(text, Int16Array).map((x) => x * velocity_gain.scale);
  const count = numbers(decay).length, kind = atob(partial).length === count ? Uint8Array : Uint16Array;
  return {
    partial: numbers(partial, kind),
    pole: { re: numbers(decay).map((x) => -x), im: numbers(omega, Float64Array) },
    modal_amplitudes: modal_amplitudes.map(pair(numbers)),
    velocity_gain: velocity_gain && { velocity: velocity_gain.velocity, strokes: velocity_gain.strokes.map(pair(gain)) },
    knock: knock.map(samples),
    rate,
  };
}

/** Σ_k Re(amplitude_k z_k^n), n < count, with z = exp(logZ). */
function sumDamped(amplitude, logZ, count) {
  const CHECK = 64, GONE_POWER = 1e-60, out = new Float64Array(count); // steps between checks, and the end of a mode
  for (let k = 0; k < logZ.re.length; k++) {
    const decay = Math.exp(logZ.re[k]), c = decay * Math.cos(logZ.im[k]), s = decay * Math.sin(logZ.im[k]);
    let x = amplitude.re[k], y = amplitude.im[k];
    for (let n = 0; n < count; n++) {
      if (n % CHECK === 0 && x * x + y * y < GONE_POWER) break;
      out[n] += x;
      const turned = x * c - y * s;
      y = x * s + y * c;
      x = turned;
    }
  }
  return out;
}

/** Frequencies of the string's partials, Hz [count]. */
export function partials(string, length, count) {
  return Float64Array.from({ length: count }, (_, i) => {
    const s = (((i + 1) * Math.PI) / length) ** 2;
    return Math.sqrt(string.c ** 2 * s + string.kappa ** 2 * s * s) / (2 * Math.PI);
  });
}

/** Weights of the contact window [count]: ∫ ĝ sin(β_k x) dx. */
export function raisedCosineWeights(geometry, count) {
  const sinc = (x) => (x === 0 ? 1 : Math.sin(Math.PI * x) / (Math.PI * x));
  return Float64Array.from({ length: count }, (_, i) => {
    const beta = ((i + 1) * Math.PI) / geometry.length, s = (beta * geometry.width) / (2 * Math.PI);
    return Math.sin(beta * geometry.strike_position) * (sinc(s) + 0.5 * sinc(s + 1) + 0.5 * sinc(s - 1));
  });
}

/** Contact steps per sample. */
export function contactRatio(string, geometry, rate) {
  const strong = raisedCosineWeights(geometry, MOST_MODES).findLastIndex((x) => Math.abs(x) > FAINT_WEIGHT) + 1;
  const needed = Math.min(ENOUGH_MODES, strong || ENOUGH_MODES);
  const wanted = Math.max(LOWEST_RATE, (1.01 * partials(string, geometry.length, needed)[needed - 1]) / HIGHEST);
  return Math.ceil(wanted / rate);
}

/** Mode table of the string at the contact rate, Hz; see model/modes.py. Complex columns are pairs {re, im}. */
export function modeTable(key, rate) {
  const { string, geometry } = key, step = 1 / rate, a = step / 2, all = partials(string, geometry.length, MOST_MODES);
  const below = all.filter((f) => f < HIGHEST * rate).length;
  const count = Math.min(MOST_MODES, 64 * Math.ceil(below / 64));
  const weights = raisedCosineWeights(geometry, count), column = () => new Float64Array(count);
  const pair = () => ({ re: column(), im: column() });
  // strikeWeight: Φ; unit: amplitude that a unit T leaves, m/N, in the numerical scheme; excitation: the same in
  // physical displacement, or that of the release of 1 N; pickup: signal per displacement; mass and omega2: those of the scheme, for its energy.
  const t = { step, strikeWeight: column(), unit: pair(), excitation: pair(), pole: pair(), pickup: pair(),
    compliance: 0, mass: column(), omega2: column(), modes: 0 };
  for (let k = 0; k < count; k++) {
    const beta = ((k + 1) * Math.PI) / geometry.length, s = beta * beta;
    const omega = Math.sqrt(string.c ** 2 * s + string.kappa ** 2 * s * s);
    const alpha = Math.min(string.b1 + string.b2 * s, MOST_DAMPED * omega), turn = Math.sqrt(omega ** 2 - alpha ** 2);
    const angle = Math.min(omega * a, HIGHEST * Math.PI), scale = angle / omega;
    // tanh(pole a)/a
    const x = -2 * alpha * scale, y = 2 * turn * scale, denominator = a * (Math.cosh(x) + Math.cos(y));
    const damping = -Math.sinh(x) / denominator, omega2 = damping ** 2 + (Math.sin(y) / denominator) ** 2;
    const weight = omega * step < 2 * Math.PI * HIGHEST ? weights[k] : 0;
    const drive = ((2 * weight) / geometry.mass) * (omega2 / omega ** 2);
    const v = (a * drive) / (1 + 2 * a * damping + a * a * omega2), q = a * v;
    const warp = angle / (Math.sin(angle) * Math.cos(angle));
    t.unit.re[k] = q;
    t.unit.im[k] = -(v + damping * q) / Math.sqrt(omega2 - damping ** 2);
    [t.excitation.re[k], t.excitation.im[k]] = [t.unit.re[k] * warp, t.unit.im[k] * warp];
    if (!key.hammer) { // the static displacement under 1 N, see excitation/pluck.py
      const q0 = (2 * weight) / (geometry.mass * omega ** 2);
      [t.excitation.re[k], t.excitation.im[k]] = [q0, (-q0 * alpha) / turn];
    }
    [t.pole.re[k], t.pole.im[k]] = [-alpha, turn];
    [t.pickup.re[k], t.pickup.im[k]] = pickupOf(key, beta, k, alpha, turn);
    t.compliance += (weight * drive) / omega2;
    t.strikeWeight[k] = weight;
    t.mass[k] = drive === 0 ? 0 : weight / drive;
    t.omega2[k] = omega2;
    if (weight !== 0) t.modes = k + 1;
  }
  return t;
}

/** Signal per free displacement of a mode, complex. */
function pickupOf({ quantity, string, geometry }, beta, k, alpha, turn) {
  const read = Math.sin(beta * geometry.pickup);
  if (quantity === "displacement") return [read, 0];
  if (quantity === "velocity") return [-alpha * read, turn * read];
  const tension = ((string.c ** 2 * beta + string.kappa ** 2 * beta ** 3) * geometry.mass) / geometry.length;
  return [k % 2 ? -tension : tension, 0];
}

/** Level of each mode in the path filter, dB; see `sample_at_modes` in model/output_path.py. */
export function sampleAtModes(path, pole) {
  const count = pole.re.length, size = Float64Array.from(pole.re, (x, k) => Math.hypot(x, pole.im[k]) / (2 * Math.PI));
  const db = new Float64Array(count), last = path.frequency.length - 1;
  for (let k = 0; k < count; k++) {
    let above = path.frequency.findIndex((f) => f >= size[k]);
    if (above < 0) above = last;
    const lower = Math.max(above - 1, 0);
    const nearest = size[k] - path.frequency[lower] <= path.frequency[above] - size[k] ? lower : above;
    const near = Math.abs(size[k] / path.frequency[nearest] - 1) < SAME_PARTIAL;
    const width = Math.log(path.frequency[above] / path.frequency[lower]);
    const part = width ? Math.min(Math.max(Math.log(size[k] / path.frequency[lower]) / width, 0), 1) : 0;
    db[k] = near ? path.db[nearest] : path.db[lower] + part * (path.db[above] - path.db[lower]);
  }
  return { frequency: size, db };
}

/** Minimum-phase impulse response [samples] of levels at frequencies, truncated; see model/output_path.py. */
function impulse({ frequency, db }, rate) {
  const size = 2 ** Math.ceil(Math.log2(RESPONSE * rate)), half = size / 2;
  const re = new Float64Array(size), im = new Float64Array(size);
  for (let k = 0, at = 0; k <= half; k++) {
    const f = (k * rate) / size;
    while (at < frequency.length - 2 && frequency[at + 1] < f) at++;
    const part = Math.min(Math.max((f - frequency[at]) / (frequency[at + 1] - frequency[at]), 0), 1);
    const smooth = part * part * (3 - 2 * part);
    re[k] = (Math.LN10 / 20) * (db[at] + smooth * (db[at + 1] - db[at]));
    re[(size - k) % size] = re[k];
  }
  fft(re, im, 1);
  for (let n = 0; n < size; n++) {
    re[n] *= (n === 0 || n === half ? 1 : n < half ? 2 : 0) / size;
    im[n] = 0;
  }
  fft(re, im);
  for (let k = 0; k < size; k++) {
    const r = Math.exp(re[k]);
    [re[k], im[k]] = [r * Math.cos(im[k]), r * Math.sin(im[k])];
  }
  fft(re, im, 1);
  const energy = re.subarray(0, half).reduce((sum, x) => sum + x * x, 0);
  let tail = 0, end = half;
  while (end > 1 && tail + re[end - 1] ** 2 <= TAIL_ENERGY * energy) tail += re[--end] ** 2;
  return re.slice(0, end).map((x) => x / size);
}

/** Samples after `silence` zeros. */
function delayed(silence, samples) {
  const out = new Float64Array(silence + samples.length);
  out.set(samples, silence);
  return out;
}

/** Products of complex columns {re, im}. */
export const times = (a, b) => ({
  re: a.re.map((x, k) => x * b.re[k] - a.im[k] * b.im[k]), im: a.im.map((x, k) => x * b.re[k] + a.re[k] * b.im[k]),
});
const firstModes = (pair, count) => ({ re: pair.re.slice(0, count), im: pair.im.slice(0, count) });
/** A complex column times a real factor. */
export const scaled = ({ re, im }, factor) => ({ re: re.map((x) => factor * x), im: im.map((x) => factor * x) });
const logZOf = (pole, rate) => ({ re: pole.re.map((x) => x / rate), im: pole.im.map((x) => x / rate) });

/** Transfer function of the path at the pole of each mode, summed within `MOST_DECAY`. */
function pathGains(response, logZ) {
  const out = { re: new Float64Array(logZ.re.length), im: new Float64Array(logZ.re.length) };
  for (let k = 0; k < logZ.re.length; k++) {
    const end = Math.min(response.length, Math.floor(MOST_DECAY / Math.max(-logZ.re[k], 1e-12)));
    const size = Math.exp(-logZ.re[k]), c = size * Math.cos(logZ.im[k]), s = -size * Math.sin(logZ.im[k]);
    let re = 0, im = 0;
    for (let j = end - 1; j >= 0; j--) [re, im] = [re * c - im * s + response[j], re * s + im * c];
    [out.re[k], out.im[k]] = [re, im];
  }
  return out;
}

/** Response of a key without measured modes: its string through its output path. */
function stringResponse(key, t, path, rate, ratio) {
  const count = t.pole.im.filter((x, k) => k < t.modes && x < Math.PI * rate).length;
  const [audiblePole, excitation, pickup] = [t.pole, t.excitation, t.pickup].map((pair) => firstModes(pair, count));
  const dryGain = scaled(pickup, key.gain);
  const filter = path ? impulse(path, rate) : [], size = filter.length;
  const gain = path ? times(dryGain, pathGains(filter, logZOf(audiblePole, rate))) : dryGain;
  const fineLogZ = logZOf(audiblePole, rate * ratio), kernel = new Float64Array(size * ratio);
  const [dry, resonators] = [dryGain, gain].map((g) => sumDamped(times(g, excitation), fineLogZ, size * ratio));
  for (let phase = 0; phase < ratio && size; phase++) {
    const samples = Float64Array.from({ length: size }, (_, j) => dry[j * ratio + phase]);
    convolve(samples, filter, size).forEach((x, j) => (kernel[j * ratio + phase] = x - resonators[j * ratio + phase]));
  }
  const direct = [sumDamped(times(gain, excitation), fineLogZ, BLOCK * ratio)];
  return { pole: audiblePole, excitation, gain: [gain], kernel: [kernel], direct, ratio, lead: 0, padding: 0, edge: 0 };
}

/** Measured response of a key, from the force on the string to the file. */
function measuredResponse({ modal_response: measured }, rate) {
  const below = Array.from(measured.pole.im.keys()).filter((k) => measured.pole.im[k] < Math.PI * rate);
  const column = (values) => Float64Array.from(below, (k) => values[k]);
  const chosen = ({ re, im }) => ({ re: column(re), im: column(im) });
  const pole = chosen(measured.pole), gain = measured.modal_amplitudes.map(chosen), logZ = logZOf(pole, rate);
  const velocityGain = measured.velocity_gain && { ...measured.velocity_gain,
    strokes: measured.velocity_gain.strokes.map(chosen) };
  // The lead is padded to whole blocks, because dampers move at the beginning of blocks.
  const knockLead = Math.round(LEAD * rate), lead = BLOCK * Math.ceil(knockLead / BLOCK), padding = lead - knockLead;
  const kernel = measured.knock.map((x) => delayed(padding, resample(x, measured.rate, rate)));
  subtractFirstSample(kernel, gain, lead);
  const prompt = promptModes(pole, column(measured.partial), gain);
  const response = { pole, logZ, gain, velocityGain, prompt, kernel, ratio: 1, lead, padding, edge: EDGE };
  return { ...response, ...excite(response, { re: pole.re.map(() => 1), im: pole.re.map(() => 0) }) };
}

/**
 * Subtract half of the first sample of the sum of modes from the sample `at` of each channel of a knock, which in the page
 * is a part of a continuous response; see `continuous_knock` in model/modal_response.py.
 */
export function subtractFirstSample(knock, gain, at) {
  knock.forEach((x, i) => {
    if (at < x.length) x[at] -= 0.5 * gain[i].re.reduce((sum, y) => sum + y, 0);
  });
}

/** The amplitudes `excitation` that a unit force leaves in the modes, and their sound within a block. */
function excite({ gain, logZ }, excitation) {
  return { excitation, direct: gain.map((g) => sumDamped(times(g, excitation), logZ, BLOCK)) };
}

const expOf = (re, im) => ({ re: Math.exp(re) * Math.cos(im), im: Math.exp(re) * Math.sin(im) });
const product = (a, b) => ({ re: a.re * b.re - a.im * b.im, im: a.re * b.im + a.im * b.re });
const inverse = ({ re, im }) => ({ re: re / (re ** 2 + im ** 2), im: -im / (re ** 2 + im ** 2) });

/**
 * A knock with the correction that cancels the static deflection of modes with the additional amplitude `added`. The
 * sound of a mode is its acceleration; see `cancel_static_deflection` in model/modal_response.py.
 */
function cancelStaticDeflection({ logZ, lead }, added, knock) {
  const out = Float64Array.from(knock);
  for (let k = 0; k < logZ.re.length; k++) {
    const speed = Math.hypot(logZ.re[k], logZ.im[k]), q = Math.exp(-speed);
    const z = expOf(logZ.re[k], logZ.im[k]), zInverse = inverse(z);
    const below = inverse({ re: 1 - zInverse.re, im: -zInverse.im });
    const root = product({ re: 1 - q * zInverse.re, im: -q * zInverse.im }, below);
    const scale = product(root, root), factor = (1 - 1 / q) ** 2;
    const pole = inverse({ re: 1 - z.re / q, im: -z.im / q });
    const double = product({ re: factor * scale.re, im: factor * scale.im }, pole);
    const single = { re: scale.re - 1 - double.re, im: scale.im - double.im };
    const [a, b] = [single, double].map((x) => added.re[k] * x.re - added.im[k] * x.im);
    const size = Math.min(Math.ceil(STATIC_DECAY / speed), out.length - lead);
    for (let n = 0, power = 1; n < size; n++, power *= q) out[lead + n] += (a + b * (n + 1)) * power;
  }
  return out;
}

/** Whether each mode belongs to the prompt sound, and not to the aftersound; see `UnaCorda.weights` in Python. */
function promptModes(pole, partial, gain) {
  const partials = new Map();
  partial.forEach((k, m) => {
    if (!partials.has(k)) partials.set(k, { slowest: Infinity, fastest: 0, begin: gain.map(() => [0, 0]) });
    const all = partials.get(k), rate = -pole.re[m];
    Object.assign(all, { slowest: Math.min(all.slowest, rate), fastest: Math.max(all.fastest, rate) });
    gain.forEach(({ re, im }, c) => (all.begin[c] = [all.begin[c][0] + re[m], all.begin[c][1] + im[m]]));
  });
  return Uint8Array.from(partial, (k, m) => {
    const { slowest, fastest, begin } = partials.get(k), size = Math.hypot(...begin.flat());
    const isSlow = -pole.re[m] < Math.sqrt(slowest * fastest) * (1 - 1e-12);
    return !(isSlow && Math.hypot(...gain.flatMap(({ re, im }) => [re[m], im[m]])) <= LARGEST_AFTERSOUND * size);
  });
}

/** Velocity gain of the modes at `velocity`, m/s. */
function gainAt({ velocity: measured, strokes }, velocity) {
  const last = measured.length - 1, above = measured.findIndex((v) => v >= velocity);
  const high = above < 0 ? last : above, low = Math.max(high - 1, 0), isOutside = high === low || above < 0;
  const share = isOutside ? 1 : Math.log(velocity / measured[low]) / Math.log(measured[high] / measured[low]);
  const mixed = (part) => strokes[low][part].map((x, k) => x + share * (strokes[high][part][k] - x));
  return { re: mixed("re"), im: mixed("im") };
}

/**
 * The response to a stroke at `velocity`, m/s: the modes have their velocity gain, returned as `velocityFactor`. The
 * left pedal reduces prompt modes and knock to `share`.
 */
export function atVelocity(response, velocity, share = 1) {
  const { velocityGain, prompt, gain } = response, factor = velocityGain && gainAt(velocityGain, velocity);
  if (!factor && share === 1) return response;
  const knock = response.kernel.map((x) => x.map((y) => share * y));
  if (!prompt) {
    const direct = response.direct.map((x) => x.map((y) => share * y));
    return { excitation: scaled(response.excitation, share), direct, kernel: knock };
  }
  const weight = Float64Array.from(prompt, (isPrompt) => (isPrompt ? share : 1)), zero = weight.map(() => 0);
  if (!factor) return { ...excite(response, { re: weight, im: zero }), kernel: knock };
  const weighted = (column) => column.map((x, k) => x * weight[k]);
  const added = { re: weighted(factor.re.map((x) => x - 1)), im: weighted(factor.im) };
  const kernel = knock.map((x, i) => (x.length > response.lead ? cancelStaticDeflection(response, times(gain[i], added), x) : x));
  const excitation = { re: weighted(factor.re), im: added.im };
  return { ...excite(response, excitation), kernel, velocityFactor: factor };
}

/**
 * All tables that the engine needs of a key at a rate, Hz.
 *
 * key: {string: {c, kappa, b1, b2}, hammer: {K_H, mu, p, M_H} or null for a pluck, geometry: {length, mass, strike_position, width,
 * pickup}, quantity, gain, strings, damper, path?: {frequency, db}, modal_response?: {partial, pole, modal_amplitudes: [channel],
 * knock: [channel], rate, velocity_gain?: {velocity, strokes}}}. `pole` and the elements of `modal_amplitudes` and
 * `strokes` are {re, im}. Amplitudes are in file units per N s.
 */
export function prepare(key, rate) {
  const ratio = contactRatio(key.string, key.geometry, rate), t = modeTable(key, rate * ratio);
  const path = key.path ? sampleAtModes(key.path, t.pole) : null;
  const isMeasured = Boolean(key.modal_response);
  const response = isMeasured ? measuredResponse(key, rate) : stringResponse(key, t, path, rate, ratio);
  const pairs = ["unit", "excitation", "pole"].map((name) => [name, firstModes(t[name], t.modes)]);
  const columns = ["strikeWeight", "mass", "omega2"].map((name) => [name, t[name].slice(0, t.modes)]);
  const string = { ...Object.fromEntries([...pairs, ...columns]), step: t.step, ratio, compliance: t.compliance };
  string.damping = dampingRates(key.damper, string.pole);
  response.damping = isMeasured ? dampingRates(key.damper, response.pole) : string.damping;
  return { string, response, hammer: key.hammer, strings: key.strings, isMeasured,
    smooth: isMeasured ? lowpass(1, ratio) : null };
}
