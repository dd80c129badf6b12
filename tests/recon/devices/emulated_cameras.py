"""Folders of images for pylon's emulator to serve, and settings that let it do so."""

import hashlib

import cv2
import numpy as np

from recon.devices.basler import BaslerSettings

SERIALS = ("0815-0000", "0815-0001")


def digest(image):
    return hashlib.sha256(image.tobytes()).hexdigest()


def serve(folder, n, size, rng, **fields):
    """Write n images; gives the settings of a camera that serves them in turn, and the images' hashes."""
    folder.mkdir()
    hashes = []
    for k in range(n):
        image = rng.integers(0, 256, size[::-1], np.uint8)
        cv2.imwrite(str(folder / f"{k:04}.bmp"), image)
        hashes.append(digest(image))
    served = {"TestImageSelector": "Off", "ImageFilename": str(folder), "ImageFileMode": "On"}
    return BaslerSettings(size, features=served, **fields), hashes
