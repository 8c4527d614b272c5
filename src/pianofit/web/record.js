// Record of the events of the last minutes: strokes, releases, pedals, volume and silencing, with times in seconds.

import { writeMidi } from "./midi.js";
import { PEDALS } from "./pedals.js";

export class Record {
  /** longest: length of the record, s. */
  constructor(longest) {
    const pedals = Object.fromEntries(PEDALS.map((controller) => [controller, 0]));
    Object.assign(this, { longest, events: [], start: { pedals, volume: 1 } });
  }

  /** Add {do: "on" | "off" | "control" | "volume" | "panic", ...} at a time, s; it may precede recorded events. */
  add(message, at) {
    let place = this.events.length;
    while (place > 0 && this.events[place - 1].at > at) place--;
    this.events.splice(place, 0, { ...message, at });
    const last = this.events.at(-1).at, first = this.events.findIndex((event) => event.at >= last - this.longest);
    if (first > 0) this.start = settings(this.start, this.events.splice(0, first));
  }

  /**
   * Events of the last `seconds`, from the first stroke on, preceded by pedals and volume at that time. Releases of
   * earlier strokes are left out. Empty without a stroke.
   */
  recent(seconds) {
    const begin = this.events.at(-1)?.at - seconds;
    const first = this.events.findIndex((event) => event.do === "on" && event.at >= begin);
    if (first < 0) return [];
    const { pedals, volume } = settings(this.start, this.events.slice(0, first)), held = new Set();
    const kept = this.events.slice(first).filter((event) => {
      if (event.do === "on") held.add(event.midi);
      if (event.do === "panic") held.clear();
      return event.do !== "off" || held.delete(event.midi);
    });
    const { at } = kept[0], moved = PEDALS.map((controller) => ({ at, do: "control", controller, value: pedals[controller] }));
    return [...moved, { at, do: "volume", volume }, ...kept];
  }

  /** The whole record as a MIDI file; `midiVelocity` converts a hammer velocity, m/s. */
  midi(midiVelocity) {
    const held = new Set();
    const events = this.recent(this.longest).flatMap((event) => {
      if (event.do === "off") held.delete(event.midi);
      if (event.do === "panic") return [...held].map((midi) => ({ at: event.at, do: "off", midi }));
      if (event.do !== "on") return event.do === "volume" ? [] : [event];
      held.add(event.midi);
      return [{ ...event, velocity: midiVelocity(event.velocity) }];
    });
    return writeMidi(events);
  }
}

/** State of pedals and volume after events. */
function settings({ pedals, volume }, events) {
  const moved = { ...pedals };
  for (const event of events) {
    if (event.do === "control") moved[event.controller] = event.value;
    if (event.do === "volume") volume = event.volume;
  }
  return { pedals: moved, volume };
}
