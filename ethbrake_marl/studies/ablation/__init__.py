"""The ablation of cooperation: levels x seeds x recipes on common worlds, trained, measured, compared, drawn.

``plan`` says what is trained, ``cost`` what it takes, ``run`` trains and lets everything drive the same worlds,
``joint_optimum`` finds how well it could be done, ``comparison`` makes the figures of it, ``report`` shows them, and
``longer_lines`` does the same for more vehicles. ``run`` loads torch, ``report`` matplotlib.
"""
