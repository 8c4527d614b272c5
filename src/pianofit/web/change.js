// A key with changed parameters, and its force pulse and mode levels for the plots.

import { Contact, FreeMotion, Release, staticForce, unitAtStrike } from "./contact.js";
import { atVelocity, raisedCosineWeights } from "./prepare.js";

const MOST_STEPS_DRAWN = 65536; // of a contact
// Largest change of a measured level by the strike position, because the weight of a mode at a node is near zero.
const MOST_LEVEL = 10;
// Ranges of the parameters, as in fits (parameters.py). A felt loss coefficient of zero stays zero.
const BOUNDS = { p: [1, 5], mu: [1e-3, 10], K_H: [1e4, 1e16], M_H: [1e-4, 0.1], b1: [1e-3, 100], b2: [1e-12, 0.1],
  kappa: [1e-3, 100] };

/** Changes of a key and their neutral values: factors, except `p`, which is added. */
export const UNCHANGED = { force: 1, p: 0, mu: 1, mass: 1, strike: 1, loss: 1, inharmonicity: 1 };

/** The changes that differ from their neutral values. */
export function altered(changes) {
  return Object.fromEntries(Object.entries(changes).filter(([name, x]) => x !== UNCHANGED[name]));
}

/** Partial number of a frequency, not rounded: f = k f0 √(1 + B k²). */
export function partialOf(f, f0, B) {
  return Math.sqrt(B > 1e-12 ? (Math.sqrt(1 + 4 * B * (f / f0) ** 2) - 1) / (2 * B) : (f / f0) ** 2);
}

const within = (name, x) => x && Math.min(Math.max(x, BOUNDS[name][0]), BOUNDS[name][1]);

/**
 * The key with changes: force (felt force at the reference compression), p, mu, mass (of the hammer), strike
 * (position), loss and inharmonicity. Measured partials shift with those of the string, and `loss` scales their decays.
 */
export function changed(key, changes) {
  const c = { ...UNCHANGED, ...changes }, { hammer, geometry, string } = key;
  const out = { ...key, hammer: hammer && changedHammer(hammer, key.compression, c) };
  const edge = geometry.width / 2, wanted = geometry.strike_position * c.strike;
  out.geometry = { ...geometry, strike_position: Math.min(Math.max(wanted, edge), geometry.length - edge) };
  out.string = { ...string, b1: within("b1", string.b1 * c.loss), b2: within("b2", string.b2 * c.loss),
    kappa: within("kappa", string.kappa * Math.sqrt(c.inharmonicity)) };
  if (c.strike === 1 && c.loss === 1 && c.inharmonicity === 1) return out;
  const f0 = string.c / (2 * geometry.length), B = ((string.kappa * Math.PI) / (string.c * geometry.length)) ** 2;
  const shift = (f) => {
    const k = partialOf(f, f0, B);
    return Math.sqrt((1 + B * c.inharmonicity * k * k) / (1 + B * k * k));
  };
  if (key.path) out.path = { ...key.path, frequency: key.path.frequency.map((f) => f * shift(f)) };
  if (key.modal_response) {
    const { partial, pole, modal_amplitudes: amplitudes } = key.modal_response, f = pole.im.map((x) => x / (2 * Math.PI));
    const most = Math.max(1, ...partial);
    const [before, after] = [geometry, out.geometry].map((g) => raisedCosineWeights(g, most));
    const level = partial.map((k) => {
      const ratio = after[k - 1] / before[k - 1];
      return Math.sign(ratio) * Math.min(Math.abs(ratio), MOST_LEVEL) || 0;
    });
    const scaled = (column) => column.map((x, m) => x * level[m]);
    out.modal_response = { ...key.modal_response,
      pole: { re: pole.re.map((x) => x * c.loss), im: pole.im.map((x, m) => x * shift(f[m])) },
      modal_amplitudes: amplitudes.map(({ re, im }) => ({ re: scaled(re), im: scaled(im) })) };
  }
  return out;
}

function changedHammer(hammer, compression, c) {
  const out = { p: within("p", hammer.p + c.p), mu: within("mu", hammer.mu * c.mu), M_H: within("M_H", hammer.M_H * c.mass),
    ...(hammer.skin ? { skin: hammer.skin } : {}) };
  // The force at the reference compression does not change with p.
  const before = staticForce(hammer, compression), unit = staticForce({ ...out, K_H: 1 }, compression);
  return { ...out, K_H: within("K_H", (c.force * before) / unit) };
}

/** A stroke at rest: force, N, in steps of `step` s; and frequency, Hz, and initial level, dB, of each mode. */
export function stroke(table, velocity) {
  const { string, response, hammer } = table;
  const contact = hammer
    ? new Contact(string, new FreeMotion(string, unitAtStrike(string)), hammer, velocity)
    : new Release(string, velocity);
  for (let steps = 1024; !contact.isOver && steps <= MOST_STEPS_DRAWN; steps *= 2) contact.advance(steps);
  const drive = table.isMeasured ? contact.force : contact.drive, unit = table.isMeasured ? string.step : 1;
  const { pole, gain } = response, { excitation } = atVelocity(response, velocity);
  const frequency = pole.im.map((x) => x / (2 * Math.PI));
  const level = frequency.map((_, k) => {
    const size = Math.exp(-pole.re[k] * string.step), angle = -pole.im[k] * string.step;
    const c = size * Math.cos(angle), s = size * Math.sin(angle);
    let re = 0, im = 0;
    for (let n = contact.last; n >= 0; n--) [re, im] = [re * c - im * s + drive[n], re * s + im * c];
    const power = gain.reduce((sum, g) => sum + g.re[k] ** 2 + g.im[k] ** 2, 0) / gain.length;
    const excited = (excitation.re[k] ** 2 + excitation.im[k] ** 2) * (re * re + im * im) * unit ** 2;
    return 10 * Math.log10(power * excited + 1e-30);
  });
  return { force: contact.force.slice(0, contact.last + 2), step: string.step, frequency, level };
}
