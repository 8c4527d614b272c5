// Blind test. The sounds of each question were drawn before the page was written. Their identity is shown only at the
// end, and saved in the file of answers.
(() => {
  const byId = (id) => document.getElementById(id);
  const test = JSON.parse(byId("test").textContent);
  const bytes = Uint8Array.from(atob(test.hidden), (letter) => letter.charCodeAt(0));
  const hidden = JSON.parse(new TextDecoder().decode(bytes)); // not readable in the source of the page
  const trials = hidden.trials, roles = ["reference", "a", "b"];
  const words = {
    abx: { asked: "Which is X?", named: "X", reference: "Sound X", letter: "x", a: "X is A", b: "X is B" },
    nearer: { asked: "Which is nearer the reference?", named: "the reference", reference: "Reference", letter: "r", a: "A is nearer", b: "B is nearer" },
  };
  let at = -1, deck = null, played = null, begun = 0, started = "";

  const wording = () => words[trials[at].kind];

  function begin() {
    started = new Date().toISOString();
    byId("intro").hidden = true;
    byId("trial").hidden = false;
    next();
  }

  function next() {
    if (deck) deck.stop();
    at += 1;
    if (at === trials.length) { end(); return; }
    deck = new Deck(() => roles.map((role) => test.sounds[trials[at][role]]), show);
    played = { reference: 0, a: 0, b: 0 };
    begun = performance.now();
    byId("count").textContent = `Question ${at + 1} of ${trials.length}`;
    byId("progress").value = at / trials.length;
    for (const id of ["asked", "reference", "letter"]) byId(id).textContent = wording()[id];
    for (const role of ["a", "b"]) byId(`answer-${role}`).querySelector("span").textContent = wording()[role];
    say(`Listen to ${wording().named}, A and B; then answer.`);
    show();
    byId("trial").focus();
  }

  function hear(index) {
    deck.chosen = index;
    played[roles[index]] += 1;
    deck.start(0);
    show();
    say(`Playing ${index ? "ABC"[index - 1] : wording().named}`);
  }

  const complete = () => roles.every((role) => played[role] > 0);

  function answer(role) {
    if (!complete()) { say(`Listen to ${wording().named}, A and B first.`); return; }
    Object.assign(trials[at], {
      chosen: role, played: { ...played }, seconds: Math.round(performance.now() - begun) / 1000,
    });
    next();
  }

  function show() {
    roles.forEach((role, index) => {
      byId(`hear-${role}`).setAttribute("aria-pressed", String(deck.playing && deck.chosen === index));
      byId(`hear-${role}`).classList.toggle("played", played[role] > 0);
    });
    for (const role of ["a", "b"]) byId(`answer-${role}`).setAttribute("aria-disabled", String(!complete()));
  }

  const say = (text) => { byId("said").textContent = text; };

  function binomial(hits, count) { // two-sided, of a fair coin
    const row = [1];
    for (let k = 0; k < count; k++) row.push((row[k] * (count - k)) / (k + 1));
    const far = Math.abs(hits - count / 2);
    return row.reduce((sum, ways, k) => sum + (Math.abs(k - count / 2) >= far ? ways : 0), 0) / 2 ** count;
  }

  const side = (trial, name) => ["a", "b"].find((role) => trial[role] === name);

  function results() {
    const answered = trials.filter((trial) => trial.chosen);
    const conditions = [...new Set(trials.map((trial) => trial.condition))].map((condition) => {
      const asked = answered.filter((trial) => trial.condition === condition);
      const hits = asked.filter((trial) => trial.chosen === side(trial, trial.hit)).length;
      return { condition, hits, of: asked.length, p: asked.length ? binomial(hits, asked.length) : null };
    });
    return {
      schema: test.schema, program: test.program, version: test.version, seed: test.seed,
      listener: byId("listener").value, started, ended: new Date().toISOString(),
      asked: trials.length, answered: answered.length, conditions,
      trials: trials.flatMap((trial, n) => (trial.chosen ? [{
        number: n + 1, condition: trial.condition, case: hidden.sounds[trial.reference].case,
        reference: hidden.sounds[trial.reference].what, a: hidden.sounds[trial.a].what, b: hidden.sounds[trial.b].what,
        chosen: trial.chosen, hit: side(trial, trial.hit), played: trial.played, seconds: trial.seconds,
      }] : [])),
    };
  }

  function end() {
    const outcome = results();
    byId("trial").hidden = true;
    byId("outcome").hidden = false;
    const body = byId("outcome").querySelector("tbody");
    for (const { condition, hits, of, p } of outcome.conditions) {
      const line = body.insertRow();
      for (const text of [condition, `${hits} of ${of}`, p === null ? "–" : p.toFixed(3)]) line.insertCell().textContent = text;
    }
    const text = JSON.stringify(outcome, null, 2);
    byId("save").href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
    byId("save").focus();
    window.pianofitListening.results = outcome;
  }

  const keys = {
    r: () => hear(0), x: () => hear(0), a: () => hear(1), b: () => hear(2), " ": () => { deck.toggle(); show(); },
    ArrowLeft: () => answer("a"), ArrowRight: () => answer("b"),
  };
  document.addEventListener("keydown", (event) => {
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (byId("trial").hidden || event.ctrlKey || event.altKey || event.metaKey || event.repeat || !keys[key]) return;
    if (key === " " && event.target.matches("button")) return; // the browser presses the button
    event.preventDefault();
    keys[key]();
  });
  byId("begin").addEventListener("click", begin);
  byId("stop").addEventListener("click", () => { if (deck) deck.stop(); end(); });
  roles.forEach((role, index) => byId(`hear-${role}`).addEventListener("click", () => hear(index)));
  for (const role of ["a", "b"]) byId(`answer-${role}`).addEventListener("click", () => answer(role));
  window.pianofitListening = { binomial, trials, get deck() { return deck; }, results: null };
})();
