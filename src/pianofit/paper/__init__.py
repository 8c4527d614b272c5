"""All that is only the paper's (Bensa, Gipouloux and Kronland-Martinet 2005); nothing but the command line needs it.

- `scheme`: its grid, matrices and all, and the derivatives of its appendix: a witness that shares nothing with the
  model but the parameters' names.
- `spectral`, `struck`: eq. 19 as a search sees it. `descent`, `annealing`: what searches. `search`, `recipes`: the
  three steps of IV.C, and the criterion over the whole spectrum. `recipes` is their door.
- `twin`, `laboratory`: measurements whose truth is known, for the paper's are not public.
- `reproduce`: the page that tests its tables, figures and claims on them.

Nothing is imported here, so that a measurement does not load what a search needs.
"""
