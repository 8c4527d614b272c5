// A MIDI file, dropped on the page or chosen, that the engine plays.

const TICK = 50; // ms between looks at what comes next
const AHEAD = 0.3; // s that events are given to the audio thread early
const AHEAD_HIDDEN = 2; // s, where the browser lets a hidden page look once a second
const BEGIN = 0.1; // s from Play to the first event
const NAME = 60; // characters of a file's name that are shown

const clock = (seconds) => `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;

class SongPlayer {
  /** show(event): called when an event sounds; say(words): the page's status line. */
  constructor(player, show, say) {
    Object.assign(this, { player, show, say, song: null, begin: null });
    one("song-choose").onclick = () => one("song-file").click();
    one("song-file").addEventListener("change", ({ target }) => {
      if (target.files[0]) this.open(target.files[0]);
      target.value = ""; // the same file can be chosen again
    });
    one("song-play").onclick = () => (this.isPlaying ? this.stop("Stopped.") : this.play());
    this._drop();
  }

  get isPlaying() {
    return this.begin !== null;
  }

  /** Files can be dropped anywhere; none of them replaces the page. */
  _drop() {
    const mark = (on) => document.body.classList.toggle("dropping", on);
    const isFile = ({ dataTransfer }) => [...(dataTransfer?.types ?? [])].includes("Files");
    addEventListener("dragover", (event) => {
      if (!isFile(event)) return;
      event.preventDefault();
      mark(true);
    });
    addEventListener("dragleave", ({ relatedTarget }) => relatedTarget || mark(false));
    addEventListener("drop", (event) => {
      mark(false);
      if (!isFile(event)) return;
      event.preventDefault();
      this.open(event.dataTransfer.files[0]);
    });
  }

  async open(file) {
    if (!file) return;
    const name = file.name.length > NAME ? `${file.name.slice(0, NAME)}…` : file.name;
    const { LARGEST_SONG, readMidi } = this.player;
    try {
      if (file.size > LARGEST_SONG) throw new Error(`it has more than ${LARGEST_SONG / 2 ** 20} MiB`);
      const song = readMidi(new Uint8Array(await file.arrayBuffer()));
      this.stop();
      this._take(song, name);
    } catch (error) {
      this.say(`${name}: cannot be read as MIDI (${error.message}). Save it again as type 0 or 1.`);
    }
  }

  /** Keep the notes that the instrument has. */
  _take({ events, seconds, notes, beyond, remarks }, name) {
    const there = events.filter(({ midi }) => midi === undefined || this.player.keys.has(midi));
    const kept = there.filter((event) => event.do === "on").length, missing = notes + beyond - kept;
    if (!kept) throw new Error("the instrument has none of its keys");
    this.song = { name, events: there, seconds, end: Math.max(seconds, there.at(-1).at) };
    one("song-play").disabled = false;
    one("song-name").textContent = `${name}, ${kept} note${kept > 1 ? "s" : ""}`;
    this._position(0);
    const more = missing ? [`${missing} note${missing > 1 ? "s are" : " is"} beyond the instrument and left out`] : [];
    this.say([`${name} is ready: press Play`, ...more, ...remarks].join("; ") + ".");
  }

  async play() {
    const { player, song } = this, keys = new Set(song.events.filter((it) => it.do === "on").map(({ midi }) => midi));
    const attempt = (this.attempt = {}); // Stop and Play may follow while tables are computed
    this.begin = NaN; // until the tables are there
    this._mark();
    try {
      await player.start();
      player.context.resume();
      await player.prepareAll((done, all) => (one("song-time").textContent = `Computing tables: ${done} of ${all} keys`), keys);
    } catch (error) {
      this.begin = null;
      this._mark();
      return player.onerror(error);
    }
    if (!this.isPlaying || this.attempt !== attempt) return undefined;
    // The audio clock moves on in steps. Recorded times are the song's own, from one reading of the page's clock.
    const origin = performance.now() / 1000 + BEGIN;
    Object.assign(this, { begin: player.context.currentTime + BEGIN, origin, sent: 0, shown: 0 });
    this.say(`Playing ${song.name}.`);
    this.timer = setInterval(() => this._tick(), TICK);
    return this._tick();
  }

  _tick() {
    const { player, begin, song } = this, { events, end } = song, now = player.context.currentTime - begin;
    const until = now + (document.hidden ? AHEAD_HIDDEN : AHEAD);
    for (; this.sent < events.length && events[this.sent].at <= until; this.sent++) {
      player.schedule(this._struck(events[this.sent]), begin + events[this.sent].at);
    }
    for (; this.shown < events.length && events[this.shown].at <= now; this.shown++) this._sound(events[this.shown]);
    this._position(Math.max(now, 0));
    if (now >= end && this.shown === events.length) this.stop("The song is over.");
  }

  /** An event whose velocity is the hammer's, m/s. */
  _struck(event) {
    return event.do === "on" ? { ...event, velocity: this.player.speed(event.velocity) } : event;
  }

  /** An event sounds: it is recorded, and shown on the keys. */
  _sound(event) {
    this.player.log(this._struck(event), this.origin + event.at);
    this.show(event);
  }

  /** Stop, and let all go that the song holds. */
  stop(words) {
    if (!this.isPlaying) return;
    clearInterval(this.timer);
    const wasBegun = !Number.isNaN(this.begin);
    this.begin = null;
    this._mark();
    this._position(0);
    if (wasBegun) this._letGo();
    if (words) this.say(words);
  }

  /** End what has been sent to the audio thread, shown or not, and not ended. */
  _letGo() {
    const held = new Set(), sent = this.song.events.slice(0, this.sent);
    for (const { do: what, midi } of sent) {
      if (what === "on") held.add(midi);
      if (what === "off") held.delete(midi);
    }
    const ends = Array.from(held, (midi) => ({ do: "off", midi }));
    if (sent.findLast((event) => event.do === "pedal")?.down) ends.push({ do: "pedal", down: false });
    this.player.cancel();
    for (const event of ends) {
      this.player.act(event);
      this.show(event);
    }
  }

  _position(seconds) {
    one("song-bar").value = seconds / Math.max(this.song.end, 1e-3);
    one("song-time").textContent = `${clock(Math.min(seconds, this.song.end))} of ${clock(this.song.end)}`;
  }

  _mark() {
    one("song-play").textContent = this.isPlaying ? "■ Stop" : "▶ Play";
  }
}
