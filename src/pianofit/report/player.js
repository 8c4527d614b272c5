"use strict";
// The sounds of a player run together and only their gains differ, so that switching keeps the place to the sample.
(() => {
  const BLEND = 0.02, STEP = 0.5; // s: length of a crossfade, and of one step by an arrow key
  const contexts = new Map(); // one for each rate, so that no sound is resampled
  const players = [...document.querySelectorAll(".player")].map(makePlayer);
  let active = players[0]; // whose keys they are: the one last used

  function decode(link) { // a WAV file of 16 bits, one channel, with a header of 44 bytes
    const text = atob(link.href.slice(link.href.indexOf(",") + 1));
    const bytes = new DataView(Uint8Array.from(text, (letter) => letter.charCodeAt(0)).buffer);
    const samples = new Float32Array((bytes.byteLength - 44) / 2);
    for (let i = 0; i < samples.length; i++) samples[i] = bytes.getInt16(44 + 2 * i, true) / 32768;
    return { rate: bytes.getUint32(24, true), samples };
  }

  function contextOf(rate) { // only a user's action may start sound
    if (!contexts.has(rate)) {
      let context;
      try { context = new AudioContext({ sampleRate: rate }); } catch { context = new AudioContext(); }
      contexts.set(rate, context);
    }
    return contexts.get(rate);
  }

  function makePlayer(root) {
    const find = (what) => root.querySelector(what);
    const choices = [...root.querySelectorAll("button.choice")], canvas = find("canvas"), which = find(".which"), seeker = find(".seek");
    const links = [...document.querySelectorAll("a.sound")].filter((link) => link.dataset.player === root.id);
    const names = links.map((link) => link.dataset.name);
    const seconds = Math.min(...links.map((link) => Number(link.dataset.seconds)));
    let clips = null, context = null, output = null, voice = null, position = 0, frame = 0;
    let chosen = which ? Number(which.value) : 0;

    const decoded = () => (clips ??= links.map(decode));

    function ready() {
      if (context) return;
      context = contextOf(decoded()[0].rate);
      output = context.createGain();
      output.connect(context.destination);
      for (const clip of clips) {
        clip.buffer = context.createBuffer(1, clip.samples.length, clip.rate);
        clip.buffer.copyToChannel(clip.samples, 0);
      }
    }

    const now = () => (voice ? Math.min(seconds, position + Math.max(0, context.currentTime - voice.started)) : position);

    function start() {
      for (const other of players) if (other !== player) other.pause();
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

    function pause() {
      if (!voice) return;
      stop();
      show("Paused");
    }

    function toggle() {
      active = player;
      ready();
      context.resume();
      if (voice) stop(); else start();
      show(voice ? "Playing " + names[chosen] : "Paused");
    }

    function choose(index) {
      const previous = chosen;
      active = player;
      chosen = index;
      if (voice && previous !== index) {
        const begin = context.currentTime;
        voice.gains.forEach((gain, which) => {
          gain.cancelScheduledValues(0);
          gain.setValueAtTime(gain.value, begin);
          gain.linearRampToValueAtTime(which === chosen ? 1 : 0, begin + BLEND);
        });
      }
      show((voice ? "Playing " : "Chosen: ") + names[chosen]);
    }

    function stroke(index) { // another velocity is another stroke: from its attack on
      active = player;
      chosen = index;
      ready();
      context.resume();
      if (voice) stop();
      position = 0;
      start();
      show("Playing " + names[chosen]);
    }

    function seek(to) {
      const playing = Boolean(voice);
      active = player;
      if (playing) stop();
      position = Math.min(Math.max(0, to), seconds - 0.01);
      if (playing) start();
      draw();
    }

    function show(words) {
      find(".said").textContent = words;
      find(".play").textContent = voice ? "❚❚ Pause" : "▶ Play";
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

    function paint(place) { // the chosen sound, its played part in colour
      const scale = devicePixelRatio || 1, pen = canvas.getContext("2d");
      const width = (canvas.width = Math.round(canvas.clientWidth * scale)), height = (canvas.height = canvas.clientHeight * scale);
      const look = getComputedStyle(choices[chosen]), played = look.getPropertyValue("--own"), rest = look.getPropertyValue("--rest");
      outline(decoded()[chosen], width).forEach((peak, x) => {
        pen.fillStyle = x / width < place / seconds ? played : rest;
        pen.fillRect(x, (height * (1 - peak)) / 2, 1, Math.max(1, height * peak));
      });
    }

    function draw() { // again on each frame while it plays
      const place = now();
      if (canvas) paint(place);
      if (seeker) {
        seeker.value = place;
        seeker.setAttribute("aria-valuetext", place.toFixed(1) + " of " + seconds.toFixed(1) + " seconds");
      }
      if (which) {
        which.value = chosen;
        which.setAttribute("aria-valuetext", names[chosen]);
        find(".velocity").textContent = names[chosen];
      }
      find(".time").textContent = place.toFixed(1) + " / " + seconds.toFixed(1) + " s";
      cancelAnimationFrame(frame);
      if (voice) frame = requestAnimationFrame(draw);
    }

    find(".play").addEventListener("click", toggle);
    choices.forEach((button, index) => button.addEventListener("click", () => choose(index)));
    if (seeker) {
      seeker.max = seconds;
      seeker.addEventListener("input", (event) => seek(Number(event.target.value)));
    }
    which?.addEventListener("input", (event) => stroke(Number(event.target.value)));
    const player = {
      root, choices, which, toggle, choose, stroke, seek, seconds, pause, draw,
      get state() { return { playing: Boolean(voice), chosen: names[chosen], position: now() }; },
      get context() { ready(); return context; },
      get output() { ready(); return output; }, // to listen in: connect an analyser
    };
    return player;
  }

  const keys = {
    " ": (one) => one.toggle(), Home: (one) => one.seek(0),
    ArrowLeft: (one) => one.seek(one.state.position - STEP), ArrowRight: (one) => one.seek(one.state.position + STEP),
  };
  for (const place of [0, 1, 2]) keys[place + 1] = (one) => one.choices[place] && one.choose(place);
  document.addEventListener("keydown", (event) => {
    const at = event.target, elsewhere = at.closest("summary, a, pre, .scroll");
    if (event.ctrlKey || event.altKey || event.metaKey || !keys[event.key] || (elsewhere && !/^[123]$/.test(event.key))) return;
    if (at.matches(".which") && event.key !== " ") return; // its own keys choose the velocity
    if (event.key === " " && at.matches(".choice[aria-pressed=false]")) return; // a button's own key: it chooses
    event.preventDefault();
    active = players.find((one) => one.root.contains(at)) ?? active;
    if (!(event.repeat && event.key === " ")) keys[event.key](active);
    if (at.matches(".choice")) active.choices.find((one) => one.getAttribute("aria-pressed") === "true").focus(); // so that the space bar goes on meaning play and pause
  });
  document.addEventListener("keyup", (event) => {
    if (event.key === " " && event.target.matches(".play, .which, .choice[aria-pressed=true]")) event.preventDefault();
  });
  const again = () => players.forEach((one) => one.draw());
  addEventListener("resize", again);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
  players.forEach((one) => one.draw());
  window.pianofitPlayer = players[0];
  window.pianofitPlayers = players;
})();
