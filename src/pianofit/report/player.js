// The players of a page: one deck each, with the buttons, sliders and waveforms that the page has.
(() => {
  const STEP = 0.5; // s: one step by an arrow key
  const players = [...document.querySelectorAll(".player")].map(makePlayer);
  let active = players[0]; // keys go to the player last used

  function makePlayer(root) {
    const find = (selector) => root.querySelector(selector);
    const choices = [...root.querySelectorAll("button.choice")], canvas = find("canvas"), which = find(".which"), seeker = find(".seek");
    const links = [...document.querySelectorAll("a.sound")].filter((link) => link.dataset.player === root.id);
    const names = links.map((link) => link.dataset.name);
    const seconds = Math.min(...links.map((link) => Number(link.dataset.seconds)));
    const deck = new Deck(() => links.map((link) => link.href.slice(link.href.indexOf(",") + 1)), show, seconds);
    let frame = 0;
    deck.chosen = which ? Number(which.value) : 0;

    function toggle() {
      active = player;
      deck.toggle();
      show(deck.playing ? "Playing " + names[deck.chosen] : "Paused");
    }

    function choose(index) {
      active = player;
      deck.choose(index);
      show((deck.playing ? "Playing " : "Chosen: ") + names[index]);
    }

    function stroke(index) { // another velocity is another stroke, so it starts at the attack
      active = player;
      deck.stop();
      deck.chosen = index;
      deck.start(0);
      show("Playing " + names[index]);
    }

    function seek(to) {
      active = player;
      deck.seek(to);
      draw();
    }

    function show(text) {
      find(".said").textContent = text;
      find(".play").textContent = deck.playing ? "❚❚ Pause" : "▶ Play";
      choices.forEach((button, index) => button.setAttribute("aria-pressed", String(index === deck.chosen)));
      draw();
    }

    function outline(clip, width) { // largest magnitude of all channels under each pixel
      if (clip.outline?.length === width) return clip.outline;
      const share = (seconds * clip.rate) / width;
      clip.outline = Array.from({ length: width }, (_, x) =>
        clip.channels.reduce((most, samples) => samples.subarray(Math.floor(x * share), Math.floor((x + 1) * share))
          .reduce((larger, y) => Math.max(larger, Math.abs(y)), most), 0));
      return clip.outline;
    }

    function paint(place) { // the chosen sound, with the part already played in colour
      const scale = devicePixelRatio || 1, pen = canvas.getContext("2d");
      const width = (canvas.width = Math.round(canvas.clientWidth * scale)), height = (canvas.height = canvas.clientHeight * scale);
      const look = getComputedStyle(choices[deck.chosen]), played = look.getPropertyValue("--own"), rest = look.getPropertyValue("--rest");
      outline(deck.clips[deck.chosen], width).forEach((peak, x) => {
        pen.fillStyle = x / width < place / seconds ? played : rest;
        pen.fillRect(x, (height * (1 - peak)) / 2, 1, Math.max(1, height * peak));
      });
    }

    function draw() { // repeated on each frame during playback
      const place = deck.now;
      if (canvas) paint(place);
      if (seeker) {
        seeker.value = place;
        seeker.setAttribute("aria-valuetext", place.toFixed(1) + " of " + seconds.toFixed(1) + " seconds");
      }
      if (which) {
        which.value = deck.chosen;
        which.setAttribute("aria-valuetext", names[deck.chosen]);
        find(".velocity").textContent = names[deck.chosen];
      }
      find(".time").textContent = place.toFixed(1) + " / " + seconds.toFixed(1) + " s";
      cancelAnimationFrame(frame);
      if (deck.playing) frame = requestAnimationFrame(draw);
    }

    find(".play").addEventListener("click", toggle);
    choices.forEach((button, index) => button.addEventListener("click", () => choose(index)));
    if (seeker) {
      seeker.max = seconds;
      seeker.addEventListener("input", (event) => seek(Number(event.target.value)));
    }
    which?.addEventListener("input", (event) => stroke(Number(event.target.value)));
    const player = {
      root, choices, which, toggle, choose, stroke, seek, seconds, draw,
      get state() { return { playing: deck.playing, chosen: names[deck.chosen], position: deck.now }; },
      get context() { deck.ready(); return deck.context; },
      get output() { deck.ready(); return deck.output; }, // for tests: connect an analyser
    };
    return player;
  }

  const keys = {
    " ": (player) => player.toggle(), Home: (player) => player.seek(0),
    ArrowLeft: (player) => player.seek(player.state.position - STEP), ArrowRight: (player) => player.seek(player.state.position + STEP),
  };
  for (const place of [0, 1, 2]) keys[place + 1] = (player) => player.choices[place] && player.choose(place);
  document.addEventListener("keydown", (event) => {
    const at = event.target, elsewhere = at.closest("summary, a, pre, .scroll, .zoom, .view");
    if (event.ctrlKey || event.altKey || event.metaKey || !keys[event.key] || (elsewhere && !/^[123]$/.test(event.key))) return;
    if (at.matches(".which") && event.key !== " ") return; // arrow keys on the slider choose the velocity
    if (event.key === " " && at.matches(".choice[aria-pressed=false]")) return; // the space bar presses the focused button
    event.preventDefault();
    active = players.find((player) => player.root.contains(at)) ?? active;
    if (!(event.repeat && event.key === " ")) keys[event.key](active);
    if (at.matches(".choice")) active.choices.find((button) => button.getAttribute("aria-pressed") === "true").focus(); // so that the space bar still means play and pause
  });
  document.addEventListener("keyup", (event) => {
    if (event.key === " " && event.target.matches(".play, .which, .choice[aria-pressed=true]")) event.preventDefault();
  });
  document.addEventListener("click", (event) => {
    // a link to a hidden section shows it
    const link = event.target.closest('a[href^="#"]'), hidden = document.getElementById("hide-physics");
    if (hidden && link && document.getElementById(link.hash.slice(1))?.closest(".physics")) hidden.checked = false;
  });
  const redraw = () => players.forEach((player) => player.draw());
  addEventListener("resize", redraw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  redraw();
  window.pianofitPlayer = players[0];
  window.pianofitPlayers = players;
})();
