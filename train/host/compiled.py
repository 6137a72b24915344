"""Where compiled programs are kept between processes: in the user's own cache folder.

They are machine code, which JAX loads by name and runs unchecked. So they never lie in a folder of
results, which may come from somebody else, and never where somebody else could write them.
"""

import os
import stat
from pathlib import Path

VARIABLE = "JAX_COMPILATION_CACHE_DIR"
"""JAX's name for such a folder; whoever has set it is asked for nothing else."""


class CacheError(ValueError):
    """Others can write the folder; the message names it and says what to do."""


def folder() -> Path | None:
    """`$XDG_CACHE_HOME/palm_jax`, or `~/.cache/palm_jax`, made with mode 0700 if it is absent; None
    where none can be made.

    Raises:
      CacheError: it is somebody else's, or was open to others.
    """
    root = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        path = (root if root.is_absolute() else Path.home() / ".cache") / "palm_jax"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(mode=0o700, exist_ok=True)
        found = (path.lstat(), path.stat())  # a link may be another's, too
    except (OSError, RuntimeError):  # no home, or none that can be written
        return None
    what = f"{path}, where compiled programs are kept,"
    for info in found:
        if info.st_uid != os.geteuid():
            raise CacheError(
                f"{what} belongs to another user, whose programs would be run: set XDG_CACHE_HOME "
                f"or {VARIABLE} to a folder of your own"
            )
        if info.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not stat.S_ISLNK(info.st_mode):
            raise CacheError(
                f"{what} can be written by others, whose programs would be run: delete it, it is "
                "made anew"
            )
    return path
