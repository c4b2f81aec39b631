"""Every sample of the page on data formats is read as it stands there, and gives what it says."""

import re
import runpy
import shlex
from pathlib import Path

import pytest

from pemviz.cli.main import main
from pemviz.cli.pem.collect import CollectArguments

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "detections.md"
BLOCK = re.compile(
    r"^```(\S+)(?: \w+)?\n(?::caption: (\S+)\n\n)?(.*?)^```$", re.MULTILINE | re.DOTALL
)
TOLD_ELSEWHERE = {"nuscenes", "rosbag"}
"""Their files are too long for a page; tests/pem reads such."""


def sections():
    """Each format's blocks: kind, file name or nothing, text."""
    parts = re.split(r"^## (\S+)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return dict(zip(parts[1::2], map(BLOCK.findall, parts[2::2]), strict=True))


SAMPLED = sorted(set(sections()) - TOLD_ELSEWHERE)


def test_every_format_has_its_section():
    named = CollectArguments.__annotations__["format"]
    assert set(sections()) == set(named.__args__)


@pytest.mark.parametrize("name", SAMPLED)
def test_a_sample_is_read_as_the_page_says(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks, commands = sections()[name], 0
    for kind, caption, text in blocks:
        if caption:
            path = tmp_path / caption
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
            if path.suffix == ".py":
                runpy.run_path(str(path))
        elif kind == "sh":
            commands += 1
            capsys.readouterr()
            try:
                code = main(shlex.split(text)[1:])
            except SystemExit as end:
                code = end.code
            told = capsys.readouterr()
            printed = told.err if code else told.out
        elif kind == "text":
            assert printed == text
            assert (code == 2) == text.startswith("pemviz: ")
    assert commands >= 1
