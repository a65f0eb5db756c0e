// The player below an editor: scrubbing, playing, and a cache of the latest images.

import { make } from "./importer.js";

const MAX_KEPT_IMAGES = 48;

export class Player { // of an editor with clip, views, showMessage() and frameShown()
  constructor(editor, views, { frames, times }) {
    Object.assign(this, { editor, views, frames, times });
    this.place = 0; // index of the shown frame
    this.pictures = new Map();
    this.scrub = make("input", { type: "range", min: 0, max: frames.length - 1, value: 0, "aria-label": "Frame" });
    this.scrub.oninput = () => this.goTo(Number(this.scrub.value));
    this.playButton = make("button", { className: "pl-button", type: "button", textContent: "Play", title: "Space", onclick: () => this.play() });
    this.time = make("span", { className: "pl-fact" });
    this.time.style.minWidth = "150px";
    this.element = make("div", { className: "ed-scrub" }, this.playButton, this.scrub, this.time);
  }

  get frame() { return this.frames[this.place]; }

  async goTo(place) {
    this.place = Math.min(Math.max(place, 0), this.frames.length - 1);
    this.scrub.value = this.place;
    this.time.textContent = `frame ${this.frame}, ${this.times[this.place].toFixed(2)} s`;
    const wanted = this.place;
    const { editor } = this;
    try {
      const images = await Promise.all(this.views.map((view) => this.picture(view, this.frames[wanted])));
      if (wanted !== this.place) return;
      editor.views.forEach((view, i) => { view.image = images[i]; });
      if (this.failed) { this.failed = false; editor.showMessage(editor.nextStep()); }
    } catch (error) {
      if (wanted !== this.place) return;
      this.failed = true;
      editor.views.forEach((view) => { view.image = null; });
      editor.showMessage(error.message, true);
    }
    editor.frameShown();
  }

  picture(view, frame) {
    const key = `${view}:${frame}`;
    const known = this.pictures.get(key);
    this.pictures.delete(key);
    const picture = known ?? this.load(view, frame);
    this.pictures.set(key, picture);
    if (this.pictures.size > MAX_KEPT_IMAGES) this.pictures.delete(this.pictures.keys().next().value);
    picture.catch(() => this.pictures.delete(key));
    return picture;
  }

  async load(view, frame) {
    const answer = await fetch(`/api/frame?clip=${this.editor.clip}&view=${view}&frame=${frame}`);
    if (!answer.ok) throw new Error((await answer.json()).reason ?? "this frame cannot be shown");
    return createImageBitmap(await answer.blob());
  }

  async play() {
    this.playing = !this.playing;
    this.playButton.textContent = this.playing ? "Pause" : "Play";
    while (this.playing) {
      const next = (this.place + 1) % this.frames.length;
      const wait = next ? 1000 * (this.times[next] - this.times[this.place]) : 600;
      const begun = performance.now();
      await this.goTo(next);
      await new Promise((done) => { setTimeout(done, Math.max(wait - (performance.now() - begun), 15)); });
    }
  }
}
