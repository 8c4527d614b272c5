// K-weighted loudness (ITU-R BS.1770), as in report/sound.py, to compare sounds at equal loudness.

import { fft } from "./signal.js";

const SECONDS = 1; // length of the measured part of a sound
// The two filters of ITU-R BS.1770 as analogue prototypes: a shelf for the effect of the head, and a high-pass.
const SHELF = { w: 2 * Math.PI * 1681.974, q: 0.7071752, high: 10 ** (3.999844 / 20), root: 0.4996668 };
const HIGH_PASS = { w: 2 * Math.PI * 38.13547, q: 0.500327 };

/** |H|² of both filters at ω, rad/s. */
function weight(w) {
  const { w: a, q, high, root } = SHELF, b = HIGH_PASS.w, size = (re, im) => re * re + im * im;
  const shelf = size(a * a - high * w * w, (high ** root * a * w) / q) / size(a * a - w * w, (a * w) / q);
  return (shelf * w ** 4) / size(b * b - w * w, (b * w) / HIGH_PASS.q);
}

/** Mean square of the first second of all channels [samples], after K-weighting. */
export function kWeighted(channels, rate) {
  const count = Math.min(Math.round(SECONDS * rate), channels[0].length);
  let size = 1, sum = 0;
  while (size < count) size *= 2;
  for (const channel of channels) {
    const re = new Float64Array(size), im = new Float64Array(size);
    re.set(channel.subarray(0, count));
    fft(re, im);
    for (let k = 1; k <= size / 2; k++) {
      sum += (re[k] ** 2 + im[k] ** 2) * weight((2 * Math.PI * k * rate) / size) * (k < size / 2 ? 2 : 1);
    }
  }
  return sum / (size * count * channels.length);
}

/** Gains that make sounds, [channels] each, equally loud, with the highest peak at `ceiling`. */
export function matched(sounds, rate, ceiling) {
  const gains = sounds.map((channels) => (kWeighted(channels, rate) || 1) ** -0.5);
  const peak = Math.max(...sounds.map((channels, i) => gains[i] * Math.max(...channels.map(largest))));
  return gains.map((gain) => (peak > 0 ? (gain * ceiling) / peak : 1));
}

function largest(channel) {
  let most = 0;
  for (const x of channel) most = Math.max(most, Math.abs(x));
  return most;
}
