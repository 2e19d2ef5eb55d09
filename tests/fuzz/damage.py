"""Damaged files, from a seed: bits, cuts, zeros, numbers at their limits, parts moved."""

from __future__ import annotations

import numpy as np

# Numbers at the limits of their types, and texts that parsers treat apart.
_NUMBERS = (
    0,
    1,
    2**7 - 1,
    2**8 - 1,
    2**15 - 1,
    2**16 - 1,
    2**31 - 1,
    2**32 - 1,
    2**63 - 1,
    2**64 - 1,
)
_TEXTS = (
    b"nan", b"inf", b"-1", b"1e999", b"9" * 400, b"\x00", b"\xff\xfe", b'"', b",,", b"\n\n", b"0x1",
    b"NaN", b"null", b"[", b"{", b"<", b"]]>", b"%s", b"\r", b"-0", b"1" + b"0" * 30, b"'",
)  # fmt: skip


def damaged(data, rng):
    """Return the bytes of a file with one to four damages."""
    for _ in range(int(rng.integers(1, 5))):
        data = _KINDS[rng.integers(len(_KINDS))](data, rng)
    return data


def _flip(data, rng):
    if not data:
        return data
    at = int(rng.integers(len(data)))
    return data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :]


def _head(data, rng):
    """Flip a bit in the first bytes, where headers are."""
    n = min(len(data), 256)
    return _flip(data[:n], rng) + data[n:]


def _cut(data, rng):
    return data[: int(rng.integers(len(data) + 1))]


def _zeros(data, rng):
    a, b = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    return data[:a] + bytes(min(b - a, 4096)) + data[min(b, a + 4096) :]


def _number(data, rng):
    at = int(rng.integers(len(data) + 1))
    width = int(rng.choice([1, 2, 4, 8]))
    value = _NUMBERS[rng.integers(len(_NUMBERS))] % 2 ** (8 * width)
    order = "little" if rng.random() < 0.7 else "big"
    return data[:at] + value.to_bytes(width, order) + data[at + width :]


def _aligned(data, rng):
    """Write a number that occurs in the file, or a position in it, at an even place."""
    if len(data) < 16:
        return data
    at = 2 * int(rng.integers(len(data) // 2 - 2))
    source = 2 * int(rng.integers(len(data) // 2 - 2))
    part = data[source : source + 4]
    if rng.random() < 0.4:
        part = int(rng.integers(len(data))).to_bytes(4, "little")
    return data[:at] + part + data[at + 4 :]


def _text(data, rng):
    at = int(rng.integers(len(data) + 1))
    skip = int(rng.integers(0, 8))
    return data[:at] + _TEXTS[rng.integers(len(_TEXTS))] + data[at + skip :]


def _move(data, rng):
    a, b, c = sorted(rng.integers(0, len(data) + 1, 3).tolist())
    return data[:a] + data[b:c] + data[a:b] + data[c:]


def _double(data, rng):
    a, b = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    b = min(b, a + 2048)
    return data[:b] + data[a:b] + data[b:]


def _noise(data, rng):
    a = int(rng.integers(len(data) + 1))
    n = int(rng.integers(1, 64))
    return data[:a] + rng.bytes(n) + data[a + n :]


_KINDS = (
    _flip, _flip, _head, _head, _cut, _zeros, _number, _number, _aligned, _aligned, _text, _text,
    _move, _double, _noise,
)  # fmt: skip


def damaged_files(content, rng):
    """Return the files of a folder of which one is damaged, or lost."""
    names = sorted(content)
    name = names[rng.integers(len(names))]
    if len(names) > 1 and rng.random() < 0.03:
        return {n: data for n, data in content.items() if n != name}
    return content | {name: damaged(content[name], rng)}


def case(content, seed):
    """Return the damaged files of a number."""
    return damaged_files(content, np.random.default_rng(seed))
