// Noise of keys that are let go, with the laws of instrument/release_noise.py.

import { resample } from "./signal.js";

const RECORDED_VELOCITY = 64; // MIDI release velocity of the recordings
const SOUNDING_TIME = 0.1; // s, in which a note reaches 63 % of the noise of a long note
const SPEED_RISE = 1.5; // of the logarithm of the key's speed, from MIDI velocity 64 to 127
const LEAST_ENERGY = 1e-30;

/**
 * Noise of each key: Map of MIDI numbers to {sound: [channels], gain}.
 *
 * releases: [{midi, sound: [channels], rate}]; keys: MIDI numbers; rate: of the engine, Hz.
 */
export function releaseNoises(releases, keys, rate) {
  const sorted = [...releases].sort((a, b) => a.midi - b.midi), noises = new Map();
  const energy = ({ sound }) => sound.reduce((sum, x) => x.reduce((part, y) => part + y * y, sum), 0);
  const level = sorted.map((release) => 0.5 * Math.log(Math.max(energy(release), LEAST_ENERGY)));
  const sounds = sorted.map(({ sound, rate: from }) => sound.map((x) => Float32Array.from(resample(x, from, rate))));
  for (const midi of keys) {
    if (!sorted.length) break;
    const distance = sorted.map((release) => Math.abs(release.midi - midi));
    const nearest = distance.indexOf(Math.min(...distance));
    noises.set(midi, { sound: sounds[nearest], gain: Math.exp(levelAt(sorted, level, midi) - level[nearest]) });
  }
  return noises;
}

function levelAt(sorted, level, midi) {
  const above = sorted.findIndex((release) => release.midi >= midi);
  if (above <= 0) return level.at(above);
  const part = (midi - sorted[above - 1].midi) / (sorted[above].midi - sorted[above - 1].midi);
  return level[above - 1] + part * (level[above] - level[above - 1]);
}

/** Gain of the noise for a MIDI release velocity and a note that sounded for `seconds`. */
export function releaseGain(velocity, seconds) {
  const speed = Math.exp((SPEED_RISE * (Math.max(velocity, 1) - RECORDED_VELOCITY)) / 63);
  return speed * -Math.expm1(-Math.max(seconds, 0) / SOUNDING_TIME);
}
