// Saving what is edited: drafts that outlast a reload, and what to do when the file was changed elsewhere meanwhile.

import { ask, make } from "./importer.js";

// Names of the parts of three states that differ: in this tab, in the file, and in what both began with.
export function differences(base, here, there) {
  const text = (parts, name) => JSON.stringify(parts[name]);
  const said = (parts, name) => {
    if (text(parts, name) === text(base, name)) return "";
    if (!(name in base)) return "new";
    return name in parts ? "changed" : "removed";
  };
  const names = [...new Set([base, here, there].flatMap(Object.keys))];
  return names.map((name) => ({ name, here: said(here, name), there: said(there, name), alike: text(here, name) === text(there, name) }))
    .filter((part) => !part.alike);
}

export class Keeper { // of an editor with model and say(); `parts` gives the named parts of a state
  constructor(editor, { address, file, parts, send }) {
    Object.assign(this, { editor, address, file, parts, send });
    this.key = `paceline draft of ${address}`;
    editor.model.listeners.push(() => this.note());
  }

  note() { // what is not saved stays with the tab
    const { model } = this.editor;
    try {
      if (model.dirty) sessionStorage.setItem(this.key, JSON.stringify({ revision: model.revision, saved: model.saved, text: model.text() }));
      else sessionStorage.removeItem(this.key);
    } catch { /* no room: the draft lives as long as the page */ }
  }

  recall() { // whether there was something
    const { model } = this.editor;
    const draft = JSON.parse(sessionStorage.getItem(this.key) ?? "null");
    if (!draft || draft.text === model.text()) return false;
    model.change((m) => m.restore(JSON.parse(draft.text)));
    Object.assign(model, { revision: draft.revision, saved: draft.saved }); // of the file that it was drawn on
    model.tell();
    return true;
  }

  async save(words) {
    const { model } = this.editor;
    try {
      model.accept(await ask("PUT", this.address, { ...this.send(model), revision: model.revision }));
      this.editor.say(words());
    } catch (error) {
      if (error.status === 409) await this.settle(words);
      else this.editor.say(`Not saved: ${error.message}`, true);
    }
  }

  async settle(words) { // the file is another one now
    const { model } = this.editor;
    let theirs;
    try {
      theirs = await ask("GET", this.address);
    } catch (error) {
      this.editor.say(`Not saved: ${error.message}`, true);
      return;
    }
    const other = new model.constructor({ ...this.editor.setup, ...theirs });
    const found = differences(this.parts(JSON.parse(model.saved)), this.parts(model.state()), this.parts(other.state()));
    const keep = async () => {
      model.revision = theirs.revision;
      await this.save(words);
    };
    if (!found.some((part) => part.there)) { await keep(); return; } // other parts of the file, which stay as they are
    this.choose(found, keep, () => {
      model.change((m) => m.restore(other.state()));
      Object.assign(model, { revision: theirs.revision, saved: other.saved });
      model.tell();
      this.editor.say(`What ${this.file} holds is shown. Undo brings back what you had drawn.`);
    });
  }

  choose(found, keep, take) {
    const rows = found.map(({ name, here, there }) => make("li", {}, make("strong", { textContent: name }),
      `: ${[there && `${there} in the file`, here && `${here} here`].filter(Boolean).join(", ")}`));
    const button = (text, act, title) => make("button", { className: "pl-button", type: "button", textContent: text, title,
      onclick: () => { dialog.close(); act(); } });
    const dialog = make("dialog", { className: "pl-dialog", "aria-label": "The file was changed elsewhere" },
      make("div", { className: "pl-subtitle", textContent: `${this.file} was changed elsewhere in the meantime` }),
      make("div", { className: "pl-fact", textContent: "Nothing is saved yet, and nothing is lost. What differs:" }), make("ul", {}, ...rows),
      make("div", { className: "ed-bar" }, button("Keep mine", keep, "Writes what is drawn here over it"),
        button("Take theirs", take, "Shows what the file holds; Undo brings back yours"), button("Decide later", () => {}, "Goes on with what is drawn here")));
    dialog.onclose = () => dialog.remove();
    document.body.append(dialog);
    dialog.showModal();
  }
}
