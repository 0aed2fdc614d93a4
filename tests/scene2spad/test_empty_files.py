"""Files that hold nothing, or something else than their names say, are refused by what is wrong with them."""

from __future__ import annotations

import pytest

from scene2spad.cli import main


@pytest.mark.parametrize("name", ["a.h5", "a.exr", "a.npz", "a.npy"])
@pytest.mark.parametrize("command", ["export", "show"])
def test_an_empty_file_is_refused_as_such(tmp_path, capsys, name, command):
    """An empty .h5 was said to be of kind dense."""
    (tmp_path / name).touch()
    out = ["--out", str(tmp_path / "b.npz")] if command == "export" else []
    assert main([command, str(tmp_path / name), *out]) == 2
    assert f"{name}: the file is empty" in capsys.readouterr().err


def test_what_is_no_hdf5_file_is_refused_as_such(tmp_path, capsys):
    (tmp_path / "a.h5").write_bytes(b"<html>not found</html>")
    assert main(["export", str(tmp_path / "a.h5"), "--out", str(tmp_path / "b.npz")]) == 2
    assert "a.h5: is no HDF5 file, expected" in capsys.readouterr().err
