"""Files of another kind than a histogram are called what they are, and not damaged."""

from pathlib import Path

import numpy as np
import pytest

from render.transient import write_transient
from scene2spad.cli import main
from scene2spad.datasets.planes import wall


@pytest.mark.parametrize("command", ["compare", "depth"])
def test_a_file_of_another_kind_is_named(capsys, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    write_transient(wall(2.0, 4), tmp_path / "a.exr")
    np.save("codes.npy", np.ones((4, 1024), np.float32))
    words = {"codes.npy": "codes.npy: is of kind codes, expected a histogram; `depth` takes them by --codes-file"}
    Path("x.exr").write_bytes(b"\x89HDF\r\n\x1a\n and more")
    words["x.exr"] = "x.exr: is an HDF5 file under the name of an OpenEXR file; give it the ending .h5"
    Path("y.exr").write_bytes(b"\x76\x2f\x31\x01 and more")
    words["y.exr"] = "y.exr: is an OpenEXR picture of another program, expected a histogram"
    Path("z.exr").write_text("hello")
    words["z.exr"] = "z.exr: is no OpenEXR file, whatever its name says"
    Path("t.csv").write_text("a,b\n1,2\n")
    Path("bad.npy").write_bytes(b"\x93NUMPY\x01\x00\x0c\x00{'descr': (  \n")
    words["bad.npy"] = "bad.npy: is of kind codes, expected a histogram"
    words["t.csv"] = "t.csv: is of kind table, expected a histogram (.h5); a table holds no photon counts of pixels"
    if command == "compare":
        words["a.exr"] = "a.exr: is of kind transient, expected a histogram; sense it first: `scene2spad sense`"
    for name, said in words.items():
        assert main([command, name]) == 2
        message = capsys.readouterr().err
        assert said in message and message.count("\n") == 1
