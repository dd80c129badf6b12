"""Stand-ins for the trained networks: a detector that was told where the circles are, a segmenter that thresholds."""

import cv2
import numpy as np

from recon.tracking.networks import CELL, DETECTOR_SIZE


class Told:
    """A detector that says the places given, in px of the frame, one set of (m, 2) a frame, with the names given."""

    def __init__(self, places, size=(1280, 1024), names=(0, 1, 2)):
        self.places, self.size, self.names = [np.asarray(each, float).reshape(-1, 2) for each in places], size, names
        self.detections = self.segmentations = 0

    def detect(self, images):
        self.detections += 1
        width, height = DETECTOR_SIZE
        detection = np.zeros((len(images), 65, height // CELL, width // CELL), np.float32)
        detection[:, 64] = 8
        identity = np.zeros((len(images), 4, height // CELL, width // CELL), np.float32)
        for k, places in enumerate(self.places):
            for point, name in zip(places * [width / self.size[0], height / self.size[1]], self.names, strict=False):
                u, v = np.rint(point).astype(int)
                if 0 <= u < width and 0 <= v < height:
                    detection[k, CELL * (v % CELL) + u % CELL, v // CELL, u // CELL] = 12
                    identity[k, name, v // CELL, u // CELL] = 5
        return detection, identity

    def segment(self, patches):
        self.segmentations += 1
        return np.stack([_disc(patch) for patch in patches])


def _disc(patch):
    """Logits of the dark blob nearest to the middle, filled."""
    grey = np.clip(patch / max(patch.max(), 1e-3) * 255, 0, 255).astype(np.uint8)
    _, dark = cv2.threshold(cv2.GaussianBlur(grey, (5, 5), 0), 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [contour for contour in contours if cv2.contourArea(contour) > 200]
    mask = np.full(patch.shape, -5, np.float32)
    if large:
        nearest = min(large, key=lambda contour: np.hypot(*(contour.reshape(-1, 2).mean(axis=0) - 59)))
        cv2.drawContours(mask, [nearest], -1, 5.0, -1)
    return mask
