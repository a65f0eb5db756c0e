// The list beside the views: every path and vehicle with its fields and its checked geometry.

import { make } from "./importer.js";
import { ITEM_COLORS } from "./view.js";
import { ordered } from "./model.js";

const OFFSET_TEXT = "Metres from the drawn line to the lane centre, positive to the right of travel";
const COVERAGE_95 = 1.959963984540054; // standard deviations on each side of a 95 % interval

const uncertain = (value, half, unit) => { // half with two significant digits, the value to the same decimal
  const decimals = half > 0 ? Math.max(0, 1 - Math.floor(Math.log10(Number(half.toPrecision(2))))) : 1;
  return `${value.toFixed(decimals)} ± ${half.toFixed(decimals)} ${unit}`;
};
const metres = (value, digits = 1) => `${value.toFixed(digits)} m`;

function facts(kind, found) {
  if (!found || found.problem) return [];
  const list = [];
  if (kind === "path") {
    list.push(["from the cameras", `${metres(found.near_m, 0)} to ${metres(found.far_m, 0)}`]);
    list.push(["direction known to", `± ${(COVERAGE_95 * found.direction_std_deg).toPrecision(2)}°`]);
    if (found.beside) list.push([`beside ${found.beside}`, metres(found.gap_m, 2)]);
  } else {
    list.push(["distance", uncertain(found.distance_m, COVERAGE_95 * found.distance_std_m, "m")]);
    list.push(["width × height", `${found.width_m.toFixed(2)} × ${metres(found.height_m, 2)}`]);
    list.push(["views agree to", `${found.epipolar_px.toFixed(1)} px`]);
    if (found.beside_lane_centre_m !== undefined) list.push(["beside its lane centre", metres(found.beside_lane_centre_m, 2)]);
  }
  return list;
}

export class ItemList {
  constructor(editor) {
    this.editor = editor;
    this.paths = make("div");
    this.vehicles = make("div");
    const section = (title, button, list) => make("section", { className: "pl-panel", "aria-label": title },
      make("div", { className: "pl-row" }, make("div", { className: "pl-subtitle", textContent: title }), button), list);
    this.element = make("div", { className: "ed-side" },
      section("Paths", editor.lanesButton, this.paths), section("Vehicles", editor.vehiclesButton, this.vehicles));
  }

  show() {
    const { model, checks } = this.editor;
    const site = Object.keys(model.sitePaths).map((name) => make("div", { className: "pl-fact", textContent: `${name}: from the site file` }));
    const paths = Object.entries(model.paths).map(([name, entry], i) =>
      this.item({ kind: "path", id: name }, name, entry, checks?.paths[name], ITEM_COLORS[i % ITEM_COLORS.length]));
    const vehicles = model.vehicles.map((entry, i) =>
      this.item({ kind: "vehicle", id: i }, entry.id, entry, checks?.vehicles[i], ITEM_COLORS[i % ITEM_COLORS.length]));
    const none = (text) => [make("div", { className: "pl-fact", textContent: text })];
    this.paths.replaceChildren(...site, ...(paths.length || site.length ? paths : none("None. Draw a road line that the vehicles follow, in both views.")));
    this.vehicles.replaceChildren(...(vehicles.length ? vehicles : none("None. Outline a flat front, rear or side, in both views.")));
  }

  item(chosen, name, entry, found, color) {
    const { editor } = this;
    const now = editor.isChosen(chosen);
    const dot = make("span", { className: "ed-dot" });
    dot.style.background = color;
    const title = make("button", { className: "pl-button", textContent: "Show", onclick: (event) => { event.stopPropagation(); editor.show(chosen); } });
    const box = make("div", { className: `ed-item${now ? " chosen" : ""}`, onclick: () => { if (!editor.isChosen(chosen)) editor.choose(chosen); } },
      make("header", {}, dot, make("span", { textContent: name }), title));
    const list = facts(chosen.kind, found);
    if (list.length) {
      box.append(make("dl", {}, ...list.flatMap(([term, value]) => [make("dt", { textContent: term }), make("dd", { textContent: value })])));
    }
    if (found?.problem) box.append(make("p", { className: "problem", textContent: found.problem }));
    if (found?.warning) box.append(make("p", { className: "warning", textContent: found.warning }));
    if (!editor.readonly) box.append(...this.corrections(chosen, entry, found));
    if (now && !editor.readonly) box.append(...this.fields(chosen, name, entry));
    return box;
  }

  corrections(chosen, entry, found) { // of a vehicle that is beside its lane, one click each
    const { model } = this.editor;
    const buttons = [];
    const offer = (text, title, change) => buttons.push(make("button", { className: "pl-button", type: "button", textContent: text, title,
      onclick: (event) => { event.stopPropagation(); model.change(change); } }));
    if (found?.nearer_path) {
      offer(`Assign to ${found.nearer_path}`, "The lane whose centre is nearest", (m) => {
        m.vehicles[chosen.id] = ordered({ ...m.vehicles[chosen.id], path: found.nearer_path });
      });
    }
    if (entry.path in model.paths) { // a lane of the site file is not changed here
      for (const [travel, offset] of Object.entries(found?.lane_centres_m ?? {})) {
        const rounded = Math.round(offset * 100) / 100;
        offer(`Set lane centre to ${rounded.toFixed(2).replace("-", "−")} m (${travel})`, `Direction of travel: ${travel}. ${OFFSET_TEXT}`, (m) => {
          m.paths[entry.path] = ordered({ ...m.paths[entry.path], lateral_offset: rounded });
        });
      }
    }
    return buttons.length ? [make("div", { className: "ed-bar" }, ...buttons)] : [];
  }

  fields(chosen, name, entry) {
    const { editor } = this;
    const set = (key, value) => editor.model.change((m) => {
      const changed = ordered({ ...m.entry(chosen), [key]: value });
      if (chosen.kind === "path") m.paths[chosen.id] = changed; else m.vehicles[chosen.id] = changed;
    });
    const field = (label, input) => make("label", {}, label, input);
    const select = (options, value, key) => {
      const element = make("select", { onchange: () => set(key, element.value || undefined) });
      for (const [option, text] of options) element.append(make("option", { value: option, textContent: text, selected: option === (value ?? "") }));
      return element;
    };
    const number = (value, key, step) => {
      const element = make("input", { type: "number", step, value: value ?? "" });
      element.onchange = () => set(key, element.value === "" ? undefined : Number(element.value));
      return element;
    };
    const naming = make("input", { value: name, maxLength: 100 });
    naming.onchange = () => editor.model.change((m) => { if (naming.value.trim()) editor.chosen = m.rename(chosen, naming.value.trim()); });
    const fields = [field("name", naming)];
    if (chosen.kind === "path") {
      fields.push(field("shape", select([["line", "straight"], ["curve", "curve"]], entry.shape, "shape")));
      const offset = field("line to lane centre, m", number(entry.lateral_offset, "lateral_offset", 0.05));
      offset.title = OFFSET_TEXT;
      const limit = make("input", { value: entry.limit ?? "", placeholder: "30 mph", maxLength: 40 });
      limit.onchange = () => set("limit", limit.value.trim() || undefined);
      fields.push(offset, field("speed limit", limit));
    } else {
      const names = Object.keys(editor.model.allPaths).map((path) => [path, path]);
      fields.push(field("path", select([["", "none"], ...names], entry.path, "path")));
      const usual = entry.path ? "usual: front" : "usual: any plane";
      fields.push(field("flat part", select([["", usual], ["front", "front or rear"], ["side", "side"], ["free", "any plane"]], entry.plane, "plane")));
      fields.push(make("label", {}, "outlined in frame", make("span", { textContent: String(entry.frame) })));
    }
    const act = (text, action) => make("button", { className: "pl-button", textContent: text, onclick: (event) => { event.stopPropagation(); action(); } });
    const drawn = ["left", "right"].filter((side) => entry[side]?.length);
    const row = make("div", { className: "ed-bar" });
    for (const side of drawn) {
      const other = side === "left" ? "right" : "left";
      const button = act(`Propose ${other}`, () => editor.proposals.other(chosen, side === "left" ? 0 : 1));
      button.title = `Find in the ${other} view what is drawn in the ${side} one`;
      row.append(button);
    }
    row.append(act("Remove", () => editor.remove(chosen)));
    return [...fields, row];
  }
}
