// A fitted instrument in real time: strokes on strings that may still move, dampers, a pedal. No DOM, no libraries.
//
// Time goes on in blocks of 128 samples, at whose begin events take effect. Each key that sounds is a voice. During a
// stroke the contact is one scalar equation a step (model/contact.py): with the kernel g of the string at the strike,
//
//   e_n = y_H + 2a v_H - Σ_{m<n} g_{n-m} T_m - free motion     u_n = e_n - C T_n     F_n = K_H u_n^p (1 + μ w_n)
//
// Its drive T, or force F where the key's ringing is known, sets resonators going and passes through a short kernel
// (prepare.js says which). Between strokes nothing is left but one complex amplitude a mode. All numbers are 64 bit.

export const BLOCK = 128; // samples
const FAINT = 1e-8; // of full scale, -140 dB: modes below are left out
const MOST_STEPS = 65536; // of a contact; a hammer that stays longer is taken away
const ITERATIONS = 100;
const STRIDE = 4; // modes at once: the processor works on them side by side

/** exp(pole t) of modes with `extra` decay, 1/s. */
function turns(pole, seconds, extra = 0) {
  const size = pole.re.map((x) => Math.exp((x - extra) * seconds)), turn = pole.im.map((x) => x * seconds);
  return { re: size.map((x, k) => x * Math.cos(turn[k])), im: size.map((x, k) => x * Math.sin(turn[k])) };
}

/** Room for the recursions of `addDamped`. */
const recursions = (count) => Array.from({ length: 4 }, () => new Float64Array(count + STRIDE));

/** Modes that ring: amplitudes re + i im, per mode, of which each channel hears gain · amplitude. */
class Bank {
  constructor({ pole, left, gain }, rate, ratio, damper) {
    const count = pole.re.length;
    Object.assign(this, { count, left, gain, re: new Float64Array(count), im: new Float64Array(count), still: true });
    // Free and damped.
    this.sample = [0, damper].map((extra) => turns(pole, 1 / rate, extra));
    this.block = [0, damper].map((extra) => turns(pole, BLOCK / rate, extra));
    this.step = turns(pole, 1 / (rate * ratio));
    this.work = recursions(count);
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
      const x = re[k] * z.re[k] - im[k] * z.im[k];
      im[k] = re[k] * z.im[k] + im[k] * z.re[k];
      re[k] = x;
      size += x * x + im[k] * im[k];
    }
    if (size < 1e-40) this.stop();
  }

  /** Let steps `first` to before `last` of a drive set the modes ringing, as they are at its end. */
  fold(drive, first, last) {
    let begin = Math.max(first, 0);
    const end = Math.min(last, drive.length);
    while (begin < end && drive[begin] === 0) begin++;
    if (begin >= end) return;
    this.still = false;
    const { re, im, left, step } = this;
    for (let k = 0; k < this.count; k++) {
      const c = step.re[k], s = step.im[k];
      let x = 0, y = 0;
      for (let n = begin; n < last; n++) {
        const t = n < end ? x + drive[n] : x;
        x = t * c - y * s;
        y = t * s + y * c;
      }
      re[k] += left.re[k] * x - left.im[k] * y;
      im[k] += left.re[k] * y + left.im[k] * x;
    }
  }
}

/** Add Σ_k of `count` damped exponentials, each by its recursion from work = [first, second, c, d], to out [size]. */
function addDamped([a, b, c, d], count, out, size) {
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

/** A list of numbers that grows, zero where nothing was written. */
function longer(list, length, room = Math.max(2 * list.length, length)) {
  if (list.length >= length) return list;
  const more = new Float64Array(room);
  more.set(list);
  return more;
}

/** Σ_k strike_k Re(amplitude_k z_k^n), the displacement under the hammer of modes that move freely, step by step. */
export class Motion {
  constructor({ strike, pole, step }, { re, im }) {
    Object.assign(this, { values: new Float64Array(0), work: recursions(strike.length) });
    this.re = strike.map((x, k) => x * re[k]);
    this.im = strike.map((x, k) => x * im[k]);
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
    this.drive = new Float64Array(1024);
    this.force = new Float64Array(1024);
    this.compliance = a * a / hammer.M_H + kernel.upTo(1)[0];
    this.free = state && new Motion(string, state);
    const speed = state ? this._meet(state) : 0;
    Object.assign(this, { y: state ? this.free.upTo(1)[0] : 0, v: velocity, u: 0, w: velocity - speed, f: 0 });
  }

  /** The string's speed under the hammer, m/s, and its energy: the scheme's, whose rate is (z - 1)/(z + 1)/a. */
  _meet({ re, im }) {
    const { strike, mass, omega2, step } = this.string, { one } = this.free;
    let speed = 0;
    for (let k = 0; k < strike.length; k++) {
      const x = one.re[k] - 1, y = one.im[k], under = (2 + x) ** 2 + y * y;
      const velocity = ((re[k] * (x * (2 + x) + y * y) - im[k] * 2 * y) / under) * (2 / step);
      speed += strike[k] * velocity;
      this.energy += 0.5 * mass[k] * (velocity ** 2 + omega2[k] * re[k] ** 2);
    }
    return speed;
  }

  /** Go on until `steps` steps are done, or until the hammer can no longer touch the string. */
  advance(steps) {
    const { a, hammer, compliance: c } = this, { K_H, mu, p, M_H } = hammer, g = this.kernel.upTo(steps + 1);
    this.drive = longer(this.drive, steps);
    this.force = longer(this.force, steps);
    const { drive, force } = this, under = this.free?.upTo(steps);
    for (let n = this.steps; n < steps && !this.over; n++) {
      let past = under ? under[n] : 0;
      for (let m = 1, i = n - 1; m <= this.last; m++, i--) past += g[i] * drive[m];
      const upper = this.y + 2 * a * this.v - past - c * this.f;
      const u = upper > 0 ? compression(upper, this.u, this.w, c, a, K_H, mu, p) : upper;
      const w = (u - this.u) / a - this.w;
      const f = u > 0 ? K_H * u ** p * Math.max(1 + mu * w, 0) : 0, t = f + this.f;
      const before = this.v;
      this.v -= (a / M_H) * t;
      this.y += a * (before + this.v);
      Object.assign(this, { u, w, f, steps: n + 1 });
      if (t > 0) this.last = n;
      drive[n] = t;
      force[n] = f;
      const own = this.y - u - (under ? under[n] : 0);
      this.work += 0.5 * t * (own - this.own);
      this.own = own;
      this.over = (u <= 0 && this.v <= 0 && this.y + this._reach() <= 0) || n > MOST_STEPS;
    }
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
    if (change <= 1e-13 * upper) break;
  }
  return u;
}

/** A stroke's force as impulses of every sample, band-limited, N s; from `edge` samples before the touch. */
class Impulses {
  constructor({ smooth, heard, string }, rate) {
    Object.assign(this, { smooth, edge: heard.edge, ratio: string.ratio, rate, values: new Float64Array(BLOCK), done: 0 });
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

/** One key while it sounds. */
class Voice {
  constructor(table, rate) {
    const { string, heard, damper } = table;
    const silent = { pole: string.own, left: string.left, gain: heard.gain };
    this.string = new Bank(table.rings ? { ...silent, gain: [] } : silent, rate, string.ratio, damper);
    this.modes = table.rings ? new Bank(heard, rate, 1, damper) : this.string;
    Object.assign(this, { table, rate, hammer: table.hammer, kernel: new Motion(string, string.unit), contact: null, strokes: [],
      waiting: [], damped: false });
  }

  get silent() {
    return this.modes.still && !this.contact && !this.strokes.length && !this.waiting.length;
  }

  _begin(velocity) {
    const { table, rate, string } = this, state = string.still ? null : string;
    this.contact = new Contact(table.string, this.kernel, this.hammer, velocity, state);
    const impulses = table.rings ? new Impulses(table, rate) : null;
    this.strokes.push({ contact: this.contact, impulses, at: 0 });
  }

  /** Add a block to out [channels]. */
  render(out) {
    const { string, modes, table } = this, { ratio } = table.string;
    this.waiting.forEach((stroke) => stroke.blocks--);
    if (!this.contact && this.waiting[0]?.blocks < 0) this._begin(this.waiting.shift().velocity);
    const damped = this.damped && !this.contact;
    if (table.rings) string.wait(damped);
    modes.ring(out, damped);
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
    string.fold(contact.drive, at * ratio, end * ratio);
    if (impulses) {
      impulses.upTo(end + heard.edge, contact);
      modes.fold(impulses.values, at - heard.lead + heard.edge, end - heard.lead + heard.edge);
    }
    const drive = impulses ? impulses.values : contact.drive, r = heard.ratio;
    const last = impulses ? Math.ceil(contact.last / ratio) + 2 * heard.edge : contact.last;
    out.forEach((channel, i) => {
      addConvolved(channel, drive, (at - heard.lead + heard.edge) * r, last, heard.direct[i], r, true);
      addConvolved(channel, drive, (at + heard.edge) * r, last, heard.kernel[i], r, false);
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
    let sum = 0;
    for (let m = begin, end = Math.min(n, last); m <= end; m++) sum += drive[m] * kernel[n - m];
    out[i] += sum;
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
    if (!this.voices.has(midi)) this.voices.set(midi, new Voice(table, this.rate));
    const voice = this.voices.get(midi);
    voice.waiting.push({ velocity, blocks: Math.round((this.lead - table.heard.lead) / BLOCK) });
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
