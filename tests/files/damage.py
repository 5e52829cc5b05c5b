"""Damage to camera files: one kind after the other, drawn at random."""

import random
import re

NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
WORDS = (
    b"nan",
    b".nan",
    b"NaN",
    b"1e300",
    b"1e999",
    b"-1e300",
    b"Infinity",
    b"-0",
    b"true",
    b"null",
    b"[]",
    b"{}",
    b'"640"',
    b"'1'",
    b"abc",
    b"*a",
    b"&a 1",
    b"0x10",
    b"010",
    b"1_000",
    b"12:30",
    b"!!python/object:os.system 1",
    b"99999999999999999999999999",
    b"-5",
    b"0",
    b"0.5",
    b"\xff\xfe",
    b"\x00",
)


def truncated(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def flipped(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def renumbered(data: bytes, rng: random.Random) -> bytes:
    found = list(NUMBER.finditer(data))
    if not found:
        return flipped(data, rng)
    match = rng.choice(found)
    return data[: match.start()] + rng.choice(WORDS) + data[match.end() :]


def quoted(data: bytes, rng: random.Random) -> bytes:
    found = list(NUMBER.finditer(data))
    if not found:
        return flipped(data, rng)
    match = rng.choice(found)
    return data[: match.start()] + b'"' + match[0] + b'"' + data[match.end() :]


def without_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    return b"\n".join(lines[:at] + lines[at + rng.choice((1, 1, 1, 2, 4)) :])


def doubled_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    at, count = rng.randrange(len(lines)), rng.choice((1, 1, 5, 6))
    return b"\n".join(lines[: at + count] + lines[at : at + count] + lines[at + count :])


def swapped_lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def renamed(data: bytes, rng: random.Random) -> bytes:
    found = list(re.finditer(rb"[A-Za-z_]{2,}", data))
    if not found:
        return flipped(data, rng)
    match = rng.choice(found)
    name = rng.choice(
        (match[0][1:], match[0] + b"x", match[0].upper(), match[0].lower(), b"distortion", b"K", b"data", b"")
    )
    return data[: match.start()] + name + data[match.end() :]


def nested(data: bytes, rng: random.Random) -> bytes:
    opening, closing = rng.choice(
        ((b"[", b"]"), (b"{", b"}"), (b"(", b")"), (b"<a>", b"</a>"), (b'{"a":', b"}"), (b"- ", b""), (b"[\n", b"]\n"))
    )
    depth, at = rng.choice((5, 100, 3000, 100_000)), rng.randrange(len(data))
    return data[:at] + opening * depth + closing * rng.choice((0, depth)) + data[at:]


def spliced(data: bytes, rng: random.Random) -> bytes:
    a, b = sorted((rng.randrange(len(data)), rng.randrange(len(data))))
    at = rng.randrange(len(data))
    return data[:at] + data[a:b] + data[at:]


def marked(data: bytes, rng: random.Random) -> bytes:
    return (
        rng.choice((b"\xef\xbb\xbf", b"\xff\xfe", b"\xfe\xff", b"\n\n", b"\x00", b"\x1f\x8b", b"%YAML:1.0\n", b"#!\n"))
        + data
    )


def line_ends(data: bytes, rng: random.Random) -> bytes:
    return data.replace(b"\n", rng.choice((b"\r\n", b"\r", b"\n\n", b" \n", b"\t\n", b"\xc2\x85")))


def utf16(data: bytes, rng: random.Random) -> bytes:
    return data.decode("latin-1").encode(rng.choice(("utf-16", "utf-16-le", "utf-32")))


def noise(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.choice((0, 8, 128))] + rng.randbytes(rng.choice((1, 20, 3000)))


KINDS = (
    truncated,
    flipped,
    renumbered,
    quoted,
    without_line,
    doubled_line,
    swapped_lines,
    renamed,
    nested,
    spliced,
    marked,
    line_ends,
    utf16,
    noise,
)


def damaged(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    """One damaged file, and which damages it has."""
    kinds = [rng.choice(KINDS) for _ in range(rng.choice((1, 1, 1, 2, 3)))]
    for kind in kinds:
        data = kind(data, rng) if data else data
    return "+".join(kind.__name__ for kind in kinds), data
