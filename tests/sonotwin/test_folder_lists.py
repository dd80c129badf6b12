"""Fields of several folders take one by itself, and each once by whatever path it is given."""

import os

import pytest
from pydantic import TypeAdapter, ValidationError

from sonotwin.folder_lists import Folders

FOLDERS = TypeAdapter(Folders)


def test_one_by_itself_is_a_list(tmp_path):
    assert FOLDERS.validate_python(str(tmp_path)) == FOLDERS.validate_python([tmp_path]) == [tmp_path]


def test_a_folder_by_two_paths_is_one(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "data")
    for other in (tmp_path / "link", tmp_path / "data" / ".." / "data", os.path.relpath(tmp_path / "data")):
        with pytest.raises(ValidationError, match=r"expected each folder once, found .* twice"):
            FOLDERS.validate_python([tmp_path / "data", other])


def test_a_link_to_itself_is_left_to_who_reads_it(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert FOLDERS.validate_python([tmp_path / "loop"]) == [tmp_path / "loop"]
