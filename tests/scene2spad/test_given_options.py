"""Options that a command would ignore, or take for another value, are refused in one line."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from csph.weights.cards import checkpoint_of
from render.transient import write_transient
from scene2spad.cli import main
from scene2spad.networks.training import config_of
from scene2spad.options.experiments import OPTIONS_OF, STUDIES
from scene2spad.options.networks import Train
from scenes.errors import InputError
from spad.detection.detect import sense
from spad.formats.depth_map import write_depth
from spad.formats.rgbd import transient_from_rgbd
from spad.measurements.histogram import write_histogram
from spad.sensor.model import PhotonBudget
from spad.sensor_names import sensor_by_name

MODEL = "learned-256x4x4-128x-s0"
STUDY_ROOM = Path(__file__).parents[2] / "scene2spad" / "studies"


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A transient, a histogram and a depth map of a slope, 8 x 10 pixels."""
    folder = tmp_path_factory.mktemp("files")
    depth = np.linspace(2, 6, 8 * 10).reshape(8, 10)
    transient = transient_from_rgbd(depth, np.full_like(depth, 0.5), np.full_like(depth, 0.02))
    write_transient(transient, folder / "g.exr")
    write_histogram(sense(transient, sensor_by_name("reference"), PhotonBudget(50, 50)), folder / "g.h5")
    write_depth(depth.astype(np.float32), folder / "d.exr", {"method": "none"})
    np.save(folder / "own.npy", np.random.default_rng(0).normal(size=(8, 1024)))
    return folder


@pytest.fixture(autouse=True)
def here(files, monkeypatch):
    monkeypatch.chdir(files)


def refused(capfd, argv: list[str]) -> str:
    before = {*Path().rglob("*")}
    capfd.readouterr()
    status = main(argv)
    err = capfd.readouterr().err
    assert status == 2 and len(err.splitlines()) == 1, err
    assert {*Path().rglob("*")} == before
    return err


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("inspect g.h5 --view 3", "g.h5: --view 3 is for a pack"),
        ("inspect g.exr --view -1", "g.exr: --view -1 is for a pack"),
        ("show g.exr --view 3", "g.exr: --view 3 is for a pack"),
        ("show g.exr --frame 3", "g.exr: --frame 3 is for captures"),
        ("show g.exr --transient g.exr", "g.exr: --transient g.exr is for a histogram"),
        ("show g.h5 --out a.gif --transient g.exr", "g.h5: --transient g.exr is for a histogram's page or picture"),
        ("export g.exr --out a.npz --frame 1", "g.exr: --frame 1 is for captures"),
        ("export g.h5 --out a.npz --frame 1", "g.h5: --frame 1 is for captures"),
        ("export g.h5 --out a.ply --view 4", "g.h5: --view 4 is for a pack"),
        ("export g.exr --out a.npz --intensity nosuch.h5", "g.exr: --intensity nosuch.h5 is for a depth map"),
        ("export g.h5 --out a.ply --layout thw", "g.h5: --layout thw is for a dense array"),
        ("export g.h5 --out a.npz --int8", "g.h5: --int8 is for codes"),
        ("export g.exr --out a.ply --sensor pf32", "g.exr: --sensor pf32 is for a dense array"),
        ("export g.exr --out a.npz --sensor tmf8820", "g.exr: a sensor of zones has no pixels"),
        ("ultraphase run fourier-16 --out run.csv", "ultraphase run: --out run.csv is for table, sweep"),
        ("ultraphase run fourier-16 --fps 1000", "--fps 1000 is for sweep"),
        ("ultraphase run fourier-16 --pixels 1024", "--pixels 1024 is for sweep"),
        ("ultraphase table --photons 1000", "--photons 1000 is for run, sweep"),
        ("ultraphase table --fps 100", "ultraphase table: --fps 100 is for sweep"),
        ("ultraphase table --define A=1", "--define A=1 is for asm, list, run, verify"),
        ("ultraphase list coarse-16 --trace 3", "--trace 3 is for run"),
        ("study memory --checkpoints nosuch.npy", "study memory: --checkpoints nosuch.npy is for study tensors"),
        ("study memory --width -5", "study memory: --width -5 is for study codes, power, render-error"),
        ("study tdc --ship --dry-run", "study tdc: --ship is for study depth-offset"),
        ("sense g.exr --out a.h5 --focal-length 0.1", "--focal-length 0.1 is for a --radiometric budget"),
        ("sense g.exr --out a.h5 --pulse-energy -5", "--pulse-energy -5 is for a --radiometric budget"),
        ("sense g.exr --out a.h5 --sensor tmf8820 --f-number 2", "--f-number 2 is for a --radiometric budget"),
        ("sense g.exr --out a.h5 --hot-rate 5", "--hot-rate 5 is for hot pixels"),
        ("sense g.exr --out a.h5 --hot-rate 5 --hot-pixels 0", "--hot-rate 5 is for hot pixels"),
        ("depth g.h5 --codes 8", "depth: --codes 8 is for --method compressive"),
        ("depth g.h5 --code gray", "depth: --code gray is for --method compressive"),
        ("depth g.h5 --code fourier --method argmax", "depth: --code fourier is for --method compressive"),
        (
            "depth g.h5 --method compressive --codes-file own.npy --codes 8",
            "--codes 8 is for --method compressive without --codes-file",
        ),
        ("dataset rooms --count 1 --width 8 --height 8 --error 0 --out s", "error 0"),
        ("dataset rooms --bounces 1 --spp 4 --out s", "dataset: --spp 4 is for indirect light (--bounces above 1)"),
        ("dataset rooms --bounces 1 --filter --out s", "dataset: --filter is for indirect light"),
        ("ultraphase list fourier-8 --out a.s", "a.s: .s is for sources, and a listing is none"),
        ("dataset rooms --offset-mode ray --out s", "--offset-mode ray is for scenes that are moved (--offset)"),
        ("dataset rooms --workers 2 --scheduler tcp://a:1 --out s", "--workers 2 is for processes of this machine"),
        ("render gallery --bounces 1 --spp 4", "render: --spp 4 is for indirect light"),
        ("render gallery --bounces 1 --filter", "render: --filter is for indirect light"),
        ("render gallery --bounces 1 --clamp 10", "render: --clamp 10 is for indirect light"),
        (
            f"evaluate {MODEL} --set published --int8-rule published",
            "evaluate: --int8-rule does not go with --set published",
        ),
        ("bench sense --repeats 2", "bench sense: --repeats 2 is below 3"),
        ("scenes living-room --width 64", "scenes: --width 64 is for a contact sheet (--sheet)"),
        ("scenes --count 3", "scenes: --count 3 is for a contact sheet (--sheet)"),
        ("ultraphase table --out t.txt", "t.txt: the output must end in .csv"),
        ("ultraphase sweep --out t.png", "t.png: the output must end in .csv"),
        ("ultraphase sweep --codes 0", "ultraphase sweep: --codes 0: no program has so many codes; program fourier-0"),
        ("ultraphase sweep --codes 7", "--codes 7: no program has so many codes; program fourier-7: 7 codes, expected"),
        ("ultraphase sweep --codes 1000000 0", "sweep: --codes 1000000 0: no program has so many codes"),
        ("ultraphase run fourier-100000", "program fourier-100000: 100000 codes, expected an even number from 2 to"),
        ("ultraphase list coarse-1000000", "program coarse-1000000: 1000000 bins, expected a power of two from 2 to"),
        ("scenes rooms --sheet s.png --width 0", "image side 0 is outside 1 to"),
        ("render photo.png --focal 0", "an RGB-D pair needs --depth FILE and --focal PIXELS"),
        ("render photo.png --depth d.png --focal 0 --depth-scale 0.001", "focal length 0 px is not positive"),
        ("render photo.png --depth d.png --focal 9 --depth-scale 0", "depth scale 0.0 m a level is not positive"),
        ("render photo.png --depth d.png --focal 1e-308 --depth-scale 1", "focal length 1e-308 px is outside 0.001 to"),
        (
            "render photo.png --depth d.png --focal 9 --depth-scale 1e308",
            "depth scale 1e+308 m a level is outside 1e-12",
        ),
        (
            "render plane --budget 1e308 10",
            "budget of 1e+308 signal, 10 background photons a pixel, expected signal above",
        ),
        ("render living-room --depth-scale 0", "an RGB-D pair needs --depth FILE"),
        ("render living-room --cosine", "an RGB-D pair needs --depth FILE"),
        ("train --devices 0", "train: --devices 0 is below 1"),
        ("train --devices -2 --dry-run", "train: --devices -2 is below 1"),
        ("train --devices 2 --dry-run", "train: --devices 2: a training is on one device"),
        ("train --threads 0", "train: --threads 0 is below 1"),
        ("train --dry-run --preset smoke --set-weights 1 2", "train: 2 --set-weights for 1 sets"),
        ("train --codes 8 --compression 64", "train: give --codes 8 or --compression, not both"),
        ("train --design none --codes 8 --dry-run", "train --design none: --codes 8 is for designs with codes"),
        (
            "train --design none --compression 64 --dry-run",
            "train --design none: --compression 64 is for designs with codes",
        ),
        ("train --design peak --full --dry-run", "train --design peak: --full is for designs with codes"),
        (
            "train --design peak --block 512 2 2 --dry-run",
            "train --design peak: --block 512 2 2 is for designs with codes",
        ),
        ("train --design none --coherence 1 --dry-run", "coherence is for codes over several pixels"),
        (
            "train --design none --spatial-start orthogonal --dry-run",
            "orthogonal is for spatial codes that are learned",
        ),
        ("train --full --spatial-start orthogonal --dry-run", "orthogonal is for spatial codes that are learned"),
        ("train --tv-start 9 --dry-run", "train --design learned: --tv-start 9 is for --tv above 0"),
        ("train --seed 99999999999999999999 --dry-run", "training: seed 99999999999999999999 is outside 0 to 92233"),
        ("study tensors --seed 99999999999999999999 --out o", "seed 99999999999999999999 is outside 0 to 92233"),
        ("evaluate a --set g.exr --out g.h5", "g.h5: is a file, expected a folder for the table"),
        ("evaluate a --set g.exr --out g.h5/x", "g.h5 is a file, expected a folder"),
        (f"evaluate {MODEL} {MODEL} --set g.exr", f"{MODEL} is the same checkpoint as {MODEL}"),
        (f"evaluate {MODEL} --set g.exr --baselines argmax argmax", "baseline argmax is named twice"),
    ],
)
def test_options_without_a_meaning_are_refused(line, message, capfd):
    found = refused(capfd, line.split())
    assert message in found


def test_options_with_a_meaning_pass(capfd, tmp_path):
    """Named again at their defaults, too."""
    out = ["--out", str(tmp_path / "a.h5"), "--no-figure"]
    assert main(["sense", "g.exr", *out, "--hot-pixels", "0.1", "--hot-rate", "5"]) == 0
    assert main(["sense", "g.exr", *out, "--radiometric", "--focal-length", "0.02"]) == 0
    assert main(["inspect", "g.exr", "--view", "0"]) == 0
    ply = str(tmp_path / "a.ply")
    assert main(["export", "g.exr", "--out", str(tmp_path / "a.npz"), "--layout", "thw", "--sensor", "reference"]) == 0
    assert main(["ultraphase", "run", "fourier-8", "--fps", "30", "--signal", "40"]) == 0
    capfd.readouterr()
    assert main(["export", "d.exr", "--out", ply, "--intensity", "g.h5"]) == 2  # of no camera, and for no other reason
    assert "does not say which camera" in capfd.readouterr().err


def test_a_checkpoint_by_its_folder_and_by_its_file_is_one(tmp_path, capfd):
    shutil.copytree(checkpoint_of(MODEL).parent, tmp_path / "run")
    argv = ["evaluate", str(tmp_path / "run"), str(tmp_path / "run/model.safetensors"), "--set", "g.exr"]
    assert "is the same checkpoint as" in refused(capfd, argv)


def test_options_of_a_training_that_mean_something_pass():
    assert config_of(Train(design="fourier+learned", spatial_start="uniform")).model.spatial_start == "uniform"
    assert config_of(Train(tv=0.1, tv_start=9)).tv_start == 9
    assert config_of(Train(design="none", preset="paper", tv_start=9)).tv_start == 9  # whose total variation is on
    assert config_of(Train(design="none", block=(256, 4, 4))).model.design is None  # at its default


def test_compression_is_128_unless_codes_are_given():
    assert config_of(Train()).model.design == config_of(Train(compression=128.0)).model.design
    assert config_of(Train(codes=8)).model.design.codes == 8
    with pytest.raises(InputError, match="not both"):
        config_of(Train(codes=8, compression=128.0))


@pytest.mark.parametrize("study", ["render-error", "real-data"])
def test_studies_take_shipped_models_by_name(study, capfd, monkeypatch):
    """The first study ends before its first render, the second before its first capture."""
    read = []

    def load(path):
        read.append(path)
        raise InputError("enough")

    module = {"render-error": "render_error", "real-data": "real_data.study"}[study]
    monkeypatch.setattr(f"scene2spad.studies.{module}.load_model", load)
    assert "enough" in refused(capfd, ["study", study, "--checkpoints", MODEL])
    assert read == [checkpoint_of(MODEL)]


def test_the_table_of_options_is_what_studies_read():
    """Every option that a study's module reads from the command, and none that its module does not; what it hands to
    those that look models up is read there."""
    trained = {"models", "preset", "retrain", "set"}
    lookups = {"obtain": trained, "found_only": {"models", "preset"}}
    for name in STUDIES:
        stem = "ablations" if name in ("spatial-block", "tensor-size", "fourier") else name.replace("-", "_")
        room = STUDY_ROOM / stem
        paths = [*room.rglob("*.py")] if room.is_dir() else [STUDY_ROOM / f"{stem}.py"]
        text = "\n".join(path.read_text(encoding="utf-8") for path in paths)
        read = {option for option in OPTIONS_OF if re.search(rf"command\.{option}\b", text)}
        for lookup, options in lookups.items():
            read |= options if re.search(rf"\b{lookup}\(", text) else set()
        assert read == {option for option, names in OPTIONS_OF.items() if name in names}, name


def test_a_pack_holds_the_views_asked_for(tmp_path, capfd):
    size = ["--width", "8", "--height", "8", "--bounces", "1", "--grid", "2", "--out", str(tmp_path / "set")]
    pack = ["--pack", str(tmp_path / "set.h5"), "--json"]
    found = []
    for count in ("3", "2"):
        capfd.readouterr()
        assert main(["dataset", "rooms", "--count", count, *size, *pack]) == 0
        found.append(json.loads(capfd.readouterr().out))
    assert [one["pack_views"] for one in found] == [3, 2] == [one["scenes"] for one in found]


def test_the_demo_takes_scenes_of_a_set(tmp_path, capfd):
    """Write the files of a scene with a slash in its name without one."""
    argv = ["demo", "--scene", "tabletop/kitchen", "--width", "16", "--height", "12", "--out", str(tmp_path)]
    assert main(argv) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"tabletop-kitchen.exr", "tabletop-kitchen.h5", "demo.png"}
