"""Which scenes, targets and folders a run is of."""

import dataclasses
import shutil
import subprocess
from pathlib import Path

import pycolmap
import pytest
from workflow_runner import config_of, copy_run, model_bytes

from snakesfm.run import CONFIGURATION_NAME

pytestmark = pytest.mark.workflow


def test_another_folder_of_the_same_name_replaces_results_only_where_the_scene_is_named(
    finished, small_scene: Path, workflow
) -> None:
    copy_run(finished[0], workflow.folder)
    before = model_bytes(workflow.folder / "out" / "square")
    scene = workflow.folder / "square"
    shutil.copytree(small_scene, scene)
    for call in ([], ["--dry-run"]):
        outcome = workflow.run(*call, *config_of(scene))
        assert outcome.status == 1 and outcome.rules == [] and "Traceback" not in outcome.text
        holds = f"'out/square' holds the results of '{(small_scene / 'images').resolve()}'"
        assert f"{holds}: set scene=NAME or another output=DIR" in outcome.text
    assert model_bytes(workflow.folder / "out" / "square") == before
    assert workflow.run("--dry-run", *config_of(scene), "scene=other").status == 0
    (workflow.folder / "link").symlink_to(small_scene, target_is_directory=True)
    linked = ["--config", "images=link/images", *config_of(small_scene)[2:], "scene=square"]
    assert workflow.run("--dry-run", *linked).status == 0


def test_several_scenes_run_together_and_a_bad_one_does_not_stop_the_others(
    finished, small_scene: Path, workflow
) -> None:
    copy_run(finished[0], workflow.folder)
    single = workflow.folder / "single"
    single.mkdir()
    shutil.copy(sorted((small_scene / "images").iterdir())[0], single)
    (workflow.folder / "mine.yaml").write_text(
        f"output: out\nscenes:\n  single: {{images: {single}}}\n"
        f"  square: {{images: {small_scene / 'images'}, reference: {small_scene / 'reference'}}}\n"
    )
    (workflow.folder / "out" / "square" / "render_report" / "index.html").unlink()
    outcome = workflow.run("--configfile", "mine.yaml")
    assert outcome.status != 0
    lines = {line.split("'")[1]: line for line in outcome.summary}
    assert "16 of 16 images" in lines["square"]
    assert "failed" in lines["single"]
    assert "Traceback" not in outcome.text


def test_the_database_is_made_by_its_own_target_alone(finished, small_scene: Path, workflow) -> None:
    copy_run(finished[0], workflow.folder)
    file = workflow.folder / "out" / "square" / "export_database" / "database.db"
    assert not file.exists()
    outcome = workflow.run("databases", *config_of(small_scene))
    assert outcome.status == 0
    assert [rule for rule in outcome.rules if rule != "databases"] == ["export_database"]
    database = pycolmap.Database.open(file)
    assert database.num_images() == database.num_frames() == 16
    assert database.num_verified_image_pairs() > 30
    database.close()


def test_a_model_of_former_images_is_not_called_this_run_s(finished, small_scene: Path, workflow) -> None:
    copy_run(finished[0], workflow.folder)
    scene = workflow.folder / "square"
    shutil.copytree(small_scene, scene)
    sorted((scene / "images").iterdir())[0].unlink()
    outcome = workflow.run("databases", *config_of(scene), "scene=square")
    assert outcome.status == 0
    *_, line = outcome.summary
    assert "COLMAP database in out/square/export_database/database.db" in line
    assert "the model is older than its images" in line
    assert "registered" not in line


def test_the_workflow_may_lie_in_a_folder_of_any_name(root: Path, small_scene: Path, workflow) -> None:
    project = workflow.folder / "snake's {sfm} 2"
    for folder in ("workflow", "scripts"):
        shutil.copytree(root / folder, project / folder)
    for file in ("Snakefile", "config.yaml"):
        shutil.copy(root / file, project)
    command = workflow.command("--until", "index_images", *config_of(small_scene))
    command[command.index("--snakefile") + 1] = str(project / "Snakefile")
    done = subprocess.run(command, cwd=workflow.folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (workflow.folder / "out" / "square" / "index_images" / "index.h5").is_file()


def test_a_job_of_a_cluster_reads_no_configuration_but_the_kept_one(root: Path, workflow) -> None:
    shutil.copytree(root / "workflow", workflow.folder / "workflow")
    shutil.copy(root / "Snakefile", workflow.folder)
    # which is being edited
    (workflow.folder / "config.yaml").write_text("match_pairs: {max_ratio:")
    (workflow.folder / "images").mkdir()
    for name in ("a.jpg", "b.jpg"):
        (workflow.folder / "images" / name).write_text(name)
    (workflow.folder / CONFIGURATION_NAME).write_text('{"images": "images", "output": "out", "blocks": 1}')
    command = workflow.command("--dry-run", "--configfile", CONFIGURATION_NAME)
    command[command.index("--snakefile") + 1] = str(workflow.folder / "Snakefile")
    done = subprocess.run(command, cwd=workflow.folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "rule adjust_bundle" in done.stdout


def test_the_output_may_be_the_folder_one_is_in(small_scene: Path, workflow) -> None:
    scene = workflow.folder / "square"
    shutil.copytree(small_scene, scene)
    inside = dataclasses.replace(workflow, folder=scene)
    outcome = inside.run("--dry-run", "--config", "images=images", "output=.")
    assert outcome.status == 0, outcome.text
    assert "adjust_bundle" in outcome.rules
