"""The method of Bensa, Gipouloux and Kronland-Martinet (2005), for comparison with the default fit.

- Section IV.B: `spectral_criterion` has eq. 19 in its bands, and its gradient.
- Section IV.C: `descent` is the gradient method (1), `annealing` is (2), and `search` runs both in a box.
- `method` has the three steps and the entry point, `fit`. `point_estimate` makes a result without intervals.

The study in `studies/bensa2005` of the repository tests the findings of the paper with this method.
"""

from .method import fit
