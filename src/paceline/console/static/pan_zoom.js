// Pointer events (mouse, pen, touch) on the views: panning and zooming; subclasses add tools.

const MAX_CLICK_MOVE_PX = 5; // on the screen: a longer movement is a drag

export class PanZoom {
  constructor(editor) { // has views, linked, paint() and showMessage()
    this.editor = editor;
    this.down = new Map(); // position of each pressed pointer
    this.drag = null; // {kind: pinch | pan | a kind of beginDrag(), start}
    this.queue = Promise.resolve(); // clicks need answers of the server: they take effect in their order
    editor.views.forEach((view, i) => this.listen(view.canvas, i));
  }

  listen(canvas, i) {
    const on = (name, act) => canvas.addEventListener(name, (event) => {
      const box = canvas.getBoundingClientRect();
      act(i, [event.clientX - box.left, event.clientY - box.top], event);
    }, { passive: false });
    on("wheel", (_, at, event) => { event.preventDefault(); this.zoom(i, Math.exp(-event.deltaY * 0.0015), at); });
    on("contextmenu", (_, at, event) => event.preventDefault());
    on("pointerdown", (_, at, event) => { canvas.setPointerCapture(event.pointerId); this.press(i, at, event); });
    on("pointermove", (_, at, event) => this.move(i, at, event));
    on("pointerup", (_, at, event) => this.release(i, at, event));
    on("pointercancel", (_, at, event) => { this.down.delete(event.pointerId); this.cancelDrag(); });
    on("pointerleave", () => { this.pointerLeft(i); this.editor.paint(); });
    on("dblclick", () => this.doubleClicked(i));
  }

  // Hooks for subclasses; `place` is in pixels of the image, `at` on the screen.
  beginDrag() { return { kind: "pan" }; } // a press: what is dragged
  pointerMoved() {} // pressed or not
  dragTo() {} // a movement of what beginDrag() returned
  endDrag() {}
  pointerLeft() {}
  doubleClicked() {}

  inOrder(act) { this.queue = this.queue.then(act).catch((error) => this.editor.showMessage(error.message, true)); }

  cancelDrag() {
    this.drag = null;
    this.editor.paint();
  }

  zoom(i, factor, at) {
    const { views, linked } = this.editor;
    views[i].zoom(factor, at);
    if (linked) for (const view of views) if (view !== views[i]) view.zoom(views[i].scale / view.scale, at);
    this.editor.paint();
  }

  pan(i, by) {
    const { views, linked } = this.editor;
    for (const view of linked ? views : [views[i]]) view.centre = view.centre.map((c, axis) => c - by[axis] / view.scale);
    this.editor.paint();
  }

  press(i, at, event) {
    document.activeElement?.blur?.();
    this.down.set(event.pointerId, at);
    if (this.down.size === 2) {
      this.cancelDrag();
      this.drag = { kind: "pinch" };
    } else if (event.button === 1 || event.button === 2) this.drag = { kind: "pan", last: at };
    else this.drag = { last: at, start: at, ...this.beginDrag(i, at, event) };
  }

  move(i, at, event) {
    const { drag } = this;
    const place = this.editor.views[i].toImage(at);
    this.pointerMoved(i, place, at);
    if (this.down.has(event.pointerId)) {
      if (drag?.kind === "pinch") this.pinch(i, event.pointerId, at);
      else if (drag?.kind === "pan") {
        this.pan(i, [at[0] - drag.last[0], at[1] - drag.last[1]]);
        drag.last = at;
      } else if (drag) this.dragTo(i, place, at, drag);
      this.down.set(event.pointerId, at);
    }
    this.editor.paint();
  }

  movedFar(at) { return Math.hypot(at[0] - this.drag.start[0], at[1] - this.drag.start[1]) >= MAX_CLICK_MOVE_PX; }

  pinch(i, id, at) {
    const [other] = [...this.down].filter(([key]) => key !== id).map(([, value]) => value);
    const before = this.down.get(id);
    const gap = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 10);
    this.pan(i, [(at[0] - before[0]) / 2, (at[1] - before[1]) / 2]);
    this.zoom(i, gap(at) / gap(before), [(at[0] + other[0]) / 2, (at[1] + other[1]) / 2]);
  }

  release(i, at, event) {
    if (!this.down.delete(event.pointerId)) return;
    const { drag } = this;
    if (drag?.kind === "pinch") {
      if (!this.down.size) this.drag = null;
      return;
    }
    const isClick = drag?.start && !this.movedFar(at);
    this.drag = null;
    this.endDrag(i, this.editor.views[i].toImage(at), drag, isClick, event);
    this.editor.paint();
  }
}
