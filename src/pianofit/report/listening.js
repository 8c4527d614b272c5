// The blind test. Which sound is A, which is B and in what order the questions come is drawn here, anew at every start,
// by the browser's own generator; what they were is said only at the end, and in the file of results.
(() => {
  const byId = (id) => document.getElementById(id);
  const test = JSON.parse(byId("test").textContent);
  const names = JSON.parse(atob(test.key)); // id -> what it is; not for the eye of who looks at the page's source
  const roles = ["reference", "a", "b"];
  let trials = [], at = -1, deck = null, heard = null, begun = 0, started = "";

  function draw(count) { // 0 to count - 1, all equally likely
    const box = new Uint32Array(1), limit = Math.floor(2 ** 32 / count) * count;
    do crypto.getRandomValues(box); while (box[0] >= limit);
    return box[0] % count;
  }

  function shuffled(items) {
    const order = [...items];
    for (let i = order.length - 1; i > 0; i--) {
      const j = draw(i + 1);
      [order[i], order[j]] = [order[j], order[i]];
    }
    return order;
  }

  function begin() {
    const asked = test.questions.flatMap((question) => Array.from({ length: question.times }, () => question));
    trials = shuffled(asked).map(({ reference, pair }) => {
      const [a, b] = shuffled(pair);
      return { reference, a, b };
    });
    started = new Date().toISOString();
    at = -1;
    byId("intro").hidden = true;
    byId("trial").hidden = false;
    next();
  }

  function next() {
    if (deck) deck.stop();
    at += 1;
    if (at === trials.length) { end(); return; }
    deck = new Deck(() => roles.map((role) => test.sounds[trials[at][role]]), show);
    heard = { reference: 0, a: 0, b: 0 };
    begun = performance.now();
    byId("count").textContent = `Question ${at + 1} of ${trials.length}`;
    byId("progress").value = at / trials.length;
    show();
    byId("trial").focus();
  }

  function hear(index) {
    deck.chosen = index;
    heard[roles[index]] += 1;
    deck.start(0);
    show();
    say(`Playing ${index ? "ABC"[index - 1] : "the reference"}`);
  }

  const complete = () => roles.every((role) => heard[role] > 0);

  function answer(role) {
    if (!complete()) { say("Listen to the reference, A and B first."); return; }
    Object.assign(trials[at], {
      chosen: trials[at][role], played: { ...heard }, seconds: Math.round(performance.now() - begun) / 1000,
    });
    say(`${role.toUpperCase()} noted.`);
    next();
  }

  function show() {
    roles.forEach((role, index) => {
      byId(`hear-${role}`).setAttribute("aria-pressed", String(deck.playing && deck.chosen === index));
      byId(`hear-${role}`).classList.toggle("heard", heard[role] > 0);
    });
    for (const role of ["a", "b"]) byId(`nearer-${role}`).setAttribute("aria-disabled", String(!complete()));
  }

  const say = (words) => { byId("said").textContent = words; };

  function binomial(hits, count) { // two-sided, of a fair coin
    const row = [1];
    for (let k = 0; k < count; k++) row.push((row[k] * (count - k)) / (k + 1));
    const far = Math.abs(hits - count / 2);
    return row.reduce((sum, ways, k) => sum + (Math.abs(k - count / 2) >= far ? ways : 0), 0) / 2 ** count;
  }

  function results() {
    const answered = trials.filter((trial) => trial.chosen);
    const rows = test.comparisons.map(({ first, second }) => {
      const own = answered.filter(({ a, b }) => [first, second].every((what) => [a, b].some((id) => names[id].what === what)));
      const hits = own.filter(({ chosen }) => names[chosen].what === first).length;
      return { first, second, first_nearer: hits, of: own.length, p: own.length ? binomial(hits, own.length) : null };
    });
    const control = answered.filter(({ reference, a, b }) => [a, b].includes(reference));
    return {
      schema: 1, program: test.program, version: test.version, seed: test.seed,
      question: "which of two sounds is nearer the reference", listener: byId("listener").value,
      started, ended: new Date().toISOString(), asked: trials.length, answered: answered.length,
      control: { right: control.filter(({ reference, chosen }) => chosen === reference).length, of: control.length },
      comparisons: rows,
      trials: answered.map((trial, n) => ({
        number: n + 1, velocity: names[trial.reference].velocity, reference: names[trial.reference].what,
        a: names[trial.a].what, b: names[trial.b].what, chosen: names[trial.chosen].what,
        played: trial.played, seconds: trial.seconds,
      })),
    };
  }

  function end() {
    const found = results();
    byId("trial").hidden = true;
    byId("outcome").hidden = false;
    byId("control").textContent = `The control (the reference itself against another sound): ${found.control.right} of ${found.control.of} right.`;
    const body = byId("comparisons");
    for (const row of found.comparisons) {
      const line = body.insertRow();
      const p = row.p === null ? "–" : row.p.toFixed(3);
      for (const text of [row.first, row.second, `${row.first_nearer} of ${row.of}`, p]) line.insertCell().textContent = text;
    }
    const text = JSON.stringify(found, null, 2);
    byId("save").href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
    byId("save").focus();
    window.pianofitListening.results = found;
  }

  const keys = {
    r: () => hear(0), a: () => hear(1), b: () => hear(2), " ": () => { deck.toggle(); show(); },
    ArrowLeft: () => answer("a"), ArrowRight: () => answer("b"),
  };
  document.addEventListener("keydown", (event) => {
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (byId("trial").hidden || event.ctrlKey || event.altKey || event.metaKey || event.repeat || !keys[key]) return;
    if (key === " " && event.target.matches("button")) return; // a button's own key: it is pressed
    event.preventDefault();
    keys[key]();
  });
  byId("begin").addEventListener("click", begin);
  byId("stop").addEventListener("click", () => { if (deck) deck.stop(); end(); });
  roles.forEach((role, index) => byId(`hear-${role}`).addEventListener("click", () => hear(index)));
  for (const role of ["a", "b"]) byId(`nearer-${role}`).addEventListener("click", () => answer(role));
  window.pianofitListening = { draw, shuffled, binomial, get trials() { return trials; }, get deck() { return deck; }, results: null };
})();
