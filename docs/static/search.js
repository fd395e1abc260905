// Order of the site's search: pages for which the words of the question are listed here, or stand in headings, first;
// records last. docs/conf.py adds the listed words to the index of each page, so this object is JSON.
const WORDS = {
  "cooperation": "ablation channel communication delay drop fairness loss altruism packet v2x",
  "data": "behavior behaviour clone cloning csv dataset expert imitation offline",
  "environments": "action discrete info render reset reward seed space step truncated vectorised vectorized wrapper",
  "evaluate": "baseline compare confidence figure interval metric plot report significance statistics ttc video",
  "extend": "agent custom define feature measure metric observation own plugin policy reward write",
  "first-ten-minutes": "begin getting started quickstart start tutorial",
  "game": "accident collide collision crash definition glossary harm markov pomdp",
  "installing": "cuda docker gpu install installation mac macos pip requirements setup windows",
  "least-harm": "best bound braking ideal lower optimal optimum oracle regret",
  "libraries": "benchmarl cleanrl dask ray rllib skrl torchrl wrapper",
  "paper": "replicate replication reproduce reproducibility reproduction wang",
  "physics": "collision friction impact impulse model momentum restitution",
  "reference/policies": "checkpoint model pretrained shipped trained weights zoo",
  "results/benchmark": "benchmark challenge enter leaderboard submission submit task",
  "scenarios": "custom driver human icy latency mass reaction road scenario time truck vehicle weather wet yaml",
  "shield": "constraint filter guarantee limit override proof rl safe safety",
  "simulators": "carla co-simulation commonroad openscenario simulator sumo",
  "standards": "aeb euro human ncap norm regulation unece",
  "train": "agent centralised centralized critic ctde hyperparameter ippo learner learning logging mappo multi multiagent normalise normalization normalize parameter play ppo resume sac self sharing tensorboard tune wandb"
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
  score: ([name, , , , score]) => {
    const { docnames, titles, titleterms } = Search._index;
    const page = docnames.indexOf(name);
    const listed = (WORDS[name] ?? "").split(" ");
    const question = new URLSearchParams(window.location.search).get("q").toLowerCase();
    for (const word of splitQuery(question)) {
      if (listed.includes(word)) score += 30;
      const pages = titleterms[new Stemmer().stemWord(word)];
      if (pages === page || (Array.isArray(pages) && pages.includes(page))) score += 10;
      if (word.length > 2 && titles[page].toLowerCase().includes(word)) score += 10;
    }
    return /^(index|decisions|code|proofs|results|reference\/cli)/.test(name) ? score - 20 : score;
  },
};
