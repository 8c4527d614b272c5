// Play one stroke of a modal JSON file: the whole reader of the format, as its documentation (docs/modal-json.md).
// In node: import { play } from "./modal_player.js"; play(JSON.parse(text), 60, 90, 3.0) has one array a channel.

export function play(document, midi, velocity, seconds) {
  const key = document.keys.find((key) => key.midi === midi), { rate, lead } = document;
  const count = Math.floor(seconds * rate), late = document.knock_lead - lead; // the knock begins before the force
  const decode = (text) => new Int16Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
  const knock = decode(key.knock), changes = decode(key.knock_changes), channels = key.pattern.length;
  const length = knock.length / channels;
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
      const own = Float64Array.from(knock.subarray(c * length, (c + 1) * length), (x) => key.knock_scale * x);
      const strokes = force.knock_change, size = changes.length / (strokes.length * channels) || 0;
      strokes.forEach((partOf, i) => {
        for (let n = 0; n < size; n++)
          own[document.knock_lead + n] += partOf * key.knock_changes_scale * changes[(i * channels + c) * size + n];
      });
      force.impulses.forEach((impulse, n) => {
        for (let k = Math.max(lead - n, 0); k < length && n + k - lead < count; k++)
          sound[c][n + k - lead] += share * impulse * own[k];
      });
    });
  }
  return sound;
}
