"""The published tolerances of the physics, in one table; tests and reports compare with these and with nothing else.

``eps`` is the spacing of doubles at 1, 2^-52. "Round" is one simultaneous resolution of a cluster: a chain of touching
vehicles may need several at one instant. Sums run over the vehicles of a cluster, ``v`` is before it and ``v+`` after.
"""

EPS = 2.0**-52
SMALLEST = 1e-200  # relative tolerances hold for quantities that are 0 or at least this: products do not underflow

MOMENTUM_EPS = 4.0  # |sum m v+ - sum m v| <= 4 eps sum m max(|v|, |v+|), each round
RESTITUTION_EPS = 8.0  # |separation speed - e closing speed| <= 8 eps of the pair's largest |v|, an isolated pair
ENERGY_EPS = 8.0  # sum m v+^2 <= (1 + 8 eps) sum m v^2, each round (speeds over ground)
CLUSTER_EPS = 8.0  # each v+ of a cluster against the exact law: 8 eps of its largest |v|, each round

GAP_M = 1e-9  # a gap never lies below -1e-9 m between events, and differs so little from its closed form
CONTACT_TIME_EPS = 8.0  # relative, of a pair's contact time and closing speed: 8 eps (1 + (w^2 + 2 |b| g) / D)
# A segment that is split changes gaps, speeds and harm relative to at least 100 m, 30 m/s, 900 m2/s2 by no more than
SPLIT = 1e-12  # in a world with up to 30 impacts,
SPLIT_CASCADE = 1e-10  # and beyond: each impact multiplies the rounding of the ones before.
FEW_IMPACTS = 30

EXACT_RUN = 1e-9  # m, m/s, s: every impact and the end of a run of 6 s against rational arithmetic
RESTING_MPS2 = 1e-9  # accelerations of touching vehicles against the exact law, measured over 1/64 s
BOUNCE_SERIES_EPS = 1e4  # relative duration of a series of up to 506 bounces: 20 eps each

# A contact is decided by the sign of ``D - touch^2`` and by its time against the segment's end. Where these come closer
# to zero than the following, the closed form in doubles says nothing, and exact arithmetic decides.
DISCRIMINANT_EPS = 32.0  # of the scale w^2 + 2 |b| g, or of squared speeds and |b| ways where events lie before
END_EPS = 64.0  # of the way the pair's vehicles make in the segment, plus the gap; for the gap at the segment's end
