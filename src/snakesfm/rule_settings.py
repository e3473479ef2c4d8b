"""What Snakemake's command line and profiles say of a rule, for rules that do the same in other scenes."""

from collections.abc import Set
from typing import Any

from snakesfm.errors import ConfigError


def share_resources(settings: Any, rule: str, twins: Set[str]) -> None:
    """Have --set-resources and --set-threads of a rule hold for its twins as well.

    Parameters
    ----------
    settings : resource settings of Snakemake's workflow (9.27), before the twins are defined.
    rule : a rule's name.
    twins : names of rules; what is said of one of them by its own name holds.
    """
    # parsed when the first rule was defined
    for option in ("_parsed_overwrite_resources", "_parsed_overwrite_threads"):
        said = getattr(settings, option, {})
        if rule in said:
            said.update({twin: said[rule] for twin in twins if twin not in said})


def check_named_together(words: Set[str], rule: str, twins: Set[str]) -> None:
    """Refuse a command line that names a rule and would so leave out the scenes of its twins.

    Parameters
    ----------
    words : of Snakemake's command line, as :func:`snakesfm.records.split_words` gives them.
    rule : a rule's name.
    twins : names of rules.

    Raises
    ------
    ConfigError : the rule is named, and not all of its twins are.
    """
    if rule in words and not twins <= words:
        raise ConfigError(
            f"Scenes with other numbers of blocks have rule '{rule}' under other names: say "
            f"'{' '.join((rule, *sorted(twins)))}' in place of '{rule}'."
        )
