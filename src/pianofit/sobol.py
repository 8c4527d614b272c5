"""Scrambled Sobol points. They equal those of `scipy.stats.qmc.Sobol`, but the import of `scipy.stats` takes 0.3 s.

A coordinate of point i is the exclusive or of direction numbers, selected by the bits of the Gray code of i (Sobol
1967; Antonov and Saleev 1979). Direction numbers follow from a primitive polynomial and a few initial values (Joe and
Kuo 2008). The scrambling is a random lower triangular matrix of bits and a random shift (Matousek 1998).
"""

import functools

import numpy as np

# Bits of a coordinate, as in SciPy.
BITS = 30
# Primitive polynomials and initial direction numbers of dimensions 2 to 64 (https://web.maths.unsw.edu.au/~fkuo/sobol).
TABLE = """
3:1 7:1,3 11:1,3,1 13:1,1,1 19:1,1,3,3 25:1,3,5,13 37:1,1,5,5,17 41:1,1,5,5,5 47:1,1,7,11,19 55:1,1,5,1,1
59:1,1,1,3,11 61:1,3,5,5,31 67:1,3,3,9,7,49 91:1,1,1,15,21,21 97:1,3,1,13,27,49 103:1,1,1,15,7,5 109:1,3,1,15,13,25
115:1,1,5,5,19,61 131:1,3,7,11,23,15,103 137:1,3,7,13,13,15,69 143:1,1,3,13,7,35,63 145:1,3,5,9,1,25,53
157:1,3,1,13,9,35,107 167:1,3,1,5,27,61,31 171:1,1,5,11,19,41,61 185:1,3,5,3,3,13,69 191:1,1,7,13,1,19,1
193:1,3,7,5,13,19,59 203:1,1,3,9,25,29,41 211:1,3,5,13,23,1,55 213:1,3,7,3,13,59,17 229:1,3,1,3,5,53,69
239:1,1,5,5,23,33,13 241:1,1,7,7,1,61,123 247:1,1,7,9,13,61,49 253:1,3,3,5,3,55,33 285:1,3,1,15,31,13,49,245
299:1,3,5,15,31,59,63,97 301:1,3,1,11,11,11,77,249 333:1,3,1,11,27,43,71,9 351:1,1,7,15,21,11,81,45
355:1,3,7,3,25,31,65,79 357:1,3,1,1,19,11,3,205 361:1,1,5,9,19,21,29,157 369:1,3,7,11,1,33,89,185
391:1,3,3,3,15,9,79,71 397:1,3,7,11,15,39,119,27 425:1,1,3,1,11,31,97,225 451:1,1,1,3,23,43,57,177
463:1,3,7,7,17,17,37,71 487:1,3,1,5,27,63,123,213 501:1,1,3,5,11,43,53,133 529:1,3,5,5,29,17,47,173,479
539:1,3,3,11,3,1,109,9,69 545:1,1,1,5,17,39,23,5,343 557:1,3,1,5,25,15,31,103,499 563:1,1,1,11,11,17,63,105,183
601:1,1,5,11,9,29,97,231,363 607:1,1,5,15,19,45,41,7,383 617:1,3,7,7,31,19,83,137,221 623:1,1,1,3,23,15,111,223,83
631:1,1,5,13,31,15,55,25,161 637:1,1,3,13,25,47,39,87,257
"""


def sobol_points(dimensions: int, count: int, seed: int) -> np.ndarray:
    """Return the first points of a scrambled Sobol sequence, in [0, 1) [count, dimensions].

    Parameters
    ----------
    dimensions : number of coordinates. Beyond the table, SciPy computes the points.
    count : number of points. Only powers of two are balanced.
    seed : seed of the scrambling. The points are those of `scipy.stats.qmc.Sobol` with a generator of this seed.
    """
    rng = np.random.default_rng(seed)
    if dimensions > len(_directions()):
        from scipy.stats import qmc

        return qmc.Sobol(dimensions, rng=rng).random(count)
    rng = rng.spawn(1)[0]  # as SciPy does
    shift = rng.integers(2, size=(dimensions, BITS), dtype=np.uint32) @ (1 << np.arange(BITS, dtype=np.uint32))
    mix = np.tril(rng.integers(2, size=(dimensions, BITS, BITS), dtype=np.uint32), -1) | np.eye(BITS, dtype=np.uint32)
    place = np.arange(BITS - 1, -1, -1, dtype=np.uint32)  # of bits, from the highest
    bits = _directions()[:dimensions, :, None] >> place & 1
    scrambled = ((bits @ mix.swapaxes(1, 2) & 1) << place).sum(axis=-1, dtype=np.uint32)
    index = np.arange(count)
    points = np.tile(shift, (count, 1))
    for j in range(max(count - 1, 0).bit_length()):
        points[(index ^ index >> 1) >> j & 1 == 1] ^= scrambled[:, j]
    return points / 2.0**BITS


@functools.cache
def _directions() -> np.ndarray:
    """Direction numbers [dimensions, BITS] of the dimensions of the table."""
    rows = [[1] * BITS]
    for text in TABLE.split():
        polynomial, values = text.split(":")
        v = [int(x) for x in values.split(",")]
        degree = len(v)
        for j in range(degree, BITS):
            new = v[j - degree]
            for k in range(1, degree + 1):
                new ^= (int(polynomial) >> (degree - k) & 1) * (v[j - k] << k)
            v.append(new)
        rows.append(v)
    return np.array(rows, np.uint32) << np.arange(BITS - 1, -1, -1, dtype=np.uint32)
