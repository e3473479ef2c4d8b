"""index_images: list the images and assign them to cameras."""

from collections import Counter
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.images import ImageIndex
from snakesfm.blocks import deal_blocks
from snakesfm.errors import ImageError, SceneError, UnreadableImageError
from snakesfm.geometry.camera import cameras_to_columns
from snakesfm.ingest.cameras import ImageCameras, Photograph, assign_cameras, warn_of_own_cameras
from snakesfm.ingest.discover import (
    DIGESTS_NAME,
    digest_images,
    fingerprint,
    list_photographs,
    resolved_name,
)
from snakesfm.ingest.known import match_known_cameras, read_known_cameras
from snakesfm.ingest.read import read_header
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.index_images import IndexImagesOptions

FLICKERS = "{path} could be read at one moment and not at another: start the same command again."
UNREAD = "{path} has an unsupported format: convert it to JPEG."


def run(job: StageJob) -> None:
    """Index the images of a folder and write the ImageIndex.

    Settings: ``images`` (folder), ``cameras`` (known intrinsics, or "") and ``blocks``.

    Raises
    ------
    ConfigError : the folder cannot be listed, or the known intrinsics are wrong.
    SceneError : fewer than two different images can be used, or one could not be read each time.
    """
    options: IndexImagesOptions = job.options
    folder = Path(job.settings["images"])
    known = read_known_cameras(job.settings["cameras"]) if job.settings.get("cameras") else None
    names, unread = list_photographs(folder)
    digests = digest_images(folder, names, job.output.parent / DIGESTS_NAME, job.threads)
    photographs, refused = _read_headers(job, folder, digests)
    refused |= {name: UNREAD.format(path=folder / name) for name in unread}
    _check_scene(folder, names, {digests[p.name] for p in photographs}, refused)
    given, warnings = match_known_cameras(known, photographs) if known else ([None] * len(photographs), [])
    found = assign_cameras(
        photographs,
        given,
        sharing=options.camera_sharing,
        model=options.camera_model,
        default_focal_ratio=options.default_focal_ratio,
        use_exif=options.use_exif_focal,
    )
    warnings += warn_of_own_cameras(photographs, found, options.camera_sharing)
    index = _to_index(photographs, [digests[p.name] for p in photographs], found, refused, warnings, job)
    # jobs are not told the content, for only the controller compares it
    told = {**job.settings, "content": fingerprint(digests)}
    header = replace(job, settings=told).header
    index.write(job.output, replace(header, images=resolved_name(folder)))
    _report(index)


def _read_headers(
    job: StageJob, folder: Path, digests: Mapping[str, str]
) -> tuple[list[Photograph], dict[str, str]]:
    """The usable images, and the others' names with the reason in one sentence.

    An index that lacks an image for a moment's fault would stay, so a file that could be read for its
    digest must be readable still, and one that could not must not be by now.
    """
    names = list(digests)
    progress = job.progress(len(names), "images")

    def read(name: str) -> Photograph | str:
        try:
            name.encode("utf-8")
            header = read_header(folder / name)
        except UnicodeEncodeError:
            return f"The name of {folder / name!a} is not UTF-8: rename the file."
        except UnreadableImageError as error:
            if digests[name]:
                raise SceneError(FLICKERS.format(path=folder / name)) from error
            return str(error)
        except ImageError as error:
            return str(error)
        if not digests[name]:
            raise SceneError(FLICKERS.format(path=folder / name))
        return Photograph(name, header.width, header.height, header.exif)

    photographs, refused = [], {}
    with ThreadPoolExecutor(job.threads) as pool:
        for name, result in zip(names, pool.map(read, names), strict=True):
            progress.step()
            if isinstance(result, str):
                refused[name.encode("utf-8", "backslashreplace").decode()] = result
            else:
                photographs.append(result)
    return photographs, refused


def _check_scene(folder: Path, names: list[str], contents: set[str], refused: dict[str, str]) -> None:
    if len(contents) >= 2:
        return
    _warn(refused.values())
    if not names:
        raise SceneError(
            f"The folder '{folder}' contains no JPEG, PNG, TIFF, WebP or BMP image: add some or choose "
            "another folder."
        )
    usable = "only one usable image (or copies of it)" if contents else "no usable image"
    first = f"; {len(refused)} refused, first: {next(iter(refused.values()))}" if refused else "."
    raise SceneError(f"At least two images are needed, but '{folder}' contains {usable}: add images{first}")


def _to_index(
    photographs: list[Photograph],
    digests: list[str],
    found: ImageCameras,
    refused: dict[str, str],
    warnings: list[str],
    job: StageJob,
) -> ImageIndex:
    first_with: dict[str, int] = {}
    originals = [first_with.setdefault(digest, row) for row, digest in enumerate(digests)]
    models, camera_sizes, params, sources = cameras_to_columns(found.cameras)
    return ImageIndex(
        names=np.array([p.name for p in photographs], dtype=object),
        sizes=np.array([(p.width, p.height) for p in photographs], np.int32),
        sha256=np.array(digests, dtype=object),
        blocks=np.array(deal_blocks([p.name for p in photographs], job.settings["blocks"]), np.int32),
        camera_ids=found.camera_ids,
        orientations=np.array([p.exif.orientation for p in photographs], np.int32),
        focal_exif_px=found.focal_exif_px,
        gps=np.array([p.exif.gps for p in photographs], np.float64),
        duplicate_of=np.array(
            [-1 if original == row else original for row, original in enumerate(originals)], np.int32
        ),
        camera_models=np.array(models, dtype=object),
        camera_sizes=camera_sizes,
        camera_params=params,
        camera_sources=np.array(sources, dtype=object),
        refused_names=np.array(list(refused), dtype=object),
        refused_reasons=np.array(list(refused.values()), dtype=object),
        warnings=np.array(warnings, dtype=object),
    )


def _report(index: ImageIndex) -> None:
    copies = [row for row, original in enumerate(index.duplicate_of) if original >= 0]
    _warn(index.refused_reasons)
    _warn(index.warnings)
    _warn(f"{index.names[row]} is a copy of {index.names[index.duplicate_of[row]]}." for row in copies)
    sources = ", ".join(
        f"{count} {source}" for source, count in sorted(Counter(index.camera_sources).items())
    )
    print(
        f"{len(index.names)} images, {len(index.camera_models)} cameras ({sources}), "
        f"{len(index.refused_names)} refused",
        flush=True,
    )


def _warn(sentences: Iterable[str]) -> None:
    for sentence in sentences:
        print(f"warning: {sentence}", flush=True)
