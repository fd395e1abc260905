// The profile that is drawn by hand: one command per decision, dragged with a pointer or set with keys.

class ProfileEditor {
  constructor(holder, told, changed) {
    Object.assign(this, { holder, told, changed });
    this.commands = [0];
    this.at = 0;
    this.ghost = null;
    holder.tabIndex = 0;
    holder.setAttribute("role", "group");
    holder.setAttribute("aria-label", "Commands of the driven vehicle over time");
    holder.addEventListener("pointerdown", (event) => this.begin(event));
    holder.addEventListener("pointermove", (event) => this.drag(event));
    for (const kind of ["pointerup", "pointercancel"]) holder.addEventListener(kind, () => { this.last = null; });
    holder.addEventListener("keydown", (event) => this.press(event));
    let width = 0;
    new ResizeObserver(() => {
      if (this.grid && holder.clientWidth !== width) this.draw();
      width = holder.clientWidth;
    }).observe(holder);
  }

  // Decisions of the world as it is now; a profile that is too short holds its last command.
  fit(grid, until, ghost) {
    Object.assign(this, { grid, ghost });
    this.seen = Math.min(grid.steps, Math.max(Math.ceil((until - grid.first_s) / grid.step_s), 10));
    const last = this.commands[this.commands.length - 1];
    while (this.commands.length < grid.steps) this.commands.push(last);
    this.commands.length = grid.steps;
    this.at = Math.min(this.at, this.seen - 1);
    this.draw();
  }

  take(commands) {
    this.commands = commands.slice();
    if (this.grid) this.fit(this.grid, this.until, this.ghost);
  }

  get until() { return this.grid.first_s + this.seen * this.grid.step_s; }

  bounded(value) { return Math.min(Math.max(value, this.grid.low_mps2), this.grid.high_mps2); }

  draw() {
    const { first_s, step_s, low_mps2: low, high_mps2: high } = this.grid;
    const width = Math.max(this.holder.clientWidth, 200);
    const [left, right, top, height] = [34, 8, 10, 220];
    const bottom = height - 34;
    this.x = (t) => left + (t / this.until) * (width - left - right);
    this.y = (v) => bottom - ((v - low) / (high - low || 1)) * (bottom - top);
    this.time = (x) => ((x - left) / (width - left - right)) * this.until;
    this.value = (y) => low + ((bottom - y) / (bottom - top)) * (high - low);
    const svg = draw("svg", { width, height, viewBox: `0 0 ${width} ${height}`, "aria-hidden": "true" });
    svg.append(draw("rect", { class: "coast", x: this.x(0), y: top, width: Math.max(this.x(first_s) - this.x(0), 0), height: bottom - top }));
    for (const v of ticks(low, high || 1, 6)) {
      svg.append(draw("line", { class: v === 0 ? "zero" : "grid", x1: left, x2: width - right, y1: this.y(v), y2: this.y(v) }));
      svg.append(draw("text", { x: left - 5, y: this.y(v) + 3.5, "text-anchor": "end" }, plain(v, 0)));
    }
    for (const t of ticks(0, this.until, Math.min(8, width / 60))) svg.append(draw("text", { x: this.x(t), y: bottom + 16, "text-anchor": "middle" }, String(Number(t.toFixed(3)))));
    svg.append(draw("text", { x: (left + width - right) / 2, y: height - 3, "text-anchor": "middle" }, "Time since the alert (s); command (m/s²)"));
    svg.append(draw("rect", { class: "chosen-step", x: this.x(first_s + this.at * step_s), y: top, width: this.x(step_s) - this.x(0), height: bottom - top }));
    if (this.ghost) svg.append(draw("path", { class: "ghost", d: this.ghost(this.x, this.y, this.until) }));
    const steps = this.commands.slice(0, this.seen).map((value, k) => {
      const [x0, x1, y] = [this.x(first_s + k * step_s), this.x(first_s + (k + 1) * step_s), this.y(this.bounded(value))];
      return `${k ? "L" : "M"}${x0.toFixed(1)} ${y.toFixed(1)}L${x1.toFixed(1)} ${y.toFixed(1)}`;
    }).join("");
    const zero = this.y(0).toFixed(1);
    svg.append(draw("path", { class: "fill", d: `${steps}L${this.x(this.until).toFixed(1)} ${zero}L${this.x(first_s).toFixed(1)} ${zero}Z` }));
    svg.append(draw("path", { class: "line", d: steps }));
    this.holder.replaceChildren(svg);
  }

  place(event) {
    const box = this.holder.getBoundingClientRect();
    const k = Math.floor((this.time(event.clientX - box.left) - this.grid.first_s) / this.grid.step_s);
    const value = this.bounded(Math.round(this.value(event.clientY - box.top) * 10) / 10);
    return [Math.min(Math.max(k, 0), this.seen - 1), value];
  }

  begin(event) {
    if (!this.grid) return;
    this.holder.setPointerCapture(event.pointerId);
    this.last = this.place(event);
    this.drag(event);
  }

  // Every decision that the pointer passed over, on a straight line.
  drag(event) {
    if (!this.last) return;
    const [from, v0] = this.last;
    const [to, v1] = this.place(event);
    const count = Math.abs(to - from);
    for (let j = 0; j <= count; j += 1) {
      const share = count ? j / count : 1;
      this.commands[from + Math.sign(to - from) * j] = Math.round((v0 + share * (v1 - v0)) * 10) / 10;
    }
    if (to === this.seen - 1) this.commands.fill(v1, to);
    this.last = [to, v1];
    this.at = to;
    this.change();
  }

  press(event) {
    if (!this.grid || event.altKey || event.ctrlKey || event.metaKey) return;
    const by = event.shiftKey ? 0.1 : 0.5;
    const set = (value) => { this.commands[this.at] = this.bounded(Math.round(value * 10) / 10); };
    const go = (k) => { this.at = Math.min(Math.max(k, 0), this.seen - 1); };
    const keys = {
      ArrowLeft: () => go(this.at - 1),
      ArrowRight: () => go(this.at + 1),
      ArrowUp: () => set(this.commands[this.at] + by),
      ArrowDown: () => set(this.commands[this.at] - by),
      PageUp: () => { this.commands[this.at] = this.grid.high_mps2; },
      PageDown: () => { this.commands[this.at] = this.grid.low_mps2; },
      Home: () => go(0),
      End: () => go(this.seen - 1),
      Enter: () => this.commands.fill(this.commands[this.at], this.at),
    };
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
    this.change();
  }

  change() {
    this.draw();
    const time = this.grid.first_s + this.at * this.grid.step_s;
    this.told.textContent = `From ${plain(time, 2)} s: ${plain(this.bounded(this.commands[this.at]), 2)} m/s².`;
    this.changed();
  }
}
