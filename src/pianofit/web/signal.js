// Signal processing: Fourier transform, convolution and resampling.

const twiddles = new Map(); // by size of a transform: cosines and sines

function twiddlesOf(size) {
  if (!twiddles.has(size)) {
    const angle = Float64Array.from({ length: size / 2 }, (_, k) => (2 * Math.PI * k) / size);
    twiddles.set(size, [angle.map(Math.cos), angle.map(Math.sin)]);
  }
  return twiddles.get(size);
}

/** In-place Fourier transform of re + i im, size a power of two. `sign` +1 is the inverse without division by size. */
export function fft(re, im, sign = -1) {
  const size = re.length;
  const [cos, sin] = twiddlesOf(size);
  for (let i = 1, j = 0; i < size; i++) {
    let bit = size >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [re[i], re[j]] = [re[j], re[i]];
      [im[i], im[j]] = [im[j], im[i]];
    }
  }
  for (let half = 1; half < size; half *= 2) {
    const stride = size / (2 * half);
    for (let start = 0; start < size; start += 2 * half) {
      for (let k = 0; k < half; k++) {
        const c = cos[k * stride], s = sign * sin[k * stride], a = start + k, b = a + half;
        const x = re[b] * c - im[b] * s, y = re[b] * s + im[b] * c;
        re[b] = re[a] - x;
        im[b] = im[a] - y;
        re[a] += x;
        im[a] += y;
      }
    }
  }
}

/** The first `count` samples of a ∗ b. */
export function convolve(a, b, count) {
  let size = 1;
  while (size < a.length + b.length) size *= 2;
  const re = new Float64Array(size), im = new Float64Array(size);
  re.set(a);
  im.set(b); // both real sequences in one transform: the imaginary part of the square is 2 (a ∗ b)
  fft(re, im);
  for (let k = 0; k < size; k++) [re[k], im[k]] = [re[k] * re[k] - im[k] * im[k], 2 * re[k] * im[k]];
  fft(re, im, 1);
  return im.slice(0, count).map((x) => x / (2 * size));
}

/** Kaiser-windowed low-pass with β = 5, as in scipy.signal.resample_poly: [2 · 10 max(up, down) + 1]. */
export function lowpass(up, down) {
  const most = Math.max(up, down), half = 10 * most, h = new Float64Array(2 * half + 1);
  const bessel = (x) => {
    let sum = 1, term = 1;
    for (let k = 1; term > 1e-17 * sum; k++) sum += term *= (x / (2 * k)) ** 2;
    return sum;
  };
  let total = 0;
  for (let i = 0; i <= 2 * half; i++) {
    const t = (i - half) / most, at = (i - half) / half;
    h[i] = bessel(5 * Math.sqrt(Math.max(1 - at * at, 0))) * (t === 0 ? 1 : Math.sin(Math.PI * t) / (Math.PI * t));
    total += h[i];
  }
  return h.map((x) => (most === 1 ? Number(x === h[half]) : (x * up) / total));
}

/** Resample a sound from the rate `from` to the rate `to`, Hz, both integers. */
export function resample(x, from, to) {
  let a = from, b = to;
  while (b) [a, b] = [b, a % b];
  const up = to / a, down = from / a;
  if (up === down) return Float64Array.from(x);
  const h = lowpass(up, down), half = (h.length - 1) / 2;
  const out = new Float64Array(Math.ceil((x.length * up) / down));
  for (let k = 0; k < out.length; k++) {
    const last = Math.min(Math.floor((k * down + half) / up), x.length - 1);
    for (let m = Math.max(Math.ceil((k * down - half) / up), 0); m <= last; m++) {
      out[k] += x[m] * h[k * down - m * up + half];
    }
  }
  return out;
}
