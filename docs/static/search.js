// Ranks the site's search. Sphinx puts this before its own script, which finds every page that holds all words asked
// for. First comes what a page is called or sought by (SOUGHT, which the extension gives to the page of the search),
// then its headings, then its text; and guides before measured figures, internals, the history and records of decisions.

const TITLE = 40;
const SOUGHT_BY = 24;
const HEADING = 12;
const FOCUS = 6; // for a title that says just what was asked
const LATER = {
  "decisions/": 40,
  "results/": 24,
  "changelog": 24,
  "internals/": 16,
  "reference/": 8,
  "extensions/": 6,
  "notebooks/": 4,
};

var Scorer = {
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,

  score: ([page, , anchor, , usual]) => {
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
    for (const [folder, less] of Object.entries(LATER)) if (page.startsWith(folder)) found -= less;
    return anchor ? found - 1 : found;
  },
};
