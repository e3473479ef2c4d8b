"""What is given twice is refused, as Snakemake would lose one of the two without a word."""

import shlex

import pytest
from snakemake.cli import get_argument_parser

from snakesfm.config_checks import check_given_once
from snakesfm.errors import ConfigError


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("--config a=1 b=2 --config c=3", "--config"),
        ("--config a=1 -C c=3", "--config"),
        ("--config=a=1 -n --config=c=3", "--config"),
        ("-Ca=1 -nkC c=3", "--config"),
        ("--configfile a.yaml --config a=1 --configfile b.yaml", "--configfile"),
        ("--configfile=a.yaml --configfiles b.yaml", "--configfile"),
    ],
)
def test_an_option_of_which_only_the_last_counts_is_refused(command: str, option: str) -> None:
    arguments = shlex.split(command)
    # Snakemake takes the call and loses the first
    parsed = get_argument_parser().parse_args(arguments)
    assert len(parsed.config if option == "--config" else parsed.configfile) == 1
    with pytest.raises(ConfigError, match=rf"^{option} is given twice, and .* behind one {option}\.$"):
        check_given_once(arguments)


def test_how_often_an_option_is_given_is_said() -> None:
    with pytest.raises(ConfigError, match=r"^--config is given 3 times, and"):
        check_given_once(["--config", "a=1"] * 3)


@pytest.mark.parametrize(
    "command",
    [
        "",
        "--config a=1 b=2 --configfile a.yaml b.yaml",
        "-nC a=1 --configfiles a.yaml",
        "-c 2 -call --cores 2 --conda-prefix C --conda-cleanup-envs --config a=--config",
        "-RC -UC --replace-workflow-config -C a=1",
    ],
)
def test_other_options_that_begin_alike_are_taken(command: str) -> None:
    check_given_once(shlex.split(command))
