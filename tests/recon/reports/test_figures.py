"""Are values coloured by the whole of a colour map?"""

import matplotlib
import numpy as np
import pytest

from recon.reports.figures import CYCLIC, DIVERGING, SEQUENTIAL, Scale


@pytest.mark.parametrize("name", [CYCLIC, DIVERGING, SEQUENTIAL])
def test_pictures_have_the_colours_of_their_bar(name):
    """Whatever number of colours matplotlib has for it, 256 or 510; NaN is transparent."""
    values = np.linspace(-2.0, 3.0, 41)[None]
    found = Scale(name, -2.0, 3.0)(np.append(values, np.nan)[None])
    assert found[0, -1, 3] == 0
    expected = 255 * matplotlib.colormaps[name]((values + 2) / 5)
    assert np.abs(found[:, :-1] - expected).max() < 5
