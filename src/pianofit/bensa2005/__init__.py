"""All that is only the paper's (Bensa, Gipouloux and Kronland-Martinet 2005), in its order; no room is built on it.

- III, and the appendix: `scheme`, eq. 9 to 18 with their matrices, and the derivatives of A7 to A13: a witness that
  shares nothing with the model, whose string and hammer are those of eq. 1 to 8, but the parameters' names.
- IV.A, whose measurements are not public: `laboratory` makes some whose truth is known.
- IV.B: eq. 19 in its bands, `spectral`, of a recording and of the string and hammer that are searched.
- IV.C: `descent`, the gradient (1); `annealing` (2); `search`, the three steps by both; `recipes`, their door, and
  `point`, the result of a search that gives no intervals.
- III.C and V: `reproduce`, the page that tests the tables, figures and claims.

Nothing is imported here, so that a measurement does not load what a search needs.
"""
