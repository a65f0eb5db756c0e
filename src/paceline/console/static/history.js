// An edited document with undo and redo, and whether it is saved. Needs no browser.

const MAX_UNDO_STEPS = 200;

export class History { // a subclass has state(), a JSON value, and restore(state)
  begin() {
    this.saved = this.text();
    this.past = [];
    this.future = [];
    this.listeners = [];
    this.frozen = false; // read-only: nothing can be changed
  }

  text() { return JSON.stringify(this.state()); }
  get dirty() { return this.text() !== this.saved; }

  change(edit) { // one step that can be undone
    if (this.frozen) return;
    const before = this.text();
    edit(this);
    if (this.text() === before) return;
    this.past.push(before);
    if (this.past.length > MAX_UNDO_STEPS) this.past.shift();
    this.future = [];
    this.notify();
  }

  undo() { this.step(this.past, this.future); }
  redo() { this.step(this.future, this.past); }
  step(from, to) {
    if (!from.length) return;
    to.push(this.text());
    this.restore(JSON.parse(from.pop()));
    this.notify();
  }

  notify() { for (const listener of this.listeners) listener(); }
}
