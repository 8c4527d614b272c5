// A note in a notebook: struck by a button, at any velocity; see widget.py. CODE and `Player` stand before this.

const [SLOWEST, FASTEST] = [0.05, 12]; // m/s, the velocities that a fit finds
const STEPS_OF_VELOCITY = 200;

/** A slider in words: its input and its output. */
function slider(parent, words, properties) {
  const label = put(parent, "label");
  put(label, "span", { textContent: words });
  const output = put(label, "output"), input = put(label, "input", { type: "range", ...properties });
  return { input, output };
}

async function render({ model, el }) {
  const instrument = model.get("instrument"), [{ midi, note }] = instrument.keys;
  const root = put(el, "div", { className: "pianofit-note" }), said = put(root, "p");
  said.setAttribute("role", "status");
  let player;
  try {
    player = await Player.open(instrument, CODE);
  } catch (error) {
    said.textContent = `This notebook does not let the note play: ${error.message}.`;
    return undefined;
  }
  player.onerror = (error) => (said.textContent = `No sound: ${error.message}.`);
  const row = put(root, "div"), strike = put(row, "button", { type: "button", textContent: `Strike, ${note}` });
  const pedal = put(put(row, "label", { className: "switch", textContent: "rings on " }), "input", { type: "checkbox", checked: true });
  const [wav, json] = ["Save as WAV", "Save as note.json"].map((words) => put(row, "button", { type: "button", textContent: words }));
  const at = (v) => (STEPS_OF_VELOCITY * Math.log(v / SLOWEST)) / Math.log(FASTEST / SLOWEST);
  const velocity = slider(root, "Hammer velocity",
    { min: 0, max: STEPS_OF_VELOCITY, step: 1, value: Math.round(at(instrument.velocity.at_64)) });
  const volume = slider(root, "Volume", { min: -40, max: 40, step: 1, value: 0 });
  const speed = () => SLOWEST * (FASTEST / SLOWEST) ** (Number(velocity.input.value) / STEPS_OF_VELOCITY);
  const shown = () => {
    velocity.output.textContent = `${speed().toPrecision(3)} m/s`;
    volume.output.textContent = `${volume.input.value} dB`;
  };
  const act = async (message) => {
    try {
      await player.act(message);
    } catch (error) {
      player.onerror(error);
    }
  };
  const down = async () => {
    strike.setAttribute("aria-pressed", "true");
    const v = speed(), { force, step } = player.stroke(player.table(midi), v);
    await act({ do: "on", midi, velocity: v });
    wav.disabled = false;
    said.textContent = `${v.toPrecision(3)} m/s: ${Math.max(...force).toPrecision(3)} N at most, ` +
      `contact over after ${(1e3 * force.length * step).toPrecision(3)} ms.`;
  };
  const up = () => {
    if (strike.getAttribute("aria-pressed") === "true") act({ do: "off", midi });
    strike.setAttribute("aria-pressed", "false");
  };
  strike.addEventListener("pointerdown", down);
  strike.addEventListener("keydown", (event) => ["Enter", " "].includes(event.key) && !event.repeat && down());
  for (const end of ["pointerup", "pointerleave", "pointercancel", "keyup", "blur"]) strike.addEventListener(end, up);
  pedal.addEventListener("change", () => player.setPedal(pedal.checked));
  velocity.input.addEventListener("input", shown);
  volume.input.addEventListener("input", () => {
    shown();
    player.setVolume(Number(volume.input.value));
  });
  wav.disabled = true;
  wav.onclick = async () => {
    wav.disabled = true;
    save("note.wav", await player.render((part) => (said.textContent = `Rendering, ${Math.round(100 * part)} %.`)), "audio/wav");
    wav.disabled = false;
    said.textContent = "Saved: note.wav.";
  };
  json.onclick = () => save("note.json", JSON.stringify(player.noteOf(midi, speed(), false), null, 1), "application/json");
  root.append(said);
  player.setPedal(true);
  shown();
  return () => player.close();
}

export default { render };
