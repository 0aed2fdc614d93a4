"""`evaluate` tells views that a network was trained on."""

import re
import shutil

from csph.training.views import SEEN, read_views
from render.transient.packs import write_pack
from scene2spad.cli import main
from scene2spad.datasets.planes import random_planes


def test_a_test_on_views_of_training_says_so(capfd, packed, trained, tmp_path):
    """Also where a run split its set itself; not of views that it has not seen."""
    others = tmp_path / "others.h5"
    views = random_planes(6, size=16, seed=9)
    write_pack(((t, {"scene": s}) for t, s in zip(views.transients, views.scenes, strict=True)), others)
    out = ("--levels", "50+1", "--views", "1", "--baselines", "argmax", "--out", str(tmp_path / "out"))
    for path, said in ((packed, True), (others, False)):
        assert main(["evaluate", str(trained), "--set", str(path), *out]) == 0
        told = re.findall(
            rf"was trained on (\d+) views of {path}: its errors there are not those", capfd.readouterr().err
        )
        assert told == ["1"] * said


def test_views_of_training_are_known_one_by_one(capfd, packed, trained, tmp_path):
    """Some of them among others, too. Runs of before have one hash of all: known where the set is the same."""
    seen, other = read_views(packed), random_planes(3, size=16, seed=9)
    some = tmp_path / "some.h5"
    pairs = [*zip(seen.transients[:2], seen.scenes[:2], strict=True), *zip(other.transients, "xyz", strict=True)]
    write_pack(((t, {"scene": s}) for t, s in pairs), some)
    before = tmp_path / "before"
    shutil.copytree(trained, before)
    (before / SEEN).unlink()
    out = ("--levels", "50+1", "--baselines", "argmax", "--out", str(tmp_path / "out"))
    for model, path, number in ((trained, some, "2"), (before, some, None), (before, packed, r"\d")):
        assert main(["evaluate", str(model), "--set", str(path), *out]) == 0
        assert bool(re.search(rf"was trained on {number} views of {path}", capfd.readouterr().err)) == bool(number)
