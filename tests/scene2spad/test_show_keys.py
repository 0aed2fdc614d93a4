"""The page of `show` is used by keyboard: key presses in a real browser, where there is one."""

import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator

import pytest

from scene2spad.cli import main

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CODES = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, " ": 32, "Tab": 9}
WAIT_S = 120.0  # a busy machine takes long to start a browser
STATE = """JSON.stringify({focus: document.activeElement.id, told: document.getElementById("told").textContent,
    time: document.getElementById("time").value, play: document.getElementById("play").textContent,
    cloud: document.getElementById("cloud").toDataURL()})"""


def waited(found: Callable[[], object]) -> object:
    end = time.monotonic() + WAIT_S
    while not (value := found()) and time.monotonic() < end:
        time.sleep(0.1)
    assert value
    return value


class Tab:
    """One page in the browser."""

    def __init__(self, port: int) -> None:
        from tornado.ioloop import IOLoop
        from tornado.websocket import websocket_connect

        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            address = next(one for one in json.load(answer) if one["type"] == "page")["webSocketDebuggerUrl"]
        self.loop, self.number = IOLoop(make_current=False), 0
        self.socket = self.loop.run_sync(lambda: websocket_connect(address, max_message_size=1 << 28))

    def ask(self, method: str, **parameters: object) -> dict:
        """Send a command and return its result; what the page tells meanwhile is passed over."""
        self.number += 1
        message = json.dumps({"id": self.number, "method": method, "params": parameters})
        self.loop.run_sync(lambda: self.socket.write_message(message))
        while (answer := json.loads(self.loop.run_sync(self.socket.read_message))).get("id") != self.number:
            pass
        return answer["result"]

    def value(self, expression: str) -> object:
        return self.ask("Runtime.evaluate", expression=expression)["result"].get("value")

    def press(self, key: str, *, shift: bool = False) -> dict:
        """Press a key where the focus is, and return what the page shows then."""
        common = {"key": key, "windowsVirtualKeyCode": CODES.get(key, 0), "modifiers": 8 * shift}
        self.ask("Input.dispatchKeyEvent", type="rawKeyDown", **common)
        if len(key) == 1:
            self.ask("Input.dispatchKeyEvent", type="char", text=key, **common)
        self.ask("Input.dispatchKeyEvent", type="keyUp", **common)
        return json.loads(str(self.value(STATE)))


@pytest.fixture
def tab(tmp_path) -> Iterator[Tab]:
    """The page of a histogram of 24 columns and 16 rows, opened."""
    pytest.importorskip("tornado")
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no browser to open the page")
    size = ("--width", "24", "--height", "16", "--bounces", "1", "--grid", "2")
    assert main(["render", "sphere", *size, "--no-figure", "--out", str(tmp_path / "a.exr")]) == 0
    assert main(["sense", str(tmp_path / "a.exr"), "--no-figure"]) == 0
    assert main(["show", str(tmp_path / "a.h5")]) == 0
    profile = tmp_path / "profile"
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0", f"--user-data-dir={profile}")
    page = (tmp_path / "a.histogram.html").as_uri()
    with subprocess.Popen([browser, *options, page], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            port = profile / "DevToolsActivePort"
            waited(lambda: port.is_file() and port.read_text().count("\n"))
            opened = Tab(int(port.read_text().splitlines()[0]))
            waited(lambda: opened.value('document.getElementById("told")?.textContent'))
            yield opened
        finally:
            process.kill()


def focused_by_tab(tab: Tab, wanted: str) -> dict:
    """Press Tab until an element has the focus."""
    for _ in range(40):
        state = tab.press("Tab")
        if state["focus"] == wanted:
            return state
    raise AssertionError(f"Tab never comes to {wanted}")


@pytest.mark.slow
def test_keys_choose_a_pixel_move_time_play_and_turn_the_cloud(tab):
    focused_by_tab(tab, "image")
    for key in ("ArrowUp", "ArrowLeft"):
        for _ in range(3):
            state = tab.press(key, shift=True)
    assert state["told"].startswith("Row 0, column 0:")  # it stops at the edges
    assert tab.press("ArrowDown")["told"].startswith("Row 1, column 0:")
    assert tab.press("ArrowRight", shift=True)["told"].startswith("Row 1, column 10:")
    before = focused_by_tab(tab, "time")
    assert int(tab.press("ArrowRight")["time"]) == int(before["time"]) + 1
    focused_by_tab(tab, "movie")
    assert [tab.press(" ")["play"] for _ in range(2)] == ["Pause", "Play"]
    clouds = [focused_by_tab(tab, "cloud"), tab.press("ArrowLeft"), tab.press("+")]
    assert len({one["cloud"] for one in clouds}) == 3  # turned, then nearer
