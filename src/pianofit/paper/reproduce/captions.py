"""What stands under the figures, and for those who do not see them: name -> (what is there, caption).

Fields in braces are filled in with what was computed; no number that could come out otherwise stands here.
"""

__all__ = ["CAPTIONS"]

CAPTIONS = {
    "figure-2": (
        "Force of the hammer over time for three velocities.",
        "Figure 2. Force over time; triangles mark its maxima, the arrow the time in which a wave runs to the agraffe "
        "and back. The legend has the duration of the contact.",
    ),
    "figure-3": (
        "Force of the hammer over compression of the felt: a loop.",
        "Figure 3. Force over compression at {velocity} m/s, μ = {mu}. Small loops within the large one are "
        "reflections: the felt is pressed again while it relaxes. What is gone round twice counts twice.",
    ),
    "figure-4": (
        "Spectra of the string's velocity for three hammer velocities, one below the other.",
        "Figure 4. Spectra of the string's velocity, with the spectral centroid. Every tenth partial is missing "
        "because the pickup stands on its node.",
    ),
    "band-3": (
        "Contours of the criterion over felt stiffness and hammer mass, with its minima marked.",
        "The criterion of band 3 over the felt's stiffness and the hammer's mass, the other three parameters at their "
        "truth. Every minimum marked was confirmed by descending to it; the number beside it is its criterion.",
    ),
    "searches": (
        "Where the searches ended, method by method, on a logarithmic scale.",
        "Where each search ended. Gradient descent had {gradient} evaluations of the criterion with its gradient, "
        "after which {settled} of {starts} had settled; an annealing had {annealing} of the criterion alone. Values "
        "above 10 are drawn at 10.",
    ),
    "figure-6": (
        "Spectrum of the measured velocity above, of the fitted models below.",
        "Figure 6. Spectra of the string's velocity at {velocity} m/s: measured above, the fits below.",
    ),
    "figure-7": (
        "Waveforms measured, before and after the fit, in two stretches of time.",
        "Figure 7. Waveforms at {velocity} m/s: measured (wide, grey), before (dash-dotted), after (plain; and "
        "dashed, with the string read). Above the first milliseconds; below a stretch some periods later, where the "
        "initial wave speed has left its mark.",
    ),
    "descriptors": (
        "Attack time and spectral centroid over hammer velocity, for measured and modelled sounds.",
        "Attack time (from 10 to 90 % of the first wave's height) and spectral centroid (of the partials to 6 kHz), "
        "measured on the sounds.",
    ),
    "predictions": (
        "Errors of the partials' levels at velocities that were not fitted, four bars each.",
        "Errors of the partials' levels at other velocities. For a prediction nothing changes but the hammer's "
        "velocity, to what the sensor read.",
    ),
    "repeated": (
        "Each parameter as found in repeated measurements, over its true value.",
        "Three-band fits of {count} measurements of the same blow, each with noise, a sensor's reading and a search "
        "of its own, over the truth; μ (hollow) over the paper's, since the laboratory's felt has none. Drawn at the "
        "edge: what lies beyond it.",
    ),
    "effects": (
        "The criterion that remains after a fit, with none, each and all of the laboratory's effects.",
        "What remains of the criterion after a fit at {velocity} m/s, when the laboratory has nothing that the model "
        "lacks, then one thing alone, then all. Noise is always there.",
    ),
    "kappa": (
        "The stiffness that is found through grids and steps of several sizes, beside the true one.",
        "κ of the paper's scheme when its partials are laid on those of a continuous string, by number of points and "
        "rate. No sound and no noise is involved.",
    ),
    "b2": (
        "The criterion in the three bands over decades of b2.",
        "The criterion over b₂ on a measurement of the ideal laboratory, all other parameters at their truth. Shaded "
        "in the same colour: where noise alone puts it at the truth, one standard deviation to either side.",
    ),
}
