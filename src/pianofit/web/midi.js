// Reader and writer of standard MIDI files (MIDI Association, RP-001), with the rules of playback/midi_file.py and
// playback/midi.py.
//
// Playback needs notes, controllers and tempo. Other events and chunks are skipped by their lengths. An event that
// cannot be read ends its track: earlier events are kept, and a remark reports it.

import { PEDALS } from "./pedals.js";

export const LARGEST_SONG = 2 ** 21; // bytes
const MOST_NOTES = 100_000;
const MOST_SONG_SECONDS = 1800;
const LOWEST_KEY = 21, HIGHEST_KEY = 108; // A0 to C8
const NOTE_OFF = 8, NOTE_ON = 9, CONTROL = 11; // upper half of a status byte
const ONE_BYTE = [12, 13]; // program change and channel pressure have one data byte
const SYSEX = 0xf0, ESCAPE = 0xf7, META = 0xff, END_OF_TRACK = 0x2f, SET_TEMPO = 0x51;
const SYSTEM_LENGTHS = { 0xf1: 1, 0xf2: 2, 0xf3: 1 }; // data bytes of system messages
const SOUND_OFF = 120, RESET = 121, NOTES_OFF = 123; // controllers
const RELEASE_VELOCITY = 64; // of a key that states none
const DRUMS = 9; // the tenth channel
const LAST_HELD = 3; // s from the end of a song to the release of keys without note-off
const FIRST_TEMPO = 500_000; // microseconds a beat until a file sets a tempo
const FRAME_RATES = { 24: 24, 25: 25, 29: 30_000 / 1001, 30: 30 }; // SMPTE, frames a second
const LONGEST_NUMBER = 4; // bytes
const END = 0, END_ALL = -1; // values in place of a velocity: end of one stroke, and of all strokes of a channel
const TICKS = 480; // per beat in written files: 960 ticks per second

function find(bytes, name, from) {
  const code = Array.from(name, (c) => c.charCodeAt(0));
  for (let i = from; i + code.length <= bytes.length; i++) if (code.every((c, k) => bytes[i + k] === c)) return i;
  return -1;
}

/** The reason why the rest of a track cannot be read. */
class TrackDamage extends Error {}

/** One track: channel messages, tempo changes, end, and damage. */
class Track {
  constructor(bytes, at, end, isCut) {
    Object.assign(this, { bytes, at, end, tick: 0, messages: [], tempos: [], damage: "" });
    try {
      this._read(isCut);
    } catch (error) {
      if (!(error instanceof TrackDamage)) throw error;
      this.damage = error.message;
    }
  }

  _read(isCut) {
    let running = 0; // status of messages without a status byte
    while (this.at < this.end) {
      const tick = this.tick + this._number(), status = this._byte();
      if (status === META) {
        this.tick = tick;
        if (this._isLast()) return;
      } else if (status === SYSEX || status === ESCAPE) this._skip(this._number());
      else if (status > SYSEX) this._skip(SYSTEM_LENGTHS[status] ?? 0);
      else running = this._message(tick, status, running);
      this.tick = tick;
    }
    if (isCut) throw new TrackDamage("is cut short");
  }

  /** Read a meta event from its kind on; return whether it ends the track. */
  _isLast() {
    const kind = this._byte(), size = this._number(), start = this.at;
    this._skip(size);
    const tempo = kind === SET_TEMPO && size === 3 ? this.bytes.slice(start, this.at).reduce((x, y) => 256 * x + y, 0) : 0;
    if (tempo) this.tempos.push({ tick: this.tick, tempo });
    return kind === END_OF_TRACK;
  }

  /** Read a channel message that begins with `byte` and return its status. Data above 127 are clipped. */
  _message(tick, byte, running) {
    const hasStatus = byte >= 0x80, status = hasStatus ? byte : running, first = hasStatus ? this._byte() : byte;
    if (!status) throw new TrackDamage("is damaged");
    const second = ONE_BYTE.includes(status >> 4) ? 0 : this._byte();
    this.messages.push({ tick, kind: status >> 4, channel: status & 15, first: Math.min(first, 127),
      second: Math.min(second, 127) });
    return status;
  }

  _byte() {
    if (this.at >= this.end) throw new TrackDamage("is cut short");
    return this.bytes[this.at++];
  }

  _number() {
    for (let i = 0, number = 0; i < LONGEST_NUMBER; i++) {
      const byte = this._byte();
      number = 128 * number + (byte & 0x7f);
      if (byte < 0x80) return number;
    }
    throw new TrackDamage("is damaged");
  }

  _skip(size) {
    if (size > this.end - this.at) throw new TrackDamage("is cut short");
    this.at += size;
  }
}

/** All tracks from `begin` on. After a wrong length, search for the next track. */
function tracksOf(bytes, view, begin) {
  const tracks = [];
  for (let at = begin; at >= 0 && at <= bytes.length - 8; ) {
    const end = at + 8 + view.getUint32(at + 4), isCut = end > bytes.length;
    if (find(bytes.subarray(at, at + 4), "MTrk", 0) === 0) {
      tracks.push(new Track(bytes, at + 8, Math.min(end, bytes.length), isCut));
      at = isCut ? tracks.at(-1).at : end;
    } else at = isCut ? find(bytes, "MTrk", at + 1) : end;
  }
  return tracks;
}

/** A function from ticks to seconds, from all tempo changes of a file. */
function clockOf(tempos, division) {
  const marks = [{ tick: 0, seconds: 0, rate: FIRST_TEMPO / 1e6 / division }];
  if (division >= 2 ** 15) {
    const frames = 256 - (division >> 8), ticks = division & 255;
    if (!FRAME_RATES[frames] || !ticks) throw new Error(`${ticks} ticks a frame of ${frames} frames a second`);
    marks[0].rate = 1 / (FRAME_RATES[frames] * ticks);
  } else if (!division) throw new Error("0 ticks a beat");
  const clock = (tick) => {
    let low = 0, high = marks.length;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (marks[middle].tick <= tick) low = middle;
      else high = middle;
    }
    return marks[low].seconds + (tick - marks[low].tick) * marks[low].rate;
  };
  const changes = division < 2 ** 15 ? [...tempos].sort((a, b) => a.tick - b.tick) : [];
  for (const { tick, tempo } of changes) marks.push({ tick, seconds: clock(tick), rate: tempo / 1e6 / division });
  return clock;
}

function remarksOf(tracks, declared, clock) {
  const remarks = [], damaged = tracks.findIndex((track) => track.damage);
  const more = tracks.filter((track) => track.damage).length - 1;
  if (tracks.length < declared) {
    remarks.push(`the header declares ${declared} track${declared > 1 ? "s" : ""}, and the file has ${tracks.length}`);
  }
  if (damaged >= 0) {
    const { damage, tick } = tracks[damaged], others = more ? `, and ${more} more are damaged` : "";
    remarks.push(`track ${damaged + 1} ${damage} after ${clock(tick).toFixed(1)} s${others}; the rest is played`);
  }
  return remarks;
}

/** Channel messages of a file in time order: {messages: [{at, kind, channel, first, second}], seconds, remarks}. */
function parse(bytes) {
  const begin = find(bytes, "MThd", 0), view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (begin < 0) throw new Error("it has no MIDI header, MThd");
  if (begin + 14 > bytes.length) throw new Error("its header is cut short");
  const size = view.getUint32(begin + 4), [fileType, declared, division] = [8, 10, 12].map((at) => view.getUint16(begin + at));
  const tracks = tracksOf(bytes, view, begin + 8 + Math.max(size, 6));
  if (fileType > 2) throw new Error(`type ${fileType} is unknown`);
  if (fileType === 2 && tracks.length > 1) throw new Error("type 2, whose tracks are separate songs");
  const clock = clockOf(tracks.flatMap((track) => track.tempos), division);
  const messages = tracks.flatMap((track) => track.messages).sort((a, b) => a.tick - b.tick);
  const seconds = clock(tracks.reduce((most, { tick }) => Math.max(most, tick), 0));
  return { messages: messages.map((message) => ({ ...message, at: clock(message.tick) })), seconds,
    remarks: remarksOf(tracks, declared, clock) };
}

/**
 * Events of one key in one channel, with an end added for every stroke that has none: at a stray note-off of the same
 * time (a note without length), otherwise at the next stroke of the key in the channel, otherwise no end.
 */
function addMissingEnds(moves) {
  const stray = new Set(), strokes = moves.filter((move) => move.velocity > 0), ends = [];
  const next = new Map(strokes.map((stroke, i) => [stroke, strokes[i + 1]]));
  let open = [];
  for (const move of moves) {
    if (move.velocity > 0) open.push(move);
    else if (move.velocity === END_ALL) open = [];
    else if (!open.pop()) stray.add(move.at);
  }
  for (const stroke of open) {
    const again = next.get(stroke);
    if (stray.has(stroke.at)) ends.push({ ...stroke, order: stroke.order + 0.5, velocity: END });
    else if (again) ends.push({ ...again, order: again.order - 0.5, velocity: END });
  }
  return [...moves, ...ends];
}

/**
 * Strokes and releases of one key. It is released when no channel has an open stroke left. released: velocities by time.
 */
function mergeChannels(midi, channels, released) {
  const open = new Map(), events = [], moves = [...channels.values()].flatMap(addMissingEnds);
  const isHeld = () => [...open.values()].some((count) => count > 0);
  for (const { order, at, channel, velocity } of moves.sort((a, b) => a.order - b.order)) {
    const before = isHeld(), count = open.get(channel) ?? 0;
    if (velocity > 0) {
      open.set(channel, count + 1);
      const last = events.at(-1), isDoubled = last?.do === "on" && last.at === at; // one hammer: the hardest stroke
      if (isDoubled) events.pop();
      events.push({ order, at, do: "on", midi, velocity: isDoubled ? Math.max(velocity, last.velocity) : velocity });
      continue;
    }
    open.set(channel, velocity === END ? Math.max(count - 1, 0) : 0);
    if (before && !isHeld()) events.push({ order, at, do: "off", midi, velocity: released.get(at) ?? RELEASE_VELOCITY });
  }
  return { events, isHeld: isHeld() };
}

/** As `parse`, with the advice for a file that is not a MIDI file that this page reads. */
function parsed(bytes) {
  try {
    return parse(bytes);
  } catch (error) {
    throw new Error(`cannot be read as MIDI (${error.message}); save it again as type 0 or 1`);
  }
}

/**
 * A song: {events, seconds, notes, beyond, remarks}. Events ascend in time: {at, do: "on", midi, velocity: 1 to 127},
 * {at, do: "off", midi, velocity: 0 to 127}, {at, do: "control", controller: one of PEDALS, value: 0 to 127}. `beyond`
 * counts notes outside A0 to C8.
 *
 * Throws an Error with the reason if the file cannot be used.
 */
export function readMidi(bytes) {
  const { messages, seconds, remarks } = parsed(bytes);
  if (seconds > MOST_SONG_SECONDS) throw new Error(`lasts more than ${MOST_SONG_SECONDS / 60} minutes; cut it into parts`);
  const keys = new Map(), released = new Map(), events = [], count = { notes: 0, beyond: 0 };
  const pedals = new Map(PEDALS.map((controller) => [controller, { channels: new Map(), highest: 0 }]));
  const move = (midi, channel, step) => {
    if (!keys.has(midi)) keys.set(midi, new Map());
    if (!keys.get(midi).has(channel)) keys.get(midi).set(channel, []);
    keys.get(midi).get(channel).push({ ...step, channel });
  };
  messages.forEach(({ at, kind, channel, first, second }, order) => {
    if (channel === DRUMS) return;
    const movePedal = (controller, value) => {
      const pedal = pedals.get(controller), highest = Math.max(...pedal.channels.set(channel, value).values());
      if (highest !== pedal.highest) events.push({ order, at, do: "control", controller, value: highest });
      pedal.highest = highest; // of all channels
    };
    if (kind === CONTROL && pedals.has(first)) {
      movePedal(first, second);
    } else if (kind === CONTROL && first === RESET) {
      for (const controller of PEDALS) movePedal(controller, 0);
    } else if (kind === CONTROL && [SOUND_OFF, NOTES_OFF].includes(first)) {
      for (const [midi, channels] of keys) if (channels.has(channel)) move(midi, channel, { order, at, velocity: END_ALL });
    } else if (kind === NOTE_ON || kind === NOTE_OFF) {
      const velocity = kind === NOTE_ON ? second : END, isOnPiano = first >= LOWEST_KEY && first <= HIGHEST_KEY;
      if (velocity > 0) count[isOnPiano ? "notes" : "beyond"]++;
      if (isOnPiano) move(first, channel, { order, at, velocity });
      if (kind === NOTE_OFF) released.set(first, (released.get(first) ?? new Map()).set(at, second));
    }
  });
  if (count.notes > MOST_NOTES) throw new Error(`has more than ${MOST_NOTES} notes; cut it into parts`);
  const reason = remarks.length ? ` (${remarks.join("; ")})` : "";
  if (!count.notes) throw new Error(`holds no note from A0 to C8 outside channel 10, the drums${reason}; give a MIDI file with notes`);
  const end = { order: Infinity, at: seconds + LAST_HELD };
  for (const [midi, channels] of keys) {
    const merged = mergeChannels(midi, channels, released.get(midi) ?? new Map());
    const last = { ...end, do: "off", midi, velocity: RELEASE_VELOCITY };
    events.push(...merged.events, ...(merged.isHeld ? [last] : []));
  }
  for (const [controller, { highest }] of pedals) if (highest) events.push({ ...end, do: "control", controller, value: 0 });
  events.sort((a, b) => a.at - b.at || (a.order > b.order) - (a.order < b.order));
  return { events: events.map(({ order, ...event }) => event), seconds, ...count, remarks };
}

/** A number of variable length: seven bits a byte, the highest bit set in all but the last. */
function variable(number) {
  const bytes = [number & 0x7f];
  for (let rest = number >> 7; rest > 0; rest >>= 7) bytes.unshift(0x80 | (rest & 0x7f));
  return bytes;
}

/** A MIDI file of type 0 with events as returned by `readMidi`. Time begins at the first event. */
export function writeMidi(events) {
  const perSecond = (TICKS * 1e6) / FIRST_TEMPO, four = (x) => [24, 16, 8, 0].map((shift) => (x >> shift) & 255);
  const track = [0, META, SET_TEMPO, 3, ...four(FIRST_TEMPO).slice(1)];
  let before = 0;
  for (const event of events) {
    const tick = Math.max(Math.round((event.at - events[0].at) * perSecond), before);
    const data = { on: [NOTE_ON << 4, event.midi, event.velocity],
      off: [NOTE_OFF << 4, event.midi, event.velocity ?? RELEASE_VELOCITY],
      control: [CONTROL << 4, event.controller, event.value] }[event.do];
    track.push(...variable(tick - before), ...data);
    before = tick;
  }
  track.push(0, META, END_OF_TRACK, 0);
  const text = (word) => Array.from(word, (c) => c.charCodeAt(0));
  return Uint8Array.from([...text("MThd"), ...four(6), 0, 0, 0, 1, TICKS >> 8, TICKS & 255, ...text("MTrk"),
    ...four(track.length), ...track]);
}
