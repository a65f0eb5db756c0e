// The pointer tools of the stereo editor: moving points, drawing lines and outlines.

import { PanZoom } from "./pan_zoom.js";
import { rounded, sortedCorners } from "./model.js";

export class PointerTools extends PanZoom {
  pointerLeft(i) {
    this.editor.magnified = null;
    this.editor.views[1 - i].epipolar = null;
  }

  doubleClicked() { this.inOrder(() => this.editor.finishDraft()); }

  cancelDrag() {
    this.editor.moving = null;
    if (this.editor.draft?.closed) this.editor.draft = null;
    super.cancelDrag();
  }

  beginDrag(i, at) {
    const { editor } = this;
    if (editor.tool === "vehicle" && !editor.draft) return { kind: "box", from: editor.views[i].toImage(at) };
    if (editor.tool !== "move") return { kind: "click" };
    const hit = editor.hit(i, at);
    if (hit) editor.choose(hit);
    return { kind: hit ? "point" : "pan" };
  }

  pointerMoved(i, place) {
    const { editor, drag } = this;
    editor.updateEpipolarLine(i, place);
    const working = editor.tool !== "move" || drag?.kind === "point";
    editor.magnified = working && drag?.kind !== "pan" ? { view: i, place } : null;
  }

  dragTo(i, place, at, drag) {
    const { editor } = this;
    if (drag.kind === "box" && this.movedFar(at)) {
      const [a, b] = [drag.from, place];
      editor.draft = { kind: "vehicle", view: i, closed: true, points: [a, [b[0], a[1]], b, [a[0], b[1]]] };
    } else if (drag.kind === "point" && (this.movedFar(at) || editor.moving)) editor.moving = place;
  }

  endDrag(i, place, drag, isClick, event) {
    const { editor } = this;
    if (drag?.kind === "pan") {
      if (isClick) editor.choose(null);
    } else if (drag?.kind === "point" && editor.moving) {
      this.inOrder(async () => {
        const snapped = await editor.snapped(i, place, event.altKey);
        editor.moving = null;
        editor.movePoint(snapped);
      });
    } else if (drag?.kind === "box" && editor.draft?.closed) {
      const points = sortedCorners(editor.draft.points).map(rounded);
      editor.draft = null;
      this.inOrder(() => editor.outlined(i, points));
    } else if (drag?.kind === "box" || drag?.kind === "click") {
      this.inOrder(async () => editor.clicked(i, await editor.snapped(i, place, event.altKey)));
    }
  }
}
