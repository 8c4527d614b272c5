// A hammer on a string that may still move: one scalar equation a step (model/contact.py). With the kernel g of the
// string at the strike,
//
//   e_n = y_H + 2a v_H - Σ_{m<n} g_{n-m} T_m - free motion     u_n = e_n - C T_n     F_n = K_H u_n^p (1 + μ w_n)

export const BLOCK = 128; // samples, or steps, at once
const MOST_STEPS = 65536; // of a contact; a hammer that stays longer is taken away
const ITERATIONS = 100; // of Newton, at the most
const NEAR = 1e-9; // relative: the next iteration would only change rounding
const WORTH = 4; // steps of a sum over forces that take as long as a mode's going on by one
const STRIDE = 4; // modes at once: the processor works on them side by side

/** exp(pole t) of modes with `extra` decay, 1/s. */
export function turns(pole, seconds, extra = 0) {
  const size = pole.re.map((x) => Math.exp((x - extra) * seconds)), turn = pole.im.map((x) => x * seconds);
  return { re: size.map((x, k) => x * Math.cos(turn[k])), im: size.map((x, k) => x * Math.sin(turn[k])) };
}

/** Room for the workspace of `addDamped`. */
export const workspace = (count) => Array.from({ length: 4 }, () => new Float64Array(count + STRIDE));

/** Add Σ_k of `count` damped exponentials, each by its recursion from work = [first, second, c, d], to out [size]. */
export function addDamped([a, b, c, d], count, out, size) {
  for (let k = count; k % STRIDE; k++) a[k] = b[k] = c[k] = d[k] = 0;
  for (let k = 0; k < count; k += STRIDE) {
    let a0 = a[k], a1 = a[k + 1], a2 = a[k + 2], a3 = a[k + 3];
    let b0 = b[k], b1 = b[k + 1], b2 = b[k + 2], b3 = b[k + 3];
    const c0 = c[k], c1 = c[k + 1], c2 = c[k + 2], c3 = c[k + 3];
    const d0 = d[k], d1 = d[k + 1], d2 = d[k + 2], d3 = d[k + 3];
    for (let i = 0; i < size; i += 2) { // by two, so that nothing has to be moved
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
  }
}

/** Let steps `first` to before `last` of a drive add left · Σ drive_n z^(last - n) to modes; whether there was any. */
export function addDriven({ re, im }, left, z, drive, first, last) {
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
    re[k] += left.re[k] * x - left.im[k] * y;
    im[k] += left.re[k] * y + left.im[k] * x;
    if (l === k) break;
    re[l] += left.re[l] * u - left.im[l] * v;
    im[l] += left.re[l] * v + left.im[l] * u;
  }
  return true;
}

/** Σ a_{i+m} b_{j-m} of `count`, four sums side by side. */
export function reversed(a, i, b, j, count) {
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

/** A list of numbers that grows, zero where nothing was written. */
export function longer(list, length, room = Math.max(2 * list.length, length)) {
  if (list.length >= length) return list;
  const more = new Float64Array(room);
  more.set(list);
  return more;
}

/** Amplitudes [modes] as the hammer meets them. */
function under({ strike }, { re, im }) {
  return { re: strike.map((x, k) => x * re[k]), im: strike.map((x, k) => x * im[k]) };
}

/** What a unit drive leaves under the hammer. */
export const struck = (string) => under(string, string.unit);

/** Σ_k Re(amplitude_k z_k^n), the displacement under the hammer of modes that move freely, step by step. */
export class Motion {
  constructor({ pole, step }, { re, im }) {
    Object.assign(this, { re, im, values: new Float64Array(0), work: workspace(re.length) });
    [this.one, this.block] = [turns(pole, step), turns(pole, step * BLOCK)];
  }

  /** At least the first `length` values. */
  upTo(length) {
    const { re, im, one, block } = this, [a, b, c, d] = this.work, begin = this.values.length;
    if (begin >= length) return this.values;
    for (let k = 0; k < re.length; k++) {
      a[k] = re[k];
      b[k] = re[k] * one.re[k] - im[k] * one.im[k];
      c[k] = 2 * one.re[k];
      d[k] = -(one.re[k] * one.re[k] + one.im[k] * one.im[k]);
      const x = re[k] * block.re[k] - im[k] * block.im[k];
      im[k] = re[k] * block.im[k] + im[k] * block.re[k];
      re[k] = x;
    }
    this.values = longer(this.values, begin + BLOCK, begin + BLOCK);
    addDamped(this.work, re.length, this.values.subarray(begin), BLOCK);
    return this.upTo(length);
  }
}

/** A hammer on a string, stepped as far as is asked for. */
export class Contact {
  /** state: {re, im}, how the string moves: q = Re(state · exp(pole t)); velocity, m/s. */
  constructor(string, kernel, hammer, velocity, state = null) {
    const a = string.step / 2;
    Object.assign(this, { string, kernel, hammer, a, steps: 1, last: 0, over: false, work: 0, own: 0, energy: 0 });
    // Steps whose forces are summed one by one: until all modes' going on takes less time, and then only a block's.
    this.window = BLOCK * Math.ceil((WORTH * string.strike.length) / BLOCK);
    Object.assign(this, { since: 1, left: null, origin: 0, struck: struck(string) });
    this.drive = new Float64Array(1024);
    this.force = new Float64Array(1024);
    this.compliance = a * a / hammer.M_H + kernel.upTo(1)[0];
    this.free = state && new Motion(string, under(string, state));
    const speed = state ? this._meet(state) : 0;
    Object.assign(this, { y: state ? this.free.upTo(1)[0] : 0, v: velocity, u: 0, w: velocity - speed, f: 0 });
  }

  /** The string's speed under the hammer, m/s, and its energy: the scheme's, whose rate is (z - 1)/(z + 1)/a. */
  _meet({ re, im }) {
    const { strike, mass, omega2, step } = this.string, { one } = this.free;
    let speed = 0;
    for (let k = 0; k < strike.length; k++) {
      const x = one.re[k] - 1, y = one.im[k], power = (2 + x) ** 2 + y * y;
      const velocity = ((re[k] * (x * (2 + x) + y * y) - im[k] * 2 * y) / power) * (2 / step);
      speed += strike[k] * velocity;
      this.energy += 0.5 * mass[k] * (velocity ** 2 + omega2[k] * re[k] ** 2);
    }
    return speed;
  }

  /** Go on until `steps` steps are done, or until the hammer can no longer touch the string. */
  advance(steps) {
    const { a, hammer, compliance: c } = this, { K_H, mu, p, M_H } = hammer, g = this.kernel.upTo(this.window + BLOCK);
    this.drive = longer(this.drive, steps);
    this.force = longer(this.force, steps);
    const { drive, force } = this, moved = this.free?.upTo(steps);
    for (let n = this.steps; n < steps && !this.over; n++) {
      if (n % BLOCK === 0) this._putBehind(n);
      const { since } = this, near = reversed(drive, since, g, n - since, Math.min(this.last, n - 1) - since + 1);
      const past = near + (moved ? moved[n] : 0) + (this.left ? this.left.values[n - this.origin] : 0);
      const upper = this.y + 2 * a * this.v - past - c * this.f;
      const u = upper > 0 ? compression(upper, this.u, this.w, c, a, K_H, mu, p) : upper;
      const w = (u - this.u) / a - this.w;
      const f = u > 0 ? K_H * u ** p * Math.max(1 + mu * w, 0) : 0, t = f + this.f;
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
      const own = this.y - u - (moved ? moved[n] : 0);
      this.work += 0.5 * t * (own - this.own);
      this.own = own;
      this.over = (u <= 0 && this.v <= 0 && this.y + this._reach() <= 0) || n > MOST_STEPS;
    }
  }

  /** Forces longer ago than the window have set the modes going: the sum over them ends, and the modes go on. */
  _putBehind(n) {
    if (n - this.since >= this.window) {
      const still = () => new Float64Array(this.struck.re.length);
      if (!this.left) Object.assign(this, { left: new Motion(this.string, { re: still(), im: still() }), origin: n });
      this.window = BLOCK;
      addDriven(this.left, this.struck, this.left.one, this.drive, this.since, n);
      this.since = n;
    }
    this.left?.upTo(n - this.origin + BLOCK);
  }

  /** The farthest the string can be from rest under the hammer, m (Cauchy-Schwarz over the modes). */
  _reach() {
    const { compliance } = this.string;
    return Math.sqrt(2 * Math.max(this.work, 0) * compliance) + Math.sqrt(2 * this.energy * compliance);
  }
}

/** The root of u + C F(u, w(u)) = upper, by Newton within [0, upper]: F is convex, so iterates fall onto it. */
function compression(upper, old, speed, c, a, K_H, mu, p) {
  const going = old + 2 * a * speed;
  let u = old > 0 && going > 0 && going < upper ? going : Math.min((upper / (c * K_H)) ** (1 / p), upper);
  for (let i = 0; i < ITERATIONS; i++) {
    const stiff = c * K_H * u ** (p - 1), loss = 1 + mu * ((u - old) / a - speed);
    const push = loss > 0 ? stiff * u * loss : 0, slope = loss > 0 ? stiff * (p * loss + (u * mu) / a) : 0;
    const next = Math.min(Math.max(u - (u - upper + push) / (1 + slope), 0), upper), change = Math.abs(next - u);
    u = next;
    if (change <= NEAR * u) break;
  }
  return u;
}
