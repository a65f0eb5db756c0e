// Saving, drafts that survive a reload, and the choice between versions when the file was changed elsewhere.

import { make, sendRequest } from "./importer.js";

// The parts that differ between this tab (here), the file (there) and their common base, by name.
export function differences(base, here, there) {
  const text = (parts, name) => JSON.stringify(parts[name]);
  const change = (parts, name) => {
    if (text(parts, name) === text(base, name)) return "";
    if (!(name in base)) return "new";
    return name in parts ? "changed" : "removed";
  };
  const names = [...new Set([base, here, there].flatMap(Object.keys))];
  return names.map((name) => ({ name, here: change(here, name), there: change(there, name), same: text(here, name) === text(there, name) }))
    .filter((part) => !part.same);
}

export class DraftStore { // of an editor with model and showMessage(); `parts` gives the named parts of a state
  constructor(editor, { address, file, parts, send }) {
    Object.assign(this, { editor, address, file, parts, send });
    this.key = `paceline draft of ${address}`;
    editor.model.listeners.push(() => this.store());
  }

  store() { // unsaved changes, in the session storage of the tab
    const { model } = this.editor;
    try {
      if (model.dirty) sessionStorage.setItem(this.key, JSON.stringify({ revision: model.revision, saved: model.saved, text: model.text() }));
      else sessionStorage.removeItem(this.key);
    } catch { /* storage is full: the draft is lost with the page */ }
  }

  restoreDraft() { // returns whether there was one
    const { model } = this.editor;
    const draft = JSON.parse(sessionStorage.getItem(this.key) ?? "null");
    if (!draft || draft.text === model.text()) return false;
    model.change((m) => m.restore(JSON.parse(draft.text)));
    Object.assign(model, { revision: draft.revision, saved: draft.saved }); // of the file version that was edited
    model.notify();
    return true;
  }

  async save(message) {
    const { model } = this.editor;
    try {
      model.accept(await sendRequest("PUT", this.address, { ...this.send(model), revision: model.revision }));
      this.editor.showMessage(message());
    } catch (error) {
      if (error.status === 409) await this.resolveConflict(message);
      else this.editor.showMessage(`Not saved: ${error.message}`, true);
    }
  }

  async resolveConflict(message) { // after the file was changed elsewhere
    const { model } = this.editor;
    let theirs;
    try {
      theirs = await sendRequest("GET", this.address);
    } catch (error) {
      this.editor.showMessage(`Not saved: ${error.message}`, true);
      return;
    }
    const other = new model.constructor({ ...this.editor.setup, ...theirs });
    const found = differences(this.parts(JSON.parse(model.saved)), this.parts(model.state()), this.parts(other.state()));
    const keep = async () => {
      model.revision = theirs.revision;
      await this.save(message);
    };
    if (!found.some((part) => part.there)) { await keep(); return; } // only other parts of the file differ, and these stay as they are
    this.askWhichVersion(found, keep, () => {
      model.change((m) => m.restore(other.state()));
      Object.assign(model, { revision: theirs.revision, saved: other.saved });
      model.notify();
      this.editor.showMessage(`What ${this.file} holds is shown. Undo brings back what you had drawn.`);
    });
  }

  askWhichVersion(found, keep, take) {
    const rows = found.map(({ name, here, there }) => make("li", {}, make("strong", { textContent: name }),
      `: ${[there && `${there} in the file`, here && `${here} here`].filter(Boolean).join(", ")}`));
    const button = (text, act, title) => make("button", { className: "pl-button", type: "button", textContent: text, title,
      onclick: () => { dialog.close(); act(); } });
    const dialog = make("dialog", { className: "pl-dialog", "aria-label": "The file was changed elsewhere" },
      make("div", { className: "pl-subtitle", textContent: `${this.file} was changed elsewhere in the meantime` }),
      make("div", { className: "pl-fact", textContent: "Nothing is saved yet, and nothing is lost. What differs:" }), make("ul", {}, ...rows),
      make("div", { className: "ed-bar" }, button("Keep mine", keep, "Writes what is drawn here over it"),
        button("Take theirs", take, "Shows what the file holds; Undo brings back yours"), button("Decide later", () => {}, "Continues with what is drawn here")));
    dialog.onclose = () => dialog.remove();
    document.body.append(dialog);
    dialog.showModal();
  }
}
