// Contact of a hammer with a string that may still move: one scalar equation per step (model/contact.py). With the
// kernel g of the string at the strike position,
//
//   e_n = y_H + 2a v_H - Σ_{m<n} g_{n-m} T_m - free motion     u_n = e_n - C T_n     F_n = K_H g_n^p (1 + μ w_n)
//
// with g = u²/(u + d) of a felt whose soft skin has the thickness d.

export const BLOCK = 128; // samples or steps per block
const MOST_STEPS = 65536; // of a contact; a longer contact is ended
const ITERATIONS = 100; // of Newton's method, largest number
const TOLERANCE = 1e-9; // relative; a further iteration would only change rounding
const SUM_COST = 4; // terms of a sum over forces that cost as much as one step of one mode
export const STRIDE = 4; // modes per iteration, which the processor computes in parallel

/** exp(pole t) of modes with the decay rate `damper`, 1/s, added. */
export function expPole(pole, seconds, damper = 0) {
  const size = pole.re.map((x) => Math.exp((x - damper) * seconds)), turn = pole.im.map((x) => x * seconds);
  return { re: size.map((x, k) => x * Math.cos(turn[k])), im: size.map((x, k) => x * Math.sin(turn[k])) };
}

/** Workspace of `addDamped`. */
export const workspace = (count) => Array.from({ length: 4 }, () => new Float64Array(count + STRIDE));

/**
 * Add a sum of `count` damped exponentials to out [size], by recursions from work = [first, second, c, d]. Afterwards
 * first and second are those of the samples that follow.
 */
export function addDamped([a, b, c, d], count, out, size) {
  for (let k = count; k % STRIDE; k++) a[k] = b[k] = c[k] = d[k] = 0;
  for (let k = 0; k < count; k += STRIDE) {
    let a0 = a[k], a1 = a[k + 1], a2 = a[k + 2], a3 = a[k + 3];
    let b0 = b[k], b1 = b[k + 1], b2 = b[k + 2], b3 = b[k + 3];
    const c0 = c[k], c1 = c[k + 1], c2 = c[k + 2], c3 = c[k + 3];
    const d0 = d[k], d1 = d[k + 1], d2 = d[k + 2], d3 = d[k + 3];
    for (let i = 0; i < size; i += 2) { // two steps per iteration avoid copies
      out[i] += a0 + a1 + (a2 + a3);
      out[i + 1] += b0 + b1 + (b2 + b3);
      a0 = c0 * b0 + d0 * a0;
      a1 = c1 * b1 + d1 * a1;
      a2 = c2 * b2 + d2 * a2;
      a3 = c3 * b3 + d3 * a3;
      b0 = c0 * a0 + d0 * b0;
      b1 = c1 * a1 + d1 * b1;
      b2 = c2 * a2 + d2 * b2;
      b3 = c3 * a3 + d3 * b3;
    }
    a[k] = a0;
    a[k + 1] = a1;
    a[k + 2] = a2;
    a[k + 3] = a3;
    b[k] = b0;
    b[k + 1] = b1;
    b[k + 2] = b2;
    b[k + 3] = b3;
  }
}

/**
 * Add excitation · Σ drive_n z^(last - n) to the amplitudes of modes, over the steps from `first` to before `last`.
 * Return whether the drive was nonzero.
 */
export function addDriven({ re, im }, excitation, z, drive, first, last) {
  let begin = Math.max(first, 0);
  const end = Math.min(last, drive.length), count = re.length;
  while (begin < end && drive[begin] === 0) begin++;
  if (begin >= end) return false;
  for (let k = 0; k < count; k += 2) { // two at a time
    const l = Math.min(k + 1, count - 1), c = z.re[k], s = z.im[k], d = z.re[l], e = z.im[l];
    let x = 0, y = 0, u = 0, v = 0;
    for (let n = begin; n < last; n++) {
      const f = n < end ? drive[n] : 0, t = x + f, w = u + f;
      x = t * c - y * s;
      y = t * s + y * c;
      u = w * d - v * e;
      v = w * e + v * d;
    }
    re[k] += excitation.re[k] * x - excitation.im[k] * y;
    im[k] += excitation.re[k] * y + excitation.im[k] * x;
    if (l === k) break;
    re[l] += excitation.re[l] * u - excitation.im[l] * v;
    im[l] += excitation.re[l] * v + excitation.im[l] * u;
  }
  return true;
}

/** Σ_m a_{i+m} b_{j-m} over `count` terms, as four parallel sums. */
export function reversedDot(a, i, b, j, count) {
  let w = 0, x = 0, y = 0, z = 0, m = 0;
  for (; m < count - 3; m += 4) {
    w += a[i + m] * b[j - m];
    x += a[i + m + 1] * b[j - m - 1];
    y += a[i + m + 2] * b[j - m - 2];
    z += a[i + m + 3] * b[j - m - 3];
  }
  for (; m < count; m++) w += a[i + m] * b[j - m];
  return w + x + (y + z);
}

/** The list with room for at least `length` numbers, filled with zeros. */
export function grown(list, length, room = Math.max(2 * list.length, length)) {
  if (list.length >= length) return list;
  const more = new Float64Array(room);
  more.set(list);
  return more;
}

/** Amplitudes [modes] weighted by the contact window. */
function atStrike({ strikeWeight }, { re, im }) {
  return { re: strikeWeight.map((x, k) => x * re[k]), im: strikeWeight.map((x, k) => x * im[k]) };
}

/** Amplitude that a unit drive leaves under the hammer. */
export const unitAtStrike = (string) => atStrike(string, string.unit);

/** Displacement of freely moving modes under the hammer, Σ_k Re(amplitude_k z_k^n), step by step. */
export class FreeMotion {
  constructor({ pole, step }, { re, im }) {
    Object.assign(this, { re, im, values: new Float64Array(0), work: workspace(re.length) });
    [this.stepFactor, this.blockFactor] = [expPole(pole, step), expPole(pole, step * BLOCK)];
  }

  /** The first `length` values or more. */
  upTo(length) {
    const { re, im, stepFactor: step, blockFactor: block } = this, [a, b, c, d] = this.work, begin = this.values.length;
    if (begin >= length) return this.values;
    for (let k = 0; k < re.length; k++) {
      a[k] = re[k];
      b[k] = re[k] * step.re[k] - im[k] * step.im[k];
      c[k] = 2 * step.re[k];
      d[k] = -(step.re[k] * step.re[k] + step.im[k] * step.im[k]);
      const x = re[k] * block.re[k] - im[k] * block.im[k];
      im[k] = re[k] * block.im[k] + im[k] * block.re[k];
      re[k] = x;
    }
    this.values = grown(this.values, begin + BLOCK, begin + BLOCK);
    addDamped(this.work, re.length, this.values.subarray(begin), BLOCK);
    return this.upTo(length);
  }
}

/** Contact of a hammer with a string, computed as far as requested. */
export class Contact {
  /** state: {re, im}, motion of the string, q = Re(state · exp(pole t)); velocity: of the hammer, m/s. */
  constructor(string, kernel, hammer, velocity, state = null) {
    const a = string.step / 2;
    Object.assign(this, { string, kernel, hammer, a, steps: 1, last: 0, isOver: false });
    Object.assign(this, { work: 0, displacement: 0, energy: 0 });
    // Forces of this many steps are summed directly. Then advancing all modes is cheaper, and only one block is summed.
    this.window = BLOCK * Math.ceil((SUM_COST * string.strikeWeight.length) / BLOCK);
    Object.assign(this, { windowStart: 1, pastMotion: null, origin: 0, unit: unitAtStrike(string) });
    this.drive = new Float64Array(1024);
    this.force = new Float64Array(1024);
    this.compliance = a * a / hammer.M_H + kernel.upTo(1)[0];
    this.free = state && new FreeMotion(string, atStrike(string, state));
    const speed = state ? this._initialSpeed(state) : 0;
    Object.assign(this, { y: state ? this.free.upTo(1)[0] : 0, v: velocity, u: 0, w: velocity - speed, f: 0 });
  }

  /** Speed of the string under the hammer, m/s; also sets the energy of the scheme, whose rate is (z - 1)/(z + 1)/a. */
  _initialSpeed({ re, im }) {
    const { strikeWeight, mass, omega2, step } = this.string, { stepFactor: z } = this.free;
    let speed = 0;
    for (let k = 0; k < strikeWeight.length; k++) {
      const x = z.re[k] - 1, y = z.im[k], power = (2 + x) ** 2 + y * y;
      const velocity = ((re[k] * (x * (2 + x) + y * y) - im[k] * 2 * y) / power) * (2 / step);
      speed += strikeWeight[k] * velocity;
      this.energy += 0.5 * mass[k] * (velocity ** 2 + omega2[k] * re[k] ** 2);
    }
    return speed;
  }

  /** Compute up to `steps` steps, or until the hammer can no longer touch the string. */
  advance(steps) {
    const { a, hammer, compliance: c } = this, { M_H } = hammer, g = this.kernel.upTo(this.window + BLOCK);
    this.drive = grown(this.drive, steps);
    this.force = grown(this.force, steps);
    const { drive, force } = this, freeMotion = this.free?.upTo(steps);
    for (let n = this.steps; n < steps && !this.isOver; n++) {
      if (n % BLOCK === 0) this._closeWindow(n);
      const { windowStart: start } = this, count = Math.min(this.last, n - 1) - start + 1;
      const recent = reversedDot(drive, start, g, n - start, count);
      const earlier = this.pastMotion ? this.pastMotion.values[n - this.origin] : 0;
      const past = recent + (freeMotion ? freeMotion[n] : 0) + earlier;
      const upper = this.y + 2 * a * this.v - past - c * this.f;
      const u = upper > 0 ? compression(upper, this.u, this.w, c, a, hammer) : upper;
      const w = (u - this.u) / a - this.w;
      const f = u > 0 ? staticForce(hammer, u) * Math.max(1 + hammer.mu * w, 0) : 0, t = f + this.f;
      const before = this.v;
      this.v -= (a / M_H) * t;
      this.y += a * (before + this.v);
      this.u = u;
      this.w = w;
      this.f = f;
      this.steps = n + 1;
      if (t > 0) this.last = n;
      drive[n] = t;
      force[n] = f;
      const displacement = this.y - u - (freeMotion ? freeMotion[n] : 0);
      this.work += 0.5 * t * (displacement - this.displacement);
      this.displacement = displacement;
      this.isOver = (u <= 0 && this.v <= 0 && this.y + this._maxDisplacement() <= 0) || n > MOST_STEPS;
    }
  }

  /** Convert forces older than the window to amplitudes of freely moving modes. */
  _closeWindow(n) {
    if (n - this.windowStart >= this.window) {
      const atRest = () => new Float64Array(this.unit.re.length);
      if (!this.pastMotion) {
        Object.assign(this, { pastMotion: new FreeMotion(this.string, { re: atRest(), im: atRest() }), origin: n });
      }
      this.window = BLOCK;
      addDriven(this.pastMotion, this.unit, this.pastMotion.stepFactor, this.drive, this.windowStart, n);
      this.windowStart = n;
    }
    this.pastMotion?.upTo(n - this.origin + BLOCK);
  }

  /** Bound on the displacement of the string under the hammer, m (Cauchy-Schwarz over the modes). */
  _maxDisplacement() {
    const { compliance } = this.string;
    return Math.sqrt(2 * Math.max(this.work, 0) * compliance) + Math.sqrt(2 * this.energy * compliance);
  }
}

/** A pluck with a force, N, as a contact of one step: its drive leaves the static displacement (playback/voice.py). */
export class Release {
  constructor({ step }, force) {
    Object.assign(this, { last: 0, isOver: true, drive: Float64Array.of(force), force: Float64Array.of(force / step) });
  }

  advance() {}
}

/** Static force, N, of a felt at a compression, m. */
export function staticForce({ K_H, p, skin = 0 }, compression) {
  return K_H * (skin ? compression ** 2 / (compression + skin) : compression) ** p;
}

/** Root of u + C F(u, w(u)) = upper by Newton's method in [0, upper]. F is convex, so the iteration is monotonic. */
function compression(upper, uBefore, wBefore, c, a, hammer) {
  const { K_H, mu, p, skin = 0 } = hammer, base = (upper / (c * K_H)) ** (1 / p);
  const predicted = uBefore + 2 * a * wBefore;
  const isUsable = uBefore > 0 && predicted > 0 && predicted < upper;
  let u = isUsable ? predicted : Math.min(0.5 * (base + Math.sqrt(base * (base + 4 * skin))), upper);
  for (let i = 0; i < ITERATIONS; i++) {
    const push = c * staticForce(hammer, u), loss = 1 + mu * ((u - uBefore) / a - wBefore);
    const exponent = p * (1 + skin / (u + skin || 1)), force = loss > 0 ? push * loss : 0;
    const slope = loss > 0 && u > 0 ? push * ((exponent * loss) / u + mu / a) : 0;
    const next = Math.min(Math.max(u - (u - upper + force) / (1 + slope), 0), upper), change = Math.abs(next - u);
    u = next;
    if (change <= TOLERANCE * u) break;
  }
  return u;
}
