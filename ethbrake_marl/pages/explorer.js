// The explorer: sliders set a world, the server says what every agent makes of it, and this shows it.

const SETTLED_MS = 250; // without a move, until the best profile is searched
const SEARCH_S = 0.5;
const SLOW_MS = 500; // of the first answer: then physics is being compiled
const MOST_WORLD = 1e9;
const NAME = "Name: small letters, digits, - and _, the first a letter or digit, at most 64";

// A player whose one world changes.
class LivePlayer extends Player {
  fillChoices() { this.fillAgents(); }

  choose() {
    if (this.world !== undefined) return;
    this.world = 0;
    this.build();
  }

  episodes() {
    const all = this.shown;
    this.shown = all.filter((k) => this.data.worlds[0].episodes[k]);
    const found = super.episodes();
    this.shown = all;
    return found;
  }

  change(world) {
    this.data.worlds = [world];
    this.build();
  }
}

class Explorer {
  constructor(data) {
    this.data = data;
    this.state = structuredClone(data.state);
    this.find = (part) => document.querySelector(`[data-explorer] [data-part="${part}"]`);
    this.rows = [];
    for (const group of data.groups) this.find(group.usual ? "groups" : "more").append(this.group(group));
    this.editor = new ProfileEditor(this.find("editor"), this.find("told"), () => this.move());
    this.editor.commands = [-data.state.braking_capacity_mps2[data.driven[0]]];
    this.find("number").value = data.world;
    this.fillChoices();
    this.listen();
    const slow = setTimeout(() => this.say("Compiling the physics, once: this can take minutes. The terminal says how far it is …"), SLOW_MS);
    this.move().then(() => clearTimeout(slow));
  }

  group({ field, title, unit, low, high, step, most, names }) {
    const box = make("fieldset", {}, make("legend", {}, title, make("span", {}, unit ? ` (${unit})` : "")));
    names.forEach((name, index) => {
      const called = `${title}${name ? `, ${name}` : ""}${unit ? ` in ${unit}` : ""}`;
      const range = make("input", { type: "range", min: low, max: high, step, "aria-label": `${called}, slider` });
      const number = make("input", { type: "number", min: 0, max: most, step: "any", inputmode: "decimal", "aria-label": called });
      const driven = name === `Vehicle ${this.data.driven[0] + 1}`;
      const row = { field, index, range, number };
      range.addEventListener("input", () => this.set(row, Number(range.value), number));
      number.addEventListener("input", () => {
        if (number.value === "") this.refuse(`${called}: must be a number.`);
        else this.set(row, Number(number.value), range);
      });
      this.rows.push(row);
      this.put(row);
      box.append(make("div", { class: driven ? "slider driven" : "slider" }, make("span", {}, name), range, number));
    });
    return box;
  }

  value({ field, index }) {
    const value = this.state[field];
    return Array.isArray(value) ? value[index] : value;
  }

  put(row) {
    row.range.value = this.value(row);
    row.number.value = Number(this.value(row).toFixed(4));
  }

  set(row, value, other) {
    if (Array.isArray(this.state[row.field])) this.state[row.field][row.index] = value;
    else this.state[row.field] = value;
    other.value = value;
    this.move();
  }

  fillChoices() {
    const { agents, rival } = this.data;
    const options = () => agents.map((agent, k) => make("option", { value: k }, agent));
    this.find("from").append(make("option", { value: "" }, "by hand"), ...options(), make("option", { value: "constant" }, "H*"), make("option", { value: "best" }, "best known"));
    this.find("rival").append(...options());
    this.find("rival").value = rival;
  }

  listen() {
    const on = (part, kind, act) => this.find(part).addEventListener(kind, act);
    on("number", "change", () => this.draw(this.find("number").valueAsNumber));
    on("name", "input", () => this.say("", false, "saved")); // what was said is of another name
    on("name", "invalid", () => this.say(`${NAME}.`, true, "saved"));
    on("from", "change", () => this.begin(this.find("from").value));
    on("rival", "change", () => this.show());
    const click = (what, act) => document.querySelector(`[data-explorer] [data-do="${what}"]`).addEventListener("click", act);
    click("before", () => this.draw(Math.max(Number(this.find("number").value) - 1, 0)));
    click("after", () => this.draw(Number(this.find("number").value) + 1));
    click("longer", () => this.search(10));
    document.querySelector("form[data-explorer]").addEventListener("submit", (event) => {
      event.preventDefault();
      this.save(event.submitter?.dataset.kind ?? "yaml");
    });
  }

  say(text, wrong = false, part = "state") {
    const line = this.find(part);
    line.textContent = text;
    line.classList.toggle("wrong", wrong);
  }

  // Say what is wrong with an input, and that what is shown is of another world.
  refuse(text) {
    clearTimeout(this.settled);
    this.say(text, true);
    document.body.classList.add("stale");
  }

  async ask(what, question) {
    try {
      const reply = await fetch(what, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(question) });
      const content = await reply.json();
      return reply.ok ? content : { wrong: content.error, superseded: content.superseded };
    } catch {
      return { wrong: "ethbrake watch explore does not answer; was it ended?" };
    }
  }

  // One question at a time; while it is answered the newest position waits, and no other.
  async move() {
    this.wanted = true;
    clearTimeout(this.settled);
    if (this.busy) return;
    this.busy = true;
    while (this.wanted) {
      this.wanted = false;
      const begun = performance.now();
      const question = { world: structuredClone(this.state), profile: this.editor.commands.slice() };
      const found = await this.ask("answer", question);
      document.body.classList.remove("stale");
      if (found.superseded) this.wanted = true; // by another window
      else if (found.wrong) this.refuse(found.wrong);
      else this.take(found, question, performance.now() - begun);
    }
    this.busy = false;
    if (!document.body.classList.contains("stale")) this.settled = setTimeout(() => this.search(SEARCH_S), SETTLED_MS);
  }

  take(found, question, milliseconds) {
    const same = JSON.stringify(question.world) === this.searched;
    this.found = found;
    if (!same) this.best = null;
    this.say(`Answered in ${plain(milliseconds, 0)} ms.`);
    this.show();
  }

  async search(seconds) {
    if (!this.found) return;
    const world = JSON.stringify(this.state);
    if (seconds > SEARCH_S) this.say(`Searching for ${seconds} s …`);
    const best = await this.ask("best", { world: JSON.parse(world), profile: this.editor.commands.slice(), seconds });
    if (world !== JSON.stringify(this.state) || best.superseded) return;
    if (best.wrong) {
      this.say(best.wrong, true);
      return;
    }
    const count = this.data.harm_count;
    if (!this.best || best[count] <= this.best[count] || world !== this.searched) this.best = best;
    this.searched = world;
    if (seconds > SEARCH_S) this.say(`Searched ${best.candidates.toLocaleString("en")} profiles.`);
    this.show();
  }

  // The best of the search and of all who drove here, by the harm that is minimised, then by the other.
  bestKnown() {
    const counts = this.data.harm_count === "first" ? ["first", "total"] : ["total", "first"];
    const driven = this.found.outcomes.map((each, k) => ({ ...each, by: k, episode: this.found.world.episodes[k] }));
    const less = (a, b) => {
      const apart = counts.find((count) => Math.abs(a[count] - b[count]) > LEAST);
      return apart !== undefined && a[apart] < b[apart];
    };
    return [...driven, ...(this.best ? [this.best] : [])].reduce((a, b) => (less(b, a) ? b : a));
  }

  show() {
    if (!this.found) return;
    const { world, outcomes, grid } = this.found;
    const best = this.bestKnown();
    const episodes = [...world.episodes, ...(this.best ? [{ ...best.episode }] : [])];
    for (const episode of episodes) if (typeof episode.pieces === "string") episode.pieces = decodePieces(episode.pieces, this.data.vehicles, episode.jerks);
    const shown = { ...world, episodes };
    if (!this.player) {
      const agents = [...this.data.agents, "by hand", "best known"];
      const data = { ...this.data, agents, most: agents.length, shown: agents.map((_, k) => k), worlds: [shown] };
      this.player = new LivePlayer(document.querySelector(".player.live"), data);
    } else this.player.change(shown);
    const rival = world.episodes[Number(this.find("rival").value)];
    const until = Math.max(...[rival, world.episodes[outcomes.length - 1]].map(restOf)) + 0.3;
    this.editor.fit(grid, until, ghostOf(rival, this.data));
    this.showHarms(best);
    this.find("cards").replaceChildren(...cardsOf(this.found, best, this.data.harm_count));
    this.find("score").replaceChildren(...scoreOf(outcomes, best, Number(this.find("rival").value), this.data));
  }

  showHarms(best) {
    const { outcomes, constant } = this.found;
    const rows = outcomes.map((each, k) => [each, k === outcomes.length - 1 ? "hand" : ""]);
    if (constant.first !== undefined) rows.push([{ agent: `H*: constant ${plain(constant.deceleration_mps2, 2)} m/s²`, ...constant }, ""]);
    if (this.best) rows.push([{ ...best, agent: "best known" }, "best"]);
    const most = Math.max(...rows.map(([each]) => Math.max(each.first, each.total)), LEAST);
    const cell = (value) => {
      const bar = make("span", { class: "bar" });
      bar.style.width = `${(100 * value) / most}%`;
      return make("td", {}, plain(value, 2), bar);
    };
    this.find("harms").replaceChildren(...rows.map(([each, kind]) =>
      make("tr", { class: kind, "data-agent": each.agent, "data-first": each.first, "data-total": each.total, "data-impacts": each.impacts ?? "" },
        make("th", { scope: "row" }, each.agent), make("td", {}, each.impacts === undefined ? "–" : String(each.impacts)), cell(each.first), cell(each.total))));
  }

  async begin(chosen) {
    const best = chosen === "best" && this.found ? this.bestKnown() : null;
    const from = best && best.by < this.data.agents.length ? String(best.by) : chosen;
    if (from === "best") {
      if (best?.commands) this.editor.take(best.commands); // else it is by hand already
    } else if (from === "constant") this.editor.take([-(this.found?.constant.deceleration_mps2 ?? 0)]);
    else if (from !== "") {
      const found = await this.ask("profile", { world: this.state, agent: this.data.named[Number(from)] });
      if (found.wrong) this.say(found.wrong, true);
      else this.editor.take(found.commands);
    }
    this.find("from").value = "";
    this.move();
  }

  async draw(number) {
    if (!Number.isInteger(number) || number < 0 || number > MOST_WORLD) {
      this.refuse("World: must be a whole number from 0 to 1,000,000,000.");
      return;
    }
    const found = await this.ask("world", { number });
    if (found.wrong) {
      this.refuse(found.wrong);
      return;
    }
    this.find("number").value = number;
    this.state = found.world;
    this.rows.forEach((row) => this.put(row));
    this.move();
  }

  async save(kind) {
    this.say("", false, "saved");
    const found = await this.ask("save", { world: this.state, name: this.find("name").value, kind });
    this.say(found.wrong ?? `Saved: ${found.file}`, Boolean(found.wrong), "saved");
  }
}

// What the driven vehicle of an episode did, as a path: its acceleration, step by step.
function ghostOf(episode, data) {
  return (x, y, until) => curves(episode, until, x, { gap: () => 0, speed: () => 0, acceleration: y }, data.vehicles).acceleration[data.driven[0]];
}

const explorerData = document.getElementById("explorer_data");
if (explorerData) document.body.explorer = new Explorer(JSON.parse(explorerData.textContent));
