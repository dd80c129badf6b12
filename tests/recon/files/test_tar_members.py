"""Members are found where their bytes are, and whatever a tar file claims costs one line."""

import io
import os
import tarfile

import numpy as np
import pytest

from recon.errors import InputError
from recon.files.tar_members import members, name_at, read, samples


def entry(name: str, size: int = 3, kind: bytes = tarfile.REGTYPE, link: str = "") -> tarfile.TarInfo:
    result = tarfile.TarInfo(name)
    result.size, result.type, result.linkname = size, kind, link
    return result


def write(path, files: dict[str, bytes], kind: int = tarfile.PAX_FORMAT):
    with tarfile.open(path, "w", format=kind) as archive:
        for name, content in files.items():
            archive.addfile(entry(name, len(content)), io.BytesIO(content))
    return path


@pytest.mark.parametrize("kind", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_any_member_is_read_by_its_place(tmp_path, rng, kind):
    """Also after names that need headers of their own."""
    long = "" if kind == tarfile.USTAR_FORMAT else "x" * 300
    files = {f"0-{k}{long}.{end}": rng.bytes(int(rng.integers(0, 2000))) for k in range(5) for end in ("a.png", "json")}
    path = write(tmp_path / "shard.tar", files, kind)
    found = list(members(path))
    for member in reversed(found):
        assert read(path, member.offset, member.size) == files[member.name]
    assert [member.name for member in found] == list(files)
    assert name_at(path, found[3].offset) == found[3].name
    assert name_at(path, 1) == "at byte 1"


def test_samples_are_what_agrees_up_to_the_first_dot(tmp_path):
    """As in WebDataset; folders count, hidden files of other systems don't."""
    names = ["./0.a.png", "./0.json", "./._0.json", "part.1/0.a.png", "part.1/0.json", "1.json"]
    path = write(tmp_path / "shard.tar", dict.fromkeys(names, b"abc"))
    assert [(key, sorted(files)) for key, files in samples(path)] == [
        ("0", ["a.png", "json"]),
        ("part.1/0", ["a.png", "json"]),
        ("1", ["json"]),
    ]


def test_links_and_devices_are_no_samples(tmp_path):
    """Nothing outside the file is read, whatever it points at."""
    path = tmp_path / "shard.tar"
    with tarfile.open(path, "w") as archive:
        for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE):
            archive.addfile(entry("0.json", 0, kind, "/etc/passwd"))
        archive.addfile(entry("1.json"), io.BytesIO(b"abc"))
    assert [key for key, _ in samples(path)] == ["1"]


def claim(path, size: int):
    """A tar file whose only member claims a size."""
    header = entry("0.json", size).tobuf(tarfile.GNU_FORMAT)
    path.write_bytes(header + b"abc".ljust(512, b"\0") + b"\0" * 1024)


@pytest.mark.parametrize(
    ("size", "found"),
    [
        (10**15, r"expected a file of up to \d+ bytes, found 1000000000000000"),
        (10**6, "expected 1000000 bytes, found the tar file cut short"),
        (-512, "found"),
        (-(10**12), "found"),
    ],
)
def test_a_size_that_cant_be_is_refused(tmp_path, size, found):
    claim(tmp_path / "shard.tar", size)
    with pytest.raises(InputError, match=found) as caught:
        list(members(tmp_path / "shard.tar"))
    assert str(caught.value).startswith(f"{tmp_path}/shard.tar: ") and "\n" not in str(caught.value)


def test_files_with_holes_are_refused(tmp_path):
    """Their bytes don't lie where they are counted."""
    path = tmp_path / "shard.tar"
    with tarfile.open(path, "w", format=tarfile.PAX_FORMAT) as archive:
        sparse = entry("0.json")
        sparse.pax_headers = {
            "GNU.sparse.major": "0",
            "GNU.sparse.minor": "1",
            "GNU.sparse.map": "0,3",
            "GNU.sparse.size": "9" * 15,
        }
        archive.addfile(sparse, io.BytesIO(b"abc"))
    with pytest.raises(InputError, match=r"expected a file of up to \d+ bytes, found one with holes"):
        list(members(path))


def test_no_damage_ends_otherwise_than_in_a_line(tmp_path, rng):
    """Headers changed at random are read or refused."""
    whole = write(tmp_path / "whole.tar", {f"0-{k}{'x' * 120}.json": rng.bytes(300) for k in range(3)}).read_bytes()
    path, refused = tmp_path / "shard.tar", 0
    for _ in range(300):
        content = bytearray(whole)
        for place in rng.integers(0, 3000, 3):
            content[place] = rng.integers(256)
        for header in range(0, len(content) - 511, 512):  # with sums that fit, so that more than these is looked at
            block = content[header : header + 512]
            block[148:156] = b" " * 8
            content[header + 148 : header + 156] = b"%06o\0 " % sum(block)
        path.write_bytes(content[: rng.integers(len(content))] if rng.random() < 0.2 else content)
        try:
            assert all(member.size >= 0 for member in members(path))
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 50


def test_a_missing_file_and_a_folder_are_said(tmp_path):
    for path in (tmp_path / "nowhere.tar", tmp_path):
        with pytest.raises(InputError, match=f"^{path}: expected a"):
            list(members(path))
    with pytest.raises(InputError, match="expected a tar file, found none"):
        read(tmp_path / "nowhere.tar", 0, 1)
    (tmp_path / "short.tar").write_bytes(b"abc")
    with pytest.raises(InputError, match="expected 5 bytes at 1, found 2; was it changed meanwhile"):
        read(tmp_path / "short.tar", 1, 5)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
    """Nobody writes to it."""
    os.mkfifo(tmp_path / "shard-00000.tar")
    for attempt in (lambda path: list(members(path)), lambda path: read(path, 0, 1)):
        with pytest.raises(InputError, match=r"shard-00000\.tar: expected a tar file, found a pipe$"):
            attempt(tmp_path / "shard-00000.tar")


def test_bytes_are_where_they_are_said_to_be(tmp_path):
    content = np.arange(256, dtype=np.uint8).tobytes()
    path = write(tmp_path / "shard.tar", {"0.bin": content})
    [member] = members(path)
    assert path.read_bytes()[member.offset : member.offset + member.size] == content
