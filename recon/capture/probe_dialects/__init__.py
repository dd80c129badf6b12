"""Files of the probe's calibration. Each module is a dialect, recognised by its content.

A module has

- `recognises(path)`: whether the file is of this dialect and of no other;
- `read(path, speed_m_s)`: the `ProbeCalibration` in mm, or InputError; for a speed of sound, m/s, where the file names none and a
  caller does. `recon.capture.probe_values` has what is checked of all.
"""
