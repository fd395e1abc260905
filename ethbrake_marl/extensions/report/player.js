// The episode player shows a chosen world, with chosen agents, at a chosen time. The rest of the page works without it.

const MOST_AGENTS = 3;
const FRAME_S = 0.04;
const STEP_S = 0.1;
const BEFORE_S = 1; // the page opens this long before the first impact

class Player {
  constructor(root, data) {
    this.root = root;
    this.data = data;
    this.time = 0;
    this.playing = false;
    this.speed = 1;
    this.shown = root.clientWidth < 500 ? data.shown.slice(-2) : data.shown;
    this.find = (name) => root.querySelector(`[data-part="${name}"]`);
    this.calm = matchMedia("(prefers-reduced-motion: reduce)");
    this.fillChoices();
    this.listen();
    this.choose(0);
    root.classList.add("ready");
    this.jump(1);
    this.seek(this.time - BEFORE_S);
    this.play(!this.calm.matches);
  }

  fillChoices() {
    const kinds = new Map();
    this.data.worlds.forEach((world, k) => {
      if (!kinds.has(world.kind)) kinds.set(world.kind, make("optgroup", { label: world.kind }));
      kinds.get(world.kind).append(make("option", { value: k }, `World ${world.number}: ${plain(world.value, 2)}`));
    });
    this.find("world").append(...kinds.values());
    this.fillAgents();
  }

  fillAgents() {
    this.find("agents").append(
      ...this.data.agents.map((agent, k) => {
        const box = make("input", { type: "checkbox", value: k });
        box.checked = this.shown.includes(k);
        box.addEventListener("change", () => this.toggle(k));
        return make("label", {}, box, ` ${agent}`);
      }),
    );
  }

  listen() {
    const on = (name, kind, act) => this.find(name).addEventListener(kind, act);
    on("world", "change", (event) => this.choose(Number(event.target.value)));
    on("before", "click", () => this.choose(this.world - 1));
    on("after", "click", () => this.choose(this.world + 1));
    on("scrub", "input", (event) => this.seek(Number(event.target.value)));
    on("speed", "change", (event) => { this.speed = Number(event.target.value); });
    for (const button of this.root.querySelectorAll("[data-do]")) button.addEventListener("click", () => this.act(button.dataset.do));
    this.root.addEventListener("keydown", (event) => this.press(event));
    document.addEventListener("click", (event) => {
      const target = event.target.closest("[data-watch]");
      const k = target ? this.data.worlds.findIndex((world) => world.number === Number(target.dataset.watch)) : -1;
      if (k < 0) return;
      this.choose(k);
      this.root.scrollIntoView({ block: "start" });
      this.root.focus({ preventScroll: true });
    });
    let width = 0;
    new ResizeObserver(() => {
      if (this.root.clientWidth !== width) this.build();
      width = this.root.clientWidth;
    }).observe(this.root);
  }

  act(what) {
    const moves = {
      play: () => this.play(!this.playing),
      start: () => this.seek(0),
      end: () => this.seek(this.until),
      back: () => this.step(-STEP_S),
      forward: () => this.step(STEP_S),
      "previous-impact": () => this.jump(-1),
      "next-impact": () => this.jump(1),
    };
    moves[what]();
  }

  press(event) {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    const { key, target } = event;
    const own = target.closest("select, summary, textarea, [type=checkbox], button");
    if (own && (key === " " || (own.matches("select") && /^Arrow|^Home|^End|^.$/.test(key)))) return;
    const keys = {
      " ": () => this.act("play"),
      ArrowLeft: () => (event.shiftKey ? this.jump(-1) : this.step(-STEP_S)),
      ArrowRight: () => (event.shiftKey ? this.jump(1) : this.step(STEP_S)),
      ",": () => this.step(-FRAME_S),
      ".": () => this.step(FRAME_S),
      Home: () => this.seek(0),
      End: () => this.seek(this.until),
      ArrowUp: () => this.choose(this.world - 1),
      ArrowDown: () => this.choose(this.world + 1),
      "+": () => this.faster(1),
      "-": () => this.faster(-1),
    };
    const act = keys[key] ?? (/^[1-9]$/.test(key) && Number(key) <= this.data.agents.length ? () => this.toggle(Number(key) - 1) : null);
    if (!act) return;
    event.preventDefault();
    act();
  }

  faster(by) {
    const select = this.find("speed");
    select.selectedIndex = Math.min(Math.max(select.selectedIndex + by, 0), select.options.length - 1);
    this.speed = Number(select.value);
  }

  // Show or hide agent k. At least one agent is shown, and at most three: a fourth replaces the first.
  toggle(k) {
    if (!this.shown.includes(k)) this.shown = [...this.shown, k].slice(-MOST_AGENTS);
    else if (this.shown.length > 1) this.shown = this.shown.filter((each) => each !== k);
    this.shown.sort((a, b) => a - b);
    for (const box of this.find("agents").querySelectorAll("input")) box.checked = this.shown.includes(Number(box.value));
    this.build();
  }

  choose(k) {
    this.world = Math.min(Math.max(k, 0), this.data.worlds.length - 1);
    this.find("world").value = this.world;
    this.play(false);
    this.time = 0;
    this.build();
  }

  episodes() {
    const world = this.data.worlds[this.world];
    return this.shown.map((k) => {
      const episode = world.episodes[k];
      if (typeof episode.pieces === "string") episode.pieces = decodePieces(episode.pieces, this.data.vehicles);
      episode.agent = this.data.agents[k];
      return episode;
    });
  }

  build() {
    const world = this.data.worlds[this.world];
    const episodes = this.episodes();
    this.until = Math.max(...episodes.map((each) => Math.min(each.end, restOf(each) + 0.5)), 0.5);
    this.time = Math.min(this.time, this.until);
    const view = roadOf(episodes);
    const ranges = rangesOf(episodes);
    this.find("conditions").textContent = `World ${world.number}: ${world.conditions}.`;
    const road = this.find("road");
    const traces = this.find("traces");
    road.replaceChildren();
    traces.replaceChildren();
    const columns = episodes.map((episode) => make("div", { class: "column" }, make("h3", {}, episode.agent)));
    traces.append(...columns);
    this.rows = episodes.map((episode, k) => {
      const head = make("div", { class: "head" });
      const holder = make("div", { class: "holder" });
      const readout = make("p", { class: "readout" });
      road.append(make("div", { class: "row" }, head, holder, readout));
      return {
        head,
        readout,
        lane: new Lane(holder, episode, this.data, view, k === episodes.length - 1),
        traces: new Traces(columns[k], episode, this.data, ranges, this.until, (time) => this.seek(time)),
      };
    });
    const scrub = this.find("scrub");
    scrub.max = this.until;
    this.show();
  }

  show() {
    const { vehicles } = this.data;
    for (const { head, readout, lane, traces } of this.rows) {
      const { state, now } = lane.show(this.time);
      const ahead = gapsAhead(state, lane.episode.obstacle);
      traces.show(this.time, state);
      const episode = lane.episode;
      head.replaceChildren(
        make("strong", {}, episode.agent),
        make("span", { "data-impacts": now.impacts }, `${now.impacts} ${now.impacts === 1 ? "impact" : "impacts"}`),
        make("span", { "data-first": now.first }, `harm ${plain(now.first, 2)} first-impact`),
        make("span", { "data-total": now.total }, `${plain(now.total, 2)} total`),
        make("span", { class: "unit" }, "m²/s²"),
      );
      if (!episode.rest) head.append(make("span", { class: "unit", "data-cut": "" }, `a vehicle still moves at the horizon, ${plain(episode.end, 2)} s`));
      const guarded = steppedInAt(episode, this.time) ? "shield steps in" : "shielded";
      if (episode.stepped.length) head.append(make("span", { class: "shield" }, guarded));
      readout.replaceChildren(
        ...Array.from({ length: vehicles }, (_, i) => {
          const key = make("span", { class: `key k${(i + 1) % 7}` }, String(i + 1));
          const gap = ahead[i] === null ? "" : ` · gap ahead ${plain(ahead[i], 2)} m`;
          return make("span", { class: "each" }, key, ` ${plain(state.speeds[i], 1)} m/s, ${plain(state.accelerations[i], 1)} m/s²${gap}`);
        }),
      );
    }
    const scrub = this.find("scrub");
    scrub.value = this.time;
    scrub.setAttribute("aria-valuetext", `${plain(this.time, 2)} of ${plain(this.until, 2)} seconds`);
    this.find("time").textContent = `${plain(this.time, 2)} / ${plain(this.until, 2)} s`;
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.until);
    this.show();
  }

  step(by) {
    this.play(false);
    this.seek(Math.round((this.time + by) * 1e6) / 1e6);
  }

  // Go to the previous (way < 0) or next (way > 0) impact of any agent that is shown.
  jump(way) {
    this.play(false);
    const times = this.episodes().flatMap((each) => each.impacts.map((impact) => impact[0])).sort((a, b) => a - b);
    const found = way > 0 ? times.find((t) => t > this.time + 1e-9) : times.findLast((t) => t < this.time - 1e-9);
    if (found !== undefined) this.seek(found);
  }

  play(on) {
    if (on && this.time >= this.until) this.time = 0;
    this.playing = on;
    const button = this.root.querySelector('[data-do="play"]');
    button.textContent = on ? "Pause" : "Play";
    button.setAttribute("aria-pressed", on);
    if (!on) return;
    let last = performance.now();
    let kept = 0;
    const tick = (now) => {
      if (!this.playing) return;
      kept += ((now - last) / 1000) * this.speed;
      last = now;
      if (kept >= (this.calm.matches ? 0.25 : 0)) {
        this.seek(this.time + kept);
        kept = 0;
      }
      if (this.time >= this.until) this.play(false);
      else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }
}

for (const root of document.querySelectorAll(".player[data-episodes]")) {
  root.player = new Player(root, JSON.parse(document.getElementById(root.dataset.episodes).textContent));
}
