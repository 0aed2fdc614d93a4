"""`report` on a made-up tree of results: what is there is shown once, what is not is named, and the page is valid HTML
that loads nothing."""

import base64
import io
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene2spad.cli import main
from scene2spad.report.plan import SECTIONS

VOID = {"meta", "link", "img", "br", "hr", "input"}
LOADING = {"src", "href", "srcset", "data", "poster", "action", "background", "xlink:href"}


class Page(HTMLParser):
    """Elements of a page, and everything that is wrong with them."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str]]] = []
        self.wrong: list[str] = []
        self.text: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        if tag == "p" and "p" in self.open:
            self.wrong.append("p within p")
        self.seen.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.wrong.append(f"</{tag}> closes something else")

    def handle_data(self, data):
        self.text.append(data)

    def of(self, tag: str) -> list[dict[str, str]]:
        return [attrs for name, attrs in self.seen if name == tag]

    @property
    def words(self) -> str:
        return " ".join(" ".join(self.text).split())


def png(seed: int, size: tuple[int, int] = (9, 7)) -> bytes:
    pixels = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def put(path: Path, contents: bytes | str | dict, age: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(contents) if isinstance(contents, dict) else contents
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    os.utime(path, (1_700_000_000 - age,) * 2)


@pytest.fixture
def tree(tmp_path) -> Path:
    """A bench, an ablation with markup in its names, a broken figure, a cut table, inner files of studies."""
    root = tmp_path / "results"
    put(root / "bench/bench-render-raw.png", png(1))
    put(root / "bench/bench-render-pulse.png", png(2))
    ratio = {"scene": "flash", "size": 64, "ratio": 12.3456, "error": 0.01, "chief": True}
    numbers = {"ratios": [ratio, {**ratio, "scene": "not chief", "chief": False}], "checks": []}
    put(root / "bench/bench-render.json", {**numbers, "machine": {"cpus": 2, "versions": {"mitsuba": "3.9"}}})
    put(root / "bench/bench-hard-cases.csv", "name,passed,error\n<b>glass</b> & co,True,1e-4\n")
    put(root / "bench/bench-sense.csv", 'name,seconds\n"cut')
    model = {
        "name": "fourier-1024x1x1-128x-s0",
        "preset": "laptop",
        "steps": 8,
        "trained_on": "planes",
        "sha256": "ab" * 32,
    }
    fourier = {
        "models": [model],
        "absent": ["gray-1024x1x1-128x-s0"],
        "conclusions": [{"claim": "4 x 4 is <best>", "verdict": "not decided", "why": "absent: <x>"}],
        "summary": [{"design": "fourier", "mae_mm": None}],
    }
    put(root / "study/fourier.json", fourier)
    put(root / "study/fourier-12-128x.png", png(3))
    put(root / "older/fourier-12-128x.png", png(4), age=1000)
    published = "model,of,near_mae_mm_label\nfourier-1024x1x1-128x-s0,5 of 8 scenes,80.68\n"
    put(root / "study/fourier-published.csv", published)
    put(root / "study/codes.png", png(5)[:-30])
    put(root / "study/copy.png", png(3))
    put(root / "study/power.json", "{")
    put(root / "study/depth-offset.json", {"models": [1, "x"], "absent": 3, "bars": [1], "conclusions": "none"})
    put(root / "study/smoke/sets/tabletop/set.json", {"set": "tabletop", "grid": 4, "deep": {"a": 1, "b": {}}})
    put(root / "study/smoke/models/m/config.json", {"preset": "smoke", "rate": 0.001})
    put(root / "study/smoke/renders/inner.png", png(6))
    put(root / "study/emulated/inner.png", png(7))
    put(root / "study/timings.jsonl", '{"study": "fourier"}\n')
    return root


def made(tree: Path, capfd) -> tuple[dict, str]:
    out = tree / "report.html"
    assert main(["report", "--results", str(tree), "--out", str(out), "--json"]) == 0
    message = json.loads(capfd.readouterr().out)
    assert message["out"] == str(out) and message["bytes"] == out.stat().st_size
    return message, out.read_text(encoding="utf-8")


def test_every_section_is_there_and_every_link_leads_somewhere(tree, capfd):
    _, text = made(tree, capfd)
    page = Page(text)
    assert not page.wrong and not page.open
    ids = [attrs["id"] for _, attrs in page.seen if "id" in attrs]
    assert len(ids) == len(set(ids))
    expected = [one.anchor for part in SECTIONS for one in (part, *part.items)]
    shown = [one for one in ids if one in expected]
    # what was measured, in order, speed against error first; what was not makes no heading
    assert shown == [one for one in expected if one in shown]
    assert {"speed", "bench-render", "bench-hard-cases", "figure-12"} <= set(shown) and "bench-encode" not in shown
    assert ids[-1] == "not-measured" and {"configurations", "others"} <= set(ids)
    links = [attrs["href"] for attrs in page.of("a")]
    assert set(links) == {href for href in links if href[1:] in ids} and len(links) >= len(shown)
    assert text.startswith("<!DOCTYPE html>") and page.of("html")[0]["lang"] == "en"
    assert [tag for tag, _ in page.seen].count("h1") == 1 and len(page.of("title")) == 1


def test_the_page_loads_nothing(tree, capfd):
    _, text = made(tree, capfd)
    page = Page(text)
    for tag, attrs in page.seen:
        assert tag not in ("script", "iframe", "object", "embed", "form")
        for name in LOADING & set(attrs):
            assert attrs[name].startswith(("#", "data:")), f"{tag} {name}={attrs[name][:40]}"
    assert not re.search(r"https?://|url\(|@import", text)
    assert "default-src 'none'" in text


def test_pictures_are_whole_in_it_once_and_told(tree, capfd):
    message, text = made(tree, capfd)
    images = Page(text).of("img")
    embedded = [base64.b64decode(one["src"].removeprefix("data:image/png;base64,")) for one in images]
    assert embedded == [png(1), png(2), png(3)] and message["figures"] == 3  # no older, inner, broken or second one
    assert all(one["alt"] and (one["width"], one["height"]) == ("9", "7") for one in images)
    words = Page(text).words
    assert "1 older of that name not shown" in words and "shown above" in words


def test_results_in_folders_named_as_those_inside_are_shown(tree, capfd):
    """All below `results` or `maps` was passed over, even where that folder held the studies."""
    put(tree / "project/results/maps/study/timings.jsonl", '{"study": "codes"}\n')
    put(tree / "project/results/maps/study/codes.png", png(40))
    put(tree / "project/results/maps/study/laptop/models/m/log.csv", "step\n1\n")
    _, text = made(tree, capfd)
    assert base64.b64encode(png(40)).decode() in text and "log.csv" not in text


def test_text_of_results_is_text(tree, capfd):
    _, text = made(tree, capfd)
    page = Page(text)
    assert "<b>" not in text and "<x>" not in text and "<best>" not in text
    assert "<b>glass</b> & co" in page.words and "4 x 4 is <best>" in page.words


def test_what_is_missing_or_broken_is_named_with_its_command(tree, capfd):
    message, text = made(tree, capfd)
    missing = {one["command"]: one["files"] for one in message["missing"]}
    assert missing["scene2spad bench encode"] == ["bench-encode.png", "bench-encode.csv"]
    assert "scene2spad bench render" not in missing or missing["scene2spad bench render"] == ["bench-render.csv"]
    assert missing["scene2spad study fourier --full"] == ["fourier-11-64x.png"]
    assert "codes.png" not in missing.get("scene2spad study codes", [])  # there, but broken
    broken = {line.split(":")[0] for line in message["problems"]}
    assert broken == {"study/codes.png", "bench/bench-sense.csv", "study/power.json", "study/depth-offset.json"}
    end = text[text.index('id="not-measured"') :]
    for command, files in missing.items():
        assert command in end and all(name in end for name in files)
    assert all(name in end for name in broken)
    assert "fourier: 4 x 4 is &lt;best&gt;" in end and "captures" in end


def test_configurations_and_versions(tree, capfd):
    _, text = made(tree, capfd)
    words = Page(text[text.index('id="configurations"') :]).words
    for message in (
        "scene2spad",
        "torch",
        "study/smoke/sets/tabletop",
        "study/smoke/models/m",
        "mitsuba: 3.9",
        "planes",
    ):
        assert message in words
    assert "abababababab" in words and "ab" * 7 not in words


def test_sets_with_views_above_their_error_target_are_marked(tree, capfd):
    folder = tree / "study/smoke/sets/tabletop"
    lines = [json.dumps({"view": i, "file": "view.exr", "target_met": i > 1}) for i in range(5)]
    put(folder / "index.jsonl", "\n".join(lines) + "\n")
    put(folder / "view.exr", b"")
    put(tree / "study/smoke/sets/rooms/set.json", {"set": "rooms"})
    put(tree / "study/smoke/sets/rooms/index.jsonl", "{cut")
    message, text = made(tree, capfd)
    words = Page(text[text.index('id="configurations"') :]).words
    assert "above the error target" in words and "2 (!)" in words
    assert any("rooms/index.jsonl: cannot be read" in line for line in message["problems"])


def test_only_the_chief_ratios_are_shown(tree, capfd):
    words = Page(made(tree, capfd)[1]).words
    assert "12.35" in words and "not chief" not in words


def test_measured_things_come_first_and_missing_ones_in_one_list_at_the_end(tree, capfd):
    _, text = made(tree, capfd)
    before, _, end = text.partition('<section id="not-measured"')
    assert 'class="missing"' not in text and "not measured" not in before.partition("<main>")[2].lower()
    assert "bench-encode.png" not in before and "bench-encode.png" in end
    first = re.search(r"<h3>(.*?)</h3>", before)
    assert first is not None and first[1] == "Rendering"


def test_smoke_results_stand_apart_and_never_beside_print(tree, capfd):
    numbers = json.loads((tree / "study/fourier.json").read_text())
    for message in ({"preset": "smoke"}, {"models": [{**numbers["models"][0], "preset": "smoke"}]}):
        put(tree / "study/fourier.json", {**numbers, **message})
        _, text = made(tree, capfd)
        page = Page(text)
        ids = [attrs["id"] for _, attrs in page.seen if "id" in attrs]
        assert "smoke" in ids and "80.68" not in text and "40.34" not in text
        smoke = text[text.index('<section id="smoke"') : text.index('<section id="configurations"')]
        assert base64.b64encode(png(3)).decode() in smoke + text and "smoke: study/fourier-12-128x.png" in smoke
        assert "study/fourier-published.csv" in smoke and not page.wrong and not page.open


def test_smoke_figures_of_other_names_stand_apart_too(tree, capfd):
    """The point clouds of `study real-data`."""
    for number, name in enumerate(("real-data-128x.png", "clouds.png", "codes.png")):
        put(tree / "study/own" / name, png(20 + number))
    put(tree / "study/own/real-data.csv", "capture,method,mae_mm\nroom,argmax,98.76\n")
    for preset, apart in (("laptop", False), ("smoke", True)):
        put(tree / "study/own/real-data.json", {"preset": preset, "figures": ["real-data-128x.png", "clouds.png"]})
        _, text = made(tree, capfd)
        smoke = text[text.find('<section id="smoke"') :]
        for name in ("real-data-128x.png", "clouds.png", "real-data.csv"):
            assert (f"study/own/{name}" in smoke and text.count(f"smoke: study/own/{name}") < 3) == apart
        assert ("98.76" in text) != apart and "smoke: study/own/codes.png" not in text


def test_smoke_results_of_studies_without_numbers_stand_apart_by_their_record(tree, capfd):
    """`study power` and `render-error` write tables alone."""
    put(tree / "study/own/render-error.csv", "method,mae_mm\nargmax,98.76\n")
    put(tree / "study/own/ultraphase-power.png", png(30))
    files = dict.fromkeys(("render-error.csv", "ultraphase-power.png"), "ab" * 32)
    for smoke in (False, True):
        record = {"study": "power", "asked": {}, "smoke": smoke, "files": files}
        put(tree / "study/own/power.run.json", record)
        _, text = made(tree, capfd)
        apart = text[text.find('<section id="smoke"') :] if smoke else ""
        assert ("98.76" in text) != smoke and "power.run.json" not in text
        assert all((f"study/own/{name}" in apart) == smoke for name in files)


def test_an_empty_folder_makes_a_page_of_what_is_missing(tmp_path, capfd):
    (tmp_path / "results").mkdir()
    message, text = made(tmp_path / "results", capfd)
    page = Page(text)
    assert not page.wrong and not page.open and message["figures"] == 0
    expected = {name.file for part in SECTIONS for item in part.items for name in (*item.pictures, *item.tables)}
    assert expected <= {name for one in message["missing"] for name in one["files"]}
    assert not page.of("img") and page.words.count("Not found, and the command that makes it") == 1


def test_the_same_results_give_the_same_page(tree, capfd):
    put(tree / "study/codes.png", b"")
    first, second = made(tree, capfd), made(tree, capfd)
    assert first == second and "study/codes.png: is no picture" in first[0]["problems"]


def test_names_that_look_like_numbers_are_names(tree, capfd):
    """Captures 2026_11_29 and 007 stood there as 20261129 and 7; scenes 1 and 01 were one, and so were methods."""
    lines = [f"{name},argmax,{value}" for name, value in (("2026_11_29", "1e-05"), ("007", "-1.5"), ("1e5", "12"))]
    put(tree / "study/real-data.csv", "\n".join(["capture,method,mae_mm", *lines]) + "\n")
    head = "method,scene,view,signal,background,group,mae_mm,rmse_mm,within_1mm,within_5mm,within_10mm,within_20mm,ssim"
    rows = [
        f"{name},{scene},{view},1,1,all,{mae},9,0,0,0.5,1,1,9,0,0"
        for name in ("7", "007")
        for view, (scene, mae) in enumerate((("1", 10), ("01", 20), ("01", 30)))
    ]
    put(tree / "evaluate/evaluation.csv", "\n".join([f"{head},pixels,missing,beyond_range", *rows]) + "\n")
    page = Page(made(tree, capfd)[1])
    assert "2026_11_29 argmax 1e-05 007 argmax -1.5 1e5 argmax 12" in page.words
    # mean of 10 and 25, not of three images
    assert "7 17.5 – 9 50 1 007 17.5 – 9 50 1" in page.words


def test_means_of_every_evaluation_are_shown_with_their_places(tree, capfd):
    """Show those that `evaluate` forms: each scene counts by its mean over views and levels."""
    head = (
        "method,scene,view,signal,background,group,mae_mm,rmse_mm,within_1mm,within_5mm,within_10mm,within_20mm,ssim,"
        "pixels,missing,beyond_range\n"
    )
    lines = [
        f"{name},{scene},{view},1,{background},{group},{mae},{mae + 8},0.1,0.2,0.625,0.5,"
        f"{0.875 if group == 'all' else 'nan'},9,0,0"
        for name in ("run/net.ckpt", "argmax")
        for scene, view, background, all_mm in (("a", 0, 1, 10), ("a", 0, 100, 30), ("b", 1, 1, 113))
        for group, mae in (("all", all_mm + (name == "argmax")), ("mixed", all_mm + 200.5))
    ]  # fmt: skip
    put(tree / "evaluate/near/evaluation.csv", head + "\n".join(lines) + "\n")
    put(tree / "evaluate/far/evaluation.csv", head + lines[0] + "\n", age=9)
    put(tree / "evaluate/far/evaluation.json", json.dumps({"offset_m": 7.0, "decoder": "median", "tile": [4, 4]}))
    put(tree / "evaluate/other/evaluation.csv", "method,mae_mm\nargmax,3\n")
    put(tree / "evaluate/cut/evaluation.csv", "method,mae_mm\nargmax\n")
    message, text = made(tree, capfd)
    part = Page(text[text.index('<section id="evaluate"') :].partition("</section>")[0])
    assert "method MAE [mm] MAE of mixed pixels [mm] RMSE [mm] within 10 mm [%] SSIM" in part.words
    # mean of 20 and 113, not of three images
    assert "run/net.ckpt 66.5 267 74.5 62.5 0.875" in part.words and "argmax 67.5 267 75.5 62.5 0.875" in part.words
    assert "2 views at 2 photon levels (evaluate/near/evaluation.csv, 2023-11-14)" in part.words
    of = "offset_m: 7; decoder: median; tile: 4, 4"
    assert f"1 view at 1 photon level; {of} (evaluate/far/evaluation.csv" in part.words
    assert "not shown" not in part.words and "evaluation.json" not in text
    assert any(line.startswith("evaluate/other/evaluation.csv: cannot be read") for line in message["problems"])
    assert any("cut/evaluation.csv: cannot be read (row 1 is of another" in line for line in message["problems"])


def test_mistakes_end_in_one_line(tree, tmp_path, capfd):
    put(tmp_path / "mine.html", "<p>my own page</p>")
    for given, output in (
        (("--results", str(tmp_path / "none")), "no folder of results"),
        (("--results", str(tree), "--out", str(tmp_path / "page.txt")), "must end in .html"),
        (("--results", str(tree), "--out", str(tmp_path / "mine.html")), "choose another --out"),
        (("--results", str(tree), "--out", str(tmp_path / "no/page.html")), "does not exist"),
    ):
        assert main(["report", *given]) == 2
        message = capfd.readouterr().err
        assert output in message and len(message.strip().splitlines()) == 1
    assert (tmp_path / "mine.html").read_text() == "<p>my own page</p>"
