"""Changes of a file's bytes as damage, malice and mistakes make them: of its bytes, its text, its JSON, its archive."""

import io
import json
import re
import zipfile
from collections.abc import Callable

import numpy as np

Rng = np.random.Generator
Change = Callable[[Rng, bytes], bytes]

NASTY = (
    None,
    True,
    [],
    {},
    "",
    0,
    -1,
    1e308,
    -1e-308,
    2**63,
    10**40,
    float("nan"),
    float("inf"),
    "nan",
    "-1 um",
    "1e400 nm",
    "../../../etc/passwd",
    "/dev/zero",
    "\x1b[31mred\x07",
    "\u202eright to left",
    "\ud800",
    "a" * 70000,
    "os:system",
    [[[[]]]],
    [1, 2, 3, 4, 5, 6, 7],
    {"a": {"b": 1}},
)
_EXTREMES = (b"\x00\x00\x00\x00", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x80\x00\x00\x00")
_NUMBER = re.compile(rb"-?\d+\.?\d*(e-?\d+)?")
_NUMBERS = (b"0", b"-1", b"1e999", b"nan", b"9" * 5000, b"0x10", b"1e-320", b"99999999999", b"1_0", b"+ 1")
_TEXT = (b"\x1b[2J", b"\x00", b"\xff\xfe", b"\xc3", b"[" * 3000, b"{" * 3000, b'"', b"\\", b"\r", "\u2028".encode())


def _part(rng: Rng, data: bytes) -> tuple[int, int]:
    """Where a random part of it begins and ends."""
    begin = int(rng.integers(len(data) + 1))
    return begin, min(len(data), begin + int(2 ** rng.uniform(0, 1 + np.log2(len(data) + 1))))


def _flip(rng: Rng, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        if changed:
            changed[rng.integers(len(changed))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _flip_ahead(rng: Rng, data: bytes) -> bytes:
    """Flips among the first bytes, where headers are."""
    return _flip(rng, data[:256]) + data[256:]


def _cut(rng: Rng, data: bytes) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def _leave_out(rng: Rng, data: bytes) -> bytes:
    begin, end = _part(rng, data)
    return data[:begin] + data[end:]


def _repeat(rng: Rng, data: bytes) -> bytes:
    begin, end = _part(rng, data)
    return data[:end] + data[begin:]


def _noise(rng: Rng, data: bytes) -> bytes:
    begin, end = _part(rng, data)
    return data[:begin] + rng.bytes(end - begin) + data[end:]


def _extreme(rng: Rng, data: bytes) -> bytes:
    begin = int(rng.integers(len(data) + 1))
    value = _EXTREMES[rng.integers(len(_EXTREMES))]
    return data[:begin] + value + data[begin + 4 :]


def _empty(rng: Rng, data: bytes) -> bytes:
    return b""


def _double(rng: Rng, data: bytes) -> bytes:
    return data + data


def _number(rng: Rng, data: bytes) -> bytes:
    places = list(_NUMBER.finditer(data))
    if not places:
        return _flip(rng, data)
    place = places[rng.integers(len(places))]
    return data[: place.start()] + _NUMBERS[rng.integers(len(_NUMBERS))] + data[place.end() :]


def _text(rng: Rng, data: bytes) -> bytes:
    begin = int(rng.integers(len(data) + 1))
    return data[:begin] + _TEXT[rng.integers(len(_TEXT))] + data[begin:]


def _line(rng: Rng, data: bytes) -> bytes:
    """A line left out, repeated, or exchanged with another."""
    lines = data.splitlines(keepends=True)
    if len(lines) < 2:
        return _leave_out(rng, data)
    a, b = (int(k) for k in rng.integers(len(lines), size=2))
    if rng.random() < 1 / 3:
        del lines[a]
    elif rng.random() < 1 / 2:
        lines.insert(b, lines[a])
    else:
        lines[a], lines[b] = lines[b], lines[a]
    return b"".join(lines)


def _json(rng: Rng, data: bytes) -> bytes:
    """A value of another kind, a key left out or written twice."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return _text(rng, data)
    places = [(value, key) for value in _containers(value) for key in _keys(value)]
    if not places:
        return _text(rng, data)
    inside, key = places[rng.integers(len(places))]
    if rng.random() < 0.2:
        del inside[key]
    elif rng.random() < 0.15 and isinstance(inside, dict):
        mark = "twice-told"
        inside[mark] = inside[key]
        return json.dumps(value).replace(json.dumps(mark), json.dumps(key)).encode()
    else:
        inside[key] = NASTY[rng.integers(len(NASTY))]
    return json.dumps(value).encode()


def _containers(value: object) -> list:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    here = [value] if isinstance(value, dict | list) else []
    return here + [found for part in inner for found in _containers(part)]


def _keys(value: dict | list) -> list:
    return list(value) if isinstance(value, dict) else list(range(len(value)))


def _archive(rng: Rng, data: bytes) -> bytes:
    """A member of a zip archive changed, with checksums that fit again."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # whatever a damaged archive makes of it
        return _flip(rng, data)
    if not parts:
        return _flip(rng, data)
    name = list(parts)[rng.integers(len(parts))]
    how = int(rng.integers(4))
    if how == 0:
        del parts[name]
    elif how == 1:
        parts[name] = _bytes_of_array(rng)
    else:
        parts[name] = BYTES[rng.integers(len(BYTES))](rng, parts[name])
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for each, content in parts.items():
            archive.writestr(zipfile.ZipInfo(each), content)
    return stream.getvalue()


def _bytes_of_array(rng: Rng) -> bytes:
    kinds = ("<f4", "<f8", "<i8", "|u1", "|b1", "<c16", "|S3", "<M8[s]", ">f4")
    shapes = ((), (0,), (1,), (4, 4), (64, 64), (2, 2, 2, 2))
    values = np.array([np.nan, np.inf, -1, 255])[rng.integers(4)]
    stream = io.BytesIO()
    with np.errstate(all="ignore"):
        array = np.full(shapes[rng.integers(len(shapes))], values).astype(kinds[rng.integers(len(kinds))])
    np.save(stream, array)
    return stream.getvalue()


BYTES: tuple[Change, ...] = (_flip, _flip_ahead, _cut, _leave_out, _repeat, _noise, _extreme, _empty, _double)
TEXT: tuple[Change, ...] = (_number, _text, _line, _number, _line)
_TEXTS = (".toml", ".json", ".jsonl", ".csv", ".html", ".dat", ".step", ".ini")


def changed(rng: Rng, name: str, data: bytes) -> tuple[bytes, str]:
    """A changed file, and what was done to it in a word.

    Args:
        rng: chooses what is done.
        name: its name, whose ending says what it is.
        data: its bytes.
    """
    ending = "." + name.lower().rpartition(".")[2]
    ways = list(BYTES)
    if ending in _TEXTS:
        ways += TEXT * 2
    if ending in (".json", ".jsonl"):
        ways += [_json] * 20
    if ending in (".npz", ".3mf"):
        ways += [_archive] * 9
    way = ways[rng.integers(len(ways))]
    with np.errstate(all="ignore"):
        return way(rng, data), way.__name__.strip("_")
