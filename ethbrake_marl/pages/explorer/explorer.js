// The explorer: sliders set a world, the server says what every agent makes of it, and this shows it.

const SETTLED_MS = 250; // without a move, until the best profile is searched
const SEARCH_S = 0.5;
const SLOW_MS = 500; // of the first answer: then physics is being compiled
const LEAST = 1e-9; // m²/s²: harms closer than this are one harm

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
    const slow = setTimeout(() => this.say("Compiling the physics, once; some twenty seconds …"), SLOW_MS);
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
      number.addEventListener("input", () => number.value !== "" && this.set(row, Number(number.value), range));
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
    on("number", "change", () => this.draw(Number(this.find("number").value)));
    on("from", "change", () => this.begin(this.find("from").value));
    on("rival", "change", () => this.show());
    const click = (what, act) => document.querySelector(`[data-explorer] [data-do="${what}"]`).addEventListener("click", act);
    click("before", () => this.draw(Number(this.find("number").value) - 1));
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

  async ask(what, question) {
    try {
      const reply = await fetch(what, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(question) });
      const content = await reply.json();
      return reply.ok ? content : { wrong: content.error, superseded: content.superseded };
    } catch {
      return { wrong: "ethbrake explore does not answer; was it ended?" };
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
      if (found.superseded) this.wanted = true; // by another window
      else if (found.wrong) this.say(found.wrong, true);
      else this.take(found, question, performance.now() - begun);
      document.body.classList.toggle("stale", Boolean(found.wrong)); // what is shown is of another world
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

  // The best of the search and of all who drove here.
  bestKnown() {
    const count = this.data.harm_count;
    const all = [...this.found.outcomes, ...(this.best ? [this.best] : [])];
    return all.reduce((a, b) => (b[count] < a[count] - LEAST ? b : a));
  }

  show() {
    if (!this.found) return;
    const { world, outcomes, grid } = this.found;
    const episodes = [...world.episodes, ...(this.best ? [this.best.episode] : [])];
    for (const episode of episodes) if (typeof episode.pieces === "string") episode.pieces = decodePieces(episode.pieces, this.data.vehicles);
    const shown = { ...world, episodes };
    if (!this.player) {
      const agents = [...this.data.agents, "by hand", "best known"];
      const data = { ...this.data, agents, most: agents.length, shown: agents.map((_, k) => k), worlds: [shown] };
      this.player = new LivePlayer(document.querySelector(".player.live"), data);
    } else this.player.change(shown);
    const rival = world.episodes[Number(this.find("rival").value)];
    const until = Math.max(...[rival, world.episodes[outcomes.length - 1]].map(restOf)) + 0.3;
    this.editor.fit(grid, until, ghostOf(rival, this.data));
    this.showHarms();
    this.find("cards").replaceChildren(...cardsOf(this.found, this.bestKnown(), this.data.harm_count));
    this.find("score").replaceChildren(...scoreOf(outcomes, this.bestKnown(), Number(this.find("rival").value), this.data));
  }

  showHarms() {
    const { outcomes, constant } = this.found;
    const rows = outcomes.map((each, k) => [each, k === outcomes.length - 1 ? "hand" : ""]);
    if (constant.first !== undefined) rows.push([{ agent: `H*: constant ${plain(constant.deceleration_mps2, 2)} m/s²`, ...constant }, ""]);
    if (this.best) rows.push([this.best, "best"]);
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

  async begin(from) {
    if (from === "best") {
      if (this.best) this.editor.take(this.best.commands);
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
    if (!(number >= 0)) return;
    const found = await this.ask("world", { number });
    if (found.wrong) {
      this.say(found.wrong, true);
      return;
    }
    this.find("number").value = number;
    this.state = found.world;
    this.rows.forEach((row) => this.put(row));
    this.move();
  }

  async save(kind) {
    const found = await this.ask("save", { world: this.state, name: this.find("name").value, kind });
    this.say(found.wrong ?? `Saved: ${found.file}`, Boolean(found.wrong), "saved");
  }
}

// What the driven vehicle of an episode did, as a path: its acceleration, step by step.
function ghostOf(episode, data) {
  return (x, y, until) => curves(episode, until, x, { gap: () => 0, speed: () => 0, acceleration: y }, data.vehicles).acceleration[data.driven[0]];
}

function card(kind, title, value, text) {
  return make("div", { class: `card ${kind}` }, make("h3", {}, title), make("strong", {}, value), make("p", {}, text));
}

function cardsOf({ verdict, constant }, best, count) {
  const unit = "m²/s²";
  const proven = verdict.proven_harm === null ? "No harm is proven here." : verdict.proven_harm > 0 ? `Proven: no command does less than ${plain(verdict.proven_harm, 2)} ${unit}.` : "No harm is proven.";
  const words = { true: "Avoidable", false: "Unavoidable", null: "Not decided" }[String(verdict.avoidable)];
  const why = verdict.avoidable ? "Some command avoids all contact." : `${verdict.why[0].toUpperCase()}${verdict.why.slice(1)}. ${proven}`;
  const cards = [card(verdict.avoidable ? "good" : "bad", "Contact", words, why)];
  if (constant.first === undefined) cards.push(card("", "H*, best constant deceleration", "–", constant.why));
  else cards.push(card("", "H*, best constant deceleration", `${plain(constant[count], 2)} ${unit}`, `at ${plain(constant.deceleration_mps2, 2)} m/s², held from the first decision on`));
  const least = verdict.proven_harm > 0 && best[count] - verdict.proven_harm < 1e-3 ? "; proven: nothing does less" : "";
  const who = best.candidates ? `a search of ${best.candidates.toLocaleString("en")} candidates` : best.agent === "by hand" ? "by your hand" : `by ${best.agent}`;
  cards.push(card("good", "Best known", `${plain(best[count], 2)} ${unit}`, who + least));
  return cards;
}

function scoreOf(outcomes, best, rival, data) {
  const count = data.harm_count;
  const you = outcomes[outcomes.length - 1];
  const other = outcomes[rival];
  const worst = outcomes[data.worst];
  const by = other[count] - you[count];
  const won = by > LEAST;
  const first = won ? `You beat ${other.agent} by ${plain(by, 2)} m²/s². ` : Math.abs(by) <= LEAST ? `You do as well as ${other.agent}. ` : `${other.agent} does ${plain(-by, 2)} m²/s² less harm than you. `;
  const room = worst[count] - best[count];
  const share = (100 * (worst[count] - you[count])) / room;
  let saved = `Compared with ${worst.agent} you save ${plain(share, 0)} % of what the best known saves.`;
  if (room <= LEAST) saved = `${worst.agent} does as well as the best known: nothing is left to be saved.`;
  else if (share < 0) saved = `That is more than ${worst.agent} does.`;
  return [make("span", { class: won ? "won" : "" }, first), `Your harm: ${plain(you.first, 2)} first-impact, ${plain(you.total, 2)} total. ${saved}`];
}

const explorerData = document.getElementById("explorer_data");
if (explorerData) document.body.explorer = new Explorer(JSON.parse(explorerData.textContent));
