"""The file of the program Entropy Piano Tuner, plain XML of version 1.

The format is that of `app/piano/pianofileioxml.cpp` of its source code (gitlab.com/tp3/Entropy-Piano-Tuner, read in a
mirror, commit 1c3a86a of August 2017). Its meanings are those of `modules/core/piano/key.h` and `key.cpp` there: the
recorded frequency is that of partial 1, computed frequencies belong to A4 = 440 Hz, and partial n lies at
f1 n √((1 + B n²)/(1 + B)), which is the B of this package. A frequency of 0 is not known.

A key that was not recorded has only a computed frequency, because the program takes every inharmonicity for a measured
one. Spectra are left out. The program fills them with zeros. Its tuning mode does not need them, its own calculation of
a tuning curve does.
"""

from xml.etree import ElementTree

from ..conversions import A4, A4_MIDI, LOWEST_KEY
from ..schema.tuning import TunedKey, Tuning

VERSION = "1"
GRAND = "0"  # type of a piano; the default of the program
# Texts that are not known. The program sets an empty time to the present.
UNKNOWN = ("serialNumber", "manufactionYear", "manufactionLocation", "tuningLocation", "tuningTimestamp")
BASS_KEYS = "28"  # keys on the bass bridge; the default of the program


def entropy_piano_tuner_file(tuning: Tuning) -> bytes:
    """Return the content of an `.ept` file."""
    root = ElementTree.Element("entropyPianoTunerFile", version=VERSION)
    piano = ElementTree.SubElement(root, "piano", concertPitch=repr(tuning.a4), type=GRAND)
    ElementTree.SubElement(piano, "name").text = tuning.name
    for name in UNKNOWN:
        ElementTree.SubElement(piano, name)
    sizes = {"numberOfKeys": str(len(tuning.keys)), "keyNumberOfA": str(A4_MIDI - LOWEST_KEY)}
    keyboard = ElementTree.SubElement(piano, "keyboard", sizes, numberOfBassKeys=BASS_KEYS)
    for i, key in enumerate(tuning.keys):
        ElementTree.SubElement(keyboard, "key", {"key": str(i)} | _values(key, tuning.a4))
    ElementTree.SubElement(piano, "algorithms")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _values(key: TunedKey, a4: float) -> dict[str, str]:
    recorded = key.recorded
    return {
        "recordedFrequency": repr(key.first_partial.value) if recorded else "0",
        "measuredInharmonicity": repr(key.B.value) if recorded else "0",
        "computedFrequency": repr(key.target.value * A4 / a4),
        "tunedFrequency": "0",
        "recorded": "1" if recorded else "0",
        "quality": "0",
    }
