"""README and guides: short, every link leads somewhere, every command exists. test_page_commands runs them."""

import json
import math
import re
import textwrap
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from csph.weights.shipped import shipped_names
from scene2spad.cli.main import COMMANDS as NAMES
from scene2spad.cli.main import main
from scenes.library.sets import scene_set
from spad.sensor.files import read_sensor

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMANDS = {*NAMES}
WORDS = 1000
IN_CODE = re.compile(r"`[^`\n]+`|^    .*$|```.*?```", re.M | re.S)


def _links(page: Path) -> list[str]:
    return re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))


def test_the_front_page_is_one_page():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= WORDS


def test_what_pages_count_is_what_there_is():
    networks, scenes = ((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("networks.md", "scenes.md"))
    assert re.search(r"(\d+) trained networks come with the package", networks)[1] == str(len(shipped_names()))
    listed = dict(re.findall(r"^\| `([\w-]+)` \|.*\| (\d+) \|$", scenes, re.M))
    assert {"tabletop", "hard-cases"} <= listed.keys()
    for name, size in listed.items():
        assert scene_set(name).size == int(size), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page):
    for link in _links(page):
        name, _, anchor = link.partition("#")
        if name.startswith(("http:", "https:")):
            continue
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), f"{page.name}: {link}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), re.M)
            anchors = [re.sub(r"[^\w\- ]", "", one.lower()).replace(" ", "-") for one in headings]
            assert anchor in anchors, f"{page.name}: {link}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_addresses_elsewhere_are_well_formed(page):
    """They are not followed, since tests have no network: https, and a host with a dot."""
    for link in _links(page):
        if "://" in link:
            parts = urlsplit(link)
            assert parts.scheme == "https" and re.fullmatch(r"[a-z0-9-]+(\.[a-z0-9-]+)+", parts.netloc), link


def test_every_page_can_be_reached_from_the_front_page():
    reached, waiting = set(), [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        if page in reached or page.suffix != ".md":
            continue
        reached.add(page)
        waiting += [(page.parent / link.partition("#")[0]).resolve() for link in _links(page) if "://" not in link]
    assert {page.resolve() for page in PAGES} == {page.resolve() for page in reached}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_named_exists(page):
    code = "\n".join(IN_CODE.findall(page.read_text(encoding="utf-8")))
    named = set(re.findall(r"(?<!import )scene2spad ([a-z][a-z-]*)", code))
    assert named <= COMMANDS, f"{page.name}: {sorted(named - COMMANDS)}"


def test_the_worked_example_of_the_photon_budget_runs(tmp_path, monkeypatch, capfd):
    """The page's wall, its command and its numbers: 163.9 signal and 408,089 background photons."""
    text = (ROOT / "docs/radiometric.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", text, re.S)
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "radiometric.md", "exec"), {})
    (command,) = re.findall(r"scene2spad (sense wall\.exr.*?)\n    scene2spad", text, re.S)
    assert main([*command.replace("\\\n", " ").split(), "--no-figure", "--json"]) == 0
    message = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert message["mean_signal"] == pytest.approx(163.9, abs=0.1)
    assert message["mean_background"] == pytest.approx(408089, rel=2e-4)
    assert message["model"] == "first-photon"


def test_the_worked_example_of_the_processor_gives_the_codes_that_the_page_says():
    text = (ROOT / "docs/ultraphase.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", text, re.S)
    names: dict = {}
    exec(compile(block, "ultraphase.md", "exec"), names)
    assert (names["codes"] == names["histogram"].counts @ names["fourier"].matrix(names["temporal"]).T).all()


def test_the_sensor_file_of_the_guide_is_one(tmp_path):
    """With the page's tables of optics, jitter and a time-to-digital converter; and with those of zones."""
    page = (ROOT / "docs/sensors.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```toml\n(.*?)```", page, re.S)
    found = re.findall(r"^    \[[a-z]+\]\n(?:    .*\n)+", page, re.M)
    tables = {table.split("]")[0].strip(" ["): textwrap.dedent(table) for table in found}
    assert set(tables) == {"optics", "jitter", "tdc", "zones"}
    zones = tables.pop("zones")
    (tmp_path / "mine.toml").write_text(text + "".join(tables.values()))
    sensor = read_sensor(tmp_path / "mine.toml").sensor
    assert (sensor.bins, sensor.dead_time_s, sensor.pde) == (1000, 30e-9, 0.25)
    assert (sensor.jitter.fwhm_s, sensor.jitter.tail_s) == pytest.approx((60e-12, 120e-12))
    without = re.sub(r"^(dead_time|reset) = .*\n", "", text, flags=re.M)  # which the page says are of pixels alone
    (tmp_path / "zones.toml").write_text(without + zones)
    array = read_sensor(tmp_path / "zones.toml").zones
    assert array.centre_x == (-0.105, 0.105) and array.delay_s == pytest.approx((0, 35e-12))
    assert array.trials == (math.inf, 1e5)
