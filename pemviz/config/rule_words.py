"""Rules and start values as they are written on a command line: NAME=FORMULA, NAME=DISTRIBUTION."""

from collections.abc import Mapping, Sequence

from pemviz.config.settings import Rule
from pemviz.errors import ConfigError


def read_rules(words: Sequence[str]) -> Mapping[str, str]:
    """Name to formula.

    Raises:
        ConfigError: One is not NAME=FORMULA, or a name stands twice.
    """
    return _read_named(words, kind="rule", value="FORMULA", another="another rule")


def read_starts(words: Sequence[str]) -> Mapping[str, str]:
    """Name to distribution.

    Raises:
        ConfigError: One is not NAME=DISTRIBUTION, or a name stands twice.
    """
    return _read_named(words, kind="start", value="DISTRIBUTION", another="another start value")


def _read_named(words: Sequence[str], *, kind: str, value: str, another: str) -> Mapping[str, str]:
    found: dict[str, str] = {}
    for word in words:
        name, equals, text = (part.strip() for part in word.partition("="))
        if not equals or not name or not text:
            message = f"{kind} = {word!r}: must be NAME={value}"
            raise ConfigError(message)
        if name in found:
            message = f"{kind} = {word!r}: {another} has this name"
            raise ConfigError(message)
        found[name] = text
    return found


def rules_text(rules: Sequence[Rule]) -> str:
    """A line for each rule, as :func:`read_rules` takes them."""
    return "\n".join(f"{rule.name} = {rule.formula}" for rule in rules)
