// Mouse, pen and fingers in the stereo editor: moving points, drawing.

import { Hands } from "./pan_zoom.js";
import { rounded, sortedCorners } from "./model.js";

export class Pointers extends Hands {
  left(i) {
    this.editor.magnified = null;
    this.editor.views[1 - i].epipolar = null;
  }

  twice() { this.then(() => this.editor.finishDraft()); }

  forget() {
    this.editor.moving = null;
    if (this.editor.draft?.closed) this.editor.draft = null;
    super.forget();
  }

  begin(i, at) {
    const { editor } = this;
    if (editor.tool === "vehicle" && !editor.draft) return { kind: "box", from: editor.views[i].toImage(at) };
    if (editor.tool !== "move") return { kind: "click" };
    const hit = editor.hit(i, at);
    if (hit) editor.choose(hit);
    return { kind: hit ? "point" : "pan" };
  }

  hover(i, place) {
    const { editor, drag } = this;
    editor.trace(i, place);
    const working = editor.tool !== "move" || drag?.kind === "point";
    editor.magnified = working && drag?.kind !== "pan" ? { view: i, place } : null;
  }

  pull(i, place, at, drag) {
    const { editor } = this;
    if (drag.kind === "box" && this.wandered(at)) {
      const [a, b] = [drag.from, place];
      editor.draft = { kind: "vehicle", view: i, closed: true, points: [a, [b[0], a[1]], b, [a[0], b[1]]] };
    } else if (drag.kind === "point" && (this.wandered(at) || editor.moving)) editor.moving = place;
  }

  finish(i, place, drag, still, event) {
    const { editor } = this;
    if (drag?.kind === "pan") {
      if (still) editor.choose(null);
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
  }
}
