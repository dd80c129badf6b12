"""A sequence is reconstructed as the PLUS toolkit's configuration says."""

import re

import cv2
import numpy as np
import pytest

from recon.errors import InputError
from recon.files import volumes
from recon.freehand import plus_config, sequences, volume_compounding
from recon.freehand.scans import VolumeSettings
from recon.freehand.volume_compounding import Clip
from recon.geometry import rigid
from recon.model.fan import Fan
from recon.model.probe import ProbeCalibration
from sonotwin.cli import main

CONFIG = """<PlusConfiguration version="2.1">
  <CoordinateDefinitions>
    <Transform From="Image" To="Probe" Matrix="0.1 0 0 1
      0 0.1 0 2.5e-003   0 0 0.1 3   0 0 0 1" Error="1.7"/>
  </CoordinateDefinitions>
  <VolumeReconstruction OutputSpacing="0.5 0.6 0.7" ClipRectangleOrigin="3 4" ClipRectangleSize="10 20"
    Interpolation="NEAREST_NEIGHBOR" Optimization="FULL" CompoundingMode="MEAN" FillHoles="ON" NumberOfThreads="1">
    <HoleFilling><HoleFillingElement Type="STICK" StickLengthLimit="9" NumberOfSticksToUse="1"/></HoleFilling>
  </VolumeReconstruction>
</PlusConfiguration>
"""


def test_what_is_in_a_configuration(tmp_path):
    (tmp_path / "c.xml").write_text(CONFIG)
    config = plus_config.read_config(tmp_path / "c.xml")
    assert np.array_equal(config.transforms["ImageToProbe"], [[0.1, 0, 0, 1], [0, 0.1, 0, 0.0025], [0, 0, 0.1, 3], [0, 0, 0, 1]])
    assert config.volume == VolumeSettings(
        (0.5, 0.6, 0.7), "aligned", "mean", "nearest", Clip(3, 4, 11, 21), 9, 1, arithmetic="plus_full"
    )
    assert config.names == ("Image", "Probe", "Reference")


def test_what_a_configuration_may_leave_out(tmp_path):
    text = '<A><VolumeReconstruction OutputSpacing="1 1 1" Interpolation="LINEAR" ClipRectangleSize="0 0"/></A>'
    (tmp_path / "c.xml").write_text(text)
    config = plus_config.read_config(tmp_path / "c.xml")
    assert config.transforms == {}
    assert config.volume == VolumeSettings((1, 1, 1), "aligned", "mean", "linear", None, 0, 1, arithmetic="plus_full")


@pytest.mark.parametrize(
    ("attributes", "compounding"),
    [
        ('Compounding="OFF"', "latest"),
        ('Compounding="ON" Calculation="WEIGHTED_AVERAGE"', "mean"),
        ('Compounding="OFF" Calculation="MAXIMUM"', "maximum"),
        ('Compounding="OFF" CompoundingMode="MEAN"', "mean"),
    ],
)
def test_compounding_as_before_2014(tmp_path, attributes, compounding):
    """By two attributes, as PLUS still understands them; the newer one goes before."""
    (tmp_path / "c.xml").write_text(f'<VolumeReconstruction OutputSpacing="1 1 1" {attributes}/>')
    assert plus_config.read_config(tmp_path / "c.xml").volume.compounding == compounding


def test_a_configuration_without_a_reconstruction_gives_its_transforms(tmp_path):
    """As most do, of devices and of calibrations."""
    path = tmp_path / "c.xml"
    path.write_text(re.sub("<VolumeReconstruction.*</VolumeReconstruction>", "", CONFIG, flags=re.DOTALL))
    config = plus_config.read_config(path)
    assert list(config.transforms) == ["ImageToProbe"] and config.volume is None
    path.write_text("<PlusConfiguration><DataCollection/></PlusConfiguration>")
    with pytest.raises(InputError, match=r"PlusConfiguration: expected an element VolumeReconstruction or CoordinateDefinitions"):
        plus_config.read_config(path)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("</Plus", "</Minus", "expected XML, found it broken: mismatched tag"),
        ("0.1 0 0 1\n", "0.1 0 0\n", "ImageToProbe: expected 16 finite numbers, found '0.1 0 0"),
        ("2.5e-003", "nan", "ImageToProbe: expected 16 finite numbers"),
        ("0 0 0 1", "0 0 0 2", "ImageToProbe: expected an invertible matrix with the last row 0 0 0 1"),
        ("0.5 0.6 0.7", "0.5 0 0.7", "OutputSpacing: expected 3 lengths above 0, found '0.5 0 0.7'"),
        ("10 20", "10", "ClipRectangleSize: expected 2 whole numbers of at least 0, found '10'"),
        ('"MEAN"', '"MEDIAN"', "CompoundingMode: expected one of MEAN, MAXIMUM, LATEST, IMPORTANCE_MASK, found MEDIAN"),
        ('"MEAN"', '"IMPORTANCE_MASK"', "VolumeReconstruction.ImportanceMaskFilename: expected a value, found none"),
        ('"FULL"', '"MORE"', "Optimization: expected one of FULL, PARTIAL, NONE, found MORE"),
        ('"STICK"', '"GAUSSIAN"', "HoleFilling: expected one element of type STICK, found GAUSSIAN"),
        ('"9"', '"nine"', "StickLengthLimit: expected a whole number of at least 1, found 'nine'"),
        ('"FULL"', '"FULL" FanAnglesDeg="-30"', "FanAnglesDeg: expected 2 finite numbers, found '-30'"),
        ('"FULL"', '"FULL" FanAnglesDeg="-30 95"', "Fan: angles: expected two from -89 to 89"),
    ],
)
def test_a_fault_in_one_line(tmp_path, old, new, line):
    path = tmp_path / "c.xml"
    path.write_text(CONFIG.replace(old, new))
    with pytest.raises(InputError) as fault:
        plus_config.read_config(path)
    assert str(fault.value).startswith(f"{path}: {line}") and "\n" not in str(fault.value)


@pytest.mark.parametrize(
    ("attributes", "fan"),
    [
        (
            'FanAnglesDeg="-30 35" FanOriginPixel="9 -20" FanRadiusStartPixel="25" FanRadiusStopPixel="60"',
            (9, -20, 25, 60, -30, 35),
        ),
        ('FanAngles="35 -30" FanOrigin="9 -20" FanDepth="60"', (9, -20, 0, 60, -30, 35)),  # as before 2013
        ('FanAnglesDeg="-30 35"', (0, 0, 0, 500, -30, 35)),  # the rest is as PLUS has it without a word
    ],
)
def test_a_fan_is_read_by_its_names_of_today_and_before(tmp_path, attributes, fan):
    path = tmp_path / "c.xml"
    path.write_text(CONFIG.replace('"FULL"', f'"FULL" {attributes}'))
    assert plus_config.read_config(path).volume.fan == Fan(*fan)
    path.write_text(CONFIG.replace('"FULL"', '"FULL" FanAnglesDeg="0 0" FanDepth="60"'))
    assert plus_config.read_config(path).volume.fan is None


def test_what_lies_beside_a_fan_is_no_part_of_the_volume(rng, tmp_path):
    """As large as the fan, from end to end; and all that is in it lies there, and nothing that is not."""
    probe = ProbeCalibration(np.eye(4), np.array([0.5, 0.5]))
    poses = np.array([rigid.from_rotation_vector([0, 0, 0], [0, 0, z]) for z in np.arange(5) / 2])
    fan = Fan(40.0, -15.0, 30.0, 90.0, -35.0, 35.0)
    inside = fan.mask((90, 80))
    images = np.where(inside, 200, 10).astype(np.uint8).repeat(5).reshape(90, 80, 5).transpose(2, 0, 1)
    path = tmp_path / "s.igs.nrrd"
    sequences.write_sequence(path, sequences.sequence_of(np.ascontiguousarray(images), poses, probe, np.arange(5) / 20))
    attributes = 'FanAnglesDeg="-35 35" FanOriginPixel="40 -15" FanRadiusStartPixel="30" FanRadiusStopPixel="90"'
    (tmp_path / "c.xml").write_text(f'<VolumeReconstruction OutputSpacing="0.5 0.5 0.5" CompoundingMode="LATEST" {attributes}/>')
    pasted, _ = plus_config.reconstruct_sequence(path, plus_config.read_config(tmp_path / "c.xml"))
    assert set(np.unique(pasted.volume.voxels)) == {0, 200}
    v, u = np.nonzero(inside)
    assert np.allclose(pasted.volume.origin, [u.min() / 2, v.min() / 2, 0])
    assert pasted.filled.sum() == 5 * inside.sum()


def test_an_importance_mask_weights_the_pixels(rng, tmp_path, capsys):
    """The left half of each B-scan by 3 against 1, the last columns not at all; the mask's file beside the configuration."""
    probe = ProbeCalibration(np.eye(4), np.array([0.5, 0.5]))
    poses = np.array([rigid.from_rotation_vector([0, 0, 0], [10.0 * k, 0, 0]) for k in range(2)])  # by half a B-scan
    images = np.stack([np.full((20, 40), level, np.uint8) for level in (50, 90)])
    sequences.write_sequence(path := tmp_path / "s.igs.nrrd", sequences.sequence_of(images, poses, probe, np.arange(2) / 20))
    attributes = 'OutputSpacing="0.5 0.5 0.5" CompoundingMode="Importance_Mask" ImportanceMaskFilename="mask.png"'
    (tmp_path / "c.xml").write_text(f"<VolumeReconstruction {attributes}/>")
    weights = np.repeat([[180] * 20 + [60] * 15 + [0] * 5], 20, axis=0).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "mask.png"), weights)
    pasted, _ = plus_config.reconstruct_sequence(path, plus_config.read_config(tmp_path / "c.xml"))
    levels = pasted.volume.voxels[0]
    assert (
        (levels[:, :20] == 50).all()
        and (levels[:, 20:35] == (60 * 50 + 180 * 90) // 240).all()
        and (levels[:, 35:55] == 90).all()
    )
    assert not pasted.filled[0, :, 55:].any()

    line = ["freehand", f"sequence={path}", "implausible=take", f"out={tmp_path / 'out'}"]
    assert main([*line, f"config={tmp_path / 'c.xml'}"]) == 0
    assert np.array_equal(volumes.read_volume(tmp_path / "out" / "volume.nrrd").voxels[0], levels)
    assert main([*line, f"config={tmp_path / 'c.xml'}", "compounding=latest"]) == 0
    capsys.readouterr()
    cv2.imwrite(str(tmp_path / "mask.png"), weights[:10])
    for given, complaint in (
        ([f"config={tmp_path / 'c.xml'}"], "mask.png: expected 40x20 8-bit, found 40x10 8-bit"),
        (["compounding=weighted"], "weights: expected an image with compounding=weighted, and only then, found none"),
        ([f"weights={tmp_path / 'mask.png'}"], "mask.png with compounding=mean"),
    ):
        assert main([*line, *given]) == 2
        assert complaint in (said := capsys.readouterr().err) and said.count("\n") == 1


def test_the_real_sweep_becomes_the_volume_of_plus(real):
    """To the last bit, filled holes and all."""
    folder = real / "tracked_sweep"
    config = plus_config.read_config(folder / "config_NN_MEAN.xml")
    reference = volumes.read_volume(folder / "volume_NN_MEAN.mha")
    _, whole = plus_config.reconstruct_sequence(folder / "SpinePhantomFreehand.igs.mha", config)
    assert np.abs(whole.volume.origin - reference.origin).max() < 1e-3  # as many digits as the file has
    assert np.array_equal(whole.volume.voxels, reference.voxels)


def test_ones_own_sequence_is_reconstructed_without_further_transforms(rng, tmp_path):
    """And frames whose pose or image is invalid are not in it."""
    probe = ProbeCalibration(rigid.from_rotation_vector([0.1, 0.2, 0.3], [4, 5, 6]), np.array([0.2, 0.2]))
    poses = np.array([rigid.from_rotation_vector([0, 0, 0], [0, 0, z]) for z in range(5)], float)
    poses[1, 0, 0] = np.nan
    images = rng.integers(1, 256, (5, 30, 40), np.uint8)
    frames = sequences.sequence_of(images, poses, probe, np.arange(5) / 20)
    frames.valid["Image"][3] = False
    sequences.write_sequence(tmp_path / "s.igs.nrrd", frames)
    (tmp_path / "c.xml").write_text('<VolumeReconstruction OutputSpacing="0.5 0.5 0.5" CompoundingMode="LATEST"/>')
    found, _ = plus_config.reconstruct_sequence(tmp_path / "s.igs.nrrd", plus_config.read_config(tmp_path / "c.xml"))
    used = [0, 2, 4]
    matrices = poses[used] @ sequences.target_from_pixel(probe)
    grid = volume_compounding.aligned_grid(volume_compounding.corners(matrices, (30, 40)), 0.5)
    expected = volume_compounding.reconstruct(images[used], matrices, grid, "latest", arithmetic="plus_full")
    assert np.array_equal(found.volume.voxels, expected.volume.voxels) and np.array_equal(found.filled, expected.filled)


def test_a_sequence_without_images_or_transforms(rng, tmp_path):
    (tmp_path / "c.xml").write_text('<VolumeReconstruction OutputSpacing="0.5 0.5 0.5"/>')
    config = plus_config.read_config(tmp_path / "c.xml")
    path = tmp_path / "s.igs.mha"
    yes = np.ones(2, bool)
    sequences.write_sequence(path, sequences.Frames(np.arange(2.0), {}, {"Image": yes}, np.zeros((2, 4, 4), np.uint8)))
    with pytest.raises(InputError, match=r"s.igs.mha: transforms: expected some in each frame, .* found none: without poses"):
        plus_config.reconstruct_sequence(path, config)
    sequences.write_sequence(path, sequences.Frames(np.arange(2.0), {}, {}))
    with pytest.raises(InputError, match=r"s.igs.mha: DimSize: expected images, found tracking only"):
        plus_config.reconstruct_sequence(path, config)
