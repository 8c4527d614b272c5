"use strict";
// Three sounds run together and only their gains differ, so that switching keeps the place to the sample.
(() => {
  const BLEND = 0.02, STEP = 0.5; // s: length of a crossfade, and of one step by an arrow key
  const byId = (id) => document.getElementById(id);
  const choices = [...document.querySelectorAll("button.choice")];
  const clips = [...document.querySelectorAll("a.sound")].map(decode);
  const seconds = Math.min(...clips.map((clip) => clip.samples.length / clip.rate));
  let context = null, output = null, voice = null, chosen = 0, position = 0, frame = 0;

  function decode(link) { // a WAV file of 16 bits, one channel, with a header of 44 bytes
    const text = atob(link.href.slice(link.href.indexOf(",") + 1));
    const bytes = new DataView(Uint8Array.from(text, (letter) => letter.charCodeAt(0)).buffer);
    const samples = new Float32Array((bytes.byteLength - 44) / 2);
    for (let i = 0; i < samples.length; i++) samples[i] = bytes.getInt16(44 + 2 * i, true) / 32768;
    return { name: link.dataset.name, rate: bytes.getUint32(24, true), samples };
  }

  function ready() { // only a user's action may start sound
    if (context) return;
    const rate = clips[0].rate;
    try { context = new AudioContext({ sampleRate: rate }); } catch { context = new AudioContext(); }
    output = context.createGain();
    output.connect(context.destination);
    for (const clip of clips) {
      clip.buffer = context.createBuffer(1, clip.samples.length, clip.rate);
      clip.buffer.copyToChannel(clip.samples, 0);
    }
  }

  const now = () => (voice ? Math.min(seconds, position + Math.max(0, context.currentTime - voice.started)) : position);

  function start() {
    const started = context.currentTime + 0.01, master = context.createGain();
    master.connect(output);
    if (position > 0) { // never click; but at the very start leave the attack alone
      master.gain.setValueAtTime(0, started);
      master.gain.linearRampToValueAtTime(1, started + BLEND / 2);
    }
    voice = { started, master, gains: [], sources: [] };
    clips.forEach((clip, index) => {
      const gain = new GainNode(context, { gain: index === chosen ? 1 : 0 });
      const source = new AudioBufferSourceNode(context, { buffer: clip.buffer });
      source.connect(gain).connect(master);
      source.start(started, position);
      voice.gains.push(gain.gain);
      voice.sources.push(source);
    });
    const mine = voice;
    voice.sources[0].onended = () => { if (voice === mine) { voice = null; position = 0; show("Ended"); } };
  }

  function stop() {
    position = now();
    const { master, sources } = voice, end = context.currentTime + BLEND / 2;
    voice = null;
    master.gain.cancelScheduledValues(0);
    master.gain.setValueAtTime(1, context.currentTime);
    master.gain.linearRampToValueAtTime(0, end);
    for (const source of sources) source.stop(end);
  }

  function toggle() {
    ready();
    context.resume();
    if (voice) stop(); else start();
    show(voice ? "Playing " + clips[chosen].name : "Paused");
  }

  function choose(index) {
    const previous = chosen;
    chosen = index;
    if (voice && previous !== index) {
      const begin = context.currentTime;
      voice.gains.forEach((gain, which) => {
        gain.cancelScheduledValues(0);
        gain.setValueAtTime(gain.value, begin);
        gain.linearRampToValueAtTime(which === chosen ? 1 : 0, begin + BLEND);
      });
    }
    show((voice ? "Playing " : "Chosen: ") + clips[chosen].name);
  }

  function seek(to) {
    const playing = Boolean(voice);
    if (playing) stop();
    position = Math.min(Math.max(0, to), seconds - 0.01);
    if (playing) start();
    draw();
  }

  function show(words) {
    byId("said").textContent = words;
    byId("play").textContent = voice ? "❚❚ Pause" : "▶ Play";
    choices.forEach((button, index) => button.setAttribute("aria-pressed", String(index === chosen)));
    draw();
  }

  function outline(clip, width) { // largest magnitude under each pixel
    if (clip.outline?.length === width) return clip.outline;
    const share = (seconds * clip.rate) / width;
    clip.outline = Array.from({ length: width }, (_, x) =>
      clip.samples.subarray(Math.floor(x * share), Math.floor((x + 1) * share)).reduce((most, y) => Math.max(most, Math.abs(y)), 0));
    return clip.outline;
  }

  function draw() { // the chosen sound, its played part in colour; again on each frame while it plays
    const canvas = byId("wave"), scale = devicePixelRatio || 1, pen = canvas.getContext("2d"), place = now();
    const width = (canvas.width = Math.round(canvas.clientWidth * scale)), height = (canvas.height = canvas.clientHeight * scale);
    const played = getComputedStyle(choices[chosen]).getPropertyValue("--own");
    outline(clips[chosen], width).forEach((peak, x) => {
      pen.fillStyle = x / width < place / seconds ? played : "#b9c2cb";
      pen.fillRect(x, (height * (1 - peak)) / 2, 1, Math.max(1, height * peak));
    });
    byId("seek").value = place;
    byId("seek").setAttribute("aria-valuetext", place.toFixed(1) + " of " + seconds.toFixed(1) + " seconds");
    byId("time").textContent = place.toFixed(1) + " / " + seconds.toFixed(1) + " s";
    cancelAnimationFrame(frame);
    if (voice) frame = requestAnimationFrame(draw);
  }

  const keys = {
    " ": toggle, "1": () => choose(0), "2": () => choose(1), "3": () => choose(2), Home: () => seek(0),
    ArrowLeft: () => seek(now() - STEP), ArrowRight: () => seek(now() + STEP),
  };
  document.addEventListener("keydown", (event) => {
    const at = event.target, elsewhere = at.closest("summary, a, pre, .scroll");
    if (event.ctrlKey || event.altKey || event.metaKey || !keys[event.key] || (elsewhere && !/^[123]$/.test(event.key))) return;
    if (event.key === " " && at.matches(".choice[aria-pressed=false]")) return; // a button's own key: it chooses
    event.preventDefault();
    if (!(event.repeat && event.key === " ")) keys[event.key]();
    if (at.matches(".choice")) choices[chosen].focus(); // so that the space bar goes on meaning play and pause
  });
  document.addEventListener("keyup", (event) => {
    if (event.key === " " && event.target.matches("#play, .choice[aria-pressed=true]")) event.preventDefault();
  });
  byId("play").addEventListener("click", toggle);
  choices.forEach((button, index) => button.addEventListener("click", () => choose(index)));
  byId("seek").max = seconds;
  byId("seek").addEventListener("input", (event) => seek(Number(event.target.value)));
  addEventListener("resize", draw);
  draw();
  window.pianofitPlayer = {
    toggle, choose, seek, seconds,
    get state() { return { playing: Boolean(voice), chosen: clips[chosen].name, position: now() }; },
    get context() { ready(); return context; },
    get output() { ready(); return output; }, // to listen in: connect an analyser
  };
})();
