"""Files made from the code are up to date, and what they show is true."""

import json
from pathlib import Path

import jsonschema
import pytest
import yaml

from snakesfm.config.configuration import load_configuration
from snakesfm.documentation import GENERATED


@pytest.mark.parametrize("name", sorted(GENERATED))
def test_generated_file_is_up_to_date(root: Path, name: str) -> None:
    committed = (root / name).read_text("utf-8")
    assert committed == GENERATED[name](), f"run 'python -m snakesfm.documentation' to rewrite {name}"


def test_config_yaml_is_valid_and_holds_the_defaults(root: Path) -> None:
    values = yaml.safe_load((root / "config.yaml").read_text("utf-8"))
    jsonschema.validate(
        values, json.loads((root / "workflow/schemas/config.schema.json").read_text("utf-8"))
    )
    assert load_configuration(values) == load_configuration({})
