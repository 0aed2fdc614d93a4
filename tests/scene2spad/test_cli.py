"""The command line as a user meets it: results, files, one line for every mistake."""

import json
import sys

import numpy as np
import pytest
import torch
from processes import run_process

from render.transient import read_transient
from scene2spad.cli import main
from spad.measurements.histogram import read_histogram

SMALL = ["--width", "16", "--height", "12"]


def run(capfd, *argv: str) -> tuple[int, str, str]:
    status = main(list(argv))
    out, err = capfd.readouterr()
    return status, out, err


def refused(capfd, *argv: str) -> str:
    """The one line that a mistake ends in."""
    status, out, err = run(capfd, *argv)
    assert status == 2 and out == ""
    lines = [line for line in err.splitlines() if line.startswith("scene2spad: ")]
    assert len(lines) == 1 and err.rstrip().endswith(lines[0]) and "Traceback" not in err
    return lines[0]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_render_sense_depth(capfd, folder):
    status, out, _ = run(capfd, "render", "living-room", *SMALL, "--error", "0.1", "--json")
    result = json.loads(out)
    assert status == 0 and len(out.splitlines()) == 1
    assert {
        "seconds",
        "rays",
        "spp",
        "returns",
        "indirect_fraction",
        "relative_error",
        "target_met",
        "plan",
        "out",
    } <= result.keys()
    assert 0 < result["relative_error"] < 0.1 and 0 < result["indirect_fraction"] < 0.5
    transient = read_transient(folder / "living-room.exr")
    assert transient.returns == result["returns"] and transient.depth_m.shape == (12, 16)

    status, out, _ = run(capfd, "sense", "living-room.exr", "--signal", "200", "--background", "20", "--json")
    result = json.loads(out)
    assert {"seconds", "mean_signal", "mean_background", "pile_up", "model", "wrapped", "out"} <= result.keys()
    assert result["mean_signal"] == pytest.approx(200, rel=1e-4) and result["model"] == "poisson"
    histogram = read_histogram(folder / "living-room.h5")
    assert histogram.meta["transient"]["sha256"] == transient.sha256()

    for method in ("argmax", "matched", "log-matched", "compressive"):
        status, out, _ = run(capfd, "depth", "living-room.h5", "--method", method, "--json")
        result = json.loads(out)
        assert status == 0 and {"seconds", "mae_mm", "rmse_mm", "within_10mm", "unmixed", "out"} <= result.keys()
        assert result["unmixed"]["mae_mm"] < 400
    names = {path.name for path in folder.iterdir()}
    assert {"living-room.transient.png", "living-room.histogram.png", "living-room-fourier-16.depth.png"} <= names
    assert "living-room-log-matched.exr" in names
    assert not any("part" in name for name in names)


def test_same_seed_same_files(capfd, folder):
    for name in ("a", "b"):
        main(["render", "living-room", *SMALL, "--seed", "7", "--out", f"{name}.exr", "--no-figure", "--error", "0.1"])
        main(["sense", f"{name}.exr", "--seed", "7", "--no-figure"])
    assert (folder / "a.exr").read_bytes() == (folder / "b.exr").read_bytes()
    assert read_histogram(folder / "a.h5").sha256() == read_histogram(folder / "b.h5").sha256()


def test_demo_makes_one_figure(capfd, folder):
    status, out, _ = run(capfd, "demo", "--width", "32", "--height", "24", "--json")
    result = json.loads(out)
    assert status == 0 and {"seconds", "mae_mm", "figure"} <= result.keys() and len(result["mae_mm"]) == 4
    assert (folder / result["figure"]).read_bytes()[:4] == b"\x89PNG"
    assert all(np.isfinite(list(result["mae_mm"].values())))


def test_offset_moves_the_scene_in_time_alone(capfd, folder):
    for offset in ("0", "7"):
        main(["render", "sphere", *SMALL, "--offset", offset, "--out", f"{offset}.exr", "--no-figure"])
    near, far = read_transient(folder / "0.exr"), read_transient(folder / "7.exr")
    assert np.allclose(far.depth_m, near.depth_m + 7, equal_nan=True) and (far.radiance == near.radiance).all()
    assert far.meta["time_offset_m"] == 7


def test_scenes_are_listed_and_described(capfd):
    status, out, _ = run(capfd, "scenes", "--json")
    assert status == 0 and "living-room" in json.loads(out)["scenes"]
    status, out, _ = run(capfd, "scenes", "living-room", "--json")
    described = json.loads(out)["scenes"]["living-room"]
    assert described["triangles"] > 1000 and described["ambient_light"]
    status, out, _ = run(capfd, "scenes", "living-room")
    assert "camera" in out and "triangles" in out


def test_help_teaches_every_command(capfd):
    status, out, _ = run(capfd, "--help")
    assert status == 0 and all(name in out for name in ("demo", "scenes", "render", "sense", "depth"))
    for command, word in (("render", "--bounces"), ("sense", "--background"), ("depth", "--method"), ("demo", "--out")):
        status, out, _ = run(capfd, command, "--help")
        assert status == 0 and word in out


def test_help_needs_neither_torch_nor_mitsuba():
    code = "import sys; from scene2spad.cli import main; main(['-h']); print({'torch', 'mitsuba'} & {*sys.modules})"
    done = run_process([sys.executable, "-c", code])
    assert done.stdout.endswith("set()\n")


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["bogus"], "bogus"),
        (["render", "--widht", "3"], "--widht"),
        (["render", "living-room", "--width", "many"], "--width"),
        (["render", "living-room", "--width", "0"], "width 0"),
        (["render", "living-room", "--height", "-3"], "height -3"),
        (["render", "living-room", "--bounces", "0"], "bounces 0"),
        (["render", "living-room", "--error", "2"], "error 2"),
        (["render", "living-room", "--error", "0.1", "--budget", "1", "1"], "not both"),
        (["render", "living-room", "--offset", "nan"], "offset nan"),
        (["render", "living-room", "--out", "room.png"], "must end in .exr"),
        (["render", "living-room", "--out", "nowhere/room.exr"], "nowhere"),
        (["render", "castle"], "castle"),
        (["render", "missing.obj"], "missing.obj"),
        (["render", "missing.xml"], "missing.xml"),
        (["render", "."], "scene '.'"),
        (["scenes", "castle"], "castle"),
        (["sense", "missing.exr"], "missing.exr"),
        (["sense", "missing.exr", "--signal", "-1"], "signal -1"),
        (["sense", "missing.exr", "--background", "nan"], "background nan"),
        (["sense", "missing.exr", "--sensor", "retina"], "retina"),
        (["sense", "missing.exr", "--dark-count-rate", "-5"], "dark count rate -5"),
        (["sense", "missing.exr", "--model", "magic"], "magic"),
        (["depth", "missing.h5"], "missing.h5"),
        (["depth", "missing.h5", "--method", "magic"], "magic"),
        (["sense", ""], "'' is empty, expected a value"),
        (["depth", "missing.h5", "--out="], "--out= is empty, expected a value"),
        (["depth", "missing.h5", "--method", "compressive", "--codes", "-1"], "--codes -1 is outside 1 to 9999"),
        (["depth", "missing.h5", "--method", "compressive", "--codes", "10000"], "--codes 10000 is outside 1 to 9999"),
        (["inspect", "/"], "/: is a folder, expected a file"),
        (["depth", "."], "."),
        (["demo", "--signal", "-4"], "signal -4"),
        (["demo", "--seed", "-1", "--width", "8", "--height", "6"], "seed -1"),
    ],
)
def test_mistakes_end_in_one_line(capfd, folder, argv, message):
    assert message in refused(capfd, *argv)
    assert list(folder.iterdir()) == []


def test_bad_files_end_in_one_line_and_leave_nothing(capfd, folder):
    (folder / "empty.obj").write_text("")
    (folder / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    (folder / "nan.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "textured.obj").write_text("mtllib t.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    (folder / "t.mtl").write_text("newmtl a\nmap_Kd missing.png\n")
    (folder / "broken.xml").write_text("<scene version='3.0.0'><shape type='sphere'>")
    (folder / "unknown.xml").write_text("<scene version='3.0.0'><shape type='teapotahedron'/></scene>")
    (folder / "words.exr").write_text("no image")
    (folder / "text.h5").write_text("no histogram")
    before = sorted(path.name for path in folder.iterdir())
    for argv, message in (
        (["render", "empty.obj"], "empty.obj"),
        (["render", "points.obj"], "points.obj"),
        (["render", "nan.obj"], "nan.obj"),
        (["render", "textured.obj"], "missing.png"),
        (["render", "broken.xml"], "broken.xml"),
        (["render", "unknown.xml"], "teapotahedron"),
        (["sense", "words.exr"], "words.exr"),
        (["depth", "text.h5"], "text.h5"),
        (["depth", "words.exr"], "words.exr"),
    ):
        assert message in refused(capfd, *argv)
    assert sorted(path.name for path in folder.iterdir()) == before


def test_truncated_files_end_in_one_line(capfd, folder):
    main(["render", "sphere", *SMALL, "--no-figure"])
    main(["sense", "sphere.exr", "--no-figure"])
    capfd.readouterr()
    for name, command in (("sphere.exr", "sense"), ("sphere.h5", "depth")):
        data = (folder / name).read_bytes()
        for length in np.linspace(0, len(data) - 1, 9).astype(int):
            (folder / f"cut-{name}").write_bytes(data[:length])
            assert f"cut-{name}" in refused(capfd, command, f"cut-{name}")
    assert len(list(folder.iterdir())) == 4


def test_other_files_are_not_overwritten(capfd, folder):
    main(["render", "sphere", *SMALL, "--no-figure"])
    main(["sense", "sphere.exr", "--no-figure"])
    (folder / "notes.exr").write_text("mine")
    (folder / "sphere.transient.png").mkdir()
    capfd.readouterr()
    transient = (folder / "sphere.exr").read_bytes()
    assert "no depth" in refused(capfd, "depth", "sphere.h5", "--out", "sphere.exr")
    assert "no transient" in refused(capfd, "render", "plane", *SMALL, "--out", "notes.exr")
    assert "is a folder" in refused(capfd, "render", "sphere", *SMALL)
    assert (folder / "sphere.exr").read_bytes() == transient and (folder / "notes.exr").read_text() == "mine"


def test_json_holds_no_nan(capfd, folder):
    main(["render", "sphere", *SMALL, "--no-figure"])
    main(["sense", "sphere.exr", "--signal", "0", "--background", "0", "--no-figure"])
    capfd.readouterr()
    status, out, _ = run(capfd, "depth", "sphere.h5", "--json")
    assert status == 0 and "NaN" not in out and json.loads(out)["mae_mm"] is None


@pytest.mark.parametrize(
    ("scene", "width", "height"),
    [("plane", 1, 1), *(pytest.param("sphere", *size, marks=pytest.mark.slow) for size in ((2, 2), (5, 3)))],
)
def test_tiny_and_partly_empty_images_are_drawn(scene, width, height, capfd, folder):
    status, _, err = run(capfd, "demo", "--scene", scene, "--width", str(width), "--height", str(height))
    assert status == 0, err


def test_nothing_in_view_is_refused(capfd, folder):
    (folder / "dark.xml").write_text(
        "<scene version='3.0.0'><sensor type='perspective'><float name='fov' value='40'/></sensor>"
        "<shape type='sphere'><point name='center' x='0' y='0' z='-9'/></shape></scene>"
    )
    status, out, err = run(capfd, "render", "dark.xml", *SMALL)
    assert (status, out) == (2, "") and "nothing in view" in err and len(err.splitlines()) == 1
    assert [path.name for path in folder.iterdir()] == ["dark.xml"]


def test_too_many_codes_are_refused(capfd, folder):
    main(["render", "sphere", *SMALL, "--no-figure"])
    main(["sense", "sphere.exr", "--no-figure"])
    capfd.readouterr()
    for codes in ("0", "3", "5000"):
        assert codes in refused(capfd, "depth", "sphere.h5", "--method", "compressive", "--codes", codes)


def test_interrupt_ends_with_its_own_status(capfd, folder, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("render.engine.render", stop)
    status, out, err = run(capfd, "render", "sphere", *SMALL)
    assert status == 130 and out == "" and "interrupted" in err and list(folder.iterdir()) == []


def raising(error: Exception):
    """Stand in for a renderer that ends in an error."""

    def render(*_, **__):
        raise error

    return render


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.\nGPU 0 has"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory"),
    ],
)
def test_memory_that_runs_out_is_one_line(capfd, folder, monkeypatch, error):
    """PyTorch's errors are of another kind than Python's."""
    monkeypatch.setattr("render.engine.render", raising(error))
    assert "out of memory: use a smaller image" in refused(capfd, "render", "plane", "--out", "p.exr")


def test_other_errors_of_the_program_are_not_hidden(folder, monkeypatch):
    monkeypatch.setattr("render.engine.render", raising(RuntimeError("a mistake of ours")))
    with pytest.raises(RuntimeError, match="a mistake of ours"):
        main(["render", "plane", "--out", "p.exr"])


def test_a_scene_with_a_slash_in_its_name_gets_a_file_in_this_folder(folder, capfd):
    assert main(["render", "rooms/test/0", *SMALL, "--bounces", "1", "--no-figure"]) == 0
    assert read_transient(folder / "rooms-test-0.exr").height > 0
