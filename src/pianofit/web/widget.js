// A playable note in a notebook; see widget.py, which puts CODE and player.js before this script.

const [SLOWEST, FASTEST] = [0.05, 12]; // m/s, range of the velocity slider
const STEPS_OF_VELOCITY = 200;

/** A labelled slider: its input and output. */
function slider(parent, words, properties) {
  const label = put(parent, "label");
  put(label, "span", { textContent: words });
  const output = put(label, "output"), input = put(label, "input", { type: "range", ...properties });
  return { input, output };
}

async function render({ model, el }) {
  const instrument = model.get("instrument"), [{ midi, note }] = instrument.keys;
  const root = put(el, "div", { className: "pianofit-note" }), status = put(root, "p");
  status.setAttribute("role", "status");
  let player;
  try {
    player = await Player.open(instrument, CODE);
  } catch (error) {
    status.textContent = `This notebook cannot play the note: ${error.message}.`;
    return undefined;
  }
  player.onerror = (error) => (status.textContent = `No sound: ${error.message}.`);
  const row = put(root, "div"), strike = put(row, "button", { type: "button", textContent: `Strike, ${note}` });
  const pedalLabel = put(row, "label", { className: "switch", textContent: "pedal " });
  const pedal = put(pedalLabel, "input", { type: "checkbox", checked: true });
  const button = (words) => put(row, "button", { type: "button", textContent: words });
  const [wav, json] = ["Save as WAV", "Save as note.json"].map(button);
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
    status.textContent = `${v.toPrecision(3)} m/s: peak ${Math.max(...force).toPrecision(3)} N, ` +
      `contact ends after ${(1e3 * force.length * step).toPrecision(3)} ms.`;
  };
  const up = () => {
    if (strike.getAttribute("aria-pressed") === "true") act({ do: "off", midi });
    strike.setAttribute("aria-pressed", "false");
  };
  strike.addEventListener("pointerdown", down);
  strike.addEventListener("keydown", (event) => ["Enter", " "].includes(event.key) && !event.repeat && down());
  for (const end of ["pointerup", "pointerleave", "pointercancel", "keyup", "blur"]) strike.addEventListener(end, up);
  pedal.addEventListener("change", () => player.control(player.SUSTAIN, pedal.checked ? 127 : 0));
  velocity.input.addEventListener("input", shown);
  volume.input.addEventListener("input", () => {
    shown();
    player.setVolume(Number(volume.input.value));
  });
  wav.disabled = true;
  wav.onclick = async () => {
    wav.disabled = true;
    const progress = (part) => (status.textContent = `Rendering, ${Math.round(100 * part)} %.`);
    save("note.wav", await player.render(progress), "audio/wav");
    wav.disabled = false;
    status.textContent = "Saved: note.wav.";
  };
  json.onclick = () =>
    save("note.json", JSON.stringify(player.noteOf(midi, speed(), false), null, 1), "application/json");
  root.append(status);
  player.control(player.SUSTAIN, 127);
  shown();
  return () => player.close();
}

export default { render };
