"""Write files whole or not at all."""

import errno
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def write_whole(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write a file through a temporary neighbour and a rename, so that no reader and no crash meets half a file.

    The content is on the disk before the rename makes it visible (`fsync`). A new file has the permissions that the
    process's umask leaves it; nothing of the process is changed to find out which these are.

    Args:
        path: the file; an existing one is replaced and keeps its permissions. Of a symbolic link it is the file that
            the link points to.
        content: text (written as UTF-8) or bytes.

    Raises:
        OSError: the folder does not exist or cannot be written, the disk is full, or there is something else than a
            file; an existing file is then as it was. The error names the path.
    """
    write_all_whole({path: content})


def write_all_whole(contents: Mapping[Any, str | bytes]) -> None:
    """Write several files that belong together: all content is on the disk before the first of them becomes visible.

    Args:
        contents: by path, as `write_whole` takes them.

    Raises:
        OSError: as `write_whole`; no file is replaced where one cannot be written.
    """
    ready: list[tuple[Path, Path]] = []
    try:
        for path, content in contents.items():
            real = Path(os.path.realpath(path))
            data = content.encode() if isinstance(content, str) else content
            with _naming(path):
                ready.append((_put_beside(real, data), real))
        for (temporary, real), path in zip(ready, contents, strict=True):
            with _naming(path):
                temporary.replace(real)
    except BaseException:
        for temporary, _ in ready:
            temporary.unlink(missing_ok=True)
        raise


@contextmanager
def _naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Let errors name the path that was asked for, not the temporary one."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), os.fspath(path)) from error


def _put_beside(path: Path, data: bytes) -> Path:
    """The temporary neighbour of a file, with its content and permissions."""
    if path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
    if path.exists() and not path.is_file():
        raise OSError(
            errno.EISDIR if path.is_dir() else errno.EEXIST, "want the place of a file, got a folder or a device"
        )
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    handle = os.open(temporary, flags, 0o666)  # less the umask, which the system takes off by itself
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            temporary.chmod(path.stat().st_mode & 0o777)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return temporary
