// What the player draws: the road with its vehicles, and curves over time (traces) below the road. Both are SVG.

const SVG = "http://www.w3.org/2000/svg";
const LABEL = 58; // width of a closing speed and a blank

function draw(name, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function make(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

// Round numbers for the ticks of an axis from `low` to `high`, with at most `most` steps.
function ticks(low, high, most) {
  const rough = (high - low) / most;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((each) => each >= rough);
  const found = [];
  for (let at = Math.ceil(low / step - 1e-9) * step; at <= high + 1e-9 * step; at += step)
    found.push(Math.abs(at) < step / 1e6 ? 0 : at);
  return found;
}

const plain = (value, digits) => value.toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1").replace("-", "−");

// A drawn lane, to scale, with the vehicles of one agent's episode.
class Lane {
  constructor(holder, episode, data, view, scaleBelow) {
    Object.assign(this, { episode });
    const width = Math.max(holder.clientWidth, 200);
    this.scale = width / (view.right - view.left);
    this.x = (m) => (m - view.left) * this.scale;
    this.half = Math.max(6, Math.min(13, 0.95 * this.scale));
    this.middle = this.half + 25;
    const bottom = this.middle + this.half + 9;
    const height = bottom + (scaleBelow ? 18 : 2);
    this.svg = draw("svg", { class: "lane", width, height, viewBox: `0 0 ${width} ${height}`, role: "img" });
    const band = { y: this.middle - this.half - 9, height: 2 * this.half + 18 };
    this.svg.append(draw("rect", { class: "asphalt", x: 0, width, rx: 3, ...band }));
    const dashes = `${3 * this.scale} ${6 * this.scale}`;
    for (const y of [this.middle - this.half - 5, this.middle + this.half + 5])
      this.svg.append(draw("line", { class: "dash", x1: 0, x2: width, y1: y, y2: y, "stroke-dasharray": dashes }));
    if (scaleBelow) this.drawScale(view, bottom, width);
    if (episode.obstacle !== null) {
      const block = { x: this.x(episode.obstacle), width: Math.max(this.scale, 4), ...band };
      this.svg.append(draw("rect", { class: "obstacle", ...block }));
    }
    this.cars = Array.from({ length: data.vehicles }, (_, i) => this.makeCar(i));
    this.flashes = draw("g");
    this.svg.append(this.flashes);
    holder.append(this.svg);
  }

  drawScale(view, y, width) {
    for (const m of ticks(view.left, view.right, width / 70)) {
      this.svg.append(draw("line", { class: "tick", x1: this.x(m), x2: this.x(m), y1: y, y2: y + 4 }));
      if (this.x(m) > 16 && this.x(m) < width - 22)
        this.svg.append(draw("text", { x: this.x(m), y: y + 15, "text-anchor": "middle" }, `${plain(m, 0)} m`));
    }
  }

  makeCar(i) {
    const length = BODY_M * this.scale;
    const h = this.half;
    const box = { x: -length, y: -h, height: 2 * h };
    const body = draw("rect", { class: `body s${(i + 1) % 7}`, ...box, width: length, rx: Math.min(4, h / 2) });
    const driven = this.episode.driven.includes(i);
    const brake = draw("rect", { class: "brake", ...box, width: Math.max(2.5, length / 12) });
    const drive = draw("path", { class: "drive", d: `M${-length * 0.12} ${-h * 0.6}L0 0L${-length * 0.12} ${h * 0.6}Z` });
    const around = { x: -length - 4, y: -h - 4, width: length + 8, height: 2 * h + 8, rx: 6 };
    const guard = draw("rect", { class: "guard", ...around });
    const size = Math.min(2 * h, 14);
    const place = { x: -length / 2, y: 0.36 * size, "text-anchor": "middle", "font-size": size };
    const label = draw("text", { class: "number", ...place }, String(i + 1));
    const group = draw("g", { class: driven ? "car driven" : "car" }, guard, body, brake, drive, label);
    this.svg.append(group);
    return { group, brake, drive, guard, driven };
  }

  show(time) {
    const state = stateAt(this.episode, time);
    const fronts = frontsOf(state);
    const inForce = steppedInAt(this.episode, time);
    this.cars.forEach((car, i) => {
      car.group.setAttribute("transform", `translate(${this.x(fronts[i]).toFixed(2)} ${this.middle})`);
      const a = state.accelerations[i];
      car.brake.setAttribute("opacity", a < 0 ? 0.35 + 0.65 * Math.min(-a / 6, 1) : 0);
      car.drive.setAttribute("opacity", a > 0 ? 0.35 + 0.65 * Math.min(a / 6, 1) : 0);
      car.guard.setAttribute("opacity", inForce && car.driven ? 1 : 0);
    });
    this.flashes.replaceChildren(...this.flashesAt(time, fronts));
    const now = countedBy(this.episode, time);
    const words = state.speeds.map((v, i) => `Vehicle ${i + 1} ${plain(v, 1)} metres per second`).join(", ");
    const told = `${this.episode.agent} at ${plain(time, 2)} seconds: ${now.impacts} ${now.impacts === 1 ? "impact" : "impacts"}; ${words}`;
    this.svg.setAttribute("aria-label", told);
    return { state, now };
  }

  flashesAt(time, fronts) {
    const shown = new Map(struckAround(this.episode, time).map((impact) => [impact[1], impact]));
    let free = Infinity; // the numbers stand side by side, from the right
    return [...shown.values()].sort((a, b) => a[1] - b[1]).map(([, pair, closing, first]) => {
      const x = this.x(pair < 0 ? fronts[0] : fronts[pair + 1]);
      const r = this.half + 5;
      const points = Array.from({ length: 16 }, (_, k) => {
        const long = k % 2 ? r * 0.5 : r;
        const [across, down] = [long * Math.cos((k * Math.PI) / 8), long * Math.sin((k * Math.PI) / 8)];
        return `${(x + across).toFixed(1)},${(this.middle + down).toFixed(1)}`;
      });
      const speed = `${closing < 0.05 ? "< 0.1" : plain(closing, 1)} m/s`;
      free = Math.min(x, free - LABEL);
      const text = draw("text", { class: "closing", x: free, y: 12, "text-anchor": "middle" }, speed);
      const star = draw("polygon", { class: first ? "flash" : "flash later", points: points.join(" ") });
      return draw("g", {}, star, text);
    });
  }
}

const TRACES = [
  { name: "gap", title: "Gap (m)" },
  { name: "speed", title: "Speed (m/s)" },
  { name: "acceleration", title: "Acceleration (m/s²)" },
];

// The traces of one agent: three panels over time, with a vertical line at the time that the player shows.
class Traces {
  constructor(holder, episode, data, ranges, until, seek) {
    Object.assign(this, { episode, until, vehicles: data.vehicles });
    const width = Math.max(holder.clientWidth, 200);
    const [left, right, top, panel, apart] = [34, 8, 18, 84, 26];
    const height = 3 * panel + 2 * apart + top + 36;
    this.x = (t) => left + (Math.min(t, until) / until) * (width - left - right);
    this.y = {};
    this.svg = draw("svg", { class: "trace", width, height, viewBox: `0 0 ${width} ${height}`, role: "img" });
    this.svg.setAttribute("aria-label", `${episode.agent}: gaps, speeds and accelerations over time`);
    TRACES.forEach(({ name, title }, k) => {
      const [low, high] = ranges[name];
      const y0 = top + k * (panel + apart);
      this.y[name] = (v) => y0 + panel - ((v - low) / (high - low)) * panel;
      this.svg.append(draw("text", { class: "title", x: left, y: y0 - 6 }, title));
      for (const v of ticks(low, high, 4)) {
        const y = this.y[name](v);
        this.svg.append(draw("line", { class: v === 0 ? "zero" : "grid", x1: left, x2: width - right, y1: y, y2: y }));
        this.svg.append(draw("text", { x: left - 5, y: y + 3.5, "text-anchor": "end" }, plain(v, 0)));
      }
    });
    this.bottom = top + 3 * panel + 2 * apart;
    const below = (x, y, text) => this.svg.append(draw("text", { x, y, "text-anchor": "middle" }, text));
    for (const t of ticks(0, until, Math.min(8, width / 60))) below(this.x(t), this.bottom + 19, String(Number(t.toFixed(3))));
    below((left + width - right) / 2, this.bottom + 33, "Time since the alert (s)");
    this.drawMarks(top);
    this.drawCurves();
    this.cursor = draw("line", { class: "cursor", y1: top, y2: this.bottom });
    this.dots = draw("g");
    this.svg.append(this.cursor, this.dots);
    const from = () => this.svg.getBoundingClientRect().left + left;
    const at = (event) => ((event.clientX - from()) / (width - left - right)) * until;
    this.svg.addEventListener("pointerdown", (event) => {
      this.svg.setPointerCapture(event.pointerId);
      seek(at(event));
    });
    this.svg.addEventListener("pointermove", (event) => { if (event.buttons) seek(at(event)); });
    holder.append(this.svg);
  }

  drawMarks(top) {
    for (const time of this.episode.stepped) {
      const title = draw("title", {}, `shield stepped in at ${plain(time, 2)} s`);
      this.svg.append(draw("path", { class: "stepped", d: `M${this.x(time)} ${this.bottom + 1}l4 7h-8z` }, title));
    }
    for (const [time, pair, closing, first] of this.episode.impacts) {
      const x = this.x(time);
      if (first) this.svg.append(draw("line", { class: "impact", x1: x, x2: x, y1: top, y2: this.bottom }));
      const r = first ? 4.5 : 2.5;
      const y = this.y.gap(0);
      const whom = pair < 0 ? "Vehicle 1 and the obstacle" : `Vehicles ${pair + 1} and ${pair + 2}`;
      const title = draw("title", {}, `impact of ${whom} at ${plain(time, 2)} s, ${plain(closing, 2)} m/s`);
      const cross = `M${x - r} ${y - r}L${x + r} ${y + r}M${x - r} ${y + r}L${x + r} ${y - r}`;
      this.svg.append(draw("path", { class: first ? "struck" : "struck later", d: cross }, title));
    }
  }

  drawCurves() {
    const found = curves(this.episode, this.until, this.x, this.y, this.vehicles);
    for (const { name } of TRACES)
      found[name].forEach((d, k) => {
        const i = name === "gap" ? k + 1 : k;
        this.svg.append(draw("path", { class: `curve c${(i + 1) % 7} d${i % 5}`, d }));
      });
  }

  show(time, state) {
    const x = this.x(time);
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
    const values = { gap: state.gaps, speed: state.speeds, acceleration: state.accelerations };
    const dot = (name, v, i) => draw("circle", { class: `s${(i + 1) % 7}`, cx: x, cy: this.y[name](v), r: 3 });
    const dots = ({ name }) => values[name].map((v, k) => dot(name, v, name === "gap" ? k + 1 : k));
    this.dots.replaceChildren(...TRACES.flatMap(dots));
  }
}

// Range of each panel's axis, the same for all agents that are shown.
function rangesOf(episodes) {
  const found = { gap: [0, 1], speed: [0, 1], acceleration: [-1, 1] };
  const hold = (name, values) => {
    found[name] = [Math.min(found[name][0], ...values), Math.max(found[name][1], ...values)];
  };
  for (const episode of episodes)
    for (const time of [...episode.pieces.map((piece) => piece.time), episode.end]) {
      const state = stateAt(episode, time);
      hold("gap", state.gaps);
      hold("speed", state.speeds);
      hold("acceleration", state.accelerations);
    }
  found.acceleration = found.acceleration.map((a) => 1.08 * a);
  return found;
}
