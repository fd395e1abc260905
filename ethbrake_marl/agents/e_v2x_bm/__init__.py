"""E-V2X-BM, the analytic baseline: closed form of a pair, pairwise and coupled optimum, the agent."""
