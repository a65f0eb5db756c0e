// Proposals of the server: the same item in the other view, lanes, vehicles.

import { sendRequest } from "./importer.js";
import { VIEW_NAMES, ordered } from "./model.js";

function searchText(kind, { state, done, total }) {
  if (state === "waiting") return `Detecting ${kind}: waiting for the previous run`;
  if (!done) return `Detecting ${kind}: starting`;
  return done < total ? `Detecting ${kind}: ${done} of ${total} frames read` : `Detecting ${kind}: almost done`;
}

export class Proposals {
  constructor(editor) { this.editor = editor; }

  async other(item, view) {
    const other = VIEW_NAMES[1 - view];
    const entry = this.editor.model.entry(item);
    this.editor.showMessage(`Searching the ${other} view…`);
    try {
      const body = { view, frame: item.kind === "vehicle" ? entry.frame : this.editor.frame, entry: { ...entry, [other]: [] }, path: this.editor.model.allPaths[entry.path] ?? null };
      const { pixels, correlation } = await sendRequest("POST", `/api/propose?clip=${this.editor.clip}`, body);
      const [width, height] = this.editor.setup.sizes[1 - view];
      const inside = item.kind === "path" ? pixels.filter(([x, y]) => x >= 0 && y >= 0 && x < width && y < height) : pixels;
      if (inside.length < 2) throw new Error("it lies outside the other view");
      this.editor.model.change((m) => {
        const proposed = ordered({ ...m.entry(item), [other]: inside });
        if (item.kind === "path") m.paths[item.id] = proposed; else m.vehicles[item.id] = proposed;
      });
      this.editor.showMessage(`Proposed in the ${other} view (correlation ${correlation.toFixed(2)}). Check it closely, and drag any point that is off.`);
    } catch (error) {
      this.editor.showMessage(`In the ${other} view: ${error.message}`, true);
    }
    this.editor.paint();
  }

  async search(kind) { // by a run of the command, which continues when the page is left
    try {
      const run = await sendRequest("POST", `/api/run?clip=${this.editor.clip}`, { kind });
      sessionStorage.setItem(this.key, JSON.stringify([kind, run.number]));
      await this.wait(kind, run);
    } catch (error) {
      this.editor.showMessage(error.message, true);
    }
  }

  get key() { return `paceline search in ${this.editor.clip}`; }

  resume() { // a search that was active when the page was left
    const [kind, number] = JSON.parse(sessionStorage.getItem(this.key) ?? "[]");
    if (kind) this.wait(kind, { number, state: "waiting" });
  }

  async wait(kind, run) { // until it ends, then add its proposals
    const buttons = [this.editor.lanesButton, this.editor.vehiclesButton]; // one search at a time
    for (const button of buttons) button.disabled = true;
    const address = `clip=${this.editor.clip}&number=${run.number}`;
    try {
      while (["waiting", "running"].includes(run.state)) {
        this.editor.showMessage(searchText(kind, run));
        await new Promise((done) => { setTimeout(done, 500); });
        run = await sendRequest("GET", `/api/run?${address}`);
      }
      if (run.state !== "measured") throw new Error(run.reason || `the search was ${run.state}`);
      this[kind === "lanes" ? "takeLanes" : "takeVehicles"](await sendRequest("GET", `/api/proposed?${address}`));
    } catch (error) {
      this.editor.showMessage(error.message, true);
    } finally {
      sessionStorage.removeItem(this.key);
      for (const button of buttons) button.disabled = false;
    }
  }

  lanes() { return this.search("lanes"); }

  takeLanes({ paths }) {
    this.editor.model.change((m) => { for (const entry of Object.values(paths)) m.addPath(entry); });
    this.editor.showMessage(`${Object.keys(paths).length} proposed. The lines drawn are the lane centres. Check them, remove what is wrong, and save. Next: the vehicles.`);
  }

  async vehicles() {
    if (this.editor.model.dirty) this.editor.showMessage("Save first: vehicles are detected along the saved paths.", true);
    else await this.search("vehicles");
  }

  takeVehicles({ vehicles }) {
    this.editor.model.change((m) => { for (const { id, ...entry } of vehicles) m.addVehicle(entry); });
    this.editor.showMessage(`${vehicles.length} proposed. Look at each outline closely, remove what is wrong, and save. Then measure.`);
  }
}
