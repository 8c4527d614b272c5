"""How much of a core's time 16 voices of an instrument's Faust program take, compiled by Faust and a C++ compiler.

    python benchmarks/faust.py [INSTRUMENT.JSON] [--keys A0-C8] [--flags "-O3"]

Without an instrument it is that of `synthetic_piano.py`, whose keys all have some hundred modes and a knock in stereo.
All voices are struck at once and play for four seconds in blocks of 512 samples at 48 kHz. Counted is the processor's
time; the least of several runs is printed, of the first two blocks and of all others, with the time and memory that
Faust takes to compile the program.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import tempfile
import time
from pathlib import Path

from synthetic_piano import piano

from pianofit.analysis.note_names import parse_keys
from pianofit.export.faust import write_faust
from pianofit.instrument import load_instrument

RUNS = 3
PLAYER = r"""
#include <cmath>
#include <cstdio>
#include <ctime>
#include <map>
#include <string>
#include <vector>
#define FAUSTFLOAT float
struct Meta { void declare(const char*, const char*) {} };
struct UI {
  std::map<std::string, float*> at;
  void openVerticalBox(const char*) {}
  void closeBox() {}
  void declare(float*, const char*, const char*) {}
  void addButton(const char* name, float* zone) { at[name] = zone; }
  void addHorizontalSlider(const char* name, float* zone, float, float, float, float) { at[name] = zone; }
};
struct dsp { virtual ~dsp() {} };
#include "program.cpp"
int main() {
  const int voices = 16, block = 512, rate = 48000, blocks = 4 * rate / block;
  std::vector<mydsp> voice(voices);
  std::vector<UI> ui(voices);
  std::vector<float> left(block), right(block);
  float* out[2] = {left.data(), right.data()};
  for (int i = 0; i < voices; i++) {
    voice[i].init(rate);
    voice[i].buildUserInterface(&ui[i]);
    voice[i].compute(block, nullptr, out);
    *ui[i].at["freq"] = 440 * std::pow(2.0f, (36 + 3 * i - 69) / 12.0f);
    *ui[i].at["gain"] = 0.8f;
    *ui[i].at["gate"] = 1;
  }
  const auto render = [&](int count) {
    const std::clock_t begin = std::clock();
    for (int k = 0; k < count; k++)
      for (auto& one : voice) one.compute(block, nullptr, out);
    return double(std::clock() - begin) / CLOCKS_PER_SEC / (double(count) * block / rate);
  };
  const double first = render(2), all = render(blocks);
  std::printf("%g %g\n", first, all);
}
"""


def main() -> None:
    """Print one line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("instrument", type=Path, nargs="?")
    parser.add_argument("--keys", default="A0-C8")
    parser.add_argument("--flags", default="-O3")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        instrument = load_instrument(asked.instrument) if asked.instrument else piano(parse_keys(asked.keys))
        done = write_faust(place / "program.dsp", instrument, parse_keys(asked.keys))
        begin = time.perf_counter()
        subprocess.run(["faust", "-t", "0", "program.dsp", "-o", "program.cpp"], cwd=place, check=True)
        took, used = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
        (place / "player.cpp").write_text(PLAYER)
        subprocess.run(["g++", *asked.flags.split(), "player.cpp", "-o", "player"], cwd=place, check=True)
        runs = [[float(x) for x in subprocess.check_output([place / "player"]).split()] for _ in range(RUNS)]
        first, rest = map(min, zip(*runs, strict=True))
    print(
        f"{done}\nFaust: {took:.0f} s ({used.ru_utime:.0f} s of a core), {used.ru_maxrss / 2**10:.0f} MiB; "
        f"16 voices take {100 * rest:.0f} % of a core's time, {100 * first:.0f} % while hammers are on strings"
    )


if __name__ == "__main__":
    main()
