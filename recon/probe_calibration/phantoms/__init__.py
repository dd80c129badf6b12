"""Phantoms that a probe is calibrated by, at rest while it moves. Each module is one, named as `phantom` of a calibration.

A module has

- `SHOWS`: its name in an image, for messages; `MIN_FRAMES` with it; `WAYS` on, by the reason of a rejection;
- `read(settings, reference)`: what is known of it beforehand, or None; `reference` is the frame of the poses, None for the world;
- `find(image, appearance, known)`: where it is in a B-scan : (h, w), 8-bit grey levels, log-compressed, with its covariance, or
  the reason of its rejection: a `phantom_frames.Seen`. `appearance` is an `Appearance` on the scanner, or None;
- `sight(seen, poses, covariance, rates, lag_sigma_s)`: all of these, as the calibration takes them, with the poses of their
  frames, their covariance, their change a second of the B-scans' lag, and its standard deviation;
- `calibrate(frames, settings, expected)`: a `phantom_frames.Adjusted`, by `phantom_frames.PhantomFrames`;
- `misfit(frames, settings)`, where it serves to find the B-scans' lag: mean square distance, mm^2, from where the phantom is
  likeliest, large ones cut, by a quick robust start; the adjustment of such a phantom has `late`, a `lateness.Lateness`;
- `others(known)`, where it may be defined wrongly: other definitions of the same kind, in words and as of `read`, which are tried
  where frames are refused;
- `figures(found)` and `describe(found, settings)` of that one: `Metrics`, and lines, besides those of all phantoms.

A phantom that shows one point has but `find` of its own, the rest is in `recon.probe_calibration.point_phantom`;
of one that shows a surface, in `surface_phantom`.
"""
