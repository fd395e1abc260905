// Ranks the site's search. Sphinx puts this before its own script, which finds every page that holds all words asked
// for. First comes what a page is called or sought by (SOUGHT, which the extension gives to the page of the search),
// then its headings, then its text; and guides before measured figures, proofs, the history and records of decisions.

const TITLE = 40;
const SOUGHT_BY = 24;
const HEADING = 12;
const FOCUS = 6; // for a title that says just what was asked
const OBJECT = 30; // a public name that was written out
const LATER = {
  "decisions/": 40,
  "results/": 24,
  "changelog": 24,
  "proofs/": 16,
  "api/": 10,
  "reference/": 8,
  "tutorials/": 4,
};
const LAST = ["cli", "layout", "paper", "paper-figures", "paper-motion", "physics-tests", "releasing", "reproduction", "tests"];

var Scorer = {
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,

  score: ([page, title, anchor, , usual, , kind]) => {
    const { docnames, titles, titleterms } = Search._index;
    const number = docnames.indexOf(page);
    const query = document.querySelector('input[name="q"]').value.trim().toLowerCase();
    const stems = (text) => new Set(splitQuery(text.toLowerCase()).map((word) => new Stemmer().stemWord(word)));
    const share = (list, holds) => [...list].filter(holds).length / Math.max(list.size, 1);
    const asked = Search._parseQuery(query)[1];
    const named = stems(titles[number]);
    const sought = stems(SOUGHT[page] ?? "");
    const headed = (word) => [titleterms[word] ?? []].flat().includes(number);
    let found = usual + TITLE * share(asked, (word) => named.has(word) || sought.has(word));
    found += SOUGHT_BY * share(asked, (word) => sought.has(word));
    found += HEADING * share(asked, headed) + FOCUS * share(named, (word) => asked.has(word));
    if (kind === "object") found = title.toLowerCase().split(".").pop() === query ? OBJECT : usual;
    for (const [folder, less] of Object.entries(LATER)) if (page.startsWith(folder)) found -= less;
    if (LAST.includes(page)) found -= LATER["proofs/"];
    return anchor ? found - 1 : found;
  },
};
