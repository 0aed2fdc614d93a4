"""Contact sheets, and RGB-D pairs and offsets from the command line."""

import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib import pyplot as plt
from PIL import Image

from render.transient import read_transient
from scene2spad.cli import main
from scene2spad.datasets import contact_sheets
from spad.formats.rgbd import transient_from_rgbd


def test_a_sheet_of_rooms_is_drawn(tmp_path, capsys):
    sheet = tmp_path / "sheet.png"
    assert main(["scenes", "rooms/val", "--sheet", str(sheet), "--count", "2", "--width", "20", "--json"]) == 0
    message = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert message["scenes"] == ["rooms/val/0", "rooms/val/1"]
    assert Image.open(sheet).width > 100


@pytest.mark.parametrize("count", [1, 2])
def test_all_words_of_a_small_sheet_are_within_it(count, tmp_path, monkeypatch):
    """Draw sheets of one and two small views, whose colour bar has a label longer than they are wide."""
    depth = np.full((12, 16), 2.0)
    drawn = []
    monkeypatch.setattr(contact_sheets, "save", lambda figure, path: drawn.append(figure) or path)
    views = [transient_from_rgbd(depth, depth / 4, depth / 4, block=1)] * count
    views = [replace(view, meta={**view.meta, "scene": "rooms/train/0"}) for view in views]
    contact_sheets.draw_views(views, tmp_path / "sheet.png")
    (figure,) = drawn
    figure.canvas.draw()
    words = [text for axes in figure.axes for text in (axes.title, axes.xaxis.label) if text.get_text()]
    assert len(words) == count + 1
    for text in words:
        box = text.get_window_extent()
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1, text
    plt.close(figure)


def test_sets_are_listed_and_bad_sheets_refused(tmp_path, capsys):
    assert main(["scenes", "--json"]) == 0
    assert {"rooms/train", "tabletop", "middlebury"} <= set(json.loads(capsys.readouterr().out)["sets"])
    for arguments in (["kitchens", "--sheet", str(tmp_path / "s.png")], ["rooms", "--sheet", str(tmp_path / "s.jpg")]):
        assert main(["scenes", *arguments]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_an_rgbd_pair_is_rendered_and_moved(tmp_path, capsys):
    Image.fromarray(np.full((12, 16), 188, np.uint8)).save(tmp_path / "photo.png")
    Image.fromarray(np.full((12, 16), 2000, np.uint16)).save(tmp_path / "depth.png")
    pair = ["render", str(tmp_path / "photo.png"), "--depth", str(tmp_path / "depth.png"), "--no-figure"]
    pair += ["--width", "16", "--bounces", "1", "--grid", "2"]
    known = ["--focal", "20", "--depth-scale", "0.001"]
    for name, more, extra_m in (("here", [], 0.0), ("far", ["--offset", "3", "--offset-mode", "ray"], 3.0)):
        assert main([*pair, *known, *more, "--out", str(tmp_path / f"{name}.exr")]) == 0
        transient = read_transient(tmp_path / f"{name}.exr")
        x, y = (np.arange(16) - 7.5) / 20, (np.arange(12)[:, None] - 5.5) / 20
        assert np.abs(transient.depth_m - 2 * np.sqrt(1 + x**2 + y**2) - extra_m).max() < 2e-3
    capsys.readouterr()
    for missing in (known[:2], known[2:]):
        assert main([*pair, *missing, "--out", str(tmp_path / "no.exr")]) == 2
        message = capsys.readouterr().err
        assert message.count("\n") == 1 and "scale" in message + "scale" * ("--focal" in message)
    assert not (tmp_path / "no.exr").exists()
