"""Which outputs Snakemake has a record of."""

import json
from base64 import urlsafe_b64encode
from pathlib import Path

import pytest
from snakemake.settings.enums import PersistenceBackend
from snakemake.settings.types import WorkflowSettings
from users import without_root

from snakesfm.errors import ConfigError
from snakesfm.records import (
    check_backend,
    check_folder,
    deletes,
    forget,
    makes_nothing,
    unrecorded_files,
    was_made_with,
)


def test_a_folder_without_room_for_records_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    check_folder("/opt/snakesfm/Snakefile")
    tmp_path.chmod(0o555)
    with without_root(), pytest.raises(ConfigError) as refused:
        check_folder("/opt/snakesfm/Snakefile")
    assert str(tmp_path) in str(refused.value)
    assert "-s /opt/snakesfm/Snakefile" in str(refused.value)
    assert "--directory" in str(refused.value)
    tmp_path.chmod(0o755)
    records = tmp_path / ".snakemake"
    records.mkdir()
    records.chmod(0o555)
    with without_root(), pytest.raises(ConfigError, match=r"\.snakemake cannot be written"):
        check_folder("/opt/snakesfm/Snakefile")


def test_records_in_a_database_are_refused_as_none_of_them_would_be_found() -> None:
    check_backend(WorkflowSettings().persistence_backend.item_to_choice())
    with pytest.raises(ConfigError, match=r"--persistence-backend db .*: leave out this option"):
        check_backend(PersistenceBackend.DB.item_to_choice())


def write_record(records: Path, output: Path, endtime: float, *params: str) -> list[str]:
    code = urlsafe_b64encode(str(output).encode()).decode()
    parts = [code[k : k + 254] for k in range(0, len(code), 254)]
    record = records.joinpath(*[f"@{part}" for part in parts[:-1]], parts[-1])
    record.parent.mkdir(parents=True, exist_ok=True)
    record.write_text(json.dumps({"endtime": endtime, "params": [repr(text) for text in params]}))
    return parts


def test_files_with_a_record_are_known_however_long_their_names(tmp_path: Path) -> None:
    short, long = tmp_path / "a.h5", tmp_path / ("deep" * 50) / ("name" * 40 + ".h5")
    for path in (short, long, tmp_path / "b.h5", tmp_path / "c.json"):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    records = tmp_path / "records"
    for path in (short, long):
        parts = write_record(records, path, path.stat().st_mtime)
    assert len(parts) == 3
    outputs = [str(tmp_path / name) for name in ("a.h5", "b.h5", "c.json", "missing.h5")]
    assert unrecorded_files([*outputs, str(long)], records) == [tmp_path / "b.h5", tmp_path / "c.json"]


def test_a_record_of_the_file_that_was_there_before_is_none(tmp_path: Path) -> None:
    path, records = tmp_path / "a.h5", tmp_path / "records"
    path.touch()
    for seconds in (-3.0, 3.0):
        write_record(records, path, path.stat().st_mtime + seconds)
        assert unrecorded_files([str(path)], records) == [path]
    (records / urlsafe_b64encode(str(path).encode()).decode()).write_text("cut o")
    assert unrecorded_files([str(path)], records) == [path]


def test_a_forgotten_file_stays_and_is_older_than_all_and_unrecorded(tmp_path: Path) -> None:
    path, records = tmp_path / "summary.json", tmp_path / "records"
    path.write_text("{}")
    write_record(records, path, path.stat().st_mtime)
    assert unrecorded_files([str(path)], records) == []
    forget(path, records)
    assert path.stat().st_mtime == 1
    assert list(records.iterdir()) == []
    assert unrecorded_files([str(path)], records) == [path]


@pytest.mark.parametrize(
    ("arguments", "nothing"),
    [
        (["--profile", "profiles/local", "--config", "output=out"], False),
        (["-c", "2", "-k", "databases", "--report-after-run"], False),
        (["-j2", "--rerun-incomplete", "--list-untracked"], True),
        (["-np"], True),
        (["-kFnc2"], True),
        (["-call"], False),
        (["-jall", "-k"], False),
        (["-kcall"], False),
        (["--dryrun", "--cores", "1"], True),
        (["--summary"], True),
        (["-S"], True),
        (["--report=out.html"], True),
        (["--lint"], True),
        (["--rulegraph", "mermaid-js"], True),
        (["--unlock"], True),
        (["--touch"], True),
        (["-t"], True),
        (["--cleanup-metadata", "out/a.h5"], True),
        (["--delete-all-output"], True),
    ],
)
def test_what_makes_nothing_is_told_by_its_arguments(arguments: list[str], nothing: bool) -> None:
    assert makes_nothing(arguments) == nothing


@pytest.mark.parametrize(
    ("arguments", "some"),
    [
        (["--delete-all-output", "--cores", "1"], True),
        (["--delete-temp-output"], True),
        # -s takes the rest of its word, and unlocking pretends nothing
        (["--delete-all-output", "-sn"], True),
        (["--unlock", "--delete-all-output", "-k"], True),
        (["--delete-all-output", "-n"], False),
        (["-pn", "--delete-all-output"], False),
        (["--dry-run", "--delete-temp-output"], False),
        (["--delete-all-output", "--dryrun"], False),
        (["--touch", "all"], False),
        (["-n"], False),
    ],
)
def test_what_deletes_is_told_by_its_arguments(arguments: list[str], some: bool) -> None:
    assert deletes(arguments) == some


def test_params_of_a_file_are_held_against_its_record(tmp_path: Path) -> None:
    file, records = tmp_path / "a.h5", tmp_path / "records"
    params = json.dumps({"settings": {"images": "it's \u00e4"}, "seed": 0})
    assert was_made_with(str(file), params, records)
    write_record(records, file, 1.0, params)
    assert was_made_with(str(file), params, records)
    assert not was_made_with(str(file), params.replace("0", "1"), records)
