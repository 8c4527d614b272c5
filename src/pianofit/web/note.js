// A key as a note.json, with the entries of a fit.json that `pianofit render` and similar commands read.

import { partialOf } from "./change.js";
import { encodeWav } from "./output.js";

const SCHEMA = 4; // of fit.json: FIT_SCHEMA in io/files.py

/** Bytes as base64, in parts, because the number of arguments of a call is limited. */
function base64(bytes) {
  const PART = 8192;
  let text = "";
  for (let i = 0; i < bytes.length; i += PART) text += String.fromCharCode(...bytes.subarray(i, i + PART));
  return btoa(text);
}

/** Output path of a key as lists of numbers, or null. */
export function pathOf({ path }) {
  return path ? Object.fromEntries(Object.entries(path).map(([name, x]) => [name, Array.from(x)])) : null;
}

/** Modal response of a key divided by its gain, with the knock as a WAV file of 32-bit floats. */
export function ringingOf({ ringing, string, geometry, gain }) {
  const { pole, pattern, knock, rate, participation } = ringing;
  const list = (column, factor = 1) => Array.from(column, (x) => x * factor);
  const f0 = string.c / (2 * geometry.length), B = ((string.kappa * Math.PI) / (string.c * geometry.length)) ** 2;
  const frequency = list(pole.im, 1 / (2 * Math.PI));
  return {
    by: knock[0]?.length ? "modes and knock" : "modes",
    modes: { partial: frequency.map((f) => Math.max(Math.round(partialOf(f, f0, B)), 1)), frequency,
      decay: list(pole.re, -1) },
    pattern: pattern.map(({ re, im }) => ({ real: list(re, 1 / gain), imag: list(im, 1 / gain) })),
    participation: participation && {
      velocity: participation.velocity,
      strokes: participation.strokes.map(({ re, im }) => ({ real: list(re), imag: list(im) })),
    },
    knock: knock[0]?.length
      ? { wav: base64(encodeWav(knock.map((x) => x.map((y) => y / gain)), rate)), scale: 1, rate }
      : null,
  };
}

/**
 * Document of a key with its changes, struck at `velocity`, m/s.
 *
 * claims: a sentence on its origin; rate: default sample rate of rendered sounds, Hz.
 */
export function noteDocument(key, { velocity, rate, claims }) {
  const { string, hammer, geometry, quantity, gain } = key;
  const values = { ...string, ...hammer, v_H0: velocity, x0: geometry.strike_position, width: geometry.width,
    M_S: geometry.mass, L: geometry.length, pickup: geometry.pickup };
  const given = (value) => ({ value, interval: null, status: "given" });
  return {
    schema: SCHEMA, program: "pianofit", kind: "note", claims, messages: [],
    felt: hammer.mu === 0 ? "power" : "hunt-crossley",
    parameters: Object.fromEntries(Object.entries(values).map(([name, value]) => [name, given(value)])),
    recordings: [{ rate, v_H0: velocity, v_H0_status: "given", gain, gain_status: "given", first: true }],
    pickup: { quantity, path: pathOf(key) },
    ringing: key.ringing ? ringingOf(key) : { by: "law" },
  };
}
