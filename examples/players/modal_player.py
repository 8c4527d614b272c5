"""Play one stroke of a modal JSON file.

    python modal_player.py grand.json 60 90 3.0 stroke.wav

The whole reader of the format in plain Python, as its documentation (docs/modal-json.md). It is slow.
"""

import base64
import cmath
import json
import math
import struct
import sys
import wave
from pathlib import Path


def play(document, midi, velocity, seconds):
    """Sound of one stroke at a MIDI velocity: lists of samples, one a channel."""
    key = next(key for key in document["keys"] if key["midi"] == midi)
    rate, count, modes = document["rate"], int(seconds * document["rate"]), key["modes"]
    forces = key["forces"]
    above = next((f for f in forces if f["midi_velocity"] >= velocity), forces[-1])
    below = next((f for f in reversed(forces) if f["midi_velocity"] <= velocity), forces[0])
    part = (velocity - below["midi_velocity"]) / max(above["midi_velocity"] - below["midi_velocity"], 1)
    sound = [[0.0] * count for _ in key["pattern"]]
    for force, share in ((below, 1 - part), (above, part)):
        late = document["knock_lead"] - document["lead"]  # the knock begins before the force
        for channel, pattern in zip(sound, key["pattern"], strict=True):
            for m, (hertz, decay) in enumerate(zip(modes["frequency"], modes["decay"], strict=True)):
                turn = cmath.exp(complex(-decay, 2 * math.pi * hertz) / rate)
                gain = complex(force["gain"][0][m], force["gain"][1][m])
                weight = share * gain * complex(pattern[0][m], pattern[1][m])
                state = 0j
                for n in range(count - late):
                    state = state * turn + (force["impulses"][n] if n < len(force["impulses"]) else 0.0)
                    channel[late + n] += (weight * state).real
        for channel, knock in zip(sound, knocks(key, force, document["knock_lead"]), strict=True):
            for n, impulse in enumerate(force["impulses"]):
                for k in range(min(len(knock), count - n + document["lead"])):
                    if n + k >= document["lead"]:
                        channel[n + k - document["lead"]] += share * impulse * knock[k]
    return sound


def knocks(key, force, lead):
    """Knock of a stroke: that of the key, changed from the touch on; lists of samples, one a channel."""
    found = decode(key["knock"], key["knock_scale"], len(key["pattern"]))
    shares = force["knock_change"]
    changes = decode(key["knock_changes"], key["knock_changes_scale"], len(shares) * len(found))
    for i, change in enumerate(changes):
        knock = found[i % len(found)]
        for n, x in enumerate(change):
            knock[lead + n] += shares[i // len(found)] * x
    return found


def decode(text, scale, rows):
    """Lists of numbers, one a row, of base64 of 16 bit integers."""
    numbers = [scale * x for (x,) in struct.iter_unpack("<h", base64.b64decode(text))]
    return [numbers[i * len(numbers) // rows : (i + 1) * len(numbers) // rows] for i in range(rows)]


if __name__ == "__main__":
    file, key, velocity, seconds, out = sys.argv[1:]
    document = json.loads(Path(file).read_text())
    sound = play(document, int(key), float(velocity), float(seconds))
    peak = max(abs(x) for channel in sound for x in channel) or 1.0
    with wave.open(out, "wb") as wav:
        wav.setparams((len(sound), 2, document["rate"], 0, "NONE", ""))
        frames = zip(*sound, strict=True)
        wav.writeframes(b"".join(struct.pack("<h", int(32767 * x / peak)) for frame in frames for x in frame))
