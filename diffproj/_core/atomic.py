"""Write files whole or not at all."""

import os
import secrets
from pathlib import Path


def write_whole(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write a file through a temporary neighbour and a rename, so that no reader and no crash meets half a file.

    The content is on the disk before the rename makes it visible (`fsync`). A new file has the permissions that the
    process's umask leaves it; nothing of the process is changed to find out which these are.

    Args:
        path: the file; an existing one is replaced and keeps its permissions. Of a symbolic link it is the file that
            the link points to.
        content: text (written as UTF-8) or bytes.

    Raises:
        OSError: the folder does not exist or cannot be written; an existing file is then as it was.
    """
    path = Path(os.path.realpath(path))
    data = content.encode() if isinstance(content, str) else content
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
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
