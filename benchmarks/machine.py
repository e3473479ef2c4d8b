"""Which machine something was measured on, and with which versions."""

import os
import platform
from collections.abc import Iterable
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


def describe_machine(packages: Iterable[str]) -> str:
    """Kind of processor, cores, memory, and the versions of Python and of packages, in one line."""
    names = Path("/proc/cpuinfo")
    text = names.read_text("utf-8") if names.is_file() else ""
    kinds = [line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name")]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    parts = [f"processor {kinds[0] if kinds else platform.machine()}", f"cores {os.cpu_count()}"]
    parts += [f"memory {memory:.0f} GiB", f"Python {platform.python_version()}"]
    for package in packages:
        try:
            parts.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            parts.append(f"{package} not installed")
    return ", ".join(parts)


def today() -> str:
    """The date, in UTC."""
    return datetime.now(UTC).strftime("%Y-%m-%d")
