// The last frame of an active run, with outlines, particles and values of its vehicles.

import { make } from "./importer.js";
import { View } from "./view.js";

const CLOSE_UP_FACTOR = 3; // the size of a close-up, in sizes of the outline

class LiveView extends HTMLElement { // no attribute has the name of a field: NiceGUI would overwrite the field
  static observedAttributes = ["scene"];

  connectedCallback() {
    if (this.views) return;
    const count = Number(this.getAttribute("cameras"));
    this.views = (count === 1 ? ["camera"] : ["left", "right"]).map((side) => new View(side, [16, 9]));
    this.closeUp = null; // the vehicle in the close-up
    this.caption = make("div", { className: "pl-fact", role: "status" });
    this.choices = make("div", { className: "ed-bar", role: "group", "aria-label": "What is shown" });
    const boxes = this.views.map((view) => {
      view.canvas.setAttribute("aria-label", `${view.side} view`);
      return make("div", { className: "ed-view" }, view.canvas, make("span", { className: "tag", textContent: view.side }));
    });
    this.pictures = make("div", { className: "ed-views" }, ...boxes);
    this.pictures.style.gridTemplateColumns = `repeat(${count}, 1fr)`;
    this.append(make("div", { className: "pl-row pl-wrap" }, this.choices, this.caption), this.pictures);
    new ResizeObserver(() => this.paint()).observe(this.views[0].canvas);
    this.attributeChangedCallback();
  }

  async attributeChangedCallback() { // one frame at a time: while images load, only the latest scene is kept
    this.nextScene = this.getAttribute("scene");
    if (!this.views || this.loading) return;
    this.loading = true;
    while (this.nextScene) {
      const scene = JSON.parse(this.nextScene);
      this.nextScene = null;
      try {
        const images = await Promise.all(this.views.map((_, view) => this.picture(view, scene.frame)));
        this.views.forEach((view, i) => {
          view.image = images[i];
          view.size = scene.size ?? [images[i].width, images[i].height];
        });
        const [width, height] = this.views[0].size;
        this.pictures.style.aspectRatio = images.length * width / height;
        this.drawn = scene;
        this.caption.textContent = `frame ${scene.frame}, ${scene.time.toFixed(2)} s`;
        this.choose(this.closeUp);
      } catch (error) {
        this.caption.textContent = error.message;
      }
    }
    this.loading = false;
  }

  async picture(view, frame) {
    const clip = encodeURIComponent(this.getAttribute("clip"));
    const run = this.getAttribute("live"); // of a live run the latest reduced images are kept for a moment
    const where = run ? `/api/live?number=${run}&` : "/api/frame?";
    const answer = await fetch(`${where}clip=${clip}&view=${view}&frame=${frame}`);
    if (!answer.ok) throw new Error((await answer.json()).reason ?? "this frame cannot be shown");
    return createImageBitmap(await answer.blob());
  }

  choose(name) {
    this.closeUp = this.drawn.vehicles.some((v) => v.name === name) ? name : null;
    const button = (text, value) => make("button", { className: "pl-button", type: "button", textContent: text,
      "aria-pressed": String(this.closeUp === value), onclick: () => this.choose(value) });
    const names = this.drawn.vehicles.filter((v) => v.outlines.length).map((v) => v.name);
    const wanted = ["Whole image", ...names];
    if (wanted.join("\n") !== this.offeredChoices) {
      this.offeredChoices = wanted.join("\n");
      this.choices.replaceChildren(button("Whole image", null), ...names.map((n) => button(`Close-up of ${n}`, n)));
    }
    [...this.choices.children].forEach((element, i) => element.setAttribute("aria-pressed", String(this.closeUp === (i ? names[i - 1] : null))));
    this.paint();
  }

  paint() {
    if (!this.drawn) return;
    const closeUp = this.drawn.vehicles.find((v) => v.name === this.closeUp);
    this.views.forEach((view, i) => {
      view.fit();
      if (closeUp?.outlines[i]) view.show(closeUp.outlines[i].flat(Array.isArray(closeUp.outlines[i][0][0]) ? 1 : 0), CLOSE_UP_FACTOR);
      view.draw(this.drawn.vehicles.flatMap((v) => this.drawings(v, i)), null);
    });
  }

  drawings({ outlines, particles, color, label }, view) {
    const outline = outlines[view] ?? [];
    const lines = Array.isArray(outline[0]?.[0]) ? outline.map((points) => ({ points, color })) : [{ points: outline, closed: true, color }];
    const dots = { points: particles[view] ?? [], color: "#ffe26a", dots: true };
    const all = outline.flat(Array.isArray(outline[0]?.[0]) ? 1 : 0);
    const top = all.length ? [Math.min(...all.map((p) => p[0])), Math.min(...all.map((p) => p[1]))] : null;
    const text = top ? [{ points: [top], color, text: label }] : [];
    return [...lines, dots, ...text].filter((drawing) => drawing.points.length);
  }
}

if (!customElements.get("pl-live-view")) customElements.define("pl-live-view", LiveView);
