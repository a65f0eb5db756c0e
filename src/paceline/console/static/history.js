// Something that is edited, with undo, and whether it is saved. No browser needed.

const DEPTH = 200; // steps that can be undone

export class History { // of a subclass with state(), what JSON can hold, and restore(state)
  begin() {
    this.saved = this.text();
    this.past = [];
    this.future = [];
    this.listeners = [];
    this.frozen = false; // where nothing can be saved
  }

  text() { return JSON.stringify(this.state()); }
  get dirty() { return this.text() !== this.saved; }

  change(edit) { // one step that can be undone
    if (this.frozen) return;
    const before = this.text();
    edit(this);
    if (this.text() === before) return;
    this.past.push(before);
    if (this.past.length > DEPTH) this.past.shift();
    this.future = [];
    this.tell();
  }

  undo() { this.step(this.past, this.future); }
  redo() { this.step(this.future, this.past); }
  step(from, to) {
    if (!from.length) return;
    to.push(this.text());
    this.restore(JSON.parse(from.pop()));
    this.tell();
  }

  tell() { for (const listener of this.listeners) listener(); }
}
