"""What is predicted of a plane is what is found on a rendered one, and depends on the rig as theory has it."""

import cv2
import numpy as np
import pytest

from recon.estimation import covariance as covariances
from recon.geometry import rigid
from recon.identification import calibrated_optics as identified_optics
from recon.identification import rig_file
from recon.identification.estimates import Estimate, Findings
from recon.model.patterns import Fringes, GrayCode, Patterns
from recon.model.rig import Pose
from recon.optical_calibration import uncertainty
from scenes.board_poses import Config as Poses
from scenes.kinds import plane
from tests.twin.small_rigs import cropped
from twin.conditions import IDEAL, Frames
from twin.experiments import chain_trial, closed_forms, drawn_rig, predicted_plane, surface_accuracy
from twin.experiments.drawn_session import Noise, calibrated_optics
from twin.experiments.predicted_plane import Measurement
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import Shooting


def measurement(rig, **fields) -> Measurement:
    parts = (Fringes(pitch=12, steps=8), GrayCode(pitch=12, bits=8, complementary=True))
    patterns = Patterns(projector_size=rig.projector.optics.size, unwrap="gray", parts=parts)
    usual = {"plate": plane.PAPER_POSES[2], "shooting": Shooting(), "tracing": Tracing(samples=1024, room_lux=20)}
    return Measurement(**{"patterns": patterns} | usual | fields)


@pytest.mark.slow
def test_a_rendered_plane_is_as_far_off_as_is_predicted(rig):
    """Of a rig drawn at random, within 5 %, and so are exposures, which are set for the brightest places: amid the image.

    By many samples: of a coarse raster, nearly in focus, 16 leave 0.05 projector px of noise of their own, 64 half of it.
    """
    seed = 202
    drawn, _ = drawn_rig.draw(rig, seed)
    drawn = drawn.model_copy(
        update={"cam1": cropped(drawn.cam1, (drawn.cam1.optics.size[0] // 2, drawn.cam1.optics.size[1] // 2))}
    )
    chosen = measurement(drawn)
    found = surface_accuracy.experiment(drawn, plane.build(chosen.plate), chosen.patterns, seed, chosen.tracing)
    predicted = predicted_plane.predict(drawn, chosen)
    assert predicted.rms_mm == pytest.approx(found.metrics["plane_plate_rms_mm"], rel=0.05)
    assert predicted.exposure_s == pytest.approx(found.view.exposure.time_s, rel=0.05)


def test_shot_noise_falls_with_the_root_of_the_light(rig):
    """Of sensors without dark noise, in images of 12 bits: fourfold for half the error. Longer ones that saturate are refused."""
    sensor = rig.cam1.sensor.model_copy(update={"dark_noise_e": 0.0, "dark_current_e_per_s": 0.0, "adc_bits": 12})
    quiet = rig.model_copy(update={"cam1": rig.cam1.model_copy(update={"sensor": sensor})})
    dark = Tracing(samples=16, room_lux=0)
    shots = [Shooting(exposure_s=seconds, bits=12) for seconds in (0.001, 0.004)]
    short, long = (predicted_plane.predict(quiet, measurement(rig, tracing=dark, shooting=shot)) for shot in shots)
    assert short.noise_mm / long.noise_mm == pytest.approx(2, rel=0.02)
    with pytest.raises(ValueError, match="bright places saturate"):
        predicted_plane.predict(quiet, measurement(rig, shooting=Shooting(exposure_s=0.1, bits=12)))
    assert long.modulation_dn / short.modulation_dn == pytest.approx(4, rel=1e-6)


def test_shot_noise_counts_where_the_wave_is_steep(rig, rng):
    """Of eight steps behind gamma 2.2, by 100 000 pixels of Poisson's noise; that of the mean light is a tenth more."""
    wave = closed_forms.waveform(rig, Fringes(pitch=12, steps=8), 512)
    harmonics, steps = 4000 * 2 * np.fft.rfft(wave).real[:6] / 512, 2 * np.pi * np.arange(8) / 8
    phase = rng.uniform(0, 2 * np.pi, 100_000)
    light = harmonics[0] / 2 + sum(harmonics[k] * np.cos(k * (phase[:, None] + steps)) for k in range(1, 6))
    found = np.angle(rng.poisson(np.maximum(light, 0)) @ np.exp(-1j * steps) * np.exp(-1j * phase)).std()
    by_mean, by_weighed = (
        closed_forms.phase_sigma(8, np.sqrt(level), harmonics[1])
        for level in (harmonics[0] / 2, (harmonics[0] - harmonics[2]) / 2)
    )
    assert found == pytest.approx(by_weighed, rel=0.01) and by_mean > 1.05 * found


def test_flicker_costs_the_light_of_the_brightest_frame(rig, rng):
    """Exposures are set for it: of a code's nine frames, which are brighter than fringes, to 2 in 1000."""
    steady, flickering = (predicted_plane.predict(rig, measurement(rig, frames=Frames(flicker=share))) for share in (0.0, 0.02))
    bright = sum(part.count for part in measurement(rig).patterns.parts if isinstance(part, GrayCode))
    brightest = 1 + 0.02 * rng.standard_normal((20_000, bright)).max(axis=1).mean()
    assert steady.exposure_s / flickering.exposure_s == pytest.approx(brightest, rel=2e-3)
    assert flickering.noise_mm > 1.005 * steady.noise_mm and flickering.frames_mm == 0
    for count in (1, 3, 40):
        expected = rng.standard_normal((20_000, count)).max(axis=1).mean()
        assert predicted_plane.largest_normal(count) == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("steps", [3, 8])
@pytest.mark.parametrize("errors", [Frames(flicker=0.02), Frames(stray_dn=1.0), Frames(shift=0.03)])
def test_phases_err_by_errors_of_frames_as_the_closed_form_says(rng, steps, errors):
    """About each surface's own mean, by 4000 sequences of 64 phases, to 4 %."""
    turn, phase, level = 2 * np.pi * np.arange(steps) / steps, 2 * np.pi * np.arange(64) / 64, 1.4
    gain, stray, late = rng.standard_normal((3, 4000, steps, 1))
    waves = level + np.cos(phase + turn[:, None] + 2 * np.pi / steps * errors.shift * late)
    images = (1 + errors.flicker * gain) * waves + errors.stray_dn / 100 * stray
    off = np.angle(np.einsum("snp,n->sp", images, np.exp(-1j * turn)) * np.exp(-1j * phase))
    found = np.sqrt(np.mean((off - off.mean(axis=1, keepdims=True)) ** 2))
    closed = closed_forms.phase_sigma_of_frames(steps, errors.flicker, errors.stray_dn / 100, errors.shift, level)
    assert closed == pytest.approx(found, rel=0.04)


def test_errors_of_frames_count_where_the_decoder_can_not_find_them(rig):
    """By three steps, as their phases err; by four none."""
    errors = Frames(flicker=0.01, stray_dn=0.5, shift=0.01)

    def by(steps):
        parts = (Fringes(pitch=12, steps=steps), GrayCode(pitch=12, bits=8, complementary=True))
        patterns = Patterns(projector_size=rig.projector.optics.size, unwrap="gray", parts=parts)
        return predicted_plane.predict(rig, measurement(rig, patterns=patterns, frames=errors))

    three, four = by(3), by(4)
    assert four.frames_mm == 0 < three.frames_mm
    assert three.rms_mm == pytest.approx(np.sqrt(three.noise_mm**2 + three.frames_mm**2 + three.mirrors_mm**2))
    flat = plane.build(plane.PAPER_POSES[2]).shapes[0]
    level = 1 / closed_forms.contrast(rig, Fringes(pitch=12, steps=3), flat.point)
    phase = closed_forms.phase_sigma_of_frames(3, errors.flicker, errors.stray_dn / three.modulation_dn, errors.shift, level)
    assert three.frames_mm == pytest.approx(closed_forms.plane_sigma(rig, flat, 12 / (2 * np.pi) * phase), rel=0.05)


def test_elasticities_are_those_of_larger_changes(rig):
    """By a twentieth up and down, as blur bends the curve; the depth of focus, at the plane, changes nothing to first order."""
    names = ["cam1.sensor.saturation_e", "projector.gamma", "projector.lens.blur_px"]
    found = predicted_plane.elasticities(rig, measurement(rig), names)
    assert list(found) == sorted(names, key=lambda name: -abs(found[name])) and found[names[0]] == pytest.approx(-0.5, abs=0.05)
    for name, slope in found.items():
        ends = [
            predicted_plane.predict(
                rig_file.apply(rig, Findings({name: Estimate(rig.number(name) * share, 0.0, "a test")})), measurement(rig)
            ).rms_mm
            for share in (0.95, 1.05)
        ]
        assert slope == pytest.approx(np.log(ends[1] / ends[0]) / np.log(1.05 / 0.95), abs=0.01)


def test_the_interval_is_that_of_the_measured_numbers(rig):
    """5 % of the saturation, which the error goes with by -0.5, and half as much again in quadrature of another like it."""
    number = rig.cam1.sensor.saturation_e
    one = rig_file.apply(rig, Findings({"cam1.sensor.saturation_e": Estimate(number, 0.05 * number, "a test")}))
    now = predicted_plane.predict(rig, measurement(rig)).rms_mm
    assert predicted_plane.uncertainty(rig, measurement(rig)) == 0
    assert predicted_plane.uncertainty(one, measurement(rig)) == pytest.approx(0.025 * now, rel=0.1)


def test_rows_count_where_they_measure(rig):
    """With the projector turned by a right angle about its own axis, rows measure as columns did; information adds up.

    Of a small plate in the middle of both views, where a turn changes hardly anything else; pinholes with square pixels.
    """
    optics = rig.projector.optics
    middle = tuple((side - 1) / 2 for side in optics.size)
    plain = optics.model_copy(update={"centre_px": middle, "distortion": (0.0,) * 5})
    pose = rigid.from_rotation_vector((0.0, 0.0, np.pi / 2), (0.0, 0.0, 0.0)) @ plain.device_from_world.matrix()
    turned = Pose(rotation_deg=tuple(np.rad2deg(cv2.Rodrigues(pose[:3, :3])[0].ravel())), translation_mm=tuple(pose[:3, 3]))
    rigs = [
        rig.model_copy(update={"projector": rig.projector.model_copy(update={"optics": one})})
        for one in (plain, plain.model_copy(update={"device_from_world": turned}))
    ]
    small = plane.Config(centre_mm=plane.PAPER_POSES[2].centre_mm, size_mm=(60, 60))

    def errors(one, *axes):
        parts = tuple(Fringes(axis=axis, pitch=pitch, steps=8) for axis in axes for pitch in (12, 130, 1400))
        patterns = Patterns(projector_size=one.projector.optics.size, unwrap="heterodyne", parts=parts)
        return predicted_plane.predict(one, measurement(one, plate=small, patterns=patterns))

    columns, rows = ([errors(one, axis) for one in rigs] for axis in ("columns", "rows"))
    assert rows[1].rms_mm == pytest.approx(columns[0].rms_mm, rel=0.03)
    assert columns[1].noise_mm > 1.5 * rows[1].noise_mm
    for one, *single in zip(rigs, columns, rows, strict=True):
        together = sum(found.noise_mm**-2 for found in single) ** -0.5
        assert errors(one, "columns", "rows").noise_mm == pytest.approx(together, rel=0.01)


def code_alone(rig, pitch, *axes, guide=()) -> Patterns:
    """A code of cells of `pitch` px, each bit with its inverse."""
    size = rig.projector.optics.size
    lengths = {"columns": size[0], "rows": size[1]}
    parts = (
        GrayCode(axis=axis, pitch=pitch, bits=int(np.ceil(np.log2(lengths[axis] / pitch))), inverted=True, start=-0.5)
        for axis in axes
    )
    return Patterns(projector_size=size, unwrap="gray", parts=(*parts, *guide))


def sharp(rig, blur_px):
    """A rig of fine camera pixels and pinholes, whose projector blurs by so many of its px, and whose black is black."""
    lens = {"blur_px": 0.01, "f_number": 1000.0}
    sensor = rig.cam1.sensor.model_copy(update={"dark_current_e_per_s": 0.0})  # pinholes are dark
    camera = rig.cam1.model_copy(update={"lens": rig.cam1.lens.model_copy(update=lens), "sensor": sensor})
    optics = camera.optics.model_copy(update={"focal_px": tuple(20 * f for f in camera.optics.focal_px)})
    optics = optics.model_copy(update={name: tuple(20 * n for n in getattr(optics, name)) for name in ("size", "centre_px")})
    projector = rig.projector.model_copy(
        update={"lens": rig.projector.lens.model_copy(update=lens | {"blur_px": blur_px}), "contrast": 1e6}
    )
    return rig.model_copy(update={"cam1": camera.model_copy(update={"optics": optics}), "projector": projector})


def test_a_code_alone_errs_by_its_cells(rig):
    """Of 4 px, by 4 over the root of 12 of a column, where bits are sharp; both axes add information."""
    known, flat = sharp(rig, 0.01), plane.build(plane.PAPER_POSES[2]).shapes[0]
    columns, rows, both = (
        predicted_plane.predict(known, measurement(known, patterns=code_alone(known, 4, *axes)))
        for axes in (("columns",), ("rows",), ("columns", "rows"))
    )
    assert columns.rms_mm == pytest.approx(closed_forms.plane_sigma(known, flat, 4 / np.sqrt(12)), rel=0.02)
    together = predicted_plane.predict(known, measurement(known, patterns=code_alone(known, 8, "columns", "rows")))
    assert both.rms_mm < min(columns.rms_mm, rows.rms_mm) and together.rms_mm == pytest.approx(2 * both.rms_mm, rel=0.02)


def test_blur_that_hides_the_finest_stripes_makes_cells_wider(rig):
    """Stripes of a period of 4 px are 0.7 % of their contrast behind 2 px of blur, and those of 8 px still 29 %.

    That is nearly twice the error; pixels on borders, which are wide now, are taken for what they are, and err less.
    """
    clear, blurred = (
        predicted_plane.predict(one, measurement(one, patterns=code_alone(one, 1, "columns")))
        for one in (sharp(rig, 0.01), sharp(rig, 2.0))
    )
    assert 1.6 < blurred.rms_mm / clear.rms_mm < 2.1


@pytest.mark.slow
def test_a_rendered_plane_under_a_code_alone_is_as_far_off_as_is_predicted(rig):
    """Of a rig drawn at random, both axes to the pixel, within 6 %: 5000 pixels know it to 1 %."""
    seed = 204
    drawn, _ = drawn_rig.draw(rig, seed)
    width, height = drawn.cam1.optics.size
    drawn = drawn.model_copy(update={"cam1": cropped(drawn.cam1, (width // 8, height // 8))})
    chosen = measurement(drawn, patterns=code_alone(drawn, 1, "columns", "rows"), tracing=Tracing(samples=256, room_lux=20))
    found = surface_accuracy.experiment(drawn, plane.build(chosen.plate), chosen.patterns, seed, chosen.tracing)
    assert predicted_plane.predict(drawn, chosen).rms_mm == pytest.approx(found.metrics["plane_plate_rms_mm"], rel=0.06)


def test_fringes_beside_a_code_alone_are_refused(rig):
    guided = (Fringes(pitch=12, steps=8), GrayCode(pitch=12, bits=8, complementary=True))
    patterns = code_alone(rig, 1, "rows", guide=guided)
    with pytest.raises(ValueError, match="found fringes of columns, code of rows"):
        predicted_plane.predict(rig, measurement(rig, patterns=patterns))


def test_a_calibrations_errors_bend_the_plane_as_predicted(rig, rng):
    """Mean square and scatter of 300 calibrations with errors drawn from the covariance of one by a board in 12 poses."""
    calibration = calibrated_optics(rig, IDEAL, Noise(board_px=0.05), Poses(count=12), 3)
    known = identified_optics.with_devices(rig, calibration)
    found, (camera, projector) = predicted_plane.predict(known, measurement(known)), known_devices(known.calibration())
    true = plane.build(plane.PAPER_POSES[2]).shapes[0]
    pixels = (
        np.stack(np.meshgrid((np.arange(17) + 0.5) / 17 * 1280, (np.arange(13) + 0.5) / 13 * 1024), axis=-1).reshape(-1, 2) - 0.5
    )
    points, _ = closed_forms.seen_points(camera, projector, true, pixels)
    seen, columns = camera.project(points), projector.project(points)[:, 0]
    terms = np.column_stack([np.ones(len(points)), points[:, :2]])
    root, squares = covariances.root(known.calibration().uncertainty.covariance), []
    for _ in range(300):
        moved = known_devices(uncertainty.apply(known.calibration(), root @ rng.standard_normal(root.shape[1])))
        off = (chain_trial.on_rays(moved, moved[0].rays(seen), columns, points) - points) @ true.normal
        squares.append(np.mean((off - terms @ np.linalg.lstsq(terms, off)[0]) ** 2))
    assert np.mean(squares) == pytest.approx(found.optics_mm**2, rel=0.2)
    assert np.std(squares) == pytest.approx(found.optics_sigma_mm2, rel=0.3)
    assert found.rms_mm == pytest.approx(np.linalg.norm([found.noise_mm, found.mirrors_mm, found.optics_mm]))


def known_devices(calibration):
    return [calibration.cameras[name] for name in ("cam1", "projector")]


def test_a_plate_out_of_view_is_refused(rig):
    with pytest.raises(ValueError, match="in view of camera 1 and the projector"):
        predicted_plane.predict(rig, measurement(rig, plate=plane.Config(centre_mm=(2000.0, 0.0, 660.0))))
