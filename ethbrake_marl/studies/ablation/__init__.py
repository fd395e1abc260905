"""What each step of cooperation is worth: levels x seeds x recipes on common worlds, measured, compared, drawn.

``levels`` says which levels belong together, ``plan`` what is trained and what it costs, ``trainings`` trains,
``measurement`` lets everything drive the same worlds, ``joint_optimum`` says how well it could be done, ``comparison``
makes the figures of it, ``tables`` and ``figures`` show them. ``figures`` loads matplotlib, ``trainings`` torch.
"""
