"""What a photograph's file tells beside its pixels: how they lie, the camera, its lens and its zoom (EXIF 2.32)."""

import struct
from typing import NamedTuple

MIRRORED = frozenset({2, 4, 5, 7})
"""Orientations in which the picture as recorded and the picture as shown are mirror images of each other."""

BESIDE = 1 | 4
"""Bits of a TIFF's `NewSubfileType` that mark a smaller copy of another picture, or where one is transparent."""

MOST_PICTURES = 10_000
"""Of a file: in a damaged one the chain of pictures may have no end."""

SHORT, LONG, RATIONAL, ASCII = 3, 4, 5, 2
ORIENTATION, KIND, MAKER, MODEL, EXIF_PART = 0x0112, 0x00FE, 0x010F, 0x0110, 0x8769
FOCAL, ZOOM, FOCAL_35, SERIAL, LENS = 0x920A, 0xA404, 0xA405, 0xA431, 0xA434


class Exif(NamedTuple):
    """What a file tells of a photograph; what it does not tell is empty, or `None`.

    Attributes:
        orientation: from 1, as recorded, to 8; see `MIRRORED`.
        camera: maker and model.
        serial: number of the camera.
        lens: name of the lens.
        focal: focal length in mm.
        zoom: ratio of the digital zoom.
        focal_35: focal length in mm of a 35 mm film camera that sees as much.
        pictures: how many pictures a TIFF holds, smaller copies left out.
        turned_at: where in a TIFF its orientation stands.
    """

    orientation: int = 1
    camera: str = ""
    serial: str = ""
    lens: str = ""
    focal: float | None = None
    zoom: float | None = None
    focal_35: float | None = None
    pictures: int = 1
    turned_at: int | None = None


def exif_of(content: bytes) -> Exif:
    """What a JPEG, PNG, WebP or TIFF tells; of other files, and of damaged data, nothing."""
    try:
        start = _start(content)
        return Exif() if start is None else _Reader(content, start).read()
    except (struct.error, IndexError, ValueError):
        return Exif()


def as_recorded(content: bytes) -> bytes:
    """A file that OpenCV reads as the sensor recorded it, if told to: TIFFs it turns nevertheless."""
    found = exif_of(content) if content[:2] in (b"II", b"MM") else Exif()
    if found.turned_at is None or found.orientation == 1:
        return content
    one = (1).to_bytes(2, "little" if content[:2] == b"II" else "big")
    return content[: found.turned_at] + one + content[found.turned_at + 2 :]


def _start(content: bytes) -> int | None:
    """Where the block in the form of a TIFF begins; `None` where there is none."""
    if content[:4] in (b"II*\0", b"MM\0*"):
        return 0
    if content[:2] == b"\xff\xd8":
        return _start_in_jpeg(content)
    if content[:8] == b"\x89PNG\r\n\x1a\n":
        return _start_in_chunks(content, 8, ">", b"eXIf", name_first=False, behind=4)
    if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
        return _start_in_chunks(content, 12, "<", b"EXIF", name_first=True, behind=0)
    return None


def _start_in_jpeg(content: bytes) -> int | None:
    place = 2
    while content[place] == 0xFF:
        marker, length = content[place + 1], int.from_bytes(content[place + 2 : place + 4], "big")
        if marker == 0xE1 and content[place + 4 : place + 10] == b"Exif\0\0":
            return place + 10
        if marker == 0xDA or length < 2:  # the pixels begin
            return None
        place += 2 + length
    return None


def _start_in_chunks(
    content: bytes, place: int, order: str, wanted: bytes, *, name_first: bool, behind: int
) -> int | None:
    """Among chunks of a name, a length and so many bytes, of an even number in a RIFF, and a checksum behind them."""
    while place + 8 <= len(content):
        name, size = content[place : place + 4], content[place + 4 : place + 8]
        name, size = (name, size) if name_first else (size, name)
        (length,) = struct.unpack(f"{order}I", size)
        place += 8
        if name == wanted:
            return place + 6 if content[place : place + 6] == b"Exif\0\0" else place
        place += length + behind + (length % 2 if name_first else 0)
    return None


class _Reader:
    """Reads the directories of a block in the form of a TIFF."""

    def __init__(self, content: bytes, start: int) -> None:
        self.content, self.start = content, start
        self.order = "<" if content[start : start + 2] == b"II" else ">"

    def read(self) -> Exif:
        first = self.number("I", 4)
        entries, following = self.entries(first)
        if EXIF_PART in entries:
            entries = {**self.entries(self.number("I", entries[EXIF_PART] + 8))[0], **entries}
        orientation = self.value(entries, ORIENTATION)
        names = [name for name in (self.text(entries, MAKER), self.text(entries, MODEL)) if name]
        turned = self.start == 0 and ORIENTATION in entries
        return Exif(
            orientation=int(orientation) if orientation is not None and 1 <= orientation <= 8 else 1,
            camera=names[-1] if len(names) > 1 and names[-1].startswith(names[0]) else " ".join(names),
            serial=self.text(entries, SERIAL),
            lens=self.text(entries, LENS),
            focal=self.value(entries, FOCAL) or None,  # 0 is for unknown
            zoom=self.value(entries, ZOOM) or None,
            focal_35=self.value(entries, FOCAL_35) or None,
            pictures=self.pictures(following, entries) if self.start == 0 else 1,
            turned_at=entries[ORIENTATION] + 8 if turned else None,
        )

    def number(self, form: str, place: int) -> int:
        """A number of the block, at a place that counts from its beginning."""
        return struct.unpack_from(self.order + form, self.content, self.start + place)[0]

    def entries(self, place: int) -> tuple[dict[int, int], int]:
        """Where each entry of a directory stands, by its tag, and where the next directory does, or 0."""
        count = self.number("H", place)
        places = [place + 2 + 12 * n for n in range(count)]
        return {self.number("H", one): one for one in places}, self.number("I", place + 2 + 12 * count)

    def value(self, entries: dict[int, int], tag: int) -> float | None:
        """The one number of an entry; `None` where there is none, or of another type."""
        if tag not in entries:
            return None
        place = entries[tag]
        kind = self.number("H", place + 2)
        if kind in (SHORT, LONG):
            return self.number("H" if kind == SHORT else "I", place + 8)
        if kind != RATIONAL:
            return None
        at = self.number("I", place + 8)
        above, below = self.number("I", at), self.number("I", at + 4)
        return above / below if below else None

    def text(self, entries: dict[int, int], tag: int) -> str:
        """The text of an entry; empty where there is none."""
        if tag not in entries or self.number("H", entries[tag] + 2) != ASCII:
            return ""
        length, place = self.number("I", entries[tag] + 4), entries[tag] + 8
        at = self.start + (place if length <= 4 else self.number("I", place))
        text = self.content[at : at + length].partition(b"\0")[0].decode("utf-8", "replace")
        return " ".join(part for part in text.split() if part.isprintable())

    def pictures(self, following: int, entries: dict[int, int]) -> int:
        """How many pictures a TIFF holds, from its first directory on."""
        count, seen = 0, {0}
        while True:
            count += not int(self.value(entries, KIND) or 0) & BESIDE
            if following in seen or len(seen) > MOST_PICTURES:
                return max(1, count)
            seen.add(following)
            entries, following = self.entries(following)
