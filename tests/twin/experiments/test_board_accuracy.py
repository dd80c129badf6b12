"""Reduced rows of boards that aren't as designed."""

from twin.experiments import board_accuracy


def test_the_shape_of_a_bowed_board_is_found(rig):
    """Half a millimetre of bow: hundreds of times the form by a board taken as designed, 0.005 mm at most by default.

    One set's errors: of 39 parameters within chi-square's 99.9 %, of points that err together by three numbers likewise.
    """
    seed, flat = next(k for k in range(10, 30) if k % 4 == 3 and k % 7 % 3 == 0), "the true lens, taken as designed"
    found = board_accuracy.each(rig, seed, ("default", flat))
    assert found["default"].form_mm < 0.005 < 0.1 * found[flat].form_mm
    assert 0.4 < found["default"].parameters < 2 and found["default"].points < 5.4
