"""Text, bytes and values changed at random."""

import json
import math
import random
import string

# What stands in for a good value.
VALUES: tuple = (
    "nan", "inf", "-inf", "-1", "0", "1", "0.5", "-0.0", "1e-30", "1e30", "1e308", "-1e308", "1e400", str(10**20),
    str(-(10**20)), "9" * 5000, "", " ", "x", "None", "true", "False", "[]", "[[", "{}", "--", "-", "--seed", "0x10", "1_000",
    "1,5", "½", "٣", "\u2028", "\U0001f681", "a" * 3000, "/", "/dev/null", "/proc/self/mem", "..", "missing.toml", "2147483648",
    "4294967296", "80000000000", "1 2 3", "\ud800",
)  # fmt: skip


def nasty_value(rng: random.Random):
    """A value for a JSON or TOML entry that has no business there."""
    return rng.choice((
        math.nan, math.inf, -math.inf, -1, 0, 1, 0.5, -1e-9, 1e30, -1e30, 10**30, 2**63, "", "x", "nan", None, True, False,
        [], [1], [[1.0]], {}, {"a": 1}, [math.nan] * 3, 10**9, 1e-9, "a" * 1000,
    ))  # fmt: skip


def changed_text(rng: random.Random, text: str) -> str:
    """A text with a few characters, words or lines changed."""
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(text) + 1)
        kind = rng.randrange(8)
        if kind == 0:
            text = text[:at]
        elif kind == 1:
            text = text[:at] + rng.choice(string.printable + "é–\x00") + text[at + 1 :]
        elif kind == 2:
            text = text[:at] + rng.choice(VALUES).encode("utf-8", "replace").decode() + text[at:]
        elif kind == 3:
            lines = text.splitlines(keepends=True) or [""]
            line = rng.randrange(len(lines))
            lines[line] = lines[line] * rng.choice((0, 2, 50))
            text = "".join(lines)
        elif kind == 4:
            text = text[:at] + "[" * rng.choice((1, 40, 3000)) + text[at:]
        elif kind == 5:
            words = text.split(" ")
            words[rng.randrange(len(words))] = (
                rng.choice(VALUES).encode("utf-8", "replace").decode()
            )
            text = " ".join(words)
        elif kind == 6:
            text = text.replace("\n", rng.choice(("\r", "\r\n", "\n\n", " ")))
        else:
            digits = [i for i, character in enumerate(text) if character.isdigit()]
            if digits:
                at = rng.choice(digits)
                text = (
                    text[:at] + rng.choice(("e", "-", "99999999", ".", "nan", "")) + text[at + 1 :]
                )
    return text


def changed_bytes(rng: random.Random, content: bytes) -> bytes:
    """Bytes with bits flipped, an end cut off, or a piece repeated."""
    data = bytearray(content)
    kind = rng.randrange(4)
    if kind == 0:
        return bytes(data[: rng.randrange(len(data) + 1)])
    if kind == 1:
        at = rng.randrange(len(data))
        data[at:at] = data[at : at + rng.choice((1, 10, 1000))]
    for _ in range(rng.choice((1, 1, 1, 2, 20))):
        # most of what can go wrong in an archive lies at its members' ends
        at = rng.randrange(len(data)) if rng.random() < 0.5 else rng.randrange(min(4096, len(data)))
        data[at] ^= 1 << rng.randrange(8)
    return bytes(data)


def changed_values(rng: random.Random, plain):
    """Nested plain values with one or two of them changed, added or left out."""
    plain = json.loads(json.dumps(plain))
    for _ in range(rng.choice((1, 1, 2))):
        node = plain
        while isinstance(node, dict) and node:
            key = rng.choice(list(node))
            if isinstance(node[key], dict) and rng.random() < 0.9:
                node = node[key]
                continue
            kind = rng.random()
            if kind < 0.8:
                node[key] = nasty_value(rng)
            elif kind < 0.9:
                del node[key]
            else:
                node[rng.choice(("", "x", key + "_", "é"))] = nasty_value(rng)
            break
    return plain
