"""Rules as they are written on a command line and in a field: NAME=FORMULA."""

from collections.abc import Mapping, Sequence

from pemviz.config.settings import Rule
from pemviz.errors import ConfigError


def read_rules(words: Sequence[str]) -> Mapping[str, str]:
    """Name to formula.

    Raises:
        ConfigError: One is not NAME=FORMULA, or a name stands twice.
    """
    rules: dict[str, str] = {}
    for word in words:
        name, equals, formula = (part.strip() for part in word.partition("="))
        if not equals or not name or not formula:
            message = f"rule = {word!r}: must be NAME=FORMULA"
            raise ConfigError(message)
        if name in rules:
            message = f"rule = {word!r}: another rule has this name"
            raise ConfigError(message)
        rules[name] = formula
    return rules


def rules_text(rules: Sequence[Rule]) -> str:
    """A line for each rule, as :func:`read_rules` takes them."""
    return "\n".join(f"{rule.name} = {rule.formula}" for rule in rules)
