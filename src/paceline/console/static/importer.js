// Importing a clip: two recordings and a rig file, chosen or dropped, sent one after the other as they are.

const IMAGE = /\.(png|jpe?g|tiff?|bmp|pgm|ppm|webp)$/i;
const MEDIA = /\.(png|jpe?g|tiff?|bmp|pgm|ppm|webp|zip|mp4|mov|m4v|mkv|webm|avi|m?ts|mpe?g|ogv|mxf)$/i;
const RIG = /\.ya?ml$/i;
const SLOTS = {
  left: ["Left camera", "a video, a zip of images, or images"],
  right: ["Right camera", "a video, a zip of images, or images"],
  rig: ["Rig file", "rig.yaml of the two cameras; may follow later"],
};

export function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  for (const name of ["role", "aria-label", "aria-pressed", "aria-live"]) {
    if (name in properties) element.setAttribute(name, properties[name]);
  }
  element.append(...children);
  return element;
}

export async function ask(method, address, body) {
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
  } catch { /* an error page: the status says enough */ }
  if (!answer.ok) throw Object.assign(new Error(found.reason ?? `the console answers ${answer.status}`), { status: answer.status });
  return found;
}

// Files of a drop, those of folders too.
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
    this.files = { left: [], right: [], rig: [] };
    this.open = make("button", { className: "pl-button primary", textContent: "Import a clip", onclick: () => this.dialog.showModal() });
    this.name = make("input", { required: true, maxLength: 80, autocomplete: "off" });
    this.rate = make("input", { type: "number", min: 0.1, max: 10000, step: "any" });
    this.rateField = make("label", { className: "pl-field", hidden: true }, "Frames per second of the images", this.rate);
    this.error = make("div", { className: "pl-error", role: "alert" });
    this.missing = make("div", { className: "pl-fact" });
    this.progress = make("progress", { max: 1, value: 0, hidden: true });
    this.send = make("button", { className: "pl-button primary", textContent: "Import", disabled: true, onclick: () => this.run() });
    this.cancel = make("button", { className: "pl-button", textContent: "Cancel", onclick: () => this.stop() });
    this.slots = {};
    const slots = make("div", { className: "pl-slots" }, ...Object.keys(SLOTS).map((slot) => this.makeSlot(slot)));
    this.dialog = make("dialog", { "aria-label": "Import a clip" },
      make("div", { className: "pl-subtitle", textContent: "Import a clip" }),
      make("div", { className: "pl-fact", textContent: "Drop a file on its place, or all of them anywhere here: names that say left and right sort themselves." }),
      make("label", { className: "pl-field" }, "Name of the clip", this.name), slots, this.rateField, this.missing, this.error, this.progress,
      make("div", { className: "pl-row" }, this.cancel, this.send));
    this.name.oninput = this.rate.oninput = () => this.show();
    this.dialog.oncancel = (event) => { event.preventDefault(); this.stop(); };
    this.dialog.ondragover = (event) => event.preventDefault();
    this.dialog.ondrop = async (event) => { event.preventDefault(); this.sort(await dropped(event.dataTransfer)); };
    this.append(this.open, this.dialog);
    this.show();
  }

  makeSlot(slot) {
    const [title, what] = SLOTS[slot];
    const input = make("input", { type: "file", multiple: slot !== "rig", onchange: () => this.take(slot, [...input.files]) });
    const told = make("span", { className: "pl-fact", textContent: what });
    const box = make("div", { className: "pl-slot" }, make("strong", { textContent: title }), told, input,
      make("button", { className: "pl-button", textContent: "Choose…", onclick: () => input.click() }));
    box.dataset.slot = slot;
    box.ondragover = (event) => { event.preventDefault(); box.classList.add("over"); };
    box.ondragleave = () => box.classList.remove("over");
    box.ondrop = async (event) => {
      event.preventDefault(); event.stopPropagation();
      box.classList.remove("over");
      this.take(slot, await dropped(event.dataTransfer));
    };
    this.slots[slot] = { box, told };
    return box;
  }

  sort(files) {
    const rest = files.filter((file) => MEDIA.test(file.name));
    const texts = files.filter((file) => RIG.test(file.name));
    const rig = texts.find((file) => /rig/i.test(file.name)) ?? (texts.length === 1 ? texts[0] : null);
    if (rig) this.take("rig", [rig]);
    const path = (file) => (file.path ?? file.name).split("/").slice(-2).join("/");
    const folder = files[0]?.path?.split("/") ?? [];
    if (!this.name.value && folder.length > 2) this.name.value = folder[1].slice(0, 80);
    const lefts = rest.filter((file) => /left|cam_?0|_l\b/i.test(path(file)));
    const rights = rest.filter((file) => /right|cam_?1|_r\b/i.test(path(file)));
    if (lefts.length && rights.length) { this.take("left", lefts); this.take("right", rights); }
    else if (rest.length === 2) { this.take("left", [rest[0]]); this.take("right", [rest[1]]); }
    else if (rest.length) this.error.textContent = "Which of them are left and which right? Drop them on their places.";
  }

  take(slot, files) {
    if (slot !== "rig" && files.length > 1) files = files.filter((file) => IMAGE.test(file.name));
    this.files[slot] = files;
    this.error.textContent = "";
    if (!this.name.value && slot === "left" && files.length === 1) {
      this.name.value = files[0].name.replace(/\.\w+$/, "").replace(/[_-]?left$/i, "").slice(0, 80);
    }
    this.show();
  }

  show() {
    for (const [slot, { box, told }] of Object.entries(this.slots)) {
      const files = this.files[slot];
      box.classList.toggle("full", files.length > 0);
      told.textContent = !files.length ? SLOTS[slot][1] : files.length === 1 ? files[0].name : `${files.length} images`;
    }
    const images = [...this.files.left, ...this.files.right].some((file) => IMAGE.test(file.name) || /\.zip$/i.test(file.name));
    this.rateField.hidden = !images;
    const missing = [
      [!this.name.value.trim(), "a name"], [!this.files.left.length, "the left camera"], [!this.files.right.length, "the right camera"],
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
      this.key = (await ask("POST", "/api/import", { name: this.name.value.trim() })).key;
      for (const [slot, file] of all) {
        await this.upload(slot, file, (part) => { this.progress.value = (sent + part) / total; });
        sent += file.size;
      }
      this.progress.removeAttribute("value"); // it is being checked; nobody knows how long
      const { name } = await ask("POST", `/api/import/${this.key}`, { rate: this.rate.value ? Number(this.rate.value) : null });
      this.key = null;
      location.href = `/setup?clip=${encodeURIComponent(name)}`;
    } catch (error) {
      this.giveUp();
      if (!this.stopped) this.error.textContent = error.message;
      this.progress.hidden = true;
      this.show();
    }
  }

  upload(slot, file, tell) {
    return new Promise((done, failed) => {
      const request = this.request = new XMLHttpRequest();
      request.open("PUT", `/api/import/${this.key}/${slot}?name=${encodeURIComponent(file.name)}`);
      request.upload.onprogress = (event) => tell(event.loaded);
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

  giveUp() {
    if (this.key) ask("DELETE", `/api/import/${this.key}`).catch(() => {});
    this.key = null;
  }

  stop() {
    this.stopped = true;
    this.request?.abort();
    this.giveUp();
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
        await ask("PUT", `/api/rig?clip=${encodeURIComponent(this.getAttribute("clip"))}`, input.files[0]);
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
