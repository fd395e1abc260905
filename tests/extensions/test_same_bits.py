"""As tests/test_same_bits.py, of extensions."""

from tests.test_same_bits import PACKAGE, TRAINED, calls_in

ROUNDED = "degrees to a direction; what is made of it is rounded to millimetres"
SOLVED = "optima of programmes, whose rates are written down as rounded percentages"
DRAWN = "corners of a star in a picture, in half pixels"
REMAINS = {
    ("learners/vine.py", "**"): TRAINED,
    ("field/human.py", "**"): "a variance",
    ("search/in_game.py", "**"): "sizes of tried changes; the game itself plays what is kept",
    ("recorded/states.py", "np.cos"): ROUNDED,
    ("recorded/states.py", "np.sin"): ROUNDED,
    ("rendering/picture.py", "math.cos"): DRAWN,
    ("rendering/picture.py", "math.sin"): DRAWN,
    ("reproduction/map_bound.py", "scipy.optimize"): SOLVED,
}


def test_extensions__call_nothing_that_differs_by_processor_but_what_is_listed() -> None:
    here = {each for each in REMAINS if (PACKAGE / "extensions" / each[0]).exists()}
    assert calls_in(PACKAGE / "extensions") == here and here
