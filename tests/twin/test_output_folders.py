"""A capture takes the place of an earlier one of its kind, and of nothing else."""

from typing import get_args

import pytest

from recon.capture import manifest
from recon.capture.manifest import SCHEMA, Device, Manifest, SweepPart
from recon.errors import InputError
from twin.output_folders import Kind, check_places


@pytest.mark.parametrize(
    ("images", "kind"), [({"us": "sweep/us"}, "sweep"), ({"cam1": "sweep/cam1", "cam2": "sweep/cam2"}, "film")]
)
def test_only_the_same_kind_is_replaced(tmp_path, images, kind):
    (tmp_path / "capture").mkdir()
    devices = {name: Device(size=(64, 48)) for name in images}
    manifest.write_manifest(tmp_path / "capture", Manifest(schema=SCHEMA, devices=devices, sweep=SweepPart(images=images)))
    check_places(tmp_path, kind)
    for other in set(get_args(Kind)) - {kind}:
        with pytest.raises(InputError, match=f"capture: expected nothing or an earlier {other}, found a {kind}; choose another"):
            check_places(tmp_path, other)
