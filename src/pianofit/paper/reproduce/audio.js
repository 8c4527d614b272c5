"use strict";
// Sounds that run together and of which one is heard, so that switching keeps the place to the sample.
class Deck {
  static BLEND = 0.02; // s, length of a crossfade
  static context = null;
  static open = null; // the deck that sounds; only one does

  constructor(clips, changed) { // clips: WAV files of 16 bits, one channel, with a header of 44 bytes, as base64
    this.clips = clips.map(Deck.decode);
    this.seconds = Math.min(...this.clips.map((clip) => clip.samples.length / clip.rate));
    this.changed = changed;
    this.chosen = 0;
    this.position = 0;
    this.voice = null;
    this.output = null;
  }

  static decode(base64) {
    const text = atob(base64);
    const bytes = new DataView(Uint8Array.from(text, (letter) => letter.charCodeAt(0)).buffer);
    const samples = new Float32Array((bytes.byteLength - 44) / 2);
    for (let i = 0; i < samples.length; i++) samples[i] = bytes.getInt16(44 + 2 * i, true) / 32768;
    return { rate: bytes.getUint32(24, true), samples };
  }

  get playing() { return Boolean(this.voice); }

  get now() {
    if (!this.voice) return this.position;
    return Math.min(this.seconds, this.position + Math.max(0, Deck.context.currentTime - this.voice.started));
  }

  ready() { // only a user's action may start sound
    if (!Deck.context) {
      try { Deck.context = new AudioContext({ sampleRate: this.clips[0].rate }); } catch { Deck.context = new AudioContext(); }
    }
    Deck.context.resume();
    if (this.output) return;
    this.output = Deck.context.createGain();
    this.output.connect(Deck.context.destination);
    for (const clip of this.clips) {
      clip.buffer = Deck.context.createBuffer(1, clip.samples.length, clip.rate);
      clip.buffer.copyToChannel(clip.samples, 0);
    }
  }

  start(position = this.position) {
    this.ready();
    if (Deck.open && Deck.open !== this) Deck.open.stop();
    if (this.voice) this.stop();
    Deck.open = this;
    this.position = position >= this.seconds - 0.01 ? 0 : position;
    const started = Deck.context.currentTime + 0.01, master = Deck.context.createGain();
    master.connect(this.output);
    if (this.position > 0) { // never click; but at the very start leave the attack alone
      master.gain.setValueAtTime(0, started);
      master.gain.linearRampToValueAtTime(1, started + Deck.BLEND / 2);
    }
    const voice = { started, master, gains: [], sources: [] };
    this.clips.forEach((clip, index) => {
      const gain = new GainNode(Deck.context, { gain: index === this.chosen ? 1 : 0 });
      const source = new AudioBufferSourceNode(Deck.context, { buffer: clip.buffer });
      source.connect(gain).connect(master);
      source.start(started, this.position);
      voice.gains.push(gain.gain);
      voice.sources.push(source);
    });
    voice.sources[0].onended = () => {
      if (this.voice === voice) { this.voice = null; this.position = 0; this.changed(); }
    };
    this.voice = voice;
    this.changed();
  }

  stop() {
    if (!this.voice) return;
    this.position = this.now;
    const { master, sources } = this.voice, end = Deck.context.currentTime + Deck.BLEND / 2;
    this.voice = null;
    master.gain.cancelScheduledValues(0);
    master.gain.setValueAtTime(1, Deck.context.currentTime);
    master.gain.linearRampToValueAtTime(0, end);
    for (const source of sources) source.stop(end);
    this.changed();
  }

  toggle() { if (this.voice) this.stop(); else this.start(); }

  choose(index) {
    const previous = this.chosen;
    this.chosen = index;
    if (this.voice && previous !== index) {
      const begin = Deck.context.currentTime;
      this.voice.gains.forEach((gain, which) => {
        gain.cancelScheduledValues(0);
        gain.setValueAtTime(gain.value, begin);
        gain.linearRampToValueAtTime(which === index ? 1 : 0, begin + Deck.BLEND);
      });
    }
    this.changed();
  }
}
