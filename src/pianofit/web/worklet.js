// The engine in the audio thread of the browser. It receives messages {do, ...}, see `act`. A message with a time
// `when`, s of the audio context, takes effect at that time.

const REPORT_BLOCKS = 16; // blocks between reports of the number of sounding strings, about 40 ms

class Piano extends AudioWorkletProcessor {
  constructor() {
    super();
    this.engine = new Engine(sampleRate);
    this.output = new Output(sampleRate, BLOCK);
    this.block = [new Float64Array(BLOCK), new Float64Array(BLOCK)];
    this.count = 0;
    this.waiting = []; // ascending in time
    this.port.onmessage = ({ data }) => (data.when > currentTime ? this.waiting.push(data) : this.act(data));
  }

  act(message) {
    const { engine } = this;
    if (message.do === "key") engine.setKey(message.midi, message.table);
    else if (message.do === "hammer") engine.setHammer(message.midi, message.hammer);
    else if (message.do === "on") engine.noteOn(message.midi, message.velocity);
    else if (message.do === "off") engine.noteOff(message.midi, message.velocity);
    else if (message.do === "control") engine.control(message.controller, message.value);
    else if (message.do === "range") engine.setRange(message.range);
    else if (message.do === "resonance") engine.setResonance(message.isOn);
    else if (message.do === "strings") engine.setStrings(message.strings);
    else if (message.do === "response") engine.setResponse(message.midi, message.response);
    else if (message.do === "releases") engine.setReleases(message.releases);
    else if (message.do === "volume") this.output.volume = message.volume;
    else if (message.do === "cancel") this.waiting = [];
    else if (message.do === "panic") this.fading = true;
  }

  process(inputs, [channels]) {
    const [left, right] = this.block;
    while (this.waiting[0]?.when < currentTime + BLOCK / sampleRate) this.act(this.waiting.shift());
    this.engine.render(left, right);
    if (this.fading) { // within one block
      for (const x of this.block) for (let n = 0; n < BLOCK; n++) x[n] *= 1 - (n + 1) / BLOCK;
      this.engine.panic();
      this.fading = false;
    }
    const out = this.output.pass(this.block);
    channels.forEach((channel, i) => channel.set(out[Math.min(i, 1)].subarray(0, channel.length)));
    if (++this.count % REPORT_BLOCKS === 0) this.port.postMessage({ sounding: this.engine.sounding });
    return true;
  }
}

registerProcessor("piano", Piano);
