"""OpenCV FileStorage as calibrations are kept in it: opened, and its matrices read, or refused in one line."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files import atomic

Array = NDArray[np.float64]

SYMMETRIC = 1e-9  # of a covariance, relative to the standard deviations: it comes from a text file


@contextmanager
def opened(path: Path, expected: str) -> Iterator[cv2.FileStorage | None]:
    """Give the storage in a file; None for an npz file.

    Parameters
    ----------
    expected : what the file should be, for the message where it can't be read

    Raises
    ------
    InputError
        If there is no such file, or it is neither.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: expected {expected}, found {(error.strerror or 'none').lower()}") from None
    if data.startswith(b"PK"):  # of any zip file
        yield None
        return
    try:
        storage = cv2.FileStorage(data.decode("utf-8"), cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
    except (cv2.error, SystemError, UnicodeDecodeError):
        raise InputError(f"{path}: expected an npz file or OpenCV's YAML, XML or JSON, found other or damaged data") from None
    try:
        yield storage
    finally:
        storage.release()


def matrix(path: Path, name: str, node: cv2.FileNode) -> Array:
    """A node's matrix.

    Raises
    ------
    InputError
        If there is none, or something else.
    """
    if node.empty():
        raise InputError(f"{path}: {name}: expected a matrix, found none")
    try:
        value = node.mat()
    except (cv2.error, SystemError):
        value = None
    if value is None:
        raise InputError(f"{path}: {name}: expected a matrix, found something else")
    return np.asarray(value, float)


def names(storage: cv2.FileStorage) -> tuple[str, ...] | None:
    """Names of a covariance's parameters; empty where they are no texts, None where there are neither names nor covariance."""
    node = storage.getNode("parameters")
    if node.empty() and storage.getNode("covariance").empty():
        return None
    entries = [node.at(i) for i in range(node.size())] if node.isSeq() else []
    return tuple(entry.string() for entry in entries) if all(entry.isString() for entry in entries) else ()


def write_covariance(storage: cv2.FileStorage, names: Sequence[str], covariance: Array) -> None:
    """Write a covariance with the names of its parameters."""
    storage.startWriteStruct("parameters", cv2.FileNode_SEQ)
    for name in names:
        storage.write("", name)
    storage.endWriteStruct()
    storage.write("covariance", covariance)


def save(path: Path, storage: cv2.FileStorage) -> None:
    """Write a storage in memory to a file, whole or not at all."""
    text = storage.releaseAndGetString()
    with atomic.new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def covariance(path: Path, storage: cv2.FileStorage, count: int) -> Array:
    """The matrix `covariance` of a number of parameters, made exactly symmetric.

    Raises
    ------
    InputError
        If it is missing, of another shape, not finite, not symmetric, or no covariance.
    """
    values = matrix(path, "covariance", storage.getNode("covariance"))
    expected = f"{path}: covariance: expected {count}x{count} variances and covariances of the parameters, found"
    if values.shape != (count, count):
        raise InputError(f"{expected} shape {values.shape}")
    if not np.isfinite(values).all():
        raise InputError(f"{expected} values that are not finite")
    sigma = np.sqrt(np.abs(np.diag(values)))
    scale = np.outer(sigma, sigma) + np.finfo(float).tiny
    if (np.abs(values - values.T) > SYMMETRIC * scale).any():
        raise InputError(f"{expected} a matrix that is not symmetric")
    if np.diag(values).min() < 0 or (np.abs(values) > (1 + SYMMETRIC) * scale).any():
        raise InputError(f"{expected} a variance below zero or a correlation beyond one")
    return (values + values.T) / 2
