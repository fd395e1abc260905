"""The paper's figures and tables, made again one by one, each with a verdict that is computed from the numbers.

``items`` has the table of them and makes each; ``folder`` writes what they give, and shows it as pages.
"""
