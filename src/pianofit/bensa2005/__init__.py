"""The methods of Bensa, Gipouloux and Kronland-Martinet (2005), in the order of the paper.

No other package of pianofit depends on this one.

- Section III and appendix: `finite_difference` has eq. 9 to 18 with their matrices, and the derivatives A7 to A13. It
  is an independent check of `pianofit.model` (eq. 1 to 8) and shares only the parameters' names with it.
- Section IV.A: `laboratory` makes measurements with known parameters. The paper's measurements are not public.
- Section IV.B: `spectral_criterion` has eq. 19 in its bands.
- Section IV.C: `descent` is the gradient method (1), `annealing` is (2), and `search` runs the three steps with both.
  `recipes` is the entry point. `point_estimate` makes a result without intervals.
- Sections III.C and V: `reproduce` makes the page that tests the tables, figures and claims.

This module imports nothing, so that `laboratory` does not load the dependencies of `search`.
"""
