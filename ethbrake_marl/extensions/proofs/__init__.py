"""Proven lower bounds on harm: no commands of the controlled vehicle lead to less harm.

The files look at one controlled vehicle and its two neighbours, with brakes that act at once and a free road ahead. The
front vehicle is also called *leader*, the controlled vehicle *follower*. The *front pair* is the front and the
controlled vehicle; the *rear pair* is the controlled and the rear vehicle. The *first contact* is the first contact of
the controlled vehicle with either neighbour. The *extreme command* is full drive after a first contact with the front
vehicle, and full braking after a first contact with the rear vehicle.

Shared names. Index l is the front vehicle, f the controlled vehicle, r the rear vehicle; v is a speed (m/s), a > 0 a
braking capacity and u >= 0 a driving capacity (m/s2). Time 0 is the moment at which the controlled vehicle may act;
times are in s after it.

- ``at``: one world at time 0, [LINE_COLUMNS] of ``line``.
- ``kind``: neighbour of the first contact, ``FRONT_FIRST`` or ``REAR_FIRST``.
- ``time``: time of the contact.
- ``early``, ``late``: earliest and latest time of the first contact.
- ``soft``, ``hard``: smallest and largest closing speed of the first contact (m/s). ``closing``: another name of
  ``hard``.
- ``end``: end of the decision step in which the first contact happens; the command cannot change before ``end``.
- ``lack``: smallest amount (m/s2) by which the command until ``end`` differs from the extreme command.
- ``floor``: known lower bound on the harm of the pair that does not have the first contact (m2/s2).
- ``best``: smallest harm that the search has reached so far (m2/s2).
- ``enough``: lower bound on the harm that is proven in another way (m2/s2). A function may return 0 if its own bound
  would not be above ``enough``.
- ``cells``: memory for the search of ``branch_and_bound``, [CELLS, CELL_COLUMNS], overwritten; a row is a set of first
  contacts.
"""
