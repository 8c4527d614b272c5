// Pedals: contact of each damper with its strings, and the effect of the left pedal on a stroke. The rules and numbers
// are those of playback/pedals.py and playback/una_corda.py.

// MIDI controllers of the right, middle and left pedal.
export const SUSTAIN = 64, SOSTENUTO = 66, SOFT = 67;
export const PEDALS = [SUSTAIN, SOSTENUTO, SOFT];
// Values of controller 64 between which the right pedal lifts the dampers.
export const PEDAL_RANGE = { low: 24, high: 64 };
const SWITCH = 64; // value from which on MIDI defines a pedal as down
const MIDI_KEYS = 128;
const FELT_EXPONENT = 2; // of the contact over the way that the damper has to fall
const FELT_RATIO = 0.7; // stiffness of the felt between the grooves over that in them

/** Positions of keys and pedals. A contact is 1 when a damper rests fully on the strings, and 0 when it is lifted. */
export class Dampers {
  constructor() {
    Object.assign(this, { range: PEDAL_RANGE, pedal: 0, soft: 0, held: new Set(), caught: new Set(), isHolding: false });
  }

  /** Contact of the damper of a key. */
  of(midi) {
    return this.held.has(midi) || this.caught.has(midi) ? 0 : this.pedalContact;
  }

  /** Contact of the dampers that follow the right pedal alone. */
  get pedalContact() {
    const { low, high } = this.range, way = (high - this.pedal) / (high - low);
    return Math.min(Math.max(way, 0), 1) ** FELT_EXPONENT;
  }

  /** Move a pedal to a value from 0 to 127. The middle pedal holds dampers that are up when it goes down. */
  move(controller, value) {
    if (controller === SUSTAIN) this.pedal = value;
    if (controller === SOFT) this.soft = value / 127;
    if (controller !== SOSTENUTO) return;
    const wasDown = this.isHolding;
    this.isHolding = value >= SWITCH;
    if (wasDown && this.isHolding) return;
    const keys = this.isHolding ? Array.from({ length: MIDI_KEYS }, (_, midi) => midi) : [];
    this.caught = new Set(keys.filter((midi) => this.of(midi) === 0));
  }
}

/** Effect of the left pedal at a position from 0 to 1 on a key with so many strings; see UnaCorda in Python. */
export function unaCorda(strings, position) {
  if (!position) return { share: 1, felt: 1 };
  const all = Math.max(Math.round(strings), 1), struck = all > 1 ? all - position : 1;
  return { share: struck / all, felt: FELT_RATIO ** position };
}

/** The hammer as the left pedal moves it. */
export function softHammer(hammer, { felt }) {
  return { ...hammer, K_H: felt * hammer.K_H };
}

/**
 * Rates that a damper adds to modes when it rests fully on the string, 1/s [modes].
 *
 * damper: {rate, hertz, slope}, the rate at a frequency and its exponent; null for a key without damper.
 */
export function dampingRates(damper, { im }) {
  return im.map((omega) => (damper ? damper.rate * (omega / (2 * Math.PI * damper.hertz)) ** damper.slope : 0));
}
