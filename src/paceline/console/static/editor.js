// The stereo editor: both views side by side, road lines and vehicles drawn in them, proposals and checks by the server.

import { EditorElement, HIT_RADIUS_PX, pushButton, READ_ONLY } from "./editing.js";
import { Player } from "./player.js";
import { make, sendRequest } from "./importer.js";
import { DraftStore } from "./drafts.js";
import { Keyboard } from "./keyboard.js";
import { Model, VIEW_NAMES, ordered, rounded, sortedCorners } from "./model.js";
import { ItemList } from "./item_list.js";
import { PointerTools } from "./pointer_tools.js";
import { Proposals } from "./proposals.js";
import { ITEM_COLORS, View } from "./view.js";

const EDITOR_TOOLS = {
  move: ["Look", "v", "Drag a point to move it, the picture to pan; the wheel zooms."],
  line: ["Road line", "l", "Click along a road line; Enter ends it. Then the same line in the other view, or let it be proposed."],
  vehicle: ["Vehicle", "r", "Drag across a flat front, rear or side, or click its four corners."],
};
const KEYS_HELP = "V look, L line, R outline; drawing: arrows move a cross (Shift: finely), X the other view, Space puts a point, Enter ends a line. "
  + "Looking: ← → frames, Space plays, N next point, arrows nudge it (Shift: more). "
  + "Always: , . frames, Del removes, Ctrl-Z undoes, Ctrl-S saves, + − 0 zoom, S snapping, Esc leaves";

// The named parts of a state, to compare two versions of the file.
function parts([paths, vehicles]) {
  return Object.fromEntries([...Object.entries(paths).map(([name, entry]) => [`path ${name}`, entry]),
    ...vehicles.map((entry) => [`vehicle ${entry.id}`, entry])]);
}

class Editor extends EditorElement {
  async connectedCallback() {
    if (!await this.loadSetup("setup")) return;
    this.model = new Model(this.setup);
    this.readonly = this.model.frozen = this.hasAttribute("readonly");
    this.views = VIEW_NAMES.map((side, i) => new View(side, this.setup.sizes[i]));
    this.tool = "move";
    this.snapping = true;
    this.linked = true;
    this.chosen = null;
    this.draft = null; // {kind, view, points}
    this.moving = null; // the position of the chosen point while it is dragged
    this.build();
    this.model.listeners.push(() => this.changed());
    this.drafts = new DraftStore(this, { address: `/api/setup?clip=${this.clip}`, file: "clip.yaml", parts,
      send: ({ paths, vehicles }) => ({ paths, vehicles }) });
    new ResizeObserver(() => this.resized()).observe(this.views[0].canvas);
    const first = this.model.vehicles[0];
    this.player.goTo(first ? Math.max(this.setup.frames.indexOf(first.frame), 0) : 0);
    if (!this.readonly && this.drafts.restoreDraft()) this.showMessage("What you had drawn and not saved is back. Undo discards it.");
    this.changed();
    if (!this.readonly) this.proposals.resume();
    window.addEventListener("beforeunload", (event) => { if (this.model.dirty) event.preventDefault(); });
    this.keyboard = new Keyboard(this, EDITOR_TOOLS);
  }

  // --- the page ----------------------------------------------------------------------------------------------------

  build() {
    const drawing = this.buildTools(EDITOR_TOOLS);
    this.snapButton = pushButton("Snap", () => this.toggleSnapping(), "Points move to the nearest edge or corner (S); Alt does the opposite for one point");
    this.linkButton = pushButton("Zoom together", () => { this.linked = !this.linked; this.buttons(); }, "Zoom and pan both views as one");
    this.lanesButton = pushButton("Propose lanes", () => this.proposals.lanes(), "Find the painted lines of the empty road; this reads the whole recording");
    this.vehiclesButton = pushButton("Propose vehicles", () => this.proposals.vehicles(), "Find what drives along the paths; this reads the whole recording");
    this.saveButton = pushButton("Save", () => this.save(), "Writes clip.yaml (Ctrl-S)");
    this.saveButton.classList.add("primary");
    this.measureButton = make("a", { className: "pl-button", href: this.getAttribute("runs"), textContent: this.readonly ? "Results…" : "Measure…" });
    this.hint = make("div", { className: "ed-hint", role: "status", "aria-live": "polite" });
    drawing.push(this.snapButton);
    for (const element of [...drawing, this.saveButton, this.lanesButton, this.vehiclesButton]) element.hidden = this.readonly;
    const bar = make("div", { className: "ed-bar", role: "toolbar", "aria-label": "Tools" }, ...drawing, this.linkButton,
      make("span", { className: "end" }, this.saveButton, this.measureButton));
    const boxes = this.views.map((view) => {
      view.canvas.setAttribute("aria-label", `${view.side} view`);
      return make("div", { className: "ed-view" }, view.canvas, make("span", { className: "tag", textContent: view.side }));
    });
    this.player = new Player(this, [0, 1], this.setup);
    this.itemList = new ItemList(this);
    this.pointers = new PointerTools(this);
    this.proposals = new Proposals(this);
    const keys = make("details", { className: "pl-fact" }, make("summary", { textContent: "Keys" }), KEYS_HELP);
    this.append(
      make("div", { className: "ed-work" }, bar, this.hint, make("div", { className: "ed-views" }, ...boxes),
        this.player.element, keys),
      this.itemList.element);
    this.take("move");
    this.showMessage(this.nextStep());
    for (const notice of this.setup.notices) this.itemList.element.append(make("div", { className: "pl-fact", textContent: `Note: ${notice}` }));
  }

  buttons() {
    this.markTools();
    this.snapButton.setAttribute("aria-pressed", String(this.snapping));
    this.linkButton.setAttribute("aria-pressed", String(this.linked));
    this.saveButton.disabled = !this.model.dirty;
    this.measureButton.classList.toggle("primary", !this.readonly && !this.model.dirty && this.model.vehicles.length > 0); // the next step
  }

  nextStep() { // the hint for the next step
    if (this.readonly) return READ_ONLY;
    const { paths, vehicles, sitePaths } = this.model;
    if (!vehicles.length && !Object.keys({ ...paths, ...sitePaths }).length) {
      return "First draw the road line that the vehicles follow, or let lanes be proposed. Then outline the vehicles. "
        + "Or just measure: lanes and vehicles are then detected.";
    }
    if (!vehicles.length) return "Now outline each vehicle, in a frame that shows it well and early.";
    return EDITOR_TOOLS[this.tool][2];
  }

  take(tool) {
    if (this.readonly) tool = "move";
    this.pointers.inOrder(() => this.finishDraft());
    this.tool = tool;
    this.showMessage(this.readonly ? READ_ONLY : EDITOR_TOOLS[tool][2]);
    this.buttons();
    this.paint();
  }

  toggleSnapping() {
    this.snapping = !this.snapping;
    this.buttons();
  }

  // --- pictures ----------------------------------------------------------------------------------------------------

  frameShown() { this.paint(); } // by the player

  drawings(view) {
    const side = VIEW_NAMES[view];
    const list = [];
    for (const entry of Object.values(this.model.sitePaths)) {
      if (entry[side]) list.push({ points: entry[side], color: "#b9c2cc", faint: true });
    }
    Object.entries(this.model.paths).forEach(([name, entry], i) => {
      if (entry[side]?.length) list.push(this.drawing({ kind: "path", id: name }, entry[side], false, i, view));
    });
    this.model.vehicles.forEach((entry, i) => {
      if (entry[side]?.length) list.push({ ...this.drawing({ kind: "vehicle", id: i }, entry[side], true, i, view), faint: entry.frame !== this.frame });
    });
    if (this.draft?.view === view) list.push({ points: this.draft.points, color: "#fff", chosen: true, closed: this.draft.closed });
    return list.filter((drawing) => drawing.points.length);
  }

  drawing(item, points, closed, i, view) {
    const chosen = this.isChosen(item);
    const point = chosen && this.chosen.view === view ? this.chosen.point : undefined;
    if (point !== undefined && this.moving) points = points.map((p, k) => (k === point ? this.moving : p));
    return { points, closed, color: ITEM_COLORS[i % ITEM_COLORS.length], chosen, point };
  }

  // --- choosing ----------------------------------------------------------------------------------------------------

  isChosen(item) { return this.chosen?.kind === item.kind && this.chosen.id === item.id; }

  choose(item) {
    this.chosen = item;
    const entry = this.model.entry(item);
    if (item?.kind === "vehicle" && entry.frame !== this.frame) this.player.goTo(this.setup.frames.indexOf(entry.frame));
    this.itemList.show();
    this.paint();
  }

  show(item) {
    this.choose(item);
    const entry = this.model.entry(item);
    const drawn = this.views.filter((view) => entry[view.side]?.length);
    for (const view of drawn) view.show(entry[view.side]);
    const least = Math.min(...drawn.map((view) => view.scale));
    for (const view of this.linked ? drawn : []) view.scale = least;
    if (drawn.length === 1 && this.linked) {
      const other = this.views.find((view) => view !== drawn[0]);
      other.scale = least;
      other.centre = [...drawn[0].centre];
    }
    this.paint();
  }

  remove(item) {
    this.chosen = null;
    this.model.change((m) => m.remove(item));
  }

  items() { // everything drawn
    return [...Object.keys(this.model.paths).map((id) => ({ kind: "path", id })), ...this.model.vehicles.map((_, id) => ({ kind: "vehicle", id }))];
  }

  // The drawn point at a position on the screen; the chosen item's points come first.
  hit(view, at) {
    const side = VIEW_NAMES[view];
    const items = this.items().filter((item) => item.kind === "path" || this.model.entry(item).frame === this.frame);
    items.sort((a, b) => Number(this.isChosen(b)) - Number(this.isChosen(a)));
    for (const item of items) {
      const points = (this.model.entry(item)[side] ?? []).map((p) => this.views[view].toScreen(p));
      const gaps = points.map((p) => Math.hypot(p[0] - at[0], p[1] - at[1]));
      const nearest = gaps.indexOf(Math.min(...gaps));
      if (gaps[nearest] <= HIT_RADIUS_PX) return { ...item, view, point: nearest };
    }
    return null;
  }

  // --- places ------------------------------------------------------------------------------------------------------

  async snapped(view, place, opposite) {
    if (this.snapping === opposite) return rounded(place);
    const reach = Math.min(Math.max(8 / this.views[view].scale, 1.5), 6);
    try {
      return await sendRequest("GET", `/api/snap?clip=${this.clip}&view=${view}&frame=${this.frame}&x=${place[0]}&y=${place[1]}&reach=${reach}`);
    } catch {
      return rounded(place); // unsnapped
    }
  }

  async updateEpipolarLine(view, place) { // of the cursor in the other view, one request at a time
    this.nextCursor = { view, place };
    if (this.requesting) return;
    this.requesting = true;
    while (this.nextCursor) {
      const now = this.nextCursor;
      this.nextCursor = null;
      try {
        const found = await sendRequest("GET", `/api/epipolar?clip=${this.clip}&view=${now.view}&x=${now.place[0]}&y=${now.place[1]}`);
        this.views[1 - now.view].epipolar = found;
        this.views[now.view].epipolar = null;
      } catch (error) {
        this.showMessage(error.message, true);
        break;
      }
      this.paint();
    }
    this.requesting = false;
  }

  // --- drawing -----------------------------------------------------------------------------------------------------

  async clicked(view, place) {
    const kind = this.tool === "line" ? "path" : "vehicle";
    if (this.draft && (this.draft.view !== view || this.draft.kind !== kind)) await this.finishDraft();
    this.draft ??= { kind, view, points: [] };
    this.draft.points.push(place);
    if (kind === "vehicle" && this.draft.points.length === 4) {
      const points = sortedCorners(this.draft.points);
      this.draft = null;
      await this.outlined(view, points);
    } else if (kind === "path") this.showMessage("Click further along the line; Enter or a double click ends it.");
    else this.showMessage(`${4 - this.draft.points.length} more corner${this.draft.points.length === 3 ? "" : "s"}`);
  }

  async finishDraft() {
    const { draft } = this;
    this.draft = null;
    if (draft?.kind !== "path") return this.paint();
    const points = draft.points.filter((p, i) => !i || Math.hypot(p[0] - draft.points[i - 1][0], p[1] - draft.points[i - 1][1]) > 1);
    if (points.length < 2) return this.paint();
    const side = VIEW_NAMES[draft.view];
    const waiting = this.chosen?.kind === "path" && !this.model.entry(this.chosen)?.[side]?.length;
    let item = this.chosen;
    this.model.change((m) => {
      if (waiting) m.paths[item.id] = ordered({ ...m.paths[item.id], [side]: points });
      else item = m.addPath({ shape: "line", [side]: points, lateral_offset: 0 });
    });
    this.choose({ kind: "path", id: item.id });
    if (!waiting) await this.proposals.other(this.chosen, draft.view);
    else this.showMessage("The line is drawn in both views. Next: the vehicles.");
  }

  async outlined(view, points) {
    const side = VIEW_NAMES[view];
    const now = this.chosen?.kind === "vehicle" ? this.model.entry(this.chosen) : null;
    const waiting = now && now.frame === this.frame && !now[side]?.length;
    let item = this.chosen;
    this.model.change((m) => {
      if (waiting) m.vehicles[item.id] = ordered({ ...m.vehicles[item.id], [side]: points });
      else {
        const names = Object.keys(m.allPaths);
        item = m.addVehicle(ordered({ path: names.length === 1 ? names[0] : undefined, frame: this.frame, [side]: points }));
      }
    });
    this.choose({ kind: "vehicle", id: item.id });
    if (!waiting) await this.proposals.other(this.chosen, view);
    else this.showMessage("The vehicle is outlined in both views.");
  }

  movePoint(place) { // the chosen one
    if (this.chosen?.point === undefined) return;
    const { view, point } = this.chosen;
    this.model.change((m) => { m.entry(this.chosen)[VIEW_NAMES[view]][point] = place; });
  }

  // --- changes -----------------------------------------------------------------------------------------------------

  changed() {
    if (this.chosen && !this.model.entry(this.chosen)) this.chosen = null;
    const points = this.chosen?.view === undefined ? null : this.model.entry(this.chosen)[VIEW_NAMES[this.chosen.view]];
    if (points && !(this.chosen.point < points.length)) this.chosen = { kind: this.chosen.kind, id: this.chosen.id };
    this.buttons();
    this.itemList.show();
    this.paint();
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.check(), 120);
  }

  async check() {
    const sent = this.model.text();
    try {
      const found = await sendRequest("POST", `/api/check?clip=${this.clip}`, { paths: this.model.allPaths, vehicles: this.model.vehicles });
      if (sent !== this.model.text()) return;
      this.checks = found;
      this.itemList.show();
    } catch (error) {
      this.showMessage(error.message, true);
    }
  }

  async save() {
    if (!this.model.dirty) return;
    const next = () => (this.model.vehicles.length ? "measure" : "outline the vehicles, or let them be proposed");
    await this.drafts.save(() => `Saved in clip.yaml. Next: ${next()}.`);
  }

  removeChosen() {
    if (!this.chosen) return;
    const points = this.chosen.point === undefined ? null : this.model.entry(this.chosen)[VIEW_NAMES[this.chosen.view]];
    if (this.chosen.kind === "path" && points && points.length > 2) {
      const { view, point } = this.chosen;
      this.chosen = { kind: "path", id: this.chosen.id };
      this.model.change((m) => { m.entry(this.chosen)[VIEW_NAMES[view]].splice(point, 1); });
    } else this.remove(this.chosen);
  }
}

if (!customElements.get("pl-editor")) customElements.define("pl-editor", Editor);
