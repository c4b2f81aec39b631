"""Help fits a screen, names what there is, and nothing else names what there is not."""

import contextlib
import io
import os
import re
import shutil
import subprocess
import sys

import pytest
import tyro

from pemviz.cli.help import HELP_ALL, options_of
from pemviz.cli.main import main
from pemviz.cli.parsing import COLOUR
from tests.cli.command_kinds import BY_PRESET, COMMANDS, PAGES, option_names

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9.-]*[a-z0-9]")


def shown(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", PAGES)
def test_the_page_of_a_command_fits_a_screen_and_has_three_examples(capsys, command):
    page = shown(capsys, *command.split(), "--help")
    lines = page.splitlines()
    assert len(lines) <= 25
    assert max(len(line) for line in lines) <= 80
    examples = [line.strip() for line in lines if line.startswith(f"  pemviz {command} ")]
    assert len(examples) == 3
    assert set(OPTION.findall(page)) - option_names(command) <= {"--help", "--help-all"}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_knows_the_options_that_the_parser_knows(command):
    kind = COMMANDS[command]
    text = io.StringIO()
    with contextlib.redirect_stdout(text), pytest.raises(SystemExit):
        tyro.cli(kind, prog="x", args=["--help"], config=(tyro.conf.FlagCreatePairsOff,))
    lines = COLOUR.sub("", text.getvalue()).splitlines()
    parsed = {word for line in lines for word in re.findall(r"^\W (--[a-z][\w.-]*)", line)}
    ours = {option.words.split()[0] for option in options_of(kind)}
    assert {word for word in ours if word.startswith("--")} == parsed - {"--help"}


@pytest.mark.parametrize("command", PAGES)
def test_all_of_help_has_every_option_once(capsys, command):
    everything = shown(capsys, *command.split(), HELP_ALL)
    heads = re.findall(r"^  (--[a-z][\w.-]*)", everything, flags=re.MULTILINE)
    assert len(set(heads)) == len(heads)
    by_preset = BY_PRESET.get(command, set())  # takes the place of what would switch it on
    off = {name.replace("--no-", "--") for name in by_preset}
    assert set(heads) == option_names(command) - off


def test_a_topic_and_a_single_option_are_explained(capsys):
    scenario = shown(capsys, "record", "--help", "scenario")
    assert "--scenario.initial-gap-m" in scenario
    assert "--encounter.side" not in scenario
    one = shown(capsys, "record", "--help=memory-s")
    assert one.startswith("  --memory-s")
    assert "--frailty" not in one
    assert "town01" in shown(capsys, "record", "--seed", "3", "-h", "--json")


def test_an_option_that_switches_off_says_so(capsys):
    for topic in ("measured-memory", "no-measured-memory"):
        option = shown(capsys, "record", "--help", topic)
        assert option.startswith("  --no-measured-memory\n      Switches off what is done")
        assert "[True]" not in option


def test_a_preset_s_values_stand_in_a_topic(capsys):
    shown_start = re.search(
        r"initial-speed-kmh X\n.*?\[(\d+)\]",
        shown(capsys, "record", "--preset", "town01", "--help", "scenario"),
        flags=re.DOTALL,
    )
    assert shown_start is not None
    assert shown_start[1] == "30"


@pytest.mark.parametrize(
    ("words", "guess"),
    [
        ("recrod", "record"),
        ("pem colect", "collect"),
        ("record --preset cutin", "cut-in"),
        ("record --preset pap", "paper"),
        ("record --pem mlnn", "ml-nn"),
        ("record --method spliting", "splitting"),
        ("record --help scenaro", "scenario"),
        ("record --help initial-gap-m", "scenario.initial-gap-m"),
        ("sweep --preset twn01", "town01"),
    ],
)
def test_what_was_meant_is_guessed(capsys, words, guess):
    assert main(words.split()) == 2
    line = capsys.readouterr().err
    assert f"did you mean {guess}?" in line
    assert line.count("\n") == 1


def test_no_guess_where_nothing_is_near(capsys):
    assert main(["zzzz"]) == 2
    assert "did you mean" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", ["--help", "record --help", "record --help-all", "pem show", "completion bash"]
)
def test_a_reader_who_has_had_enough_hears_no_complaint(words):
    command = [sys.executable, "-m", "pemviz", *words.split()]
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert done.returncode == 3
    assert done.stderr == ""


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash here")
def test_bash_completes_commands_options_and_choices(tmp_path, capsys):
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "pemviz.bash"
    script.write_text(capsys.readouterr().out)
    typed = [
        ("pemviz re", {"record", "replay", "report", "reproduce"}),
        ("pemviz record --fra", {"--frailty"}),
        ("pemviz record --metric a", {"agm"}),
        ("pemviz pem collect --format mot", {"mot", "motchallenge"}),
    ]
    asked = "\n".join(
        f"COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); COMPREPLY=(); "
        "_tyro_pemviz; echo ${COMPREPLY[*]}"
        for words, _ in typed
    )
    done = subprocess.run(
        ["bash", "-c", f"source {script}\n{asked}"], capture_output=True, text=True, check=True
    )
    assert [set(line.split()) for line in done.stdout.splitlines()] == [
        expected for _, expected in typed
    ]
