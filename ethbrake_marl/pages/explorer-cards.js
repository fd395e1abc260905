// What the explorer says of a world in words: the cards above the table, and the score of the profile by hand.

const LEAST = 1e-9; // m²/s²: harms closer than this are one harm

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
