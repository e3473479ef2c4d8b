"""Base class of all options models."""

import json
from typing import ClassVar, Self

from pydantic import BaseModel, ConfigDict


class StageOptions(BaseModel):
    """Options of one stage: frozen and typed; unknown keys are refused.

    ``stage_version`` is bumped when the stage's results change for the same inputs and options; it is part
    of what Snakemake compares, so the stage and what depends on it run again.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage_version: ClassVar[int] = 1

    def canonical_json(self) -> str:
        """The options as JSON with sorted keys: equal options give equal text."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True)

    def resolved(self) -> Self:
        """The options with 'auto' replaced where these options alone determine what it means."""
        return self
