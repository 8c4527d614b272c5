// The instrument as it was set on the page, as an instrument.json: instrument/document.py reads it.

import { pathOf, ringingOf } from "./note.js";

const INSTRUMENT_SCHEMA = 2; // see instrument/build.py
// The laws whose values and intervals a slider's change leaves without meaning.
const LAWS_OF = { force: ["K/M_S"], p: ["p"], mu: ["mu"], mass: ["M_H/M_S"], strike: ["x0/L"], loss: ["b1", "d2"],
  inharmonicity: ["B"] };

/**
 * The document of all keys.
 *
 * keys: [{key, changes}], the key as it is played now and what was changed of it, nothing if it was not; volume: a
 * factor, which the gains take up.
 */
export function instrumentDocument({ name, velocity }, keys, volume) {
  const touched = keys.filter(({ changes }) => Object.keys(changes).length).map(({ key }) => key.note);
  const which = touched.length === keys.length ? `all ${keys.length} keys` : touched.join(", ");
  const messages = ["Saved from the page to play."];
  if (touched.length) messages.push(`Changed by hand: ${which}.`);
  if (volume !== 1) messages.push(`The gains include the page's volume, ${(20 * Math.log10(volume)).toFixed(0)} dB.`);
  return {
    schema: INSTRUMENT_SCHEMA, program: "pianofit", kind: "instrument", name, quantity: keys[0].key.quantity,
    velocity: { ...velocity, from: "page" }, keys: keys.map((one) => rowOf(one, volume)), messages,
  };
}

function rowOf({ key, changes }, volume) {
  const { midi, note, recorded, state, string, hammer, geometry, gain } = key, what = Object.keys(changes);
  const stale = what.flatMap((slider) => LAWS_OF[slider]);
  const left = Object.entries(key.values ?? {}).filter(([law]) => !stale.includes(law));
  return {
    midi, note, state: what.length ? "changed" : state, changes: what.length ? changes : null, string, hammer, geometry,
    gain: gain * volume, path: pathOf(key), ringing: key.ringing ? ringingOf(key) : null,
    told: Object.fromEntries(left.map(([law, [value, low, high]]) => [law, { value, interval: [low, high] }])),
    fit: recorded ? {} : null,
  };
}
