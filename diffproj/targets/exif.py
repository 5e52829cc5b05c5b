"""What a photograph's file tells beside its pixels: how they lie, the camera, its lens and its zoom (EXIF 2.32)."""

import struct
from contextlib import suppress
from typing import NamedTuple

from diffproj.targets.animated import frames_of

MIRRORED = frozenset({2, 4, 5, 7})
"""Orientations in which the picture as recorded and the picture as shown are mirror images of each other."""

AS_RECORDED = (None, 1)
"""Orientations in which the picture is shown as recorded: not told, and told."""

BESIDE = 1 | 4
"""Bits of a TIFF's `NewSubfileType` that mark a smaller copy of another picture, or where one is transparent."""

MOST_PICTURES = 10_000
"""Of a file: in a damaged one the chain of pictures may have no end."""

MOST_ENTRIES = 10_000
"""Of a directory: in a damaged file of 64 bits the count may be any."""

TIFF, BIG_TIFF = (b"II*\0", b"MM\0*"), (b"II+\0", b"MM\0+")
"""How files begin whose places are numbers of 32 and of 64 bits."""

DAMAGE = (struct.error, IndexError, ValueError, OverflowError)
"""What a reader raises where a place lies outside of the file, or a number is none."""

SHORT, RATIONAL, ASCII = 3, 5, 2
WHOLE = {1: "B", SHORT: "H", 4: "I", 16: "Q"}
"""Types of whole numbers."""
ORIENTATION, KIND, MAKER, MODEL, EXIF_PART = 0x0112, 0x00FE, 0x010F, 0x0110, 0x8769
FOCAL, ZOOM, FOCAL_35, SERIAL, LENS = 0x920A, 0xA404, 0xA405, 0xA431, 0xA434
SIDES = 0xA002, 0xA003

Told = tuple[tuple[str, str | float], ...]
"""What a file tells of its photograph: a name and a value each."""


class Exif(NamedTuple):
    """What a file tells of a photograph; what it does not tell is empty, or `None`.

    Attributes:
        orientation: from 1, as recorded, to 8; see `MIRRORED`. Readers take a file that does not tell it as recorded.
        camera: maker and model.
        serial: number of the camera.
        lens: name of the lens.
        focal: focal length in mm.
        zoom: ratio of the digital zoom.
        focal_35: focal length in mm of a 35 mm film camera that sees as much.
        pictures: how many pictures a TIFF holds, smaller copies left out, or an animation.
        turned_at: where in a TIFF the entry of its orientation begins.
        size: `(width, height)` in px as the camera wrote it, which programs that crop often leave as it was.
    """

    orientation: int | None = None
    camera: str = ""
    serial: str = ""
    lens: str = ""
    focal: float | None = None
    zoom: float | None = None
    focal_35: float | None = None
    pictures: int = 1
    turned_at: int | None = None
    size: tuple[int, int] | None = None


def exif_of(content: bytes) -> Exif:
    """What a JPEG, PNG, WebP or TIFF tells, and how many pictures it or a GIF holds; of damaged ones what is whole."""
    found = Exif()
    with suppress(*DAMAGE):
        start = _start(content)
        if start is not None:
            found = _Reader(content, start).read()
    return found._replace(pictures=max(found.pictures, frames_of(content)))


def as_recorded(content: bytes) -> bytes:
    """A file that OpenCV reads as the sensor recorded it, if told to: TIFFs it turns nevertheless."""
    found = exif_of(content) if content[:2] in (b"II", b"MM") else Exif()
    if found.turned_at is None or found.orientation in AS_RECORDED:
        return content
    order, count = "<" if content[:2] == b"II" else ">", "Q" if content[:4] in BIG_TIFF else "I"
    one = struct.pack(f"{order}H{count}H", SHORT, 1, 1)  # the whole entry, for writers may have taken another type
    begin = found.turned_at + 2
    return content[:begin] + one + content[begin + len(one) :]


def _start(content: bytes) -> int | None:
    """Where the block in the form of a TIFF begins; `None` where there is none."""
    if content[:4] in TIFF + BIG_TIFF:
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
    """Reads the directories of a block in the form of a TIFF, or of a BigTIFF."""

    def __init__(self, content: bytes, start: int) -> None:
        self.content, self.start = content, start
        self.order = "<" if content[start : start + 2] == b"II" else ">"
        self.big = content[start : start + 4] in BIG_TIFF
        # Of an entry: where its value stands, and how many bytes it has; its directory counts entries in `count`.
        self.at, self.length, self.count, self.place = (12, 20, "Q", "Q") if self.big else (8, 12, "H", "I")

    def read(self) -> Exif:
        entries, following = self.entries(self.number(self.place, 8 if self.big else 4))
        # OpenCV turns a picture by this alone, whatever else of the file is damaged.
        orientation = self.value(entries, ORIENTATION)
        turned = self.start == 0 and ORIENTATION in entries
        if EXIF_PART in entries:
            with suppress(*DAMAGE):
                part = self.number(self.place, entries[EXIF_PART] + self.at)
                entries = {**self.entries(part)[0], **entries}
        width, height = (self.value(entries, side) or 0.0 for side in SIDES)
        names = [name for name in (self.text(entries, MAKER), self.text(entries, MODEL)) if name]
        return Exif(
            orientation=int(orientation) if orientation is not None and 1 <= orientation <= 8 else None,
            camera=names[-1] if len(names) > 1 and names[-1].startswith(names[0]) else " ".join(names),
            serial=self.text(entries, SERIAL),
            lens=self.text(entries, LENS),
            focal=self.value(entries, FOCAL) or None,  # 0 is for unknown
            zoom=self.value(entries, ZOOM) or None,
            focal_35=self.value(entries, FOCAL_35) or None,
            pictures=self.pictures(following, entries) if self.start == 0 else 1,
            turned_at=entries[ORIENTATION] if turned else None,
            size=(int(width), int(height)) if width >= 1 and height >= 1 else None,
        )

    def number(self, form: str, place: int) -> int:
        """A number of the block, at a place that counts from its beginning."""
        return struct.unpack_from(self.order + form, self.content, self.start + place)[0]

    def entries(self, place: int) -> tuple[dict[int, int], int | None]:
        """Where each entry of a directory stands, by its tag, and where the next directory does: 0, or `None`, if none.

        Raises:
            struct.error: the directory does not lie in the file as a whole.
        """
        count = self.number(self.count, place)
        first = place + struct.calcsize(self.order + self.count)
        if count > MOST_ENTRIES:
            raise ValueError(f"want a directory, got one of {count} entries")
        places = [first + self.length * n for n in range(count)]
        entries = {self.number("H", one): one for one in reversed(places)}  # of two alike the first counts
        following = None
        with suppress(*DAMAGE):
            following = self.number(self.place, first + self.length * count)
        return entries, following

    def value(self, entries: dict[int, int], tag: int) -> float | None:
        """The one number of an entry; `None` where there is none, or of another type, or outside of the file."""
        with suppress(*DAMAGE):
            if tag not in entries:
                return None
            place = entries[tag]
            kind = self.number("H", place + 2)
            if kind in WHOLE:
                return self.number(WHOLE[kind], place + self.at)
            if kind != RATIONAL:
                return None
            at = place + self.at if self.big else self.number("I", place + self.at)  # its 8 bytes fit into one of 20
            above, below = self.number("I", at), self.number("I", at + 4)
            return above / below if below else None
        return None

    def text(self, entries: dict[int, int], tag: int) -> str:
        """The text of an entry; empty where there is none, or outside of the file."""
        with suppress(*DAMAGE):
            if tag not in entries or self.number("H", entries[tag] + 2) != ASCII:
                return ""
            length, place = self.number(self.place, entries[tag] + 4), entries[tag] + self.at
            inside = length <= self.length - self.at
            at = self.start + (place if inside else self.number(self.place, place))
            text = self.content[at : at + length].partition(b"\0")[0].decode("utf-8", "replace")
            return " ".join(part for part in text.split() if part.isprintable())
        return ""

    def pictures(self, following: int | None, entries: dict[int, int]) -> int:
        """How many pictures a TIFF holds, from its first directory on; those behind damage do not count."""
        count, seen = 0, {0}
        with suppress(*DAMAGE):
            while True:
                count += not int(self.value(entries, KIND) or 0) & BESIDE
                if following is None or following in seen or len(seen) > MOST_PICTURES:
                    break
                seen.add(following)
                entries, following = self.entries(following)
        return max(1, count)
