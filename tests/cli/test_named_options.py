"""Every command and option that a text names is one that there is."""

import ast
import re
from pathlib import Path

import pytest

from pemviz.cli.main import COMMANDS as TOP
from tests.cli.command_kinds import COMMANDS, option_names

ROOT = Path(__file__).resolve().parents[2]
OPTION = re.compile(r"(?<![\w./-])--[a-z][a-z0-9.-]*[a-z0-9](?!\S*\*)")
QUOTES = "'\"`(,.;:)[]|"
HELP = {"--help", "--help-all", "--version"}
KNOWN = {command: option_names(command) | HELP for command in COMMANDS}
ANY = set().union(*KNOWN.values())
OTHERS = {  # programs and packages of others, with their own options
    "pemviz/simulators/sumo/engine.py",
    "pemviz/simulators/sumo/traffic/process.py",
    "pemviz/simulators/sumo/traffic/places.py",
    "pemviz/recording/open.py",
    "pemviz/cli/completion.py",
}
PAGES = ("README.md", *(str(p.relative_to(ROOT)) for p in sorted((ROOT / "docs").rglob("*.md"))))
OF_BENCHMARKS = {
    *("--seeds", "--first-seed", "--cases", "--checkout", "--without-numba", "--threshold"),
    *("--budget", "--truths", "--list", "--methods"),
}
"""Of ``python -m benchmarks``, which tests/bench tries."""
NOT_OURS = re.compile(
    r"(pytest|python|pip|sphinx|tests?\.|benchmarks|tools/|studies|git|dask|curl)\b"
)


def texts_of(path):
    """The string constants of a module, what is put into f-strings left out, with their lines."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    inside = {
        id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)
        for part in ast.walk(node) if part is not node
    }  # fmt: skip
    for node in ast.walk(tree):
        if id(node) in inside:
            continue
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value
        elif isinstance(node, ast.JoinedStr):
            parts = (p.value if isinstance(p, ast.Constant) else "{}" for p in node.values)
            yield node.lineno, "".join(str(part) for part in parts)


def faults(text, *, others=frozenset()):
    """What a text names that there is not: options, and commands that it quotes or gives some.

    Args:
        text: What is looked at.
        others: Options of others that it may name where it names no command.
    """
    words = text.split()
    allowed, command = ANY | others, ""
    for index, word in enumerate(words):
        if "benchmarks" in word:
            allowed = ANY | OF_BENCHMARKS
        if word.strip(QUOTES) == "pemviz" and "pemviz." not in word:
            one, two = named(words[index + 1 : index + 3])
            command = f"{one} {two}".strip() if one == "pem" else one
            allowed = KNOWN.get(command, ANY)
            is_known = one in TOP and (one != "pem" or not two.islower() or command in KNOWN)
            if word[0] in "'`" and one.isalpha() and one.islower() and not is_known:
                yield f"pemviz {command}"
        yield from (f"{command} {one}" for one in OPTION.findall(word) if one not in allowed)
        if word.rstrip(",")[-1:] in ".;:'`|":
            allowed, command = ANY | others, ""


def named(words):
    """The command and action among two words, as far as they are quoted together."""
    one, two, *_ = *words, "", ""
    return one.strip(QUOTES), two.strip(QUOTES) if one == one.rstrip(QUOTES) else ""


@pytest.mark.parametrize("part", sorted(p.name for p in (ROOT / "pemviz").iterdir()
                                        if p.is_dir() and p.name != "__pycache__"))  # fmt: skip
def test_what_the_program_says_names_what_there_is(part):
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {fault}"
        for path in (ROOT / "pemviz" / part).rglob("*.py")
        if str(path.relative_to(ROOT)) not in OTHERS
        for line, text in texts_of(path)
        for fault in faults(text)
    ]
    assert wrong == []


def lines_of(page):
    """The page's lines, those that a backslash continues as one."""
    return page.replace("\\\n", " ").splitlines()


@pytest.mark.parametrize("path", [*PAGES, *(str(p.relative_to(ROOT)) for p in
                                             sorted((ROOT / "assets").rglob("*.md")))])  # fmt: skip
def test_what_pages_say_names_what_there_is(path):
    wrong = [
        f"{path}: {fault}: {line[:80]}"
        for line in lines_of((ROOT / path).read_text(encoding="utf-8"))
        if not NOT_OURS.search(line)
        for fault in faults(line.partition("#")[0], others=OF_BENCHMARKS)
    ]
    assert wrong == []


def test_what_there_is_not_is_found():
    assert list(faults("narrowed by: pemviz pem fit --ensemble")) == ["pem fit --ensemble"]
    assert list(faults("try 'pemviz memory' instead"))
    assert list(faults("give --no-such-option"))
    assert not list(faults("a file of 'pemviz pem fit --position-errors'; --memory-curve tells"))
    assert not list(faults("pemviz record --method mixture, as pemviz writes it"))
