"""Where numba keeps the kernels that it has compiled. Imports nothing heavy: every command begins with it."""

from __future__ import annotations

import contextlib
import os
import tempfile
from importlib.util import find_spec
from pathlib import Path


def ensure_cache_directory() -> None:
    """Set NUMBA_CACHE_DIR where numba would find no place of its own to write to. Call before numba is imported."""
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    if not (os.access(package_directory(), os.W_OK) or os.access(Path.home(), os.W_OK)):
        os.environ["NUMBA_CACHE_DIR"] = str(own_directory(Path(tempfile.gettempdir())))


def cache_directory() -> Path:
    """Where the kernels are kept: NUMBA_CACHE_DIR, or beside the package's own files."""
    return Path(os.environ.get("NUMBA_CACHE_DIR", package_directory()))


def kept_kernels() -> list[Path]:
    """The index files of numba, one for each kernel; younger than its source where that has not changed since."""
    return list(cache_directory().rglob("*.nbi"))


def confirm_kernels() -> None:
    """Note that all were just loaded: numba goes by what a source holds, and keeps them when only its date is new."""
    for path in kept_kernels():
        with contextlib.suppress(OSError):  # of another user, or gone
            path.touch()


def package_directory() -> Path:
    """Of velod's own files."""
    spec = find_spec("velod")
    return Path(spec.origin).parent if spec is not None and spec.origin else Path()


def own_directory(folder: Path) -> Path:
    """This user's directory within a folder that all may write to.

    Whoever writes there says what is run: one that another user was first to make is not taken.
    """
    directory = folder / f"velod-numba-{os.getuid()}"
    directory.mkdir(mode=0o700, exist_ok=True)
    made = directory.lstat()
    if directory.is_symlink() or made.st_uid != os.getuid() or made.st_mode & 0o022:
        return Path(tempfile.mkdtemp(prefix="velod-numba-", dir=folder))
    return directory
