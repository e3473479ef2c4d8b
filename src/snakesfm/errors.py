"""The errors that a user can cause and fix.

SnakesfmError            anything that ends a job with one clear sentence
├── ConfigError          an option, a key of config.yaml or a path named there
├── ImageError           one image cannot be used (the others go on)
│   └── UnreadableImageError   its file cannot be read, whatever is in it
├── SceneError           a scene as a whole cannot be reconstructed
└── ArtifactError        a file that a stage reads is missing, damaged or of another version
    └── UnreadableArtifactError   the system cannot read it, whatever is in it

Every message is one sentence that names the file or key and says what to do.
"""

import errno

LACK_OF_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
LACK_OF_RIGHTS = (errno.EACCES, errno.EPERM, errno.EROFS)
LASTING = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL)


class SnakesfmError(Exception):
    """An error whose message alone is shown to the user, without a traceback."""


class ConfigError(SnakesfmError):
    """A configuration that cannot be run."""


class ImageError(SnakesfmError):
    """An image that cannot be read or used."""


class UnreadableImageError(ImageError):
    """An image whose file is missing or that the system cannot read, now at least."""


class SceneError(SnakesfmError):
    """A scene that cannot be reconstructed."""


class ArtifactError(SnakesfmError):
    """An artifact that cannot be read."""


class UnreadableArtifactError(ArtifactError):
    """An artifact that the system cannot read, now at least."""


def remedy_of(number: int) -> str:
    """What to do about an error of the system, by its number."""
    if number in LACK_OF_SPACE + LACK_OF_RIGHTS:
        return "free the disk or correct the permission, then run again"
    if number in LASTING:
        return "correct the path or what lies there, then run again"
    return "start the same command again"
