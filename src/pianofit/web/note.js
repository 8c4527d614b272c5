// A key as a note.json, with the entries of a fit.json that `pianofit render` and similar commands read.

import { encodeWav } from "./output.js";
import { LEAD, subtractFirstSample } from "./prepare.js";

const SCHEMA = 8; // of fit.json: FIT_SCHEMA in schema/fit.py

/** Bytes as base64, in parts, because the number of arguments of a call is limited. */
function base64(bytes) {
  const PART = 8192;
  let text = "";
  for (let i = 0; i < bytes.length; i += PART) text += String.fromCharCode(...bytes.subarray(i, i + PART));
  return btoa(text);
}

/** A sound [channels] times a factor as a WAV file of 32-bit floats. */
export function soundOf(channels, factor, rate) {
  return { wav: base64(encodeWav(channels.map((x) => x.map((y) => y * factor)), rate)), scale: 1 };
}

/** Output path of a key as lists of numbers, or null. */
export function pathOf({ path }) {
  return path ? Object.fromEntries(Object.entries(path).map(([name, x]) => [name, Array.from(x)])) : null;
}

/** Modal response of a key divided by its gain, with the knock as a WAV file of 32-bit floats. */
export function responseOf({ modal_response: measured, gain }) {
  const { partial, pole, modal_amplitudes: amplitudes, velocity_gain: velocityGain, knock, rate } = measured;
  const list = (column, factor = 1) => Array.from(column, (x) => x * factor);
  const row = ({ re, im }, factor) => ({ real: list(re, factor), imag: list(im, factor) });
  const sound = knock.map((x) => Float64Array.from(x));
  subtractFirstSample(sound, amplitudes, Math.round(LEAD * rate));
  return {
    modes: { partial: list(partial), frequency: list(pole.im, 1 / (2 * Math.PI)), decay: list(pole.re, -1) },
    modal_amplitudes: amplitudes.map((channel) => row(channel, 1 / gain)),
    velocity_gain: velocityGain && { velocity: velocityGain.velocity,
      strokes: velocityGain.strokes.map((stroke) => row(stroke)) },
    knock: knock[0]?.length ? { ...soundOf(sound, 1 / gain, rate), rate } : null,
  };
}

const feltOf = ({ skin, mu }) => (skin ? "soft-skin" : mu === 0 ? "power" : "hunt-crossley");

/**
 * Document of a key with its changes, struck at `velocity`, m/s.
 *
 * origin: a sentence on where the key comes from; rate: default sample rate of rendered sounds, Hz.
 */
export function noteDocument(key, { velocity, rate, origin }) {
  const { string, hammer, geometry, quantity, gain } = key;
  const values = { ...string, ...(hammer && { ...hammer, v_H0: velocity }), x0: geometry.strike_position, width: geometry.width,
    M_S: geometry.mass, L: geometry.length, pickup: geometry.pickup };
  const given = (value) => ({ value, interval: null, status: "given" });
  const response = key.modal_response ? responseOf(key) : null;
  // The pluck of a file has a force of 1 N, so its gain contains the force.
  const size = hammer ? 1 : velocity, velocityGain = response?.velocity_gain;
  if (velocityGain) response.velocity_gain = { ...velocityGain, velocity: velocityGain.velocity.map((x) => x / size) };
  return {
    schema: SCHEMA, program: "pianofit", kind: "note", origin,
    excitation: hammer ? "hammer" : "pluck", felt: hammer ? feltOf(hammer) : "pluck",
    parameters: Object.fromEntries(Object.entries(values).map(([name, value]) => [name, given(value)])),
    recordings: [{ gain: gain * size, rate }],
    pickup: { quantity, path: pathOf(key) },
    modal_response: response && { render_model: response.knock ? "modes and knock" : "modes", response },
  };
}
