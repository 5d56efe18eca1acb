#!/usr/bin/env python3
"""Undoes the scale of a scaled scene in a point cloud or mesh: unscale.py IN.ply OUT.ply SCALE divides x, y, z of all vertices by SCALE.

Binary little-endian PLY; everything else in the file stays as it is.
"""

import errno
import os
import sys


class Printable:
    """Standard output or error, without what a terminal would obey: names in messages may be a stranger's, and so may this folder's name in those of Python itself."""

    def __init__(self, stream):
        self.stream = stream

    def write(self, text):
        shown = "".join(sign if sign.isprintable() or sign == "\n" else "?" for sign in text)
        encoding = getattr(self.stream, "encoding", None) or "utf-8"
        self.attempt(lambda: self.stream.write(shown.encode(encoding, "replace").decode(encoding)))

    def flush(self):
        self.attempt(lambda: self.stream.flush())

    def attempt(self, action):
        """What nobody reads any more, or never did, is dropped."""
        try:
            if self.stream:
                action()
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.stream.fileno())


def explain(kind, error, _):
    """One line in place of a trace: files and paths may be a stranger's."""
    what = getattr(error, "strerror", None) or " ".join(f"{kind.__name__}: {error}".split())
    cure = "move the project to a shorter path" if getattr(error, "errno", None) == errno.ENAMETOOLONG else "check the files that it reads, or export again"
    print("interrupted" if kind is KeyboardInterrupt else f"error: {getattr(error, 'filename', None) or __file__}: {what}; {cure}", file=sys.stderr)


if __name__ == "__main__":
    sys.stdout, sys.stderr = Printable(sys.stdout), Printable(sys.stderr)
    sys.excepthook = explain
    # This folder and the current one may be a stranger's: a json.py that he put there is not imported.
    sys.path[:] = [path for path in sys.path if os.path.realpath(path) not in (os.path.dirname(os.path.realpath(__file__)), os.path.realpath(os.curdir))]

import struct
from pathlib import Path

SIZES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
SIZES |= {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}


def main():
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    source, target, scale = sys.argv[1], sys.argv[2], float(sys.argv[3])
    if not os.path.isfile(source):
        sys.exit(f"error: {source}: not a file")
    with open(source, "rb") as file:
        data = bytearray(file.read())
    try:
        end = data.index(b"end_header\n") + len(b"end_header\n")
        at = end
        for name, count, properties in elements(data[:end].decode("ascii", "replace")):
            if count > len(data):
                raise ValueError(f"{count} of {name}")
            if name == "vertex":
                divide(data, at, count, properties, scale)
                break
            at = skip(data, at, count, properties)
    except (ValueError, IndexError, KeyError, struct.error) as error:
        sys.exit(f"error: {source}: not a whole PLY ({error!r})")
    # A new file: what somebody has put in the place of a draft is not written.
    draft = Path(target + ".tmp")
    draft.unlink(missing_ok=True)
    with open(draft, "xb") as file:
        file.write(data)
    os.replace(draft, target)


def elements(header):
    found = []
    for line in header.splitlines():
        words = line.split()
        if words[:1] == ["format"] and words[1] != "binary_little_endian":
            sys.exit(f"error: {words[1]}: only binary little-endian files can be unscaled")
        if words[:1] == ["element"]:
            found.append((words[1], int(words[2]), []))
        if words[:1] == ["property"]:
            found[-1][2].append(words[1:])
    return found


def divide(data, at, count, properties, scale):
    for _ in range(count):
        for kind, *rest in properties:
            if kind == "list":
                at = after_list(data, at, rest)
                continue
            code = "<" + SIZES[kind]
            if rest[0] in ("x", "y", "z"):
                struct.pack_into(code, data, at, struct.unpack_from(code, data, at)[0] / scale)
            at += struct.calcsize(code)


def skip(data, at, count, properties):
    for _ in range(count):
        for kind, *rest in properties:
            at = after_list(data, at, rest) if kind == "list" else at + struct.calcsize("<" + SIZES[kind])
    return at


def after_list(data, at, kinds):
    counter, member = "<" + SIZES[kinds[0]], "<" + SIZES[kinds[1]]
    (length,) = struct.unpack_from(counter, data, at)
    return at + struct.calcsize(counter) + length * struct.calcsize(member)


if __name__ == "__main__":
    main()
