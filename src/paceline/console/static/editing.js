// What the editors share: loading, the tool bar, undo and redo, messages, and painting.

import { make, sendRequest } from "./importer.js";

export const HIT_RADIUS_PX = 12; // on the screen
export const READ_ONLY = "This folder cannot be written: you can look, but not change anything.";

export function pushButton(text, action, title = "") {
  return make("button", { className: "pl-button", type: "button", textContent: text, title, onclick: action });
}

export class EditorElement extends HTMLElement { // a subclass has a model, views, player, tool and hint, take() and drawings()
  async loadSetup(kind) { // loads the clip's set-up of this kind once; returns whether it has
    if (this.loaded) return false;
    this.loaded = true;
    this.clip = encodeURIComponent(this.getAttribute("clip"));
    try {
      this.setup = await sendRequest("GET", `/api/${kind}?clip=${this.clip}`);
    } catch (error) {
      this.append(make("div", { className: "pl-error", role: "alert", textContent: error.message }));
      return false;
    }
    return true;
  }

  get frame() { return this.player.frame; }

  buildTools(tools) { // the buttons of `tools`, {name: [text, key, hint]}, and those for undo and redo
    this.toolButtons = Object.fromEntries(Object.entries(tools).map(([tool, [text, key, hint]]) =>
      [tool, pushButton(text, () => this.take(tool), `${hint} (${key.toUpperCase()})`)]));
    this.undoButton = pushButton("Undo", () => this.model.undo(), "Ctrl-Z");
    this.redoButton = pushButton("Redo", () => this.model.redo(), "Ctrl-Y");
    return [...Object.values(this.toolButtons), this.undoButton, this.redoButton];
  }

  markTools() {
    for (const [tool, element] of Object.entries(this.toolButtons)) element.setAttribute("aria-pressed", String(tool === this.tool));
    this.undoButton.disabled = !this.model.past.length;
    this.redoButton.disabled = !this.model.future.length;
  }

  showMessage(text, bad = false) {
    this.hint.textContent = text;
    this.hint.classList.toggle("pl-error", bad);
  }

  resized() {
    for (const view of this.views) view.resize();
    this.paint();
  }

  paint() {
    if (this.painting) return;
    this.painting = true;
    requestAnimationFrame(() => {
      this.painting = false;
      this.views.forEach((view, i) => view.draw(this.drawings(i), this.magnified?.view === i ? this.magnified.place : null));
    });
  }
}
