"""Files of tracked ultrasound. Each module is a dialect, recognised by its content.

A module has

- `recognises(path)`: whether the file is of this dialect and of no other;
- `read_tracking(path)`: the `recon.freehand.sequences.Frames` without images, or InputError;
- `image_shape(path)`: height and width of its images, None of tracking alone;
- `images(path)`: the images (h, w) of 8-bit grey one by one, the array's marked side right and depth down.

A file that none recognises is taken for one of PLUS.
"""
