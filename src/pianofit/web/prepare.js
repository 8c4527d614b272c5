// From a key's numbers to tables that the engine plays: the string's modes, its kernel at the strike, what is heard.
//
// The same formulas as model/modes.py, model/contact.py, model/output_path.py and model/modal_response.py, in SI units. All that a key
// makes heard is a bank of resonators and a short kernel, both driven by the stroke:
//
//   a key that rings by its law    resonators: the string's modes, each with the path's gain at its own pole
//                                  kernel: what the path's response does beside that, until it is over
//   a key whose ringing is known   resonators: its measured modes; kernel: its knock
//
// No DOM, and no timing: for the page, for node and for a notebook alike.

import { BLOCK } from "./contact.js";

const LOWEST_RATE = 88000; // Hz, of the contact, see model/simulate.py
const HIGHEST = 0.4; // modes at or above this part of the contact's rate stay out
const ENOUGH_MODES = 30;
const FAINT_WEIGHT = 1e-3;
const MOST_MODES = 512;
const MOST_DAMPED = 0.9; // α/ω of a mode that does not sound
const SAME_PARTIAL = 0.005; // relative; see model/output_path.py
const RESPONSE = 1.0; // s, for which a path's response is computed; its first half is kept
const LEVEL_SPAN = 0.35, LEVEL_DECAY = 8.0; // s and 1/s, see model/free_response.py
// A path's response ends where what is left of it holds this part of its energy, -112 dB: then the sound is within
// -80 dB of that through all of it.
const LEFT_OVER = 6e-12;
// A mode's gain through the path sums the response until the mode has decayed by exp of this.
const MOST_DECAY = 12;
const LEAD = 0.012; // s, a knock begins so long before the contact, see model/modal_response.py
const SILENT = 35; // the push of a mode is followed until it has decayed by exp of this
const EDGE = 10; // samples that the band-limited force begins before its touch

/** Numbers, little endian, from base64. */
function numbers(text, kind = Float32Array) {
  return Float64Array.from(new kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer));
}

const SHARED = 256; // samples of a knock that share a scale, see payload.py

/** A key as `prepare` takes it, of an entry that payload.py wrote. */
export function decode(entry) {
  const { path, ringing, ...key } = entry, pair = ({ re, im }) => ({ re: numbers(re), im: numbers(im) });
  if (path) key.path = Object.fromEntries(Object.entries(path).map(([name, text]) => [name, numbers(text)]));
  if (ringing) {
    const knock = ({ scale, whole }) => {
      const by = numbers(scale);
      return numbers(whole, ringing.bits === 8 ? Int8Array : Int16Array).map((x, n) => x * by[Math.floor(n / SHARED)]);
    };
    const pole = { re: numbers(ringing.decay).map((x) => -x), im: numbers(ringing.omega, Float64Array) };
    const known = ringing.participation;
    const part = (text) => numbers(text, Int16Array).map((x) => x * known.scale);
    const participation = known && { velocity: known.velocity,
      strokes: known.strokes.map(({ re, im }) => ({ re: part(re), im: part(im) })) };
    key.ringing = { pole, pattern: ringing.pattern.map(pair), participation, knock: ringing.knock.map(knock),
      rate: ringing.rate };
  }
  return key;
}

const circles = new Map(); // by size of a transform: cosines and sines

function circleOf(size) {
  if (!circles.has(size)) {
    const angle = Float64Array.from({ length: size / 2 }, (_, k) => (2 * Math.PI * k) / size);
    circles.set(size, [angle.map(Math.cos), angle.map(Math.sin)]);
  }
  return circles.get(size);
}

/** In place, of a power of two: the transform of re + i im; `sign` +1 is the inverse, not divided by the size. */
export function fft(re, im, sign = -1) {
  const size = re.length;
  const [cos, sin] = circleOf(size);
  for (let i = 1, j = 0; i < size; i++) {
    let bit = size >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [re[i], re[j]] = [re[j], re[i]];
      [im[i], im[j]] = [im[j], im[i]];
    }
  }
  for (let half = 1; half < size; half *= 2) {
    const stride = size / (2 * half);
    for (let start = 0; start < size; start += 2 * half) {
      for (let k = 0; k < half; k++) {
        const c = cos[k * stride], s = sign * sin[k * stride], a = start + k, b = a + half;
        const x = re[b] * c - im[b] * s, y = re[b] * s + im[b] * c;
        re[b] = re[a] - x;
        im[b] = im[a] - y;
        re[a] += x;
        im[a] += y;
      }
    }
  }
}

/** The first `count` numbers of a ∗ b. */
function convolve(a, b, count) {
  let size = 1;
  while (size < a.length + b.length) size *= 2;
  const re = new Float64Array(size), im = new Float64Array(size);
  re.set(a);
  im.set(b); // two real sequences in one transform: a ∗ b is in the square's imaginary part, halved
  fft(re, im);
  for (let k = 0; k < size; k++) [re[k], im[k]] = [re[k] * re[k] - im[k] * im[k], 2 * re[k] * im[k]];
  fft(re, im, 1);
  return im.slice(0, count).map((x) => x / (2 * size));
}

/** Kaiser's lowpass with β = 5, as scipy.signal.resample_poly designs it: [2 · 10 max(up, down) + 1]. */
function lowpass(up, down) {
  const most = Math.max(up, down), half = 10 * most, h = new Float64Array(2 * half + 1);
  const bessel = (x) => {
    let sum = 1, term = 1;
    for (let k = 1; term > 1e-17 * sum; k++) sum += term *= (x / (2 * k)) ** 2;
    return sum;
  };
  let total = 0;
  for (let i = 0; i <= 2 * half; i++) {
    const t = (i - half) / most, at = (i - half) / half;
    h[i] = bessel(5 * Math.sqrt(Math.max(1 - at * at, 0))) * (t === 0 ? 1 : Math.sin(Math.PI * t) / (Math.PI * t));
    total += h[i];
  }
  return h.map((x) => (most === 1 ? Number(x === h[half]) : (x * up) / total));
}

/** A sound of the rate `from` at the rate `to`, Hz, both whole. */
function resample(x, from, to) {
  let a = from, b = to;
  while (b) [a, b] = [b, a % b];
  const up = to / a, down = from / a;
  if (up === down) return Float64Array.from(x);
  const h = lowpass(up, down), half = (h.length - 1) / 2;
  const out = new Float64Array(Math.ceil((x.length * up) / down));
  for (let k = 0; k < out.length; k++) {
    const last = Math.min(Math.floor((k * down + half) / up), x.length - 1);
    for (let m = Math.max(Math.ceil((k * down - half) / up), 0); m <= last; m++) {
      out[k] += x[m] * h[k * down - m * up + half];
    }
  }
  return out;
}

/** Σ_k Re(amplitude_k z_k^n), n < count, of z = exp(log): a kernel. */
function damped(amplitude, log, count) {
  const LOOK = 64, OVER = 1e-60, out = new Float64Array(count); // every so many steps: is it over?
  for (let k = 0; k < log.re.length; k++) {
    const decay = Math.exp(log.re[k]), c = decay * Math.cos(log.im[k]), s = decay * Math.sin(log.im[k]);
    let x = amplitude.re[k], y = amplitude.im[k];
    for (let n = 0; n < count; n++) {
      if (n % LOOK === 0 && x * x + y * y < OVER) break;
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

/** The weights of the contact window, as many as asked for: ∫ ĝ sin(β_k x) dx. */
export function strikeWeights(geometry, count) {
  const sinc = (x) => (x === 0 ? 1 : Math.sin(Math.PI * x) / (Math.PI * x));
  return Float64Array.from({ length: count }, (_, i) => {
    const beta = ((i + 1) * Math.PI) / geometry.length, s = (beta * geometry.width) / (2 * Math.PI);
    return Math.sin(beta * geometry.strike) * (sinc(s) + 0.5 * sinc(s + 1) + 0.5 * sinc(s - 1));
  });
}

/** Steps of the contact per sample. */
function contactRatio(string, geometry, rate) {
  const strong = strikeWeights(geometry, MOST_MODES).findLastIndex((x) => Math.abs(x) > FAINT_WEIGHT) + 1;
  const needed = Math.min(ENOUGH_MODES, strong || ENOUGH_MODES);
  const wanted = Math.max(LOWEST_RATE, (1.01 * partials(string, geometry.length, needed)[needed - 1]) / HIGHEST);
  return Math.ceil(wanted / rate);
}

/** The string's table at the contact's rate, Hz; see model/modes.py. Complex columns are pairs of arrays, re and im. */
function modeTable(key, rate) {
  const { string, geometry } = key, step = 1 / rate, a = step / 2, all = partials(string, geometry.length, MOST_MODES);
  const below = all.filter((f) => f < HIGHEST * rate).length;
  const count = Math.min(MOST_MODES, 64 * Math.ceil(below / 64));
  const weights = strikeWeights(geometry, count), column = () => new Float64Array(count);
  const pair = () => ({ re: column(), im: column() });
  // strike: Φ; unit: what a unit T leaves at the strike, m/N, in the scheme; left: the same in the string's own
  // displacement; pickup: what is read of that; mass and omega2: the scheme's, for its energy.
  const t = { step, strike: column(), unit: pair(), left: pair(), pole: pair(), pickup: pair(), compliance: 0,
    mass: column(), omega2: column(), modes: 0 };
  for (let k = 0; k < count; k++) {
    const beta = ((k + 1) * Math.PI) / geometry.length, s = beta * beta;
    const omega = Math.sqrt(string.c ** 2 * s + string.kappa ** 2 * s * s);
    const alpha = Math.min(string.b1 + string.b2 * s, MOST_DAMPED * omega), turn = Math.sqrt(omega ** 2 - alpha ** 2);
    const angle = Math.min(omega * a, HIGHEST * Math.PI), scale = angle / omega;
    const x = -2 * alpha * scale, y = 2 * turn * scale, under = a * (Math.cosh(x) + Math.cos(y)); // tanh(pole a)/a
    const damping = -Math.sinh(x) / under, omega2 = damping ** 2 + (Math.sin(y) / under) ** 2;
    const weight = omega * step < 2 * Math.PI * HIGHEST ? weights[k] : 0;
    const drive = ((2 * weight) / geometry.mass) * (omega2 / omega ** 2);
    const v = (a * drive) / (1 + 2 * a * damping + a * a * omega2), q = a * v;
    const warp = angle / (Math.sin(angle) * Math.cos(angle));
    t.unit.re[k] = q;
    t.unit.im[k] = -(v + damping * q) / Math.sqrt(omega2 - damping ** 2);
    [t.left.re[k], t.left.im[k]] = [t.unit.re[k] * warp, t.unit.im[k] * warp];
    [t.pole.re[k], t.pole.im[k]] = [-alpha, turn];
    [t.pickup.re[k], t.pickup.im[k]] = pickupOf(key, beta, k, alpha, turn);
    t.compliance += (weight * drive) / omega2;
    t.strike[k] = weight;
    t.mass[k] = drive === 0 ? 0 : weight / drive;
    t.omega2[k] = omega2;
    if (weight !== 0) t.modes = k + 1;
  }
  return t;
}

/** What is read of a mode's free displacement. */
function pickupOf({ quantity, string, geometry }, beta, k, alpha, turn) {
  const read = Math.sin(beta * geometry.pickup);
  if (quantity === "displacement") return [read, 0];
  if (quantity === "velocity") return [-alpha * read, turn * read];
  const tension = ((string.c ** 2 * beta + string.kappa ** 2 * beta ** 3) * geometry.mass) / geometry.length;
  return [k % 2 ? -tension : tension, 0];
}

/** ∫ exp(-2(decay + 8)t) dt over the span of a level, s. */
function levelEnergy(decay) {
  const rate = 2 * (decay + LEVEL_DECAY);
  return -Math.expm1(-rate * LEVEL_SPAN) / rate;
}

/** The path of the string's modes: each one's level in the filter, dB, and its own decay, 1/s; see `path.through`. */
function through(path, pole) {
  const count = pole.re.length, size = Float64Array.from(pole.re, (x, k) => Math.hypot(x, pole.im[k]) / (2 * Math.PI));
  const db = new Float64Array(count), own = new Float64Array(count), last = path.frequency.length - 1;
  for (let k = 0; k < count; k++) {
    let above = path.frequency.findIndex((f) => f >= size[k]);
    if (above < 0) above = last;
    const lower = Math.max(above - 1, 0);
    const nearest = size[k] - path.frequency[lower] <= path.frequency[above] - size[k] ? lower : above;
    const near = Math.abs(size[k] / path.frequency[nearest] - 1) < SAME_PARTIAL;
    const width = Math.log(path.frequency[above] / path.frequency[lower]);
    const part = width ? Math.min(Math.max(Math.log(size[k] / path.frequency[lower]) / width, 0), 1) : 0;
    const level = near ? path.db[nearest] : path.db[lower] + part * (path.db[above] - path.db[lower]);
    const law = -pole.re[k];
    own[k] = law * (near ? path.decay[nearest] : 1);
    db[k] = level + 10 * Math.log10(levelEnergy(law) / levelEnergy(own[k]));
  }
  return { frequency: size, db, own };
}

/** The least-phase response [samples] of levels at frequencies; see `path.impulse`. Cut where it is over. */
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
  const whole = re.subarray(0, half).reduce((sum, x) => sum + x * x, 0);
  let left = 0, end = half;
  while (end > 1 && left + re[end - 1] ** 2 <= LEFT_OVER * whole) left += re[--end] ** 2;
  return re.slice(0, end).map((x) => x / size);
}

/** Samples behind so much silence. */
function after(silence, samples) {
  const out = new Float64Array(silence + samples.length);
  out.set(samples, silence);
  return out;
}

const times = (a, b) => ({
  re: a.re.map((x, k) => x * b.re[k] - a.im[k] * b.im[k]), im: a.im.map((x, k) => x * b.re[k] + a.re[k] * b.im[k]),
});
const cut = (pair, count) => ({ re: pair.re.slice(0, count), im: pair.im.slice(0, count) });
const logs = (pole, rate) => ({ re: pole.re.map((x) => x / rate), im: pole.im.map((x) => x / rate) });

/** The path's transfer function at each mode's pole, as far back as the mode can be followed. */
function gains(response, log) {
  const out = { re: new Float64Array(log.re.length), im: new Float64Array(log.re.length) };
  for (let k = 0; k < log.re.length; k++) {
    const end = Math.min(response.length, Math.floor(MOST_DECAY / Math.max(-log.re[k], 1e-12)));
    const size = Math.exp(-log.re[k]), c = size * Math.cos(log.im[k]), s = -size * Math.sin(log.im[k]);
    let re = 0, im = 0;
    for (let j = end - 1; j >= 0; j--) [re, im] = [re * c - im * s + response[j], re * s + im * c];
    [out.re[k], out.im[k]] = [re, im];
  }
  return out;
}

/** The string itself, heard through its path. */
function byLaw(key, t, pole, path, rate, ratio) {
  const count = t.pole.im.filter((x, k) => k < t.modes && x < Math.PI * rate).length;
  const [own, left, read] = [pole, t.left, t.pickup].map((pair) => cut(pair, count));
  const dry = { re: read.re.map((x) => x * key.gain), im: read.im.map((x) => x * key.gain) };
  const response = path ? impulse(path, rate) : [], gain = path ? times(dry, gains(response, logs(own, rate))) : dry;
  const fine = logs(own, rate * ratio), size = response.length, kernel = new Float64Array(size * ratio);
  const [played, rung] = [dry, gain].map((g) => damped(times(g, left), fine, size * ratio));
  for (let phase = 0; phase < ratio && size; phase++) {
    const each = Float64Array.from({ length: size }, (_, j) => played[j * ratio + phase]);
    convolve(each, response, size).forEach((x, j) => (kernel[j * ratio + phase] = x - rung[j * ratio + phase]));
  }
  const direct = [damped(times(gain, left), fine, BLOCK * ratio)];
  return { pole: own, left, gain: [gain], kernel: [kernel], direct, ratio, lead: 0, early: 0, edge: 0 };
}

/** What was measured between the force on the string and the file. */
function byRinging({ ringing }, rate) {
  const below = Array.from(ringing.pole.im.keys()).filter((k) => ringing.pole.im[k] < Math.PI * rate);
  const column = (values) => Float64Array.from(below, (k) => values[k]);
  const chosen = ({ re, im }) => ({ re: column(re), im: column(im) });
  const pole = chosen(ringing.pole), gain = ringing.pattern.map(chosen), log = logs(pole, rate);
  const known = ringing.participation, participation = known && { ...known, strokes: known.strokes.map(chosen) };
  // In whole blocks, at whose begins dampers move.
  const own = Math.round(LEAD * rate), lead = BLOCK * Math.ceil(own / BLOCK), early = lead - own;
  const kernel = ringing.knock.map((x) => after(early, resample(x, ringing.rate, rate)));
  const heard = { pole, log, gain, participation, kernel, ratio: 1, lead, early, edge: EDGE };
  return { ...heard, ...within(heard, { re: pole.re.map(() => 1), im: pole.re.map(() => 0) }) };
}

/** What a unit of a force leaves ringing, times `left`, and what of it is heard within a block. */
function within({ gain, log }, left) {
  return { left, direct: gain.map((g) => damped(times(g, left), log, BLOCK)) };
}

const expOf = (re, im) => ({ re: Math.exp(re) * Math.cos(im), im: Math.exp(re) * Math.sin(im) });
const product = (a, b) => ({ re: a.re * b.re - a.im * b.im, im: a.re * b.im + a.im * b.re });
const inverse = ({ re, im }) => ({ re: re / (re ** 2 + im ** 2), im: -im / (re ** 2 + im ** 2) });

/**
 * A knock, in which the push of modes that have `more` amplitude is silent as well: what is heard of a mode is its
 * acceleration, see `silencing` of model/modal_response.py.
 */
function silenced({ log, lead }, more, knock) {
  const out = Float64Array.from(knock);
  for (let k = 0; k < log.re.length; k++) {
    const fast = Math.hypot(log.re[k], log.im[k]), q = Math.exp(-fast);
    const z = expOf(log.re[k], log.im[k]), over = inverse(z); // 1/z
    const root = product({ re: 1 - q * over.re, im: -q * over.im }, inverse({ re: 1 - over.re, im: -over.im }));
    const scale = product(root, root), by = (1 - 1 / q) ** 2;
    const double = product({ re: by * scale.re, im: by * scale.im }, inverse({ re: 1 - z.re / q, im: -z.im / q }));
    const once = { re: scale.re - 1 - double.re, im: scale.im - double.im };
    const [a, b] = [once, double].map((x) => more.re[k] * x.re - more.im[k] * x.im);
    const size = Math.min(Math.ceil(SILENT / fast), out.length - lead);
    for (let n = 0, power = 1; n < size; n++, power *= q) out[lead + n] += (a + b * (n + 1)) * power;
  }
  return out;
}

/** What a unit of the drive of a stroke at `velocity`, m/s, leaves ringing, and what of it is heard within a block. */
export function driven(heard, velocity) {
  if (!heard.participation) return heard;
  const { velocity: known, strokes } = heard.participation, last = known.length - 1;
  const above = known.findIndex((v) => v >= velocity), high = above < 0 ? last : above, low = Math.max(high - 1, 0);
  const share = high === low || above < 0 ? 1 : Math.log(velocity / known[low]) / Math.log(known[high] / known[low]);
  const mixed = (part) => strokes[low][part].map((x, k) => x + share * (strokes[high][part][k] - x));
  const left = { re: mixed("re"), im: mixed("im") }, more = { re: left.re.map((x) => x - 1), im: left.im };
  const kernel = heard.kernel.map((x, i) => (x.length > heard.lead ? silenced(heard, times(heard.gain[i], more), x) : x));
  return { ...within(heard, left), kernel };
}

/**
 * All that the engine needs of a key at a rate, Hz.
 *
 * key: {string: {c, kappa, b1, b2}, hammer: {K_H, mu, p, M_H}, geometry: {length, mass, strike, width, pickup},
 * quantity, gain, damper, path?: {frequency, db, decay}, ringing?: {pole, pattern: [channel], knock: [channel], rate,
 * participation?: {velocity, strokes}}}, of which `pole`, each `pattern` and each of the `strokes` is {re, im}, patterns
 * in file units per N s.
 */
export function prepare(key, rate) {
  const ratio = contactRatio(key.string, key.geometry, rate), t = modeTable(key, rate * ratio);
  const path = key.path ? through(key.path, t.pole) : null;
  const pole = path ? { re: path.own.map((x) => -x), im: t.pole.im } : t.pole;
  const heard = key.ringing ? byRinging(key, rate) : byLaw(key, t, pole, path, rate, ratio);
  const whole = ["unit", "left", "pole"].map((name) => [name, cut(t[name], t.modes)]);
  const columns = ["strike", "mass", "omega2"].map((name) => [name, t[name].slice(0, t.modes)]);
  const string = { ...Object.fromEntries([...whole, ...columns]), own: cut(pole, t.modes), step: t.step, ratio,
    compliance: t.compliance };
  return { string, heard, hammer: key.hammer, damper: key.damper, rings: Boolean(key.ringing),
    smooth: key.ringing ? lowpass(1, ratio) : null };
}
