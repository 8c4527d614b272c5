// The instrument with all changes on the page as an instrument.json, which schema/instrument.py reads.

import { pathOf, responseOf, soundOf } from "./note.js";

const INSTRUMENT_SCHEMA = 8; // see schema/instrument.py
// Laws whose values and intervals become invalid when a slider is changed.
const LAWS_OF = { force: ["F/M_S"], p: ["p"], mu: ["mu"], mass: ["M_H/M_S"], strike: ["x0/L"], loss: ["b1", "d2"],
  inharmonicity: ["B"] };

/**
 * Document of all keys.
 *
 * releases: as `decodeReleases` returns them; keys: [{key, changes}], each key with its current values and its changes,
 * empty without any; volume: a factor that is included in the gains.
 */
export function instrumentDocument({ name, velocity, even, bridge, dampers, releases, noise }, keys, volume) {
  const changedKeys = keys.filter(({ changes }) => Object.keys(changes).length).map(({ key }) => key.note);
  const names = changedKeys.length === keys.length ? `all ${keys.length} keys` : changedKeys.join(", ");
  const warnings = ["Saved from the page to play."];
  if (changedKeys.length) warnings.push(`Changed by hand: ${names}.`);
  if (volume !== 1) warnings.push(`The gains include the volume of the page, ${(20 * Math.log10(volume)).toFixed(0)} dB.`);
  return {
    schema: INSTRUMENT_SCHEMA, program: "pianofit", kind: "instrument", name, quantity: keys[0].key.quantity,
    excitation: keys[0].key.hammer ? "hammer" : "pluck",
    velocity: { ...velocity, source: "page" }, keys: keys.map((entry) => rowOf(entry, volume)), warnings, even,
    ...(bridge ? { bridge } : {}), dampers, noise: noise && { ...noise, density: noise.density.map((row) => row.map((x) => x * volume ** 2)) },
    releases: releases.map(({ midi, sound, rate }) => ({ midi, sound: soundOf(sound, volume, rate) })),
  };
}

function rowOf({ key, changes }, volume) {
  const { midi, note, recorded, state, string, hammer, geometry, gain } = key, sliders = Object.keys(changes);
  const invalid = sliders.flatMap((slider) => LAWS_OF[slider]);
  const valid = Object.entries(key.values ?? {}).filter(([law]) => !invalid.includes(law));
  return {
    midi, note, state: sliders.length ? "changed" : state, changes: sliders.length ? changes : null, string, hammer,
    geometry, gain: gain * volume, path: pathOf(key), modal_response: key.modal_response ? responseOf(key) : null,
    values: Object.fromEntries(valid.map(([law, [value, low, high]]) => [law, { value, interval: [low, high] }])),
    fit: recorded ? {} : null,
  };
}
