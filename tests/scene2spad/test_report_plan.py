"""The report expects what studies write and what was published, and its cells say which."""

import re
from pathlib import Path

import pytest

from scene2spad.networks.registry import ModelSpec
from scene2spad.options.experiments import ABLATIONS
from scene2spad.report import html as report_html
from scene2spad.report import page as report
from scene2spad.report import published as report_published
from scene2spad.report.plan import SECTIONS
from scene2spad.studies.ablations.plan import CLAIMS, sheets_of
from scene2spad.studies.depth_offset.plan import plan_of
from scenes import InputError

# What is expected, against what studies write


def test_figures_of_the_ablations_are_those_that_their_studies_draw():
    pictures = {one.file for part in SECTIONS for item in part.items for one in item.pictures}
    for study in ABLATIONS:
        for sheet in sheets_of(study, "paper", True):
            assert f"{study}-{sheet.figure}-{sheet.compression}x.png" in pictures
        assert study in CLAIMS
    for ratio in plan_of("laptop", False).compressions:
        assert f"depth-offset-3-{ratio}x.png" in pictures


def test_every_file_expected_is_written_somewhere_in_the_package():
    """Names that no module spells, whole or in its parts, are names that nothing writes."""
    folder = Path(report.__file__).parents[1]
    source = "\n".join(p.read_text() for p in folder.rglob("*.py") if p.parent.name != "report")
    for part in SECTIONS:
        for item in part.items:
            for file in (*(one.file for one in item.pictures), *(one.file for one in item.tables), *item.data):
                stem, _, ending = file.rpartition(".")
                if re.search(r"\d+x$", stem) or stem.split("-summary")[0] in ABLATIONS:
                    continue  # composed: the test above
                tail = stem.rpartition("-")[2]
                assert stem in source or f"-{tail}.{ending}" in source or f'"{tail}"' in source, file


# Published numbers


def test_published_numbers_stand_beside_ours():
    one, other = ModelSpec("fourier", (1024, 1, 1)), ModelSpec("gray", (1024, 1, 1))
    rows = report_published.error_rows([one, other], [{"model": one.name, "near_mae_mm_label": 80.68}], far=False)
    assert rows[0]["near published"] == 40.34 and rows[0]["near ours / published"] == "2.00 worse"
    assert len(rows) == 1  # the paper stands beside what was measured, alone beside nothing


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.00012346, "0.0001235"),
        (True, "yes"),
        (None, "–"),
        (float("nan"), "–"),
        (float("inf"), "∞"),
        (float("-inf"), "-∞"),
        ([1, 2.5], "1, 2.5"),
        ({"a": 1}, "a: 1"),
        (1234567, "1234567"),
    ],
)
def test_cells(value, text):
    assert report_html.format_value(value) == text


def test_gathering_wants_a_folder(tmp_path):
    with pytest.raises(InputError, match="no folder"):
        report.gather(tmp_path / "none")
