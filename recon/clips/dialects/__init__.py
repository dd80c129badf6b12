"""Clips of a scanner's screen. Each module is a dialect, recognised by its mark or its suffix, or as a folder.

A module has

- `recognises(path)`: whether it is of this dialect and of no other;
- `read(path)`: the `recon.clips.clip.Clip`, or InputError.

A file that none recognises is taken for a DICOM file.
"""
