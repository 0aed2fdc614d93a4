"""Cards of shipped models; training on a machine without a renderer and a command line."""

import json
import re
import subprocess
import sys

import pytest
from test_training import FEW, MODEL, near_planes

from csph.networks.config import preset
from csph.training.loop import train
from csph.training.views import split_views
from csph.weights.cards import cards, checkpoint_of, read_card, shipped_model
from csph.weights.shipped import WEIGHTS, ship, shipped_names
from scenes import InputError


def test_every_shipped_model_has_a_card():
    found = cards()
    assert {card.name for card in found} == set(shipped_names())
    for card in found:
        assert card.training and all(len(one) == 64 for one in card.training_sha256) and card.val_mae_mm > 0
        assert card.levels.startswith("signal ") and len(card.not_for) >= 2
    (long,) = [card for card in found if card.name == "learned-1024x4x4-128x-s0"]
    assert "depths beyond those of its training set" in long.not_for[-1] and long.compression == 128


def test_errors_that_cards_take_from_a_page_stand_on_it():
    root, taken = WEIGHTS.parents[1], 0
    for card in cards():
        for where, levels in card.errors.items():
            page = re.search(r"\((docs/[\w-]+\.md)\)$", where)
            if page is not None:
                numbers = set(re.findall(r"\d+(?:,\d{3})*(?:\.\d+)?", (root / page[1]).read_text(encoding="utf-8")))
                assert {f"{value:,}" for value in levels.values()} <= numbers, (card.name, where)
                taken += 1
    assert taken > 50


def test_a_shipped_run_tells_its_cpu_minutes_and_errors(tmp_path):
    train(preset("smoke", MODEL, **FEW), *split_views(near_planes(3)), tmp_path / "run")
    epochs = [json.loads(line) for line in (tmp_path / "run/timings.jsonl").read_text().splitlines()]
    assert [one["epoch"] for one in epochs] == [1, 2, 3] and all(one["cpu_s"] > 0 for one in epochs)
    ship(tmp_path / "run", "small", tmp_path / "weights", errors={"rooms/test": {"10 + 10": 21.5}})
    card = read_card(tmp_path / "weights/small/card.json")
    assert card.cpu_minutes == pytest.approx(sum(one["cpu_s"] for one in epochs) / 60, abs=0.06)
    assert card.errors == {"rooms/test": {"10 + 10": 21.5}} and card.levels == "signal 1 to 100, background 0.5 to 1200"


def test_models_are_found_by_name_or_path(tmp_path):
    assert checkpoint_of("none-s0") == shipped_model("none-s0") == WEIGHTS / "none-s0/model.safetensors"
    assert checkpoint_of(tmp_path) == tmp_path
    with pytest.raises(InputError, match="nonee-s0: file not found, and model 'nonee-s0' is unknown, like none-s0"):
        checkpoint_of("nonee-s0")
    with pytest.raises(InputError, match="nowhere/run: file not found"):
        checkpoint_of("nowhere/run")
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(InputError, match=r"bad\.json: is no card of a model"):
        read_card(tmp_path / "bad.json")


def test_training_needs_no_renderer_and_no_command_line():
    """A packed set is carried to another machine: Mitsuba, OpenEXR and tyro are not asked for."""
    script = (
        "import sys\n"
        "for name in ('mitsuba', 'drjit', 'OpenEXR', 'tyro'):\n"
        "    sys.modules[name] = None\n"
        "import csph.training.loop, csph.weights.cards, csph.evaluation.methods\n"
        "from csph.networks.checkpoint import load_model\n"
        "from csph.training.views import read_views\n"
        "from csph.weights.cards import shipped_model\n"
        "print(load_model(shipped_model('none-s0'))[0].parameters_count)\n"
    )
    message = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert message.returncode == 0, message.stderr
    assert int(message.stdout) > 100_000


@pytest.mark.parametrize("name", [None, 8, b"none-s0"])
def test_what_names_no_model_is_refused_in_one_line(name):
    with pytest.raises(InputError, match=r"^model .*: expected a name of `models`, or the path of a checkpoint$"):
        checkpoint_of(name)
