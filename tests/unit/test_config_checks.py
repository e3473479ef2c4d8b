"""What is given twice is refused, as Snakemake would lose one of the two without a word."""

import shlex
from pathlib import Path

import pytest
from snakemake.cli import get_argument_parser

from snakesfm.config_checks import check_given_once, check_keys
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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "seed: 1\nmatch_pairs:\n  max_ratio: 0.7\nseed: 2\n",
            "'seed' .* (lines 1 and 4): remove one of them",
        ),
        (
            "adjust_bundle: {refine_keypoints: false}\nseed: 1\nadjust_bundle:\n  max_iterations: 9\n",
            "'adjust_bundle' .* (lines 1 and 3): join the blocks",
        ),
        ("scenes:\n  a: {images: x}\n  'a': {images: y}\n", "'a' .* (lines 2 and 3): join the blocks"),
        ("scenes:\n  1: {images: x}\n  '1': {images: y}\n", "'1' .* (lines 2 and 3): join the blocks"),
        ("a: [{b: 1,\n  b: 2}]\n", "'b' .* (lines 1 and 2): remove one of them"),
        ('{"seed": 1,\n"seed": 2}', "'seed' .* (lines 1 and 2): remove one of them"),
    ],
)
def test_a_key_that_stands_twice_in_a_file_is_refused(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    words = message.replace("(", r"\(").replace(")", r"\)").replace(" .* ", f" stands twice in {file} ")
    with pytest.raises(ConfigError, match=f"^Key {words}\\.$"):
        check_keys([file])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "seed: 1\n",
        "scenes:\n  a: &x {images: x}\n  b: {<<: *x, images: y}\n  c: *x\n",
        "a: &a {x: 1}\nb: &b {y: 1}\nc:\n  <<: *a\n  <<: *b\n",
        "a: &a [*a]\n",
        "? [1, 2]\n: x\n? [1, 2]\n: y\n",
        "a: {b: 1}\nc: {b: 1}\n",
        "a: [\n",
    ],
)
def test_files_without_a_repeated_key_are_taken(text: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    check_keys([file, tmp_path / "missing.yaml"])
