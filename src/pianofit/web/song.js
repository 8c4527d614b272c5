// Playback of a MIDI file that was dropped on the page or chosen.

const TICK = 50; // ms between updates
const AHEAD = 0.3; // s, events are sent to the audio thread this early
const AHEAD_HIDDEN = 2; // s, for a hidden page, whose timers run once a second
const BEGIN = 0.1; // s from Play to the first event
const NAME_LENGTH = 60; // characters of a file name that are shown

const clock = (seconds) => `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;

class SongPlayer {
  /** show(event): called when an event sounds; say(words): the page's status line. */
  constructor(player, show, say) {
    Object.assign(this, { player, show, say, song: null, begin: null });
    byId("song-choose").onclick = () => byId("song-file").click();
    byId("song-file").addEventListener("change", ({ target }) => {
      if (target.files[0]) this.open(target.files[0]);
      target.value = ""; // so that the same file can be chosen again
    });
    byId("song-play").onclick = () => (this.isPlaying ? this.stop("Stopped.") : this.play());
    this._drop();
  }

  get isPlaying() {
    return this.begin !== null;
  }

  /** Accept files that are dropped anywhere, and prevent the browser from opening them. */
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
    const name = file.name.length > NAME_LENGTH ? `${file.name.slice(0, NAME_LENGTH)}…` : file.name;
    const { LARGEST_SONG, readMidi } = this.player;
    try {
      if (file.size > LARGEST_SONG) throw new Error(`has more than ${LARGEST_SONG / 2 ** 20} MiB; cut it into parts`);
      const song = readMidi(new Uint8Array(await file.arrayBuffer()));
      this.stop();
      this._setSong(song, name);
    } catch (error) {
      this.say(`${name}: ${error.message}.`);
    }
  }

  /** Set the song, without the notes that the instrument lacks. */
  _setSong({ events, seconds, notes, beyond, remarks }, name) {
    const playable = events.filter(({ midi }) => midi === undefined || this.player.keys.has(midi));
    const count = playable.filter((event) => event.do === "on").length, missing = notes + beyond - count;
    if (!count) throw new Error("the instrument has none of its keys");
    this.song = { name, events: playable, seconds, end: Math.max(seconds, playable.at(-1).at) };
    byId("song-play").disabled = false;
    byId("song-name").textContent = `${name}, ${count} note${count > 1 ? "s" : ""}`;
    this._position(0);
    const more = missing ? [`${missing} note${missing > 1 ? "s are" : " is"} beyond the instrument and left out`] : [];
    this.say([`${name} is ready: press Play`, ...more, ...remarks].join("; ") + ".");
  }

  async play() {
    const { player, song } = this;
    const keys = new Set(song.events.filter((event) => event.do === "on").map(({ midi }) => midi));
    const attempt = (this.attempt = {}); // the user may press Stop and Play while tables are computed
    this.begin = NaN; // until the tables are ready
    this._mark();
    try {
      await player.start();
      player.context.resume();
      await player.prepareAll((done, all) => (byId("song-time").textContent = `Computing tables: ${done} of ${all} keys`), keys);
    } catch (error) {
      this.begin = null;
      this._mark();
      return player.onerror(error);
    }
    if (!this.isPlaying || this.attempt !== attempt) return undefined;
    // The audio clock advances in steps, so recorded times are those of the song after one reading of the page clock.
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
      player.schedule(this._withSpeed(events[this.sent]), begin + events[this.sent].at);
    }
    for (; this.shown < events.length && events[this.shown].at <= now; this.shown++) this._sound(events[this.shown]);
    this._position(Math.max(now, 0));
    if (now >= end && this.shown === events.length) this.stop("The song has ended.");
  }

  /** An event with the hammer velocity, m/s, in place of the MIDI velocity. */
  _withSpeed(event) {
    return event.do === "on" ? { ...event, velocity: this.player.speed(event.velocity) } : event;
  }

  /** Record an event that sounds now, and show it on the keys. */
  _sound(event) {
    this.player.log(this._withSpeed(event), this.origin + event.at);
    this.show(event);
  }

  /** Stop, and release all keys that the song holds. */
  stop(words) {
    if (!this.isPlaying) return;
    clearInterval(this.timer);
    const wasBegun = !Number.isNaN(this.begin);
    this.begin = null;
    this._mark();
    this._position(0);
    if (wasBegun) this._release();
    if (words) this.say(words);
  }

  /** Release all keys and pedals that were sent to the audio thread and are still held. */
  _release() {
    const held = new Set(), pedals = new Map(), sent = this.song.events.slice(0, this.sent);
    for (const { do: kind, midi, controller, value } of sent) {
      if (kind === "on") held.add(midi);
      if (kind === "off") held.delete(midi);
      if (kind === "control") pedals.set(controller, value);
    }
    const ends = Array.from(held, (midi) => ({ do: "off", midi }));
    for (const [controller, value] of pedals) if (value) ends.push({ do: "control", controller, value: 0 });
    this.player.cancel();
    for (const event of ends) {
      this.player.act(event);
      this.show(event);
    }
  }

  _position(seconds) {
    byId("song-bar").value = seconds / Math.max(this.song.end, 1e-3);
    byId("song-time").textContent = `${clock(Math.min(seconds, this.song.end))} of ${clock(this.song.end)}`;
  }

  _mark() {
    byId("song-play").textContent = this.isPlaying ? "■ Stop" : "▶ Play";
  }
}
