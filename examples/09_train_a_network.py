"""A small network learns parameters from synthetic notes, and its guess starts a fit of a note that it has not seen."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optax

import pianofit

LABELS = ("b1", "M_H", "v_H0")
TRAIN, TEST = 800, 100  # notes
OPTIONS = pianofit.NoteOptions(keys=("C3", "C5"), seconds=0.7)
BANDS, FRAMES, FRAME = 40, 8, 2048  # bands of a spectrogram, its frames, and samples of a frame
WIDTH, STEPS = 128, 600  # neurons of a layer, and steps of the training


def features(note: pianofit.LabelledNote) -> np.ndarray:
    """Levels in bands of partials, dB [features]: the pitch is taken as given."""
    starts = np.linspace(0, len(note.samples) - FRAME, FRAMES).astype(int)
    frames = np.stack([note.samples[at : at + FRAME] for at in starts]) * np.hanning(FRAME)
    power = np.abs(np.fft.rfft(frames, axis=1)) ** 2
    band = np.fft.rfftfreq(FRAME, 1 / note.rate) / note.labels["f0"]
    edges = np.geomspace(0.5, 40.0, BANDS + 1)
    sums = [power[:, (band >= low) & (band < high)].sum(axis=1) for low, high in itertools.pairwise(edges)]
    levels = 10 * np.log10(np.array(sums) + 1e-9)
    return np.append(levels.ravel() / 20, np.log(note.labels["f0"] / 261.6))


def data(seed: int, count: int) -> tuple[list[pianofit.LabelledNote], np.ndarray, np.ndarray]:
    """Notes, their features [count, features], and logarithms of their labels [count, labels]."""
    notes = list(pianofit.notes(count, seed=seed, options=OPTIONS))
    labels = np.log([[note.labels[name] for name in LABELS] for note in notes])
    return notes, np.array([features(note) for note in notes], np.float32), labels.astype(np.float32)


def initial(sizes: list[int], key) -> list:
    """Weights and biases of every layer."""
    keys = jax.random.split(key, len(sizes))
    pairs = zip(keys, sizes[:-1], sizes[1:], strict=False)
    return [(jax.random.normal(k, (n, m)) * jnp.sqrt(2 / n), jnp.zeros(m)) for k, n, m in pairs]


def network(weights: list, x):
    """Labels [..., labels] from features [..., features]."""
    *hidden, (matrix, bias) = weights
    for w, b in hidden:
        x = jax.nn.relu(x @ w + b)
    return x @ matrix + bias


def train(x: np.ndarray, y: np.ndarray) -> list:
    """Minimise the mean square error by AdamW."""
    weights = initial([x.shape[1], WIDTH, WIDTH, y.shape[1]], jax.random.key(0))
    optimiser = optax.adamw(optax.cosine_decay_schedule(2e-3, STEPS), weight_decay=0.1)

    def loss(weights, x, y):
        return ((network(weights, x) - y) ** 2).mean()

    @jax.jit
    def step(weights, state, x, y):
        change, state = optimiser.update(jax.grad(loss)(weights, x, y), state, weights)
        return optax.apply_updates(weights, change), state

    state, random = optimiser.init(weights), np.random.default_rng(0)
    for _ in range(STEPS):
        batch = random.integers(len(x), size=64)
        weights, state = step(weights, state, x[batch], y[batch])
    return weights


def main() -> None:
    """Train, print what the network explains of unseen notes, and start a fit with its guess."""
    _, x, y = data(1, TRAIN)
    notes, x_new, y_new = data(2, TEST)
    mean, sd = (x.mean(axis=0), x.std(axis=0) + 1e-3), (y.mean(axis=0), y.std(axis=0))
    weights = train((x - mean[0]) / mean[1], (y - sd[0]) / sd[1])
    guess = np.asarray(network(weights, (x_new - mean[0]) / mean[1])) * sd[1] + sd[0]
    for i, name in enumerate(LABELS):
        error = np.std(guess[:, i] - y_new[:, i])
        print(f"{name:5} spread {np.std(y_new[:, i]):.2f}, error {error:.2f} (logarithms)")
    start = {name: float(np.exp(guess[0, i])) for i, name in enumerate(LABELS)}
    true = notes[0].labels
    setup = pianofit.Setup(length=true["L"], mass=true["M_S"], strike_position=true["x0"])
    sound, given = (notes[0].samples, notes[0].rate), {"setup": setup, "velocity": true["v_H0"], "note": true["key"]}
    result = pianofit.fit(sound, **given, start=start, budget=20, progress=False)
    fitted = result.parameters.M_H
    low, high = fitted.interval or (float("nan"), float("nan"))
    print(
        f"M_H: guess {start['M_H']:.3g}, fitted {fitted.value:.3g} ({low:.3g}, {high:.3g}), true {true['M_H']:.3g} kg"
    )


if __name__ == "__main__":
    main()
