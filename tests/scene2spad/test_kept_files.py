"""Commands keep files of other programs, and write again what they wrote before, as older versions left it, too."""

from pathlib import Path

import h5py
import matplotlib
import numpy as np
import pytest
import scipy.io
from commands import refused
from PIL import Image

from scene2spad.cli import main
from scene2spad.cli.results.compare import FIGURES
from scene2spad.cli.simulation.sensing import is_our_mat
from spad.formats.mat import PULSE_NAME
from ultraphase.catalog import FOLDER

MODEL = "learned-256x4x4-128x-s0"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    size = ("--width", "16", "--height", "12", "--bounces", "1")
    assert main(["render", "gallery", *size, "--no-figure", "--out", str(folder / "g.exr")]) == 0
    assert main(["sense", str(folder / "g.exr"), "--no-figure"]) == 0
    return folder


@pytest.fixture
def folder(made, tmp_path, monkeypatch) -> Path:
    """A folder of its own with a transient, its histogram and a program."""
    for name in ("g.exr", "g.h5"):
        (tmp_path / name).write_bytes((made / name).read_bytes())
    (tmp_path / "own.s").write_text((FOLDER / "coarse.s").read_text())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def kept(capfd, argv: list[str], path: str, contents: bytes) -> str:
    """The message of a command that is refused and leaves the file as it was."""
    Path(path).write_bytes(contents)
    message = refused(capfd, *argv)
    assert path in message and Path(path).read_bytes() == contents
    return message


def foreign_pdf() -> bytes:
    matplotlib.pyplot.figure().savefig("a.pdf")
    return Path("a.pdf").read_bytes()


def foreign_png() -> bytes:
    Image.fromarray(np.zeros((4, 4), np.uint8)).save("a.png", dpi=(72, 72))
    return Path("a.png").read_bytes()


TABLE = b"name,grade\nada,1\n"
CASES = {
    "listing": ("ultraphase list own.s --out x.txt", b"my notes\n"),
    "words": ("ultraphase asm own.s --define K=8 SHIFT=7 --out prec.csv", TABLE),
    "power table": ("ultraphase table --out x.csv", TABLE),
    "power sweep": ("ultraphase sweep --out x.csv", TABLE),
    "compiled": (f"ultraphase compile {MODEL} --out x.txt", b"my notes\n"),
    "comparison": ("compare g.h5 --methods argmax --out x.csv", TABLE),
    "page": ("show g.exr --out x.html", b"<html></html>"),
    "points": ("export g.h5 --out x.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"),
    "codes": (f"export {MODEL} --out x.txt", b"my notes\n"),
    "mat": ("sense g.exr --export mat --no-figure --out x.h5", b"MATLAB 5.0 MAT-file, Platform: GLNXA64"),
    "sheet": ("scenes rooms --sheet x.png --count 1 --width 8", b"\x89PNG of mine"),
}


@pytest.mark.parametrize("case", CASES)
def test_files_of_other_programs_are_kept(case, folder, capfd):
    line, contents = CASES[case]
    argv = line.split()
    path = "x.mat" if case == "mat" else next(word for word in argv if word.startswith(("x.", "prec.")))
    assert "exists and is no " in kept(capfd, argv, path, contents)
    assert not Path("x.compare.png").exists() and not Path("x.h5").exists()


def test_pictures_and_arrays_of_other_programs_are_kept(folder, capfd):
    kept(capfd, ["show", "g.exr", "--out", "photo.png"], "photo.png", foreign_png())
    kept(capfd, ["show", "g.exr", "--out", "paper.pdf"], "paper.pdf", foreign_pdf())
    np.savez("a.npz", weights=np.ones(3))
    kept(capfd, ["export", "g.exr", "--out", "mine.npz"], "mine.npz", Path("a.npz").read_bytes())
    with h5py.File("a.h5", "w") as file:
        file["weights"] = np.ones(3)
    kept(capfd, ["export", "g.exr", "--out", "mine.h5"], "mine.h5", Path("a.h5").read_bytes())
    kept(capfd, ["export", "g.exr", "--out", "g.h5"], "g.h5", Path("g.h5").read_bytes())  # a histogram


def test_no_program_is_written_over_its_source(folder, capfd):
    assert "is the input itself" in kept(
        capfd, ["ultraphase", "list", "own.s", "--out", "own.s"], "own.s", Path("own.s").read_bytes()
    )


@pytest.mark.parametrize(
    ("line", "out", "beside"),
    [
        ("render plane --bounces 1 --width 8 --height 6", "keep.exr", "keep.transient.png"),
        ("render plane --bounces 1 --width 8 --height 6", None, "plane.transient.png"),
        ("sense g.exr", "keep.h5", "keep.histogram.png"),
        ("depth g.h5", "keep.exr", "keep.depth.png"),
        ("depth g.h5", None, "g-log-matched.depth.png"),
    ],
)
def test_pictures_of_other_programs_beside_a_result_are_kept(line, out, beside, folder, capfd):
    """And no result is written beside them; without a picture of ours there is nothing to keep them from."""
    before = {*Path().iterdir()}
    argv = [*line.split(), *(["--out", out] if out else [])]
    kept(capfd, argv, beside, foreign_png())
    assert {path.name for path in {*Path().iterdir()} - before} <= {beside, "a.png"}
    assert main([*argv, "--no-figure"]) == 0
    Path(beside).unlink()
    assert main(argv) == 0
    assert main(argv) == 0  # our own is written again


def test_a_comparison_keeps_the_users_picture(folder, capfd):
    Path("my.png").write_bytes(b"a picture")
    Path("my.csv").write_text(f"method,{','.join(FIGURES)},seconds\n")  # as every version wrote it
    assert main(["compare", "g.h5", "--methods", "argmax", "--out", "my.csv"]) == 0
    assert Path("my.png").read_bytes() == b"a picture" and Path("my.compare.png").is_file()
    kept(capfd, ["compare", "g.h5", "--methods", "argmax", "--out", "x.csv"], "x.compare.png", foreign_png())


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("ultraphase list own.s", "x.txt"),
        ("ultraphase asm own.s --define K=8 SHIFT=7", "x.hex"),
        ("ultraphase table", "x.csv"),
        ("compare g.h5 --methods argmax", "x.csv"),
        ("show g.exr", "x.html"),
        ("show g.exr", "x.png"),
        ("show g.exr", "x.pdf"),
        ("export g.h5", "x.npz"),
        ("export g.exr", "x.h5"),
        ("export g.h5", "x.ply"),
        (f"export {MODEL}", "x.txt"),
        ("sense g.exr --export mat --no-figure", "x.h5"),
    ],
)
def test_what_a_command_wrote_it_writes_again(line, name, folder):
    Path(name).write_bytes(b"")  # an empty file holds nothing that could be lost
    argv = [*line.split(), "--out", name]
    if line.startswith("sense"):
        Path(name).unlink()
    assert main(argv) == 0
    first = Path(name).read_bytes()
    assert main(argv) == 0
    assert (Path(name).read_bytes() == first) or name.endswith(".csv")  # seconds differ


def test_mat_files_of_older_versions_are_ours(folder, capfd):
    """They had scipy's header; a published pulse is MATLAB's, and its variables alone make no file ours."""
    pulse = Path(f"{PULSE_NAME}12_nc-16.mat")
    frame = {"dist": np.ones((2, 2)), "bin_hr": np.ones((2, 2))}
    for path, values in ((Path("old.mat"), frame), (pulse, {"psf": np.ones(3), "pulse_len": 3.0})):
        scipy.io.savemat(path, values)
        assert is_our_mat(path)
        body = path.read_bytes()
        path.write_bytes(b"MATLAB 5.0 MAT-file, Platform: GLNXA64".ljust(116) + body[116:])
        assert not is_our_mat(path)
    scipy.io.savemat("other.mat", {"a": 1.0})
    assert not is_our_mat(Path("other.mat"))
    assert pulse.name in refused(capfd, "sense", "g.exr", "--export", "mat", "--no-figure", "--out", "new.h5")
    assert not Path("new.h5").exists()
