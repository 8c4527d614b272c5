"use strict";
// Synchronous sounds of which one is audible, so that switching keeps the position to the sample.
class Deck {
  static BLEND = 0.02; // s, length of a crossfade
  static contexts = new Map(); // one for each sample rate, to avoid resampling
  static open = null; // the deck that is playing, at most one

  // texts(): WAV files of 16 bits, with a header of 44 bytes, as base64, decoded when first needed.
  // changed(text): called when the sound ends, or stops because another deck starts.
  constructor(texts, changed, seconds) {
    this.texts = texts;
    this.changed = changed;
    this.length = seconds; // s, if it is known without decoding
    this.chosen = 0;
    this.position = 0;
    this.voice = null;
    this.output = null;
  }

  static decode(base64) {
    const text = atob(base64);
    const bytes = new DataView(Uint8Array.from(text, (letter) => letter.charCodeAt(0)).buffer);
    const count = bytes.getUint16(22, true), length = (bytes.byteLength - 44) / 2 / count;
    const channels = Array.from({ length: count }, (_, channel) =>
      Float32Array.from({ length }, (_, i) => bytes.getInt16(44 + 2 * (i * count + channel), true) / 32768));
    return { rate: bytes.getUint32(24, true), length, channels };
  }

  static contextOf(rate) { // browsers allow sound only after an action of the user
    if (!Deck.contexts.has(rate)) {
      let context;
      try { context = new AudioContext({ sampleRate: rate }); } catch { context = new AudioContext(); }
      Deck.contexts.set(rate, context);
    }
    return Deck.contexts.get(rate);
  }

  get clips() { return (this.decoded ??= this.texts().map(Deck.decode)); }

  get seconds() { return (this.length ??= Math.min(...this.clips.map((clip) => clip.length / clip.rate))); }

  get playing() { return Boolean(this.voice); }

  get now() {
    if (!this.voice) return this.position;
    return Math.min(this.seconds, this.position + Math.max(0, this.context.currentTime - this.voice.started));
  }

  ready() {
    if (this.output) return;
    this.context = Deck.contextOf(this.clips[0].rate);
    this.output = this.context.createGain();
    this.output.connect(this.context.destination);
    for (const clip of this.clips) {
      clip.buffer = this.context.createBuffer(clip.channels.length, clip.length, clip.rate);
      clip.channels.forEach((samples, channel) => clip.buffer.copyToChannel(samples, channel));
    }
  }

  start(position = this.position) {
    this.ready();
    this.context.resume();
    if (Deck.open && Deck.open !== this) Deck.open.pause();
    if (this.voice) this.stop();
    Deck.open = this;
    this.position = position > this.seconds - 0.01 ? 0 : position;
    const started = this.context.currentTime + 0.01, master = this.context.createGain();
    master.connect(this.output);
    if (this.position > 0) { // fade in to avoid a click, except at the start, to keep the attack
      master.gain.setValueAtTime(0, started);
      master.gain.linearRampToValueAtTime(1, started + Deck.BLEND / 2);
    }
    const voice = { started, master, gains: [], sources: [] };
    this.clips.forEach((clip, index) => {
      const gain = new GainNode(this.context, { gain: index === this.chosen ? 1 : 0 });
      const source = new AudioBufferSourceNode(this.context, { buffer: clip.buffer });
      source.connect(gain).connect(master);
      source.start(started, this.position);
      voice.gains.push(gain.gain);
      voice.sources.push(source);
    });
    voice.sources[0].onended = () => {
      if (this.voice === voice) { this.voice = null; this.position = 0; this.changed("Ended"); }
    };
    this.voice = voice;
  }

  stop() {
    if (!this.voice) return;
    this.position = this.now;
    const { master, sources } = this.voice, end = this.context.currentTime + Deck.BLEND / 2;
    this.voice = null;
    master.gain.cancelScheduledValues(0);
    master.gain.setValueAtTime(1, this.context.currentTime);
    master.gain.linearRampToValueAtTime(0, end);
    for (const source of sources) source.stop(end);
  }

  pause() {
    if (!this.voice) return;
    this.stop();
    this.changed("Paused");
  }

  toggle() { if (this.voice) this.stop(); else this.start(); }

  seek(to) {
    const playing = this.playing;
    this.stop();
    this.position = Math.min(Math.max(0, to), this.seconds - 0.01);
    if (playing) this.start();
  }

  choose(index) {
    const previous = this.chosen;
    this.chosen = index;
    if (!this.voice || previous === index) return;
    const begin = this.context.currentTime;
    this.voice.gains.forEach((gain, which) => {
      gain.cancelScheduledValues(0);
      gain.setValueAtTime(gain.value, begin);
      gain.linearRampToValueAtTime(which === index ? 1 : 0, begin + Deck.BLEND);
    });
  }
}
