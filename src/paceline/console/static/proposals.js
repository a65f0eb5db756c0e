// What the server proposes: the same thing in the other view, lanes, vehicles.

import { ask } from "./importer.js";
import { VIEWS, ordered } from "./model.js";

function searching(kind, { state, done, total }) {
  if (state === "waiting") return `Looking for ${kind}: waits for the run before it`;
  if (!done) return `Looking for ${kind}: starting`;
  return done < total ? `Looking for ${kind}: ${done} of ${total} frames read` : `Looking for ${kind}: nearly there`;
}

export class Proposals {
  constructor(editor) { this.editor = editor; }

  async other(item, view) {
    const other = VIEWS[1 - view];
    const entry = this.editor.model.entry(item);
    this.editor.say(`Looking for it in the ${other} view…`);
    try {
      const body = { view, frame: item.kind === "vehicle" ? entry.frame : this.editor.frame, entry: { ...entry, [other]: [] }, path: this.editor.model.allPaths[entry.path] ?? null };
      const { pixels, alike } = await ask("POST", `/api/propose?clip=${this.editor.clip}`, body);
      const [width, height] = this.editor.setup.sizes[1 - view];
      const inside = item.kind === "path" ? pixels.filter(([x, y]) => x >= 0 && y >= 0 && x < width && y < height) : pixels;
      if (inside.length < 2) throw new Error("it lies outside the other view");
      this.editor.model.change((m) => {
        const proposed = ordered({ ...m.entry(item), [other]: inside });
        if (item.kind === "path") m.paths[item.id] = proposed; else m.vehicles[item.id] = proposed;
      });
      this.editor.say(`Proposed in the ${other} view (${Math.round(100 * alike)} % alike). Look at it closely, and drag what is off.`);
    } catch (error) {
      this.editor.say(`In the ${other} view: ${error.message}`, true);
    }
    this.editor.paint();
  }

  async search(kind) { // by a run of the command, which goes on when the page is left
    try {
      const run = await ask("POST", `/api/run?clip=${this.editor.clip}`, { kind });
      sessionStorage.setItem(this.key, JSON.stringify([kind, run.number]));
      await this.wait(kind, run);
    } catch (error) {
      this.editor.say(error.message, true);
    }
  }

  get key() { return `paceline search in ${this.editor.clip}`; }

  resume() { // what was looked for when the page was left
    const [kind, number] = JSON.parse(sessionStorage.getItem(this.key) ?? "[]");
    if (kind) this.wait(kind, { number, state: "waiting" });
  }

  async wait(kind, run) { // until it ends, and take over what it proposes
    const buttons = [this.editor.lanesButton, this.editor.vehiclesButton]; // one search at a time: its words stand alone
    for (const button of buttons) button.disabled = true;
    const address = `clip=${this.editor.clip}&number=${run.number}`;
    try {
      while (["waiting", "running"].includes(run.state)) {
        this.editor.say(searching(kind, run));
        await new Promise((done) => { setTimeout(done, 500); });
        run = await ask("GET", `/api/run?${address}`);
      }
      if (run.state !== "measured") throw new Error(run.reason || `the search was ${run.state}`);
      this[kind === "lanes" ? "takeLanes" : "takeVehicles"](await ask("GET", `/api/proposed?${address}`));
    } catch (error) {
      this.editor.say(error.message, true);
    } finally {
      sessionStorage.removeItem(this.key);
      for (const button of buttons) button.disabled = false;
    }
  }

  lanes() { return this.search("lanes"); }

  takeLanes({ paths }) {
    this.editor.model.change((m) => { for (const entry of Object.values(paths)) m.addPath(entry); });
    this.editor.say(`${Object.keys(paths).length} proposed. What is drawn is the middle of each lane. Look at them, remove what is wrong, and save. The vehicles are next.`);
  }

  async vehicles() {
    if (this.editor.model.dirty) this.editor.say("Save first: vehicles are looked for along the paths that are saved.", true);
    else await this.search("vehicles");
  }

  takeVehicles({ vehicles }) {
    this.editor.model.change((m) => { for (const { id, ...entry } of vehicles) m.addVehicle(entry); });
    this.editor.say(`${vehicles.length} proposed. Look at each outline closely, remove what is wrong, and save. Then measure.`);
  }
}
