// The vehicle ahead: a line model placed on the camera's picture, learned from a box, saved for following.

import { EditorElement, HIT_RADIUS_PX, pushButton, READ_ONLY } from "./editing.js";
import { Player } from "./player.js";
import { PanZoom } from "./pan_zoom.js";
import { History } from "./history.js";
import { make, sendRequest } from "./importer.js";
import { DraftStore } from "./drafts.js";
import { keyFor } from "./keyboard.js";
import { View } from "./view.js";

const EDITOR_TOOLS = {
  look: ["Look", "v", "Drag the picture to pan; the wheel zooms. Click a line of the model to choose it."],
  place: ["Place", "p", "Drag the model onto the vehicle; drag a corner to scale it. Arrows and [ ] do it finely."],
  box: ["Learn from a box", "b", "Drag a box tightly around the rear: from one side of the body to the other."],
};
const KEYS_HELP = "V look, P place: arrows move by ¼ px (Shift: 2 px), [ ] smaller and larger by 0.2 % (Shift: 2 %); "
  + "B box: arrows move it by 1 px (Shift: its lower right corner), Enter learns. "
  + "Always: , . frames, Space plays, N next line, Del removes it, Ctrl-Z undoes, Ctrl-S saves, + − 0 zoom, Esc leaves";

class Placement extends History {
  constructor({ target, start, revision }) {
    super();
    Object.assign(this, { target, start, revision });
    this.begin();
  }

  state() { return [this.target, this.start]; }
  restore([target, start]) { Object.assign(this, { target, start }); }
  accept({ target, start, revision }) {
    Object.assign(this, { target, start, revision });
    this.saved = this.text();
    this.notify();
  }
}

class TargetPointerTools extends PanZoom {
  beginDrag(i, at) {
    const { editor } = this;
    if (editor.tool === "box") return { kind: "box", from: editor.views[0].toImage(at) };
    const handle = editor.tool === "place" ? editor.handle(at) : null;
    return handle ? { ...handle, before: editor.model.start } : { kind: "pan" };
  }

  dragTo(i, place, at, drag) {
    const { editor } = this;
    if (drag.kind === "box") editor.box = [drag.from, place];
    else if (this.movedFar(at) || editor.moving) editor.moving = editor.dragged(drag, place);
    editor.updateProjection();
  }

  endDrag(i, place, drag, isClick) {
    const { editor } = this;
    if (drag && drag.kind !== "box" && isClick) editor.chooseLine(place);
    if (drag?.kind === "box") editor.boxed();
    if (editor.moving) {
      const { moving } = editor;
      editor.moving = null;
      editor.start(moving);
    }
  }
}

class TargetEditor extends EditorElement {
  async connectedCallback() {
    if (!await this.loadSetup("target")) return;
    this.model = new Placement(this.setup);
    this.readonly = this.model.frozen = this.hasAttribute("readonly");
    this.views = [new View("camera", this.setup.size)];
    this.linked = false;
    this.tool = "look";
    this.line = null; // the chosen one
    this.box = null; // two corners, drawn or being drawn
    this.moving = null; // the start while it is dragged
    this.build();
    this.player = new Player(this, [0], this.setup);
    this.work.append(this.player.element, make("details", { className: "pl-fact" }, make("summary", { textContent: "Keys" }), KEYS_HELP));
    this.pointers = new TargetPointerTools(this);
    this.model.listeners.push(() => this.changed());
    this.drafts = new DraftStore(this, { address: `/api/target?clip=${this.clip}`, file: "follow.yaml",
      parts: ([target, start]) => ({ "the model": target, "where it starts": start }), send: ({ target, start }) => ({ target, start }) });
    new ResizeObserver(() => this.resized()).observe(this.views[0].canvas);
    const recalled = !this.readonly && this.drafts.restoreDraft();
    this.take(this.readonly ? "look" : this.model.target ? "place" : "box");
    if (this.setup.problem) this.showMessage(this.setup.problem, true);
    if (recalled) this.showMessage("What you had placed and not saved is back. Undo discards it.");
    this.player.goTo(this.model.start ? Math.max(this.setup.frames.indexOf(this.model.start.frame), 0) : 0);
    this.changed();
    window.addEventListener("beforeunload", (event) => { if (this.model.dirty) event.preventDefault(); });
    window.addEventListener("keydown", (event) => this.key(event));
  }

  // --- the page ----------------------------------------------------------------------------------------------------

  build() {
    const drawing = this.buildTools(EDITOR_TOOLS);
    this.saveButton = pushButton("Save", () => this.save(), "Writes follow.yaml, and a new model beside it (Ctrl-S)");
    this.saveButton.classList.add("primary");
    this.followButton = make("a", { className: "pl-button", href: this.getAttribute("runs"), textContent: this.readonly ? "Results…" : "Follow…" });
    this.hint = make("div", { className: "ed-hint", role: "status", "aria-live": "polite" });
    for (const element of [...drawing, this.saveButton]) element.hidden = this.readonly;
    const bar = make("div", { className: "ed-bar", role: "toolbar", "aria-label": "Tools" }, ...drawing,
      make("span", { className: "end" }, this.saveButton, this.followButton));
    this.views[0].canvas.setAttribute("aria-label", "camera view");
    const box = make("div", { className: "ed-view" }, this.views[0].canvas, make("span", { className: "tag", textContent: "camera" }));
    const views = make("div", { className: "ed-views" }, box);
    views.style.gridTemplateColumns = "1fr";
    this.work = make("div", { className: "ed-work" }, bar, this.hint, views);
    this.append(this.work, this.buildSide());
    for (const notice of this.setup.notices) this.lastChild.append(make("div", { className: "pl-fact", textContent: `Note: ${notice}` }));
  }

  buildSide() {
    this.facts = make("dl");
    this.problem = make("p", { className: "problem" });
    this.warning = make("p", { className: "warning" });
    this.width = make("input", { type: "number", min: 0.2, max: 10, step: 0.01, required: true });
    this.halfWidth = make("input", { type: "number", min: 0, step: 0.01, placeholder: "3 % of it" });
    const usual = Object.entries(this.setup.usual_widths).map(([kind, [metres, half]]) => make("li", { textContent: `${kind} ${metres.toFixed(2)} ± ${half.toFixed(2)} m` }));
    this.name = make("input", { maxLength: 100, disabled: this.readonly, value: this.setup.target?.name ?? "vehicle ahead" });
    this.name.onchange = () => { if (this.name.value.trim() && this.model.target) this.model.change((m) => { m.target = { ...m.target, name: this.name.value.trim() }; }); };
    this.learnButton = pushButton("Learn the lines in the box", () => this.learn(), "Finds the strong horizontal and vertical edges (Enter)");
    this.startButton = pushButton("Start in this frame", () => this.start({ ...this.model.start, frame: this.frame }), "Following begins in the frame that is shown");
    const file = make("input", { type: "file", accept: ".yaml,.yml", hidden: true, onchange: () => this.open(file) });
    const label = (text, input) => make("label", {}, text, input);
    const model = make("section", { className: "pl-panel ed-item", "aria-label": "Vehicle ahead" },
      make("div", { className: "pl-subtitle", textContent: "Vehicle ahead" }), label("name", this.name), this.facts, this.problem, this.warning,
      make("div", { className: "ed-bar", hidden: this.readonly }, this.startButton, pushButton("Open a model file…", () => file.click(), "A target.yaml from elsewhere"), file));
    const learn = make("section", { className: "pl-panel ed-item", "aria-label": "Learn a model", hidden: this.readonly },
      make("div", { className: "pl-subtitle", textContent: "Learn a model" }),
      make("div", { className: "pl-fact", textContent: "Drag a box around the rear in a frame in which it is near. Distances are as accurate as the width that you enter." }),
      label("true width, m", this.width), label("± (95 %), m", this.halfWidth),
      make("details", { className: "pl-fact", open: true }, make("summary", { textContent: "Usual widths, without mirrors:" }), make("ul", {}, ...usual)), make("div", { className: "ed-bar" }, this.learnButton));
    return make("div", { className: "ed-side" }, model, learn);
  }

  nextStep() { return this.readonly ? READ_ONLY : EDITOR_TOOLS[this.tool][2]; }

  take(tool) {
    this.tool = this.readonly ? "look" : tool;
    this.showMessage(this.nextStep());
    this.buttons();
    this.paint();
  }

  buttons() {
    const { model } = this;
    this.markTools();
    this.toolButtons.place.disabled = !model.target;
    this.saveButton.disabled = !model.dirty || !model.target || !model.start;
    this.learnButton.disabled = !this.box;
    this.startButton.disabled = !model.start || model.start.frame === this.frame;
    this.followButton.classList.toggle("primary", !this.readonly && !model.dirty && Boolean(model.target && model.start));
  }

  frameShown() { // by the player
    this.buttons();
    this.paint();
  }

  // --- the model on the picture ------------------------------------------------------------------------------------

  changed() {
    if (this.line !== null && !this.model.target?.segments[this.line]) this.line = null;
    if (this.model.target) this.name.value = this.model.target.name;
    this.buttons();
    this.updateProjection();
  }

  start(start) { // set by the user
    this.model.change((m) => { m.start = { ...start, center: start.center.map((v) => Math.round(v * 100) / 100), scale: Math.round(start.scale * 1e5) / 1e5 }; });
  }

  dragged(drag, place) { // the start while a handle is dragged
    const { center, scale } = drag.before;
    if (drag.kind === "move") return { frame: this.frame, scale, center: center.map((c, i) => c + place[i] - drag.from[i]) };
    const far = (p) => Math.hypot(p[0] - center[0], p[1] - center[1]);
    return { frame: this.frame, center, scale: scale * Math.max(far(place) / Math.max(far(drag.from), 1), 0.02) };
  }

  handle(at) { // the part of the model at a position on the screen: a corner scales it, the rest moves it
    if (!this.projection?.lines.length) return null;
    const from = this.views[0].toImage(at);
    const corners = this.corners();
    const [[left, top], , [right, bottom]] = corners;
    const near = HIT_RADIUS_PX / this.views[0].scale;
    for (const corner of corners) {
      if (Math.hypot(from[0] - corner[0], from[1] - corner[1]) <= near) return { kind: "scale", from };
    }
    const inside = from[0] > left - near && from[0] < right + near && from[1] > top - near && from[1] < bottom + near;
    return inside ? { kind: "move", from } : null;
  }

  corners() { // of the model in the picture, clockwise from the top left
    const all = this.projection.lines.flat();
    const [xs, ys] = [all.map((p) => p[0]), all.map((p) => p[1])];
    const [left, right, top, bottom] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    return [[left, top], [right, top], [right, bottom], [left, bottom]];
  }

  async updateProjection() { // of the model into the image, one request at a time
    this.outdated = true;
    if (this.requesting) return;
    this.requesting = true;
    while (this.outdated) {
      this.outdated = false;
      const [target, start] = [this.model.target, this.moving ?? this.model.start];
      try {
        this.projection = target && start ? await sendRequest("POST", `/api/outline?clip=${this.clip}`, { target, start }) : null;
      } catch (error) {
        this.projection = null;
        this.showMessage(error.message, true);
      }
      this.showFacts(target);
      this.paint();
    }
    this.requesting = false;
  }

  showFacts(target) {
    const shown = this.projection;
    const rows = shown ? [
      ["distance", `${shown.range_m.toFixed(1)} m`],
      ["width × height", `${shown.size_m[0].toFixed(2)} × ${shown.size_m[1].toFixed(2)} m`],
      ["in the picture", `${shown.size_px[0].toFixed(0)} × ${shown.size_px[1].toFixed(0)} px`],
      ["lines", String(target.segments.length)],
      ["starts in frame", String((this.moving ?? this.model.start).frame)],
    ] : [["model", target ? "not placed" : "none"]];
    this.facts.replaceChildren(...rows.flatMap(([term, value]) => [make("dt", { textContent: term }), make("dd", { textContent: value })]));
    this.problem.textContent = shown?.problem ?? "";
    this.warning.textContent = shown?.warning ?? "";
  }

  chooseLine(place) {
    const near = HIT_RADIUS_PX / this.views[0].scale;
    const gaps = (this.projection?.lines ?? []).map((points) => Math.min(...points.slice(1).map((b, i) => gap(place, points[i], b))));
    const best = gaps.indexOf(Math.min(...gaps));
    this.line = gaps[best] <= near ? best : null;
    if (this.line !== null) this.showMessage("Del removes this line from the model.");
    this.paint();
  }

  removeChosen() {
    if (this.line === null) return;
    const chosen = this.line;
    this.line = null;
    this.model.change((m) => { m.target = { ...m.target, segments: m.target.segments.filter((_, i) => i !== chosen) }; });
  }

  // --- learning, opening, saving -----------------------------------------------------------------------------------

  boxed() {
    if (this.box && Math.min(...[0, 1].map((i) => Math.abs(this.box[0][i] - this.box[1][i]))) < 8) this.box = null;
    if (this.box) this.showMessage("Now enter the true width of the vehicle, and learn the lines in the box.");
    this.buttons();
  }

  async learn() {
    const [xs, ys] = [0, 1].map((i) => this.box.map((p) => Math.round(p[i] * 100) / 100).sort((a, b) => a - b));
    if (!this.width.value) {
      this.showMessage("Enter the true width of the vehicle first: every distance is as accurate as it.", true);
      this.width.focus();
      return;
    }
    const half = this.halfWidth.value;
    const body = { frame: this.frame, box: [xs[0], ys[0], xs[1], ys[1]], width: Number(this.width.value), half_width: half ? Number(half) : null, name: this.name.value.trim() };
    await this.useModel(() => sendRequest("POST", `/api/learn?clip=${this.clip}`, body), "learned. Look closely: click a line that lies on a shadow or the background, and press Del. Then save.");
  }

  async open(input) {
    const [file] = input.files;
    input.value = "";
    if (file) await this.useModel(() => sendRequest("POST", `/api/model?clip=${this.clip}&frame=${this.frame}`, file), "opened. Drag the model onto the vehicle, and its corners to scale it. Then save.");
  }

  async useModel(request, text) {
    try {
      const { target, start, quality, doubted = false, notices = [] } = await request();
      this.box = null;
      this.model.change((m) => Object.assign(m, { target, start }));
      this.take("place");
      const judged = quality ? ` Found: ${quality}.` : "";
      this.showMessage([`${target.segments.length} lines ${text}${judged}`, ...notices].join(" Note: "), doubted);
    } catch (error) {
      this.showMessage(error.message, true);
    }
  }

  async save() {
    if (this.saveButton.disabled || this.readonly) return;
    await this.drafts.save(() => "Saved in follow.yaml. Next: follow.");
  }

  // --- drawing and keys --------------------------------------------------------------------------------------------

  drawings() {
    const here = (this.moving ?? this.model.start)?.frame === this.frame;
    const lines = (this.projection?.lines ?? []).map((points, i) => ({ points, color: i === this.line ? "#ff6b75" : "#4aa3ff", bold: i === this.line, faint: !here }));
    if (this.tool === "place" && lines.length) lines.push(...this.corners().map((corner) => ({ points: [corner], color: "#4aa3ff" })));
    if (this.box) {
      const [[ax, ay], [bx, by]] = this.box;
      lines.push({ points: [[ax, ay], [bx, ay], [bx, by], [ax, by]], closed: true, color: "#fff" });
    }
    return lines;
  }

  key(event) {
    const field = [this.width, this.halfWidth, document.body].includes(event.target);
    if (event.key === "Enter" && this.box && field) { event.preventDefault(); this.learn(); return; }
    const key = keyFor(event, this);
    if (key && this.press(key, event)) event.preventDefault();
  }

  press({ pressed, arrow }, { key, shiftKey }) { // returns whether the key has a function
    const { start } = this.model;
    const tool = Object.keys(EDITOR_TOOLS).find((name) => EDITOR_TOOLS[name][1] === pressed);
    const scaling = { "[": -1, "]": 1, "{": -1, "}": 1 }[key];
    if (tool && !(tool === "place" && !this.model.target)) this.take(tool);
    else if (arrow) this.arrow(arrow, shiftKey);
    else if (scaling && start) this.start({ ...start, frame: this.frame, scale: start.scale * (1 + scaling * (shiftKey ? 0.02 : 0.002)) });
    else if (pressed === "," || pressed === ".") this.player.goTo(this.player.place + (pressed === "," ? -1 : 1));
    else if (pressed === " ") this.player.play();
    else if (pressed === "escape") { if (this.box) this.box = null; else this.line = null; this.buttons(); this.paint(); }
    else if (pressed === "n") this.nextLine();
    else if (pressed === "delete" || pressed === "backspace") this.removeChosen();
    else if (pressed === "0") { this.views[0].fit(); this.paint(); }
    else if (pressed === "+" || pressed === "=" || pressed === "-") this.pointers.zoom(0, pressed === "-" ? 0.8 : 1.25, [this.views[0].width / 2, this.views[0].height / 2]);
    else return false;
    return true;
  }

  nextLine() {
    const count = this.model.target?.segments.length ?? 0;
    this.line = count ? ((this.line ?? -1) + 1) % count : null;
    this.paint();
  }

  arrow([x, y], far) {
    const { start } = this.model;
    const step = far ? 2 : 0.25;
    if (this.tool === "box") { this.stretch(x, y, far); return; }
    if (this.tool !== "place" || !start) { if (x) this.player.goTo(this.player.place + x); return; }
    this.start({ ...start, frame: this.frame, center: [start.center[0] + x * step, start.center[1] + y * step] });
  }

  stretch(x, y, far) { // the box by keys: moved, and with Shift its lower right corner
    const { size } = this.setup;
    this.box ??= [size.map((s) => s * 0.4), size.map((s) => s * 0.6)];
    const [a, b] = this.box;
    this.box = [far ? a : [a[0] + x, a[1] + y], [b[0] + x, b[1] + y]];
    this.boxed();
    this.paint();
  }
}

function gap(p, a, b) { // from a point to the line between two others
  const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
  const t = Math.min(Math.max(((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / (dx * dx + dy * dy || 1), 0), 1);
  return Math.hypot(p[0] - a[0] - t * dx, p[1] - a[1] - t * dy);
}

if (!customElements.get("pl-target")) customElements.define("pl-target", TargetEditor);
