"""What COLMAP's files of rigs and frames say (since its version 3.12), in text and in bytes.

A rig is a number of sensors, cameras or IMUs, of which one is the reference, whose frame is the rig's; each other has a
pose from the rig, if it is known. A frame is a moment: where the rig stood, world to rig, and the images taken then.
"""

import struct
from collections.abc import Sequence
from typing import NamedTuple

from diffproj.files.colmap_records import NOTICE, Bytes, number_of

SENSORS = ("CAMERA", "IMU")
"""Kinds of sensors, by their numbers in binary files."""


class SensorRecord(NamedTuple):
    """A sensor of a rig: its kind, its id, and qw qx qy qz tx ty tz from the rig, or `None` where it is not known."""

    kind: str
    id_: str
    pose: list[float] | None


class RigRecord(NamedTuple):
    """A rig: its id, and its sensors, the reference first, with no pose."""

    id_: str
    sensors: list[SensorRecord]


class FrameRecord(NamedTuple):
    """A moment of a rig: qw qx qy qz tx ty tz from the world, and the images `(camera, image)` by their ids."""

    rig: str
    pose: list[float]
    images: list[tuple[str, str]]


def rigs_from_text(text: str) -> list[RigRecord]:
    """The records of `rigs.txt`.

    Raises:
        ValueError: a line is none of a rig.
    """
    records = []
    for line in text.splitlines():
        words = line.split()
        if not words or words[0][0] == "#":
            continue
        sensors = _sensors(words[2:])
        if len(words) < 4 or sensors is None or words[1] != str(len(sensors)):
            raise ValueError(f"want RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID SENSORS[], got {line[:80]!r}")
        records.append(RigRecord(words[0], sensors))
    return records


def _sensors(words: list[str]) -> list[SensorRecord] | None:
    """The sensors of a line, the reference first; `None` where it says none."""
    found, rest = [], words
    while rest:
        kind, id_, rest = rest[0], rest[1:2], rest[2:]
        known, rest = ("0", rest) if not found else ("".join(rest[:1]), rest[1:])
        pose, rest = (rest[:7], rest[7:]) if known == "1" else ([], rest)
        if kind not in SENSORS or not id_ or known not in ("0", "1") or (known == "1" and len(pose) < 7):
            return None
        found.append(SensorRecord(kind, id_[0], [number_of(word) for word in pose] or None))
    return found


def rigs_from_bytes(data: bytes) -> list[RigRecord]:
    """The records of `rigs.bin`.

    Raises:
        ValueError: a sensor of no known kind, or fewer or more bytes than the records have.
    """
    reader, records = Bytes(data), []
    for _ in range(reader.count(8)):
        id_, count = reader.take("<II")
        sensors: list[SensorRecord] = []
        for _ in range(min(count, len(data))):
            kind, sensor = reader.take("<iI")
            pose = list(reader.take("<7d")) if sensors and reader.take("<B")[0] else None
            if not 0 <= kind < len(SENSORS):
                raise ValueError(f"rig {id_}: want sensors that are cameras or IMUs, got the kind {kind}")
            sensors.append(SensorRecord(SENSORS[kind], str(sensor), pose))
        records.append(RigRecord(str(id_), sensors))
    reader.check_end()
    return records


def rigs_to_text(records: Sequence[RigRecord]) -> str:
    """`rigs.txt`."""
    lines = [
        "# Rig calib list with one line of data per calib:",
        NOTICE,
        "#   RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, "
        "[QW, QX, QY, QZ, TX, TY, TZ])",
    ]
    for id_, sensors in records:
        words = [id_, str(len(sensors)), sensors[0].kind, sensors[0].id_]
        for kind, sensor, pose in sensors[1:]:
            words += [kind, sensor, *(["0"] if pose is None else ["1", *map(repr, pose)])]
        lines.append(" ".join(words))
    return "\n".join(lines) + "\n"


def rigs_to_bytes(records: Sequence[RigRecord]) -> bytes:
    """`rigs.bin`."""
    parts = [struct.pack("<Q", len(records))]
    for id_, sensors in records:
        parts.append(struct.pack("<II", int(id_), len(sensors)))
        for place, (kind, sensor, pose) in enumerate(sensors):
            parts.append(struct.pack("<iI", SENSORS.index(kind), int(sensor)))
            if place:
                parts.append(b"\0" if pose is None else struct.pack("<B7d", 1, *pose))
    return b"".join(parts)


def frames_to_text(records: Sequence[FrameRecord]) -> str:
    """`frames.txt`."""
    lines = [
        "# Frame list with one line of data per frame:",
        NOTICE,
        "#   FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, "
        "SENSOR_ID, DATA_ID)",
    ]
    for number, (rig, pose, images) in enumerate(records, 1):
        data = [word for camera, image in images for word in ("CAMERA", camera, image)]
        lines.append(" ".join([str(number), rig, *map(repr, pose), str(len(images)), *data]))
    return "\n".join(lines) + "\n"


def frames_to_bytes(records: Sequence[FrameRecord]) -> bytes:
    """`frames.bin`."""
    parts = [struct.pack("<Q", len(records))]
    for number, (rig, pose, images) in enumerate(records, 1):
        parts.append(struct.pack("<II7dI", number, int(rig), *pose, len(images)))
        parts += [struct.pack("<iIQ", 0, int(camera), int(image)) for camera, image in images]
    return b"".join(parts)
