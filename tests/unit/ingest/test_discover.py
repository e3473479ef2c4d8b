import json
import os
import subprocess
import sys
import time

import pytest

from snakesfm.errors import ConfigError
from snakesfm.ingest.discover import (
    count_images,
    digest_images,
    fingerprint_images,
    list_images,
    list_photographs,
)

SETTLED = "snakesfm.ingest.discover.SETTLED_NS"
ODD_NAMES = [
    "a b.jpg",
    "#1.png",
    "@me.jpg",
    "{x}.JPEG",
    "dir/a b.jpg",
    "Ünï/写真.TIF",
    "z.WebP",
    "scan.bmp",
]


def touch_all(folder, names, content=b"x", age_s=60):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content + name.encode())
        stamp = time.time() - age_s
        os.utime(path, (stamp, stamp))


def test_lists_odd_names_at_any_depth_sorted(tmp_path):
    others = [".hidden.jpg", ".git/a.jpg", "dir/@eaDir/a b.jpg/THUMB.jpg", "notes.txt", "jpg", "movie.mp4"]
    touch_all(tmp_path, [*ODD_NAMES, *others])
    (tmp_path / "folder.jpg").mkdir()
    assert list_images(tmp_path) == sorted(ODD_NAMES)


def test_photographs_that_are_not_read_are_told_but_for_those_beside_an_image(tmp_path):
    touch_all(
        tmp_path, ["a/1.HEIC", "a/2.nef", "a/2.JPG", "b/2.nef", "c.d.cr3", "c.jpg", ".e.heic", "f.mov"]
    )
    images, unread = list_photographs(tmp_path)
    assert unread == ["a/1.HEIC", "b/2.nef", "c.d.cr3"]
    assert images == list_images(tmp_path) == ["a/2.JPG", "c.jpg"]


def test_counts_up_to_the_limit(tmp_path):
    touch_all(tmp_path, ODD_NAMES)
    assert count_images(tmp_path) == count_images(tmp_path, None) == len(ODD_NAMES)
    assert count_images(tmp_path, 3) == 3
    assert count_images(tmp_path, 100) == len(ODD_NAMES)


def test_follows_links_but_no_loops_and_lists_broken_ones(tmp_path):
    outside = tmp_path / "outside"
    images = tmp_path / "images"
    touch_all(outside, ["far.jpg"])
    touch_all(images, ["sub/near.jpg"])
    (images / "linked").symlink_to(outside)
    (images / "sub" / "loop").symlink_to(images)
    (images / "broken.jpg").symlink_to(tmp_path / "nowhere.jpg")
    os.mkfifo(images / "pipe.jpg")
    names = list_images(images)
    assert names == ["broken.jpg", "linked/far.jpg", "sub/near.jpg"]
    digests = digest_images(images, names)
    assert digests["broken.jpg"] == ""
    assert len(digests["linked/far.jpg"]) == 64


def test_missing_folder_is_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match=r"nothing.*cannot be listed"):
        list_images(tmp_path / "nothing")


def test_fingerprint_follows_content_not_time(tmp_path, monkeypatch):
    monkeypatch.setattr(SETTLED, 0)
    images, cache = tmp_path / "images", tmp_path / "scene" / "digests.json"
    touch_all(images, ODD_NAMES)
    first = fingerprint_images(images, cache)
    assert set(json.loads(cache.read_text())["files"]) == set(ODD_NAMES)
    assert fingerprint_images(images, cache) == first == fingerprint_images(images)
    os.utime(images / ODD_NAMES[0], (1, 1))
    assert fingerprint_images(images, cache) == first
    (images / ODD_NAMES[0]).write_bytes(b"other")
    changed = fingerprint_images(images, cache)
    assert changed != first
    (images / ODD_NAMES[0]).rename(images / "renamed.jpg")
    assert fingerprint_images(images, cache) not in (first, changed)


# a camera's clock may be ahead
@pytest.mark.parametrize("age_s", [60, -3600])
def test_unchanged_file_is_not_read_again(tmp_path, monkeypatch, age_s):
    monkeypatch.setattr(SETTLED, 0)
    touch_all(tmp_path / "i", ["a.jpg"], b"one", age_s)
    cache = tmp_path / "digests.json"
    before = digest_images(tmp_path / "i", ["a.jpg"], cache)
    cache.write_text(cache.read_text().replace(before["a.jpg"], "remembered"))
    assert digest_images(tmp_path / "i", ["a.jpg"], cache) == {"a.jpg": "remembered"}


def test_edits_that_keep_size_and_time_are_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(SETTLED, 0)
    image = tmp_path / "i" / "a.jpg"
    touch_all(tmp_path / "i", ["a.jpg"], b"one")
    kept = image.stat()
    cache = tmp_path / "digests.json"
    before = digest_images(tmp_path / "i", ["a.jpg"], cache)
    time.sleep(0.05)
    # as exiftool -P does
    image.write_bytes(image.read_bytes().replace(b"one", b"two"))
    os.utime(image, ns=(kept.st_atime_ns, kept.st_mtime_ns))
    assert image.stat().st_size == kept.st_size
    after = digest_images(tmp_path / "i", ["a.jpg"], cache)
    assert after == digest_images(tmp_path / "i", ["a.jpg"]) != before


def test_fresh_file_is_not_remembered(tmp_path, monkeypatch):
    touch_all(tmp_path / "i", ["a.jpg"])
    cache = tmp_path / "digests.json"
    # whose time of change is that of the test, whatever the time of its content
    fingerprint_images(tmp_path / "i", cache)
    assert not cache.exists()
    monkeypatch.setattr(SETTLED, 0)
    fingerprint_images(tmp_path / "i", cache)
    assert list(json.loads(cache.read_text())["files"]) == ["a.jpg"]


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"version": 1}', '{"version":1,"folder":"x","files":3}']
)
def test_damaged_cache_is_ignored(tmp_path, content):
    touch_all(tmp_path / "i", ["a.jpg"])
    cache = tmp_path / "digests.json"
    cache.write_text(content)
    assert fingerprint_images(tmp_path / "i", cache) == fingerprint_images(tmp_path / "i")


def test_unwritable_cache_is_ignored(tmp_path):
    touch_all(tmp_path / "i", ["a.jpg"])
    (tmp_path / "file").write_text("")
    cache = tmp_path / "file" / "digests.json"
    assert fingerprint_images(tmp_path / "i", cache) == fingerprint_images(tmp_path / "i")


def test_digests_do_not_depend_on_threads(tmp_path):
    names = [f"{k:02}.jpg" for k in range(40)]
    touch_all(tmp_path, names)
    assert digest_images(tmp_path, names, None, 1) == digest_images(tmp_path, names, None, 8)


def test_name_that_is_not_utf8(tmp_path):
    raw = os.fsencode(tmp_path) + b"/\xff.jpg"
    with open(raw, "wb") as file:  # noqa: PTH123 - Path takes no bytes
        file.write(b"x")
    cache = tmp_path / "digests.json"
    assert fingerprint_images(tmp_path, cache) == fingerprint_images(tmp_path, cache)


def test_imports_nothing_heavy():
    program = (
        "import sys, snakesfm.ingest.discover\n"
        "print(*sorted({'numpy', 'PIL', 'cv2', 'h5py', 'pycolmap', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
