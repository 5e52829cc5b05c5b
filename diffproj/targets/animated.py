"""How many pictures a GIF, a PNG or a WebP holds that may be animated."""

import struct
from contextlib import suppress

PNG, GIF = b"\x89PNG\r\n\x1a\n", (b"GIF87a", b"GIF89a")
"""How files begin."""

EXTENSION, PICTURE = 0x21, 0x2C
"""How the blocks of a GIF begin."""


def frames_of(content: bytes) -> int:
    """How many pictures an animation holds; 1 for other files, and of damaged ones those before the damage."""
    with suppress(struct.error, IndexError):
        if content[:6] in GIF:
            return max(1, _in_gif(content))
        if content[:8] == PNG:
            return max(1, _in_png(content))
        if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
            return max(1, _in_webp(content))
    return 1


def _in_gif(content: bytes) -> int:
    count = 0
    with suppress(IndexError):
        place = 13 + _colours(content[10])
        while content[place] in (EXTENSION, PICTURE):
            if content[place] == PICTURE:
                place += 10 + _colours(content[place + 9]) + 1
                count += 1
            else:
                place += 2
            while content[place]:  # parts of so many bytes; one of none is the last
                place += 1 + content[place]
            place += 1
    return count


def _colours(flags: int) -> int:
    """Bytes of the table of colours of a GIF, or of a picture in it."""
    return 3 << ((flags & 7) + 1) if flags & 0x80 else 0


def _in_png(content: bytes) -> int:
    place = len(PNG)
    while content[place + 4 : place + 8] not in (b"IDAT", b""):
        (length,) = struct.unpack_from(">I", content, place)
        if content[place + 4 : place + 8] == b"acTL":
            return struct.unpack_from(">I", content, place + 8)[0]
        place += 12 + length
    return 1


def _in_webp(content: bytes) -> int:
    place, count = 12, 0
    while place + 8 <= len(content):
        count += content[place : place + 4] == b"ANMF"
        (length,) = struct.unpack_from("<I", content, place + 4)
        place += 8 + length + length % 2
    return count
