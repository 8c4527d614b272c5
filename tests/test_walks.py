"""Random walks over velocity, separated from measurement errors."""

from __future__ import annotations

import numpy as np

from pianofit.modal_response.random_walks import smooth_random_walk


def drawn_walks(size: float, own: float, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocities, random walks over their logarithm [strokes, 40], and noisy observations of them."""
    random = np.random.default_rng(seed)
    velocity = np.array([0.4, 0.9, 1.6, 2.5, 4.0])
    steps = np.sqrt(np.diff(np.log(velocity)))[:, None] * random.normal(0, size, (4, 40))
    walk = np.concatenate([np.zeros((1, 40)), np.cumsum(steps, axis=0)]) + random.normal(0, 3, 40)
    return velocity, walk, walk + random.normal(0, np.hypot(own, noise), walk.shape)


def test_walks_are_smoothed_as_well_as_if_their_size_were_known():
    """The best linear estimate uses the true step and scatter; `smooth_random_walk` must estimate them."""
    for size, own in ((0.3, 0.03), (0.05, 0.3), (0.3, 0.3)):
        velocity, walk, observed = drawn_walks(size, own, 0.05, 3)
        found = smooth_random_walk(observed, np.full(observed.shape, 0.05), velocity)
        far = np.log(velocity)
        signal = size**2 * np.minimum.outer(far - far[0], far - far[0]) + 1e6
        best = signal @ np.linalg.solve(signal + (own**2 + 0.05**2) * np.eye(5), observed)
        ours, ideal, none = (np.sqrt(np.mean((x - walk) ** 2)) for x in (found, best, observed))
        assert ours < 1.1 * ideal
        assert ours < none


def test_what_strokes_do_not_tell_apart_stays_their_mean():
    velocity, walk, _ = drawn_walks(0.0, 0.0, 0.0, 1)
    random = np.random.default_rng(2)
    observed = walk + random.normal(0, 0.2, walk.shape)
    found = smooth_random_walk(observed, np.full(observed.shape, 0.2), velocity)
    assert np.abs(np.diff(found, axis=0)).max() < 0.1
    one = smooth_random_walk(observed[:1], np.full((1, 40), 0.2), velocity[:1])
    np.testing.assert_allclose(one, observed[:1])
