// Mouse, pen and fingers on the two pictures: panning, zooming, moving points, drawing.

import { rounded, sortedCorners } from "./model.js";

const STILL = 5; // px on the screen that a click may wander

export class Pointers {
  constructor(editor) {
    this.editor = editor;
    this.down = new Map(); // where each finger or button is
    this.drag = null; // {kind: pinch | pan | box | click | point, ...}
    this.turn = Promise.resolve(); // what clicks do ask the server; they take effect in their order
    editor.views.forEach((view, i) => this.listen(view.canvas, i));
  }

  listen(canvas, i) {
    const { editor } = this;
    const on = (name, act) => canvas.addEventListener(name, (event) => {
      const box = canvas.getBoundingClientRect();
      act(i, [event.clientX - box.left, event.clientY - box.top], event);
    }, { passive: false });
    on("wheel", (_, at, event) => { event.preventDefault(); this.zoom(i, Math.exp(-event.deltaY * 0.0015), at); });
    on("contextmenu", (_, at, event) => event.preventDefault());
    on("pointerdown", (_, at, event) => { canvas.setPointerCapture(event.pointerId); this.press(i, at, event); });
    on("pointermove", (_, at, event) => this.move(i, at, event));
    on("pointerup", (_, at, event) => this.release(i, at, event));
    on("pointercancel", (_, at, event) => { this.down.delete(event.pointerId); this.forget(); });
    on("pointerleave", () => { editor.magnified = null; editor.views[1 - i].epipolar = null; editor.paint(); });
    on("dblclick", () => this.then(() => editor.finishDraft()));
  }

  then(act) { this.turn = this.turn.then(act).catch((error) => this.editor.say(error.message, true)); }

  forget() {
    this.drag = null;
    this.editor.moving = null;
    this.editor.paint();
  }

  zoom(i, factor, at) {
    const { views, linked } = this.editor;
    views[i].zoom(factor, at);
    if (linked) views[1 - i].zoom(views[i].scale / views[1 - i].scale, at);
    this.editor.paint();
  }

  pan(i, by) {
    const { views, linked } = this.editor;
    for (const view of linked ? views : [views[i]]) view.centre = view.centre.map((c, axis) => c - by[axis] / view.scale);
    this.editor.paint();
  }

  press(i, at, event) {
    const { editor } = this;
    document.activeElement?.blur?.();
    this.down.set(event.pointerId, at);
    if (this.down.size === 2) {
      this.forget();
      if (editor.draft?.closed) editor.draft = null;
      this.drag = { kind: "pinch" };
    } else if (event.button === 1 || event.button === 2) this.drag = { kind: "pan", last: at };
    else if (editor.tool === "vehicle" && !editor.draft) this.drag = { kind: "box", from: editor.views[i].toImage(at), start: at };
    else if (editor.tool !== "move") this.drag = { kind: "click" };
    else {
      const hit = editor.hit(i, at);
      this.drag = hit ? { kind: "point", start: at } : { kind: "pan", last: at, start: at };
      if (hit) editor.choose(hit);
    }
  }

  move(i, at, event) {
    const { editor, drag } = this;
    const place = editor.views[i].toImage(at);
    editor.trace(i, place);
    const working = editor.tool !== "move" || drag?.kind === "point";
    editor.magnified = working && drag?.kind !== "pan" ? { view: i, place } : null;
    if (this.down.has(event.pointerId)) {
      if (drag?.kind === "pinch") this.pinch(i, event.pointerId, at);
      else if (drag?.kind === "pan") {
        this.pan(i, [at[0] - drag.last[0], at[1] - drag.last[1]]);
        drag.last = at;
      } else if (drag?.kind === "box") this.stretch(i, at, place);
      else if (drag?.kind === "point" && this.wandered(at)) editor.moving = place;
      this.down.set(event.pointerId, at);
    }
    editor.paint();
  }

  wandered(at) { return Math.hypot(at[0] - this.drag.start[0], at[1] - this.drag.start[1]) >= STILL || this.editor.moving; }

  pinch(i, id, at) {
    const [other] = [...this.down].filter(([key]) => key !== id).map(([, value]) => value);
    const before = this.down.get(id);
    const gap = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 10);
    this.pan(i, [(at[0] - before[0]) / 2, (at[1] - before[1]) / 2]);
    this.zoom(i, gap(at) / gap(before), [(at[0] + other[0]) / 2, (at[1] + other[1]) / 2]);
  }

  stretch(i, at, place) {
    if (!this.wandered(at)) return;
    const [a, b] = [this.drag.from, place];
    this.editor.draft = { kind: "vehicle", view: i, closed: true, points: [a, [b[0], a[1]], b, [a[0], b[1]]] };
  }

  release(i, at, event) {
    if (!this.down.delete(event.pointerId)) return;
    const { editor, drag } = this;
    if (drag?.kind === "pinch") {
      if (!this.down.size) this.drag = null;
      return;
    }
    this.drag = null;
    const place = editor.views[i].toImage(at);
    if (drag?.kind === "pan") {
      if (drag.start && Math.hypot(at[0] - drag.start[0], at[1] - drag.start[1]) < STILL) editor.choose(null);
    } else if (drag?.kind === "point" && editor.moving) {
      this.then(async () => {
        const put = await editor.snapped(i, place, event.altKey);
        editor.moving = null;
        editor.put(put);
      });
    } else if (drag?.kind === "box" && editor.draft?.closed) {
      const points = sortedCorners(editor.draft.points).map(rounded);
      editor.draft = null;
      this.then(() => editor.outlined(i, points));
    } else if (drag?.kind === "box" || drag?.kind === "click") {
      this.then(async () => editor.clicked(i, await editor.snapped(i, place, event.altKey)));
    }
    editor.paint();
  }
}
