// The drawn set-up: paths by name and vehicles in order, with undo. Needs no browser.

import { History } from "./history.js";

export const VIEW_NAMES = ["left", "right"];

export class Model extends History {
  constructor({ paths, vehicles, sitePaths, revision }) {
    super();
    Object.assign(this, { paths, vehicles, sitePaths, revision });
    this.begin();
  }

  state() { return [this.paths, this.vehicles]; }
  restore([paths, vehicles]) { Object.assign(this, { paths, vehicles }); }
  get allPaths() { return { ...this.sitePaths, ...this.paths }; }

  accept({ paths, vehicles, revision }) { // as the server has saved them
    Object.assign(this, { paths, vehicles, revision });
    this.saved = this.text();
    this.notify();
  }

  entry(chosen) {
    if (!chosen) return undefined;
    return chosen.kind === "path" ? this.paths[chosen.id] : this.vehicles[chosen.id];
  }

  freeName(stem, taken) {
    for (let number = 0; ; number += 1) if (!taken.includes(`${stem}${number}`)) return `${stem}${number}`;
  }

  addPath(entry) {
    const name = this.freeName("lane", Object.keys(this.allPaths));
    this.paths[name] = entry;
    return { kind: "path", id: name };
  }

  addVehicle(entry) {
    const id = this.freeName("v", this.vehicles.map((v) => v.id));
    this.vehicles.push({ id, ...entry });
    return { kind: "vehicle", id: this.vehicles.length - 1 };
  }

  rename(chosen, name) {
    if (chosen.kind === "vehicle") {
      if (!this.vehicles.some((v, i) => v.id === name && i !== chosen.id)) this.vehicles[chosen.id].id = name;
      return chosen;
    }
    if (name in this.allPaths) return chosen;
    this.paths = Object.fromEntries(Object.entries(this.paths).map(([key, value]) => [key === chosen.id ? name : key, value]));
    for (const vehicle of this.vehicles) if (vehicle.path === chosen.id) vehicle.path = name;
    return { ...chosen, id: name };
  }

  remove(chosen) {
    if (chosen.kind === "vehicle") this.vehicles.splice(chosen.id, 1);
    else {
      delete this.paths[chosen.id];
      for (const vehicle of this.vehicles) if (vehicle.path === chosen.id) delete vehicle.path;
    }
  }
}

// Keys in the order of the file format, as a person would write them.
export function ordered(entry) {
  const keys = ["shape", "id", "path", "frame", "left", "right", "points", "lateral_offset", "limit", "plane", "speed"];
  return Object.fromEntries(keys.filter((key) => entry[key] !== undefined && entry[key] !== null).map((key) => [key, entry[key]]));
}

// Four corners, clicked in any order, as top-left, top-right, bottom-right, bottom-left.
export function sortedCorners(points) {
  const cx = points.reduce((sum, p) => sum + p[0], 0) / 4;
  const cy = points.reduce((sum, p) => sum + p[1], 0) / 4;
  const around = [...points].sort((a, b) => Math.atan2(a[1] - cy, a[0] - cx) - Math.atan2(b[1] - cy, b[0] - cx));
  let best = around;
  let least = Infinity;
  for (let turn = 0; turn < 4; turn += 1) {
    const q = [...around.slice(turn), ...around.slice(0, turn)];
    const sides = q.map((p, i) => [q[(i + 1) % 4][0] - p[0], q[(i + 1) % 4][1] - p[1]]);
    const score = -(sides[0][0] - sides[2][0] + sides[1][1] - sides[3][1]);
    if (score < least) [least, best] = [score, q];
  }
  return best;
}

export function rounded(point) { return point.map((value) => Math.round(value * 100) / 100); }
