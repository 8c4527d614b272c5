"""Tests of the tables, figures and claims of Bensa, Gipouloux and Kronland-Martinet (2005) with numbers of one run.

    python -m studies.bensa2005 --out reproduced

The paper fitted recordings that are not public. Synthetic measurements replace them (`laboratory`, with `body` and
`contact`). Their parameters are given, and they contain effects that the paper's model does not describe. `findings`
runs the studies: `direct` (Figures 2 to 4), `strokes` (fits and sounds), `hammer_search` (band 3) and `limits` (κ and
b2). `claims` decides by rules. `page` writes the page, whose text is in `index.html.j2`, and its contents as files:
every figure as PNG, every table as CSV, every sound as WAV. `python -m studies.bensa2005.recipes` compares the
paper's recipes with the default fit.
"""
