// Play one stroke of a modal JSON file: the whole reader of the format, as its documentation (docs/modal-json.md).
// In node: import { play } from "./modal_player.js"; play(JSON.parse(text), 60, 90, 3.0) has one array a channel.

export function play(document, midi, velocity, seconds) {
  const key = document.keys.find((key) => key.midi === midi), { rate, lead } = document;
  const count = Math.floor(seconds * rate), late = document.knock_lead - lead; // the knock begins before the force
  const bytes = Uint8Array.from(atob(key.knock), (letter) => letter.charCodeAt(0));
  const knock = new Int16Array(bytes.buffer), length = knock.length / key.pattern.length;
  const above = key.forces.find((force) => force.midi_velocity >= velocity) ?? key.forces.at(-1);
  const below = key.forces.findLast((force) => force.midi_velocity <= velocity) ?? key.forces[0];
  const part = (velocity - below.midi_velocity) / Math.max(above.midi_velocity - below.midi_velocity, 1);
  const sound = key.pattern.map(() => new Float64Array(count));
  for (const [force, share] of [[below, 1 - part], [above, part]]) {
    key.pattern.forEach(([patternRe, patternIm], c) => {
      key.modes.frequency.forEach((hertz, m) => {
        const size = Math.exp(-key.modes.decay[m] / rate), angle = 2 * Math.PI * hertz / rate;
        const turnRe = size * Math.cos(angle), turnIm = size * Math.sin(angle), [gainRe, gainIm] = force.gain;
        const re = share * (patternRe[m] * gainRe[m] - patternIm[m] * gainIm[m]);
        const im = share * (patternRe[m] * gainIm[m] + patternIm[m] * gainRe[m]);
        for (let n = 0, x = 0, y = 0; n < count - late; n++) {
          [x, y] = [x * turnRe - y * turnIm + (force.impulses[n] ?? 0), x * turnIm + y * turnRe];
          sound[c][late + n] += re * x - im * y;
        }
      });
      force.impulses.forEach((impulse, n) => {
        for (let k = Math.max(lead - n, 0); k < length && n + k - lead < count; k++)
          sound[c][n + k - lead] += share * impulse * key.knock_scale * knock[c * length + k];
      });
    });
  }
  return sound;
}
