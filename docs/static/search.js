// Order of the site's search: pages with many words of the question in their headings first, records last.
var Scorer = {
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
  score: ([name, , , , score]) => {
    const { docnames, titles, titleterms } = Search._index;
    const page = docnames.indexOf(name);
    const question = new URLSearchParams(window.location.search).get("q").toLowerCase();
    for (const word of splitQuery(question)) {
      const pages = titleterms[new Stemmer().stemWord(word)];
      if (pages === page || (Array.isArray(pages) && pages.includes(page))) score += 10;
      if (word.length > 2 && titles[page].toLowerCase().includes(word)) score += 10;
    }
    return /^(index|decisions|code|proofs|results|reference\/cli)/.test(name) ? score - 20 : score;
  },
};
