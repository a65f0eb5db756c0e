// One camera's image on a canvas: zoom, pan, and everything drawn over it. Pixel centres are at whole numbers.

const HANDLE_RADIUS_PX = 5; // on the screen, as all below
const LABEL_HEIGHT_PX = 19;
const MAGNIFIER_RADIUS_PX = 84;
const MAGNIFIER_ZOOM = 8;
export const ITEM_COLORS = ["#4aa3ff", "#ff9d42", "#53c87d", "#d17cf0", "#ff6b75", "#41c9d6", "#e3c847", "#b9c2cc"];

export class View {
  constructor(side, size) {
    this.side = side;
    this.size = size;
    this.scale = 1;
    this.centre = [size[0] / 2 - 0.5, size[1] / 2 - 0.5];
    this.canvas = document.createElement("canvas");
    this.canvas.tabIndex = -1;
    this.image = null;
    this.epipolar = null;
  }

  get width() { return this.canvas.clientWidth; }
  get height() { return this.canvas.clientHeight; }
  get fitting() { return Math.min(this.width / this.size[0], this.height / this.size[1]) || 1; }

  fit() {
    this.scale = this.fitting;
    this.centre = [this.size[0] / 2 - 0.5, this.size[1] / 2 - 0.5];
  }

  resize() { // to the canvas's new size: what was shown stays in view, the whole image too
    if (!this.width) return;
    if (this.fitted) this.scale *= this.fitting / this.fitted;
    else this.fit();
    this.fitted = this.fitting;
  }

  toScreen([x, y]) {
    return [(x - this.centre[0]) * this.scale + this.width / 2, (y - this.centre[1]) * this.scale + this.height / 2];
  }

  toImage([x, y]) {
    return [(x - this.width / 2) / this.scale + this.centre[0], (y - this.height / 2) / this.scale + this.centre[1]];
  }

  zoom(factor, at) {
    this.resize(); // a canvas that has another size already, as beside what else the page shows now
    const before = this.toImage(at);
    this.scale = Math.min(Math.max(this.scale * factor, this.fitting / 2), 64);
    const after = this.toImage(at);
    this.centre = this.centre.map((c, i) => c + before[i] - after[i]);
  }

  show(points, room = 2.5) { // all of them, with room around
    this.resize();
    const xs = points.map((p) => p[0]);
    const ys = points.map((p) => p[1]);
    const span = [Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys)];
    this.centre = [(Math.max(...xs) + Math.min(...xs)) / 2, (Math.max(...ys) + Math.min(...ys)) / 2];
    this.scale = Math.min(Math.max(Math.min(this.width / (span[0] * room + 1), this.height / (span[1] * room + 1)), this.fitting), 24);
  }

  // `drawings`: {points, closed, color, chosen, bold, faint, point}, or {points, dots}, or {points, text}; `cursor`: the image place under the magnifier, if any.
  draw(drawings, cursor) {
    const ratio = window.devicePixelRatio || 1;
    const { canvas, width, height } = this;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const place = (p) => this.toScreen(p);
    this.picture(context, place, this.scale);
    this.marks(context, place, drawings);
    if (cursor) this.magnify(context, cursor, drawings);
  }

  picture(context, place, scale) {
    if (!this.image) return;
    const [x, y] = place([-0.5, -0.5]);
    context.imageSmoothingEnabled = scale < 3;
    context.drawImage(this.image, x, y, this.size[0] * scale, this.size[1] * scale);
  }

  marks(context, place, drawings) {
    this.labels = []; // drawn so far: others must not overlap them
    if (this.epipolar) this.line(context, place);
    for (const drawing of drawings) {
      const { points, closed, color, chosen, bold, faint, point } = drawing;
      if (drawing.dots || drawing.text) {
        this.annotate(context, place, drawing);
        continue;
      }
      context.globalAlpha = faint ? 0.4 : 1;
      context.beginPath();
      points.map(place).forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
      if (closed) context.closePath();
      context.lineJoin = "round";
      context.strokeStyle = "#000a";
      context.lineWidth = chosen || bold ? 4 : 3;
      context.stroke();
      context.strokeStyle = color;
      context.lineWidth = chosen || bold ? 2.4 : 1.4;
      context.stroke();
      if (chosen || points.length === 1) {
        points.map(place).forEach(([x, y], i) => {
          context.beginPath();
          context.arc(x, y, i === point ? HANDLE_RADIUS_PX + 2 : HANDLE_RADIUS_PX, 0, 7);
          context.fillStyle = i === point ? color : "#0006";
          context.fill();
          context.strokeStyle = i === point ? "#fff" : color;
          context.lineWidth = 1.6;
          context.stroke();
        });
      }
      context.globalAlpha = 1;
    }
  }

  annotate(context, place, { points, color, text }) {
    context.font = "600 13px system-ui, sans-serif";
    for (const [x, y] of points.map(place)) {
      context.fillStyle = text ? "#000b" : color;
      if (!text) {
        context.fillRect(x - 1, y - 1, 2, 2);
        continue;
      }
      const box = { x: x - 4, y: y - 24, width: context.measureText(text).width + 8 };
      const overlaps = (other) => Math.abs(other.y - box.y) < LABEL_HEIGHT_PX && other.x < box.x + box.width && box.x < other.x + other.width;
      while (this.labels.some(overlaps)) box.y -= 1;
      this.labels.push(box);
      context.fillRect(box.x, box.y, box.width, LABEL_HEIGHT_PX);
      context.fillStyle = "#fff";
      context.fillText(text, x, box.y + 14);
    }
  }

  line(context, place) {
    context.beginPath();
    this.epipolar.line.map(place).forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.strokeStyle = "#ffe26a";
    context.lineWidth = 1;
    context.stroke();
    context.font = "11px system-ui, sans-serif";
    context.fillStyle = "#ffe26a";
    let last = -1e9;
    for (const [metres, ...point] of this.epipolar.marks) {
      const [x, y] = place(point);
      context.fillRect(x - 1, y - 4, 2, 8);
      if (Math.abs(x - last) > 30) {
        context.fillText(`${metres} m`, x + 3, y - 5);
        last = x;
      }
    }
  }

  magnify(context, cursor, drawings) {
    const scale = Math.max(MAGNIFIER_ZOOM, this.scale * 2);
    const [sx, sy] = this.toScreen(cursor);
    const left = sx > this.width / 2 ? MAGNIFIER_RADIUS_PX + 10 : this.width - MAGNIFIER_RADIUS_PX - 10;
    const top = sy > this.height / 2 ? MAGNIFIER_RADIUS_PX + 10 : this.height - MAGNIFIER_RADIUS_PX - 10;
    const place = ([x, y]) => [left + (x - cursor[0]) * scale, top + (y - cursor[1]) * scale];
    context.save();
    context.beginPath();
    context.arc(left, top, MAGNIFIER_RADIUS_PX, 0, 7);
    context.fillStyle = "#000";
    context.fill();
    context.clip();
    this.picture(context, place, scale);
    this.marks(context, place, drawings.map((d) => ({ ...d, chosen: false })).filter((d) => d.points.length > 1));
    context.strokeStyle = "#ff5050";
    context.lineWidth = 1;
    context.beginPath();
    for (const [x, y] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(left + x * 5, top + y * 5);
      context.lineTo(left + x * 22, top + y * 22);
    }
    context.stroke();
    context.restore();
    context.beginPath();
    context.arc(left, top, MAGNIFIER_RADIUS_PX, 0, 7);
    context.strokeStyle = "#fff8";
    context.lineWidth = 1.5;
    context.stroke();
  }
}
