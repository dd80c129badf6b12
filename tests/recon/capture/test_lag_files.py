"""A measured lag survives its file, and a bad file is refused in one line."""

import pytest

from recon.capture import lag_files
from recon.capture.lag_files import LagFile
from recon.errors import InputError

LAG = LagFile(lag_s=0.0501, sigma_s=0.0007, interval_s=(0.0487, 0.0515), coverage=0.95)


def test_a_lag_is_read_as_it_was_written(tmp_path):
    lag_files.write(tmp_path / "lag.json", LAG)
    assert lag_files.read(tmp_path / "lag.json") == LAG


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected JSON, found it damaged"),
        ("[1]", "a map of fields"),
        ('{"lag_s": 0.05}', "sigma_s"),
        ('{"lag_s": NaN, "sigma_s": 0, "interval_s": [0, 1], "coverage": 0.95}', "expected finite numbers, found NaN"),
        ('{"lag_s": 0.05, "sigma_s": -1, "interval_s": [0, 1], "coverage": 0.95}', "sigma_s"),
        ('{"lag_s": 0.05, "sigma_s": 0, "interval_s": [0], "coverage": 0.95}', "interval_s"),
        ('{"lag_s": 0.05, "sigma_s": 0, "interval_s": [0.06, 0.04], "coverage": 0.95}', "interval_s: .*low, then high"),
        (b"\xff\xfe", "JSON"),
        (None, "expected a file, found none"),
    ],
)
def test_a_bad_file_is_refused(tmp_path, text, said):
    path = tmp_path / "lag.json"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=said) as caught:
        lag_files.read(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
