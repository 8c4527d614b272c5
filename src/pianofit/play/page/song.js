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
      await player.prepareAll((done, all) => this.say(`Computing tables: ${done} of ${all} keys.`), keys);
    } catch (error) {
      this.begin = null;
      this._mark();
      return player.onerror(error);
    }
    if (!this.isPlaying || this.attempt !== attempt) return undefined;
    Object.assign(this, { begin: player.context.currentTime + BEGIN, sent: 0, shown: 0, down: new Set(), pedal: false });
    this.say(`Playing ${song.name}.`);
    this.timer = setInterval(() => this._tick(), TICK);
    return this._tick();
  }

  _tick() {
    const { player, begin, song } = this, { events, end } = song, now = player.context.currentTime - begin;
    const until = now + (document.hidden ? AHEAD_HIDDEN : AHEAD);
    for (; this.sent < events.length && events[this.sent].at <= until; this.sent++) {
      const event = events[this.sent], message = { ...event };
      if (event.do === "on") message.velocity = player.speed(event.velocity);
      player.schedule(message, begin + event.at);
    }
    for (; this.shown < events.length && events[this.shown].at <= now; this.shown++) this._sound(events[this.shown], now);
    this._position(Math.max(now, 0));
    if (now >= end && this.shown === events.length) this.stop("The song is over.");
  }

  /** An event sounds: it is recorded, and shown on the keys. */
  _sound(event, now) {
    const { player, down } = this;
    player.log(event.do === "on" ? { ...event, velocity: player.speed(event.velocity) } : event, now - event.at);
    if (event.do === "on") down.add(event.midi);
    if (event.do === "off") down.delete(event.midi);
    if (event.do === "pedal") this.pedal = event.down;
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
    if (wasBegun) {
      this.player.cancel();
      // A stroke may have begun that was not yet shown.
      const sent = this.song.events.slice(0, this.sent).filter((event) => event.do === "on");
      for (const midi of new Set(sent.map((event) => event.midi))) this._end({ do: "off", midi });
      if (this.pedal || this.player.pedal) this._end({ do: "pedal", down: false });
    }
    if (words) this.say(words);
  }

  _end(event) {
    this.player.act(event);
    this.show(event);
  }

  _position(seconds) {
    one("song-bar").value = seconds / Math.max(this.song.end, 1e-3);
    one("song-time").textContent = `${clock(Math.min(seconds, this.song.end))} of ${clock(this.song.end)}`;
  }

  _mark() {
    one("song-play").textContent = this.isPlaying ? "■ Stop" : "▶ Play";
  }
}
