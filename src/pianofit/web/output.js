// Output stage: volume, a limiter with one block of look-ahead, and WAV files.

const CEILING = 0.891; // full scale: -1 dB
const RELEASE = 0.2; // s, time constant of the limiter's recovery

/** Volume and limiter for blocks of two channels. The output is delayed by one block and never above -1 dBFS. */
export class Output {
  constructor(rate, size) {
    const pair = () => [new Float64Array(size), new Float64Array(size)];
    Object.assign(this, { volume: 1, lastVolume: 1, gain: 1, allowed: 1, delayed: pair(), out: pair() });
    this.release = 1 - Math.exp(-size / (rate * RELEASE));
  }

  /** Take a block and return the previous one: [left, right], valid until the next call. */
  pass(channels) {
    const { delayed, out, gain } = this, size = delayed[0].length;
    let peak = 0;
    out.forEach((block, i) => {
      block.set(delayed[i]);
      for (let n = 0; n < size; n++) { // the volume changes gradually over a block
        const x = (this.lastVolume + ((this.volume - this.lastVolume) * (n + 1)) / size) * channels[i][n];
        peak = Math.max(peak, Math.abs(x));
        delayed[i][n] = x;
      }
    });
    this.lastVolume = this.volume;
    const allowed = peak > CEILING ? CEILING / peak : 1;
    const next = Math.min(this.allowed, allowed, gain + (1 - gain) * this.release);
    for (let n = 0; n < size; n++) {
      const g = gain + ((next - gain) * n) / size;
      for (const block of out) block[n] *= g;
    }
    Object.assign(this, { gain: next, allowed });
    return out;
  }
}

/** Bytes of a WAV file with 32-bit floats; channels are [frames] each. */
export function encodeWav(channels, rate) {
  const frames = channels[0].length, width = 4 * channels.length, data = frames * width;
  const view = new DataView(new ArrayBuffer(58 + data));
  const text = (at, word) => [...word].forEach((c, i) => view.setUint8(at + i, c.charCodeAt(0)));
  text(0, "RIFF");
  view.setUint32(4, 50 + data, true);
  text(8, "WAVEfmt ");
  view.setUint32(16, 18, true);
  view.setUint16(20, 3, true); // IEEE float
  view.setUint16(22, channels.length, true);
  view.setUint32(24, rate, true);
  view.setUint32(28, rate * width, true);
  view.setUint16(32, width, true);
  view.setUint16(34, 32, true);
  text(38, "fact");
  view.setUint32(42, 4, true);
  view.setUint32(46, frames, true);
  text(50, "data");
  view.setUint32(54, data, true);
  channels.forEach((x, c) => x.forEach((y, n) => view.setFloat32(58 + n * width + 4 * c, y, true)));
  return new Uint8Array(view.buffer);
}
