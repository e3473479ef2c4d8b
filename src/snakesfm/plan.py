"""The plan of a run for the Snakefile: its scenes, and the weights they need."""

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from snakesfm.cache import VARIABLE
from snakesfm.config.configuration import TEXT_KEYS, RunOptions, list_scenes, load_configuration
from snakesfm.errors import ConfigError
from snakesfm.pipeline import STAGES
from snakesfm.scene_checks import check_scene
from snakesfm.scene_plan import ScenePlan


def _check_writable(folder: Path) -> None:
    """Refuse an output folder that cannot be made or written, before Snakemake stumbles over it."""
    writable = False
    # raised where a folder above may not be entered
    with contextlib.suppress(PermissionError):
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        writable = existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)
    if not writable:
        raise ConfigError(
            f"The output folder '{folder}' cannot be written: choose another one with --config output=DIR."
        )


def _check_homes(configuration: RunOptions) -> None:
    """Refuse paths that begin with '~' where the system knows no such home folder."""
    keys = [key for key in TEXT_KEYS if key != "scene"]
    given = [(key, getattr(configuration, key)) for key in keys]
    given += [(key, getattr(scene, key, "")) for scene in configuration.scenes.values() for key in keys]
    for key, path in [*given, (VARIABLE, os.environ.get(VARIABLE, ""))]:
        try:
            Path(path).expanduser()
        except RuntimeError:
            raise ConfigError(
                f"The home folder '{path.split('/')[0]}' of {key}={path} is not known: write the "
                "whole path."
            ) from None


class Plan:
    """All scenes of a run.

    Parameters
    ----------
    config : the configuration as Snakemake has it.
    weights_only : the run just fetches weights, so no scene is planned and no images need be there.
    image_counts : in a job, by scene, how many images its run was planned with; those that are there now do
        not count, and nothing is checked again.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        weights_only: bool = False,
        image_counts: Mapping[str, int] | None = None,
    ) -> None:
        self.configuration = configuration = load_configuration(config)
        _check_homes(configuration)
        self.output = Path(configuration.output).expanduser()
        self.weights = Path(configuration.weights).expanduser()
        self.weights_only = weights_only
        planned = {
            name: ScenePlan(name, inputs, configuration, self.output)
            for name, inputs in list_scenes(configuration).items()
        }
        for name, count in (image_counts or {}).items():
            planned[name].image_count = count
        # the networks whose weights any scene's stages may read
        self.models = sorted(
            {
                name
                for scene in planned.values()
                for stage in STAGES
                for name in scene.possible_models(stage)
            }
        )
        self.scenes = {} if weights_only else planned
        if not weights_only:
            _check_writable(self.output)
        if not image_counts:
            for scene in self.scenes.values():
                check_scene(scene)

    def scenes_by_blocks(self) -> dict[int, list[str]]:
        """The names of the scenes that have each number of blocks."""
        groups: dict[int, list[str]] = {}
        for name, scene in self.scenes.items():
            groups.setdefault(scene.blocks, []).append(name)
        return groups

    def select_pairs_rule(self, blocks: int) -> str:
        """The name of rule select_pairs for a number of blocks; plain for the one that most scenes have."""
        groups = self.scenes_by_blocks()
        usual = max(groups, key=lambda count: (len(groups[count]), count))
        return "select_pairs" if blocks == usual else f"select_pairs_{blocks}_blocks"

    def select_pairs_twins(self) -> set[str]:
        """The names of rule select_pairs for the scenes that do not have the usual number of blocks."""
        return {self.select_pairs_rule(blocks) for blocks in self.scenes_by_blocks()} - {"select_pairs"}
