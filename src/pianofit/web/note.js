// A key as a note.json, with the entries of a fit.json that `pianofit render` and similar commands read.

import { partialOf } from "./change.js";
import { encodeWav } from "./output.js";

const SCHEMA = 6; // of fit.json: FIT_SCHEMA in schema/fit.py

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
export function responseOf({ modal_response: measured, string, geometry, gain }) {
  const { pole, modal_amplitudes: amplitudes, velocity_gain: velocityGain, knock, rate } = measured;
  const list = (column, factor = 1) => Array.from(column, (x) => x * factor);
  const row = ({ re, im }, factor) => ({ real: list(re, factor), imag: list(im, factor) });
  const f0 = string.c / (2 * geometry.length), B = ((string.kappa * Math.PI) / (string.c * geometry.length)) ** 2;
  const frequency = list(pole.im, 1 / (2 * Math.PI));
  return {
    modes: { partial: frequency.map((f) => Math.max(Math.round(partialOf(f, f0, B)), 1)), frequency,
      decay: list(pole.re, -1) },
    modal_amplitudes: amplitudes.map((channel) => row(channel, 1 / gain)),
    velocity_gain: velocityGain && { velocity: velocityGain.velocity,
      strokes: velocityGain.strokes.map((stroke) => row(stroke)) },
    knock: knock[0]?.length
      ? { wav: base64(encodeWav(knock.map((x) => x.map((y) => y / gain)), rate)), scale: 1, rate }
      : null,
  };
}

/**
 * Document of a key with its changes, struck at `velocity`, m/s.
 *
 * origin: a sentence on where the key comes from; rate: default sample rate of rendered sounds, Hz.
 */
export function noteDocument(key, { velocity, rate, origin }) {
  const { string, hammer, geometry, quantity, gain } = key;
  const values = { ...string, ...hammer, v_H0: velocity, x0: geometry.strike_position, width: geometry.width,
    M_S: geometry.mass, L: geometry.length, pickup: geometry.pickup };
  const given = (value) => ({ value, interval: null, status: "given" });
  const response = key.modal_response ? responseOf(key) : null;
  return {
    schema: SCHEMA, program: "pianofit", kind: "note", origin,
    felt: hammer.skin ? "soft-skin" : hammer.mu === 0 ? "power" : "hunt-crossley",
    parameters: Object.fromEntries(Object.entries(values).map(([name, value]) => [name, given(value)])),
    recordings: [{ gain, rate }],
    pickup: { quantity, path: pathOf(key) },
    modal_response: response && { render_model: response.knock ? "modes and knock" : "modes", response },
  };
}
