"""The paper's figures and tables, made again one by one, each with a verdict that is computed from the numbers.

``items`` is the one table of them; ``run`` makes them and writes a folder; ``page`` and ``markdown`` show the folder.
"""
