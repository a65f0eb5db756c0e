// Importing a clip: recordings and their documents, chosen or dropped, uploaded one after the other.

const IMAGE_PATTERN = /\.(png|jpe?g|tiff?|bmp|pgm|ppm|webp)$/i;
const MEDIA_PATTERN = /\.(png|jpe?g|tiff?|bmp|pgm|ppm|webp|zip|mp4|mov|m4v|mkv|webm|avi|m?ts|mpe?g|ogv|mxf)$/i;
const YAML_PATTERN = /\.ya?ml$/i;
const RECORDING_KINDS = {
  stereo: ["Two fixed cameras at a road", {
    left: ["Left camera", "a video, a zip of images, or images"],
    right: ["Right camera", "a video, a zip of images, or images"],
    rig: ["Rig file", "rig.yaml of the two cameras; may follow later"],
  }],
  chase: ["One camera behind a vehicle", {
    video: ["Recording", "a video, a zip of images, or images"],
    camera: ["Camera file", "camera.yaml of the camera"],
    target: ["Model of the vehicle", "target.yaml; may be learned later"],
  }],
};
const YAML_SLOTS = ["rig", "camera", "target"];
const OPTIONAL_SLOTS = ["rig", "target"];

export function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  for (const name of ["role", "aria-label", "aria-pressed", "aria-live"]) {
    if (name in properties) element.setAttribute(name, properties[name]);
  }
  element.append(...children);
  return element;
}

export async function sendRequest(method, address, body) {
  const options = { method };
  if (body !== undefined) options.body = body instanceof Blob ? body : JSON.stringify(body);
  let answer;
  try {
    answer = await fetch(address, options);
  } catch {
    throw new Error("the console does not answer; is it still running?");
  }
  let found = {};
  try {
    found = await answer.json();
  } catch { /* an error page: the status is enough */ }
  if (!answer.ok) throw Object.assign(new Error(found.reason ?? `the console answers ${answer.status}`), { status: answer.status });
  return found;
}

// The files of a drop, including those in folders.
async function dropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return [...transfer.files];
  const files = [];
  async function walk(entry) {
    if (entry.isFile) {
      const file = await new Promise((done, failed) => entry.file(done, failed));
      files.push(Object.assign(file, { path: entry.fullPath }));
    } else {
      const reader = entry.createReader();
      for (;;) {
        const some = await new Promise((done, failed) => reader.readEntries(done, failed));
        if (!some.length) break;
        for (const inner of some) await walk(inner);
      }
    }
  }
  for (const entry of entries) await walk(entry);
  return files;
}

class Importer extends HTMLElement {
  connectedCallback() {
    if (this.firstChild) return;
    this.open = make("button", { className: "pl-button primary", textContent: "Import a clip", onclick: () => this.dialog.showModal() });
    this.name = make("input", { required: true, maxLength: 80, autocomplete: "off" });
    this.rate = make("input", { type: "number", min: 0.1, max: 10000, step: "any" });
    this.rateField = make("label", { className: "pl-field", hidden: true }, "Frames per second of the images", this.rate);
    this.error = make("div", { className: "pl-error", role: "alert" });
    this.missing = make("div", { className: "pl-fact" });
    this.progress = make("progress", { max: 1, value: 0, hidden: true });
    this.send = make("button", { className: "pl-button primary", textContent: "Import", disabled: true, onclick: () => this.run() });
    this.cancel = make("button", { className: "pl-button", textContent: "Cancel", onclick: () => this.stop() });
    this.places = make("div", { className: "pl-slots" });
    this.kinds = Object.fromEntries(Object.entries(RECORDING_KINDS).map(([kind, [title]]) =>
      [kind, make("button", { className: "pl-button", type: "button", textContent: title, onclick: () => this.setKind(kind) })]));
    this.dialog = make("dialog", { "aria-label": "Import a clip" },
      make("div", { className: "pl-subtitle", textContent: "Import a clip" }),
      make("div", { className: "pl-fact", textContent: "Drop a file on its place, or all of them anywhere here: names with left and right are sorted automatically." }),
      make("div", { className: "ed-bar", role: "group", "aria-label": "What recorded it" }, ...Object.values(this.kinds)),
      make("label", { className: "pl-field" }, "Name of the clip", this.name), this.places, this.rateField, this.missing, this.error, this.progress,
      make("div", { className: "pl-row" }, this.cancel, this.send));
    this.name.oninput = this.rate.oninput = () => this.show();
    this.dialog.oncancel = (event) => { event.preventDefault(); this.stop(); };
    this.dialog.ondragover = (event) => event.preventDefault();
    this.dialog.ondrop = async (event) => { event.preventDefault(); this.sort(await dropped(event.dataTransfer)); };
    this.append(this.open, this.dialog);
    this.setKind("stereo");
    window.addEventListener("beforeunload", (event) => { if (this.key) event.preventDefault(); });
    window.addEventListener("pagehide", () => this.discard());
  }

  setKind(kind) { // stereo or chase
    this.kind = kind;
    this.slots = {};
    this.files = Object.fromEntries(Object.keys(RECORDING_KINDS[kind][1]).map((slot) => [slot, []]));
    this.places.replaceChildren(...Object.keys(this.files).map((slot) => this.makeSlot(slot)));
    for (const [name, button] of Object.entries(this.kinds)) button.setAttribute("aria-pressed", String(name === kind));
    this.error.textContent = "";
    this.show();
  }

  makeSlot(slot) {
    const [title, what] = RECORDING_KINDS[this.kind][1][slot];
    const input = make("input", { type: "file", multiple: !YAML_SLOTS.includes(slot), onchange: () => this.take(slot, [...input.files]) });
    const description = make("span", { className: "pl-fact", textContent: what });
    const box = make("div", { className: "pl-slot" }, make("strong", { textContent: title }), description, input,
      make("button", { className: "pl-button", textContent: "Choose…", onclick: () => input.click() }));
    box.dataset.slot = slot;
    box.ondragover = (event) => { event.preventDefault(); box.classList.add("over"); };
    box.ondragleave = () => box.classList.remove("over");
    box.ondrop = async (event) => {
      event.preventDefault(); event.stopPropagation();
      box.classList.remove("over");
      const files = await dropped(event.dataTransfer);
      const fits = files.length === 1 || (!YAML_SLOTS.includes(slot) && files.every((file) => IMAGE_PATTERN.test(file.name)));
      if (fits) this.take(slot, files); else this.sort(files); // several kinds at once, dropped over this slot
    };
    this.slots[slot] = { box, description };
    return box;
  }

  sort(files) {
    const rest = files.filter((file) => MEDIA_PATTERN.test(file.name));
    const texts = files.filter((file) => YAML_PATTERN.test(file.name));
    const named = (slot) => texts.find((file) => new RegExp(slot, "i").test(file.name));
    for (const slot of Object.keys(this.files).filter((name) => YAML_SLOTS.includes(name))) {
      const found = named(slot) ?? (texts.length === 1 && slot !== "target" && !named("target") ? texts[0] : null);
      if (found) this.take(slot, [found]);
    }
    const path = (file) => (file.path ?? file.name).split("/").slice(-2).join("/");
    const folder = files[0]?.path?.split("/") ?? [];
    if (!this.name.value && folder.length > 2) this.name.value = folder[1].slice(0, 80);
    if (this.kind === "chase") {
      if (rest.length) this.take("video", rest);
      return;
    }
    const lefts = rest.filter((file) => /left|cam_?0|_l\b/i.test(path(file)));
    const rights = rest.filter((file) => /right|cam_?1|_r\b/i.test(path(file)));
    if (lefts.length && rights.length) { this.take("left", lefts); this.take("right", rights); }
    else if (rest.length === 2) { this.take("left", [rest[0]]); this.take("right", [rest[1]]); }
    else if (rest.length) this.error.textContent = "Cannot tell left from right by their names: drop them on their places.";
  }

  take(slot, files) {
    if (!YAML_SLOTS.includes(slot) && files.length > 1) files = files.filter((file) => IMAGE_PATTERN.test(file.name));
    this.files[slot] = files;
    this.error.textContent = "";
    if (!this.name.value && ["left", "video"].includes(slot) && files.length === 1) {
      this.name.value = files[0].name.replace(/\.\w+$/, "").replace(/[_-]?left$/i, "").slice(0, 80);
    }
    this.show();
  }

  show() {
    for (const [slot, { box, description }] of Object.entries(this.slots)) {
      const files = this.files[slot];
      box.classList.toggle("full", files.length > 0);
      description.textContent = !files.length ? RECORDING_KINDS[this.kind][1][slot][1] : files.length === 1 ? files[0].name : `${files.length} images`;
    }
    const images = Object.values(this.files).flat().some((file) => IMAGE_PATTERN.test(file.name) || /\.zip$/i.test(file.name));
    this.rateField.hidden = !images;
    const missing = [
      [!this.name.value.trim(), "a name"],
      ...Object.entries(this.files).map(([slot, files]) => [!files.length && !OPTIONAL_SLOTS.includes(slot), `the ${RECORDING_KINDS[this.kind][1][slot][0].toLowerCase()}`]),
      [images && !this.rate.value, "frames per second"],
    ].filter(([lacks]) => lacks).map(([, what]) => what);
    this.missing.textContent = missing.length ? `Still needed: ${missing.join(", ")}.` : "";
    this.send.disabled = missing.length > 0;
  }

  async run() {
    this.send.disabled = true;
    this.error.textContent = "";
    this.stopped = false;
    const all = Object.entries(this.files).flatMap(([slot, files]) => files.map((file) => [slot, file]));
    const total = all.reduce((sum, [, file]) => sum + file.size, 0) || 1;
    let sent = 0;
    this.progress.hidden = false;
    try {
      this.key = (await sendRequest("POST", "/api/import", { name: this.name.value.trim(), kind: this.kind })).key;
      for (const [slot, file] of all) {
        await this.upload(slot, file, (part) => { this.progress.value = (sent + part) / total; });
        sent += file.size;
      }
      this.progress.removeAttribute("value"); // indeterminate while the server checks it
      const { name } = await sendRequest("POST", `/api/import/${this.key}`, { rate: this.rate.value ? Number(this.rate.value) : null });
      this.key = null;
      location.href = `/setup?clip=${encodeURIComponent(name)}`;
    } catch (error) {
      this.discard();
      if (!this.stopped) this.error.textContent = error.message;
      this.progress.hidden = true;
      this.show();
    }
  }

  upload(slot, file, onProgress) {
    return new Promise((done, failed) => {
      const request = this.request = new XMLHttpRequest();
      request.open("PUT", `/api/import/${this.key}/${slot}?name=${encodeURIComponent(file.name)}`);
      request.upload.onprogress = (event) => onProgress(event.loaded);
      request.onload = () => {
        if (request.status === 200) return done();
        let reason = `the console answers ${request.status}`;
        try { reason = JSON.parse(request.responseText).reason; } catch { /* an error page */ }
        failed(new Error(reason));
      };
      request.onerror = request.onabort = () => failed(new Error(`${file.name} could not be sent`));
      request.send(file);
    });
  }

  discard() {
    if (this.key) fetch(`/api/import/${this.key}`, { method: "DELETE", keepalive: true }).catch(() => {}); // also as the page goes
    this.key = null;
  }

  stop() {
    this.stopped = true;
    this.request?.abort();
    this.discard();
    this.progress.hidden = true;
    this.dialog.close();
  }
}

class RigFile extends HTMLElement {
  connectedCallback() {
    if (this.firstChild) return;
    const error = make("div", { className: "pl-error", role: "alert" });
    const input = make("input", { type: "file", accept: ".yaml,.yml", hidden: true });
    input.onchange = async () => {
      try {
        await sendRequest("PUT", `/api/rig?clip=${encodeURIComponent(this.getAttribute("clip"))}`, input.files[0]);
        location.reload();
      } catch (problem) {
        error.textContent = problem.message;
        input.value = "";
      }
    };
    this.append(make("button", { className: "pl-button primary", textContent: "Add a rig file…", onclick: () => input.click() }), input, error);
  }
}

if (!customElements.get("pl-import")) {
  customElements.define("pl-import", Importer);
  customElements.define("pl-rig", RigFile);
}
