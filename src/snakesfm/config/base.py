"""Base class of all options models."""

import json
from typing import Any, ClassVar, Self, get_args

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator

from snakesfm.digests import options_digest


class Options(BaseModel):
    """Frozen and typed options; unknown keys are refused, and true and false where numbers are wanted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_truth_values(cls, value: Any, info: ValidationInfo) -> Any:
        # pydantic takes true for 1
        values = value if isinstance(value, list | tuple) else [value]
        if any(isinstance(item, bool) for item in values):
            types = _types_in(cls.model_fields[str(info.field_name)].annotation)
            if types & {int, float} and bool not in types:
                raise ValueError("the value should be a number, not true or false")
        return value


def _types_in(annotation: Any) -> set[Any]:
    """An annotation and all that it is made of."""
    return {annotation}.union(*(_types_in(part) for part in get_args(annotation)))


class StageOptions(Options):
    """Options of one stage.

    ``stage_version`` is bumped when the stage's results change for the same inputs and options; it is part
    of what Snakemake compares, so the stage and what depends on it run again.
    """

    stage_version: ClassVar[int] = 1

    def canonical_json(self) -> str:
        """The options as JSON with sorted keys: equal options give equal text."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True)

    def digest(self) -> str:
        """A digest of these options and of the stage's version."""
        return options_digest(self.stage_version, self.canonical_json())

    def resolved(self) -> Self:
        """The options as they are used, as far as these alone tell: 'auto' replaced, limits kept."""
        return self
