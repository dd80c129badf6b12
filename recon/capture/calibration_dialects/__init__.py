"""Files of calibrated cameras and projectors. Each module is a dialect, recognised by its content; see `camera_dialects.Content`.

A module has

- `recognises(content)`: whether the content is of this dialect and of no other;
- `read(content, sizes)`: the `Calibration` in mm, or InputError; `sizes` are the devices' images, px, where a file has none.

One that is written, too, by `sonotwin export layout=NAME`, has

- `write(folder, optics)`: writes its files, and returns their names; InputError by the first value that has no place;
- `taken(optics)`: names of the devices that it has a place for.
"""
