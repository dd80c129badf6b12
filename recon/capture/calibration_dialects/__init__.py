"""Files of calibrated cameras and projectors. Each module is a dialect, recognised by its content; see `camera_dialects.Content`.

A module has

- `TOLD_BY`: what tells it from the others, in a few words, for the refusal of a file that is of none; if it is
  left out, "a file of NAME";
- `recognises(content)`: whether the content is of this dialect and of no other. It is asked about everybody's files, so it never
  raises by what one holds: `content.values`, of OpenCV's storage, are empty and `content.texts()` none where they can't be read;
- `read(content, sizes)`: the `Calibration` in mm, or InputError that names `content.path`; `sizes` are the devices' images, px,
  where a file has none. `camera_dialects.of_mm` checks lengths in mm, or of a stated unit, and `of_metres` those in m.

One that is written, too, by `sonotwin export layout=NAME`, has

- `write(folder, optics)`: writes its files, and returns their names; InputError by the first value that has no place;
- `taken(optics)`: names of the devices that it has a place for.
"""
