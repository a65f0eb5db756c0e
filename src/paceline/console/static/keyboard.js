// Keyboard input: keys shared by all editors, and those of the stereo editor, which allow drawing without a pointer.

import { rounded, VIEW_NAMES } from "./model.js";

const ARROW_KEYS = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, -1], arrowdown: [0, 1] };
const CROSS_STEP_PX = 16; // on the screen, per arrow key; 1 px with Shift

// The pressed key, {pressed, arrow}; null where it was undo, redo or save, or is not meant for the editor.
export function keyFor(event, editor) {
  const command = event.ctrlKey || event.metaKey;
  const pressed = event.key.toLowerCase();
  const done = (act) => { event.preventDefault(); act(); return null; };
  if (command && pressed === "s") return done(() => editor.save());
  if (event.target.closest?.("input, select, textarea, dialog")) return null;
  if (command && pressed === "z") return done(() => (event.shiftKey ? editor.model.redo() : editor.model.undo()));
  if (command && pressed === "y") return done(() => editor.model.redo());
  if (command || event.altKey) return null;
  const button = event.target.closest?.("button, a, summary"); // Space and Enter activate these
  return button && (pressed === " " || pressed === "enter") ? null : { pressed, arrow: ARROW_KEYS[pressed] };
}

export class Keyboard { // of the stereo editor
  constructor(editor, tools) {
    this.editor = editor;
    this.tools = Object.fromEntries(Object.entries(tools).map(([tool, [, key]]) => [key, tool]));
    this.cross = null; // {view, place}: where the next point is put, while it is moved by keys
    window.addEventListener("keydown", (event) => {
      const key = keyFor(event, editor);
      if (key && this.press(key, event.shiftKey)) event.preventDefault();
    });
  }

  press({ pressed, arrow }, shift) { // returns whether the key has a function
    const { editor } = this;
    if (arrow) this.move(arrow, shift);
    else if (pressed in this.tools) { this.cross = null; editor.take(this.tools[pressed]); }
    else if (pressed === " " && this.cross) this.addPoint();
    else if (pressed === " ") editor.player.play();
    else if (pressed === "x" && editor.tool !== "move") this.switchView();
    else if (pressed === "," || pressed === ".") editor.player.goTo(editor.player.place + (pressed === "," ? -1 : 1));
    else if (pressed === "enter" && editor.draft) editor.pointers.inOrder(() => editor.finishDraft());
    else if (pressed === "escape") this.leave();
    else if (pressed === "delete" || pressed === "backspace") editor.removeChosen();
    else if (pressed === "s") editor.toggleSnapping();
    else if (pressed === "n") this.next();
    else if (pressed === "0") { for (const view of editor.views) view.fit(); editor.paint(); }
    else if (pressed === "+" || pressed === "=" || pressed === "-") this.zoom(pressed === "-" ? 0.8 : 1.25);
    else return false;
    return true;
  }

  move([x, y], shift) { // the cross, the chosen point, or to another frame
    const { editor } = this;
    if (editor.tool !== "move") {
      document.activeElement?.blur?.();
      const now = this.cross ?? { view: 0, place: [...editor.views[0].centre] };
      const step = (shift ? 1 : CROSS_STEP_PX) / editor.views[now.view].scale;
      this.moveCross({ view: now.view, place: [now.place[0] + x * step, now.place[1] + y * step] });
    } else if (editor.chosen?.point === undefined) {
      if (x) editor.player.goTo(editor.player.place + x);
    } else {
      const { view, point } = editor.chosen;
      const [px, py] = editor.model.entry(editor.chosen)[VIEW_NAMES[view]][point];
      const step = shift ? 2 : 0.25;
      editor.movePoint(rounded([px + x * step, py + y * step]));
      const place = editor.model.entry(editor.chosen)[VIEW_NAMES[view]][point];
      editor.magnified = { view, place };
      editor.updateEpipolarLine(view, place);
    }
  }

  moveCross(cross) {
    this.cross = this.editor.magnified = cross;
    this.editor.updateEpipolarLine(cross.view, cross.place);
    this.editor.paint();
  }

  switchView() {
    const view = 1 - (this.cross?.view ?? 1);
    this.moveCross({ view, place: [...this.editor.views[view].centre] });
  }

  addPoint() {
    const { view, place } = this.cross;
    this.editor.pointers.inOrder(async () => this.editor.clicked(view, await this.editor.snapped(view, place, false)));
  }

  zoom(factor) { // about the cross, where there is one
    const { editor } = this;
    const { view, place } = this.cross ?? { view: 0, place: editor.views[0].centre };
    editor.pointers.zoom(view, factor, editor.views[view].toScreen(place));
  }

  leave() {
    const { editor } = this;
    this.cross = editor.magnified = null;
    if (editor.draft) {
      editor.draft = null;
      editor.paint();
    } else if (editor.tool !== "move") editor.take("move");
    else editor.choose(null);
  }

  next() { // chooses the next point of the chosen item, or of the first one
    const { editor } = this;
    const chosen = editor.chosen ?? editor.items()[0];
    const entry = editor.model.entry(chosen);
    if (!entry) return;
    const places = VIEW_NAMES.flatMap((side, view) => (entry[side] ?? []).map((_, point) => ({ view, point })));
    const now = places.findIndex(({ view, point }) => view === chosen.view && point === chosen.point);
    if (places.length) editor.choose({ kind: chosen.kind, id: chosen.id, ...places[(now + 1) % places.length] });
  }
}
