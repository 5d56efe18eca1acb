#!/usr/bin/env python3
"""Puts the side files beside the images: python3 -I switch.py IMAGES

xmp.txt lists them. A side file that is there already is replaced if it holds the two switches and nothing else, as one of an earlier plan does.
Any other holds poses or settings of somebody's: it stays as it is and is named.
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

import re
import stat
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
MOST_BYTES_OF_A_RECORD = 16 << 20
# A side file without its white space.
SIDE_FILE = re.compile(
    re.escape(b'<x:xmpmetaxmlns:x="adobe:ns:meta/"><rdf:RDFxmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">')
    + re.escape(b'<rdf:Descriptionxmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"')
    + rb'xcr:InMeshing="[01]"xcr:InTexturing="[01]"'
    + re.escape(b"/></rdf:RDF></x:xmpmeta>")
)


def refuse_strangers():
    """Ends where anything here is neither a file nor a folder: it would be followed, or waited for."""
    for folder, folders, files in os.walk(HERE, onerror=lambda error: sys.exit(f"error: {error.filename}: {error.strerror}")):
        for path in (Path(folder, name) for name in [*folders, *files]):
            mode = path.lstat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                sys.exit(f"error: {path}: not made by viewrank; move it away")


def listed():
    """Names below xmp/ of the side files that viewrank wrote."""
    path = HERE / "xmp.txt"
    if not path.is_file() or path.stat().st_size > MOST_BYTES_OF_A_RECORD:
        sys.exit(f"error: {path}: missing, or not the list that viewrank wrote; export again")
    return [name for name in path.read_text(encoding="utf-8").split("\n") if name]


def holds_only_switches(path):
    """Is it a side file with the two switches and nothing else?"""
    return path.is_file() and path.stat().st_size < 1 << 12 and bool(SIDE_FILE.fullmatch(b"".join(path.read_bytes().split())))


def write(target, content):
    """Writes a new file of a name that nobody has, which takes the place of an older one when it is complete."""
    number, draft = tempfile.mkstemp(dir=target.parent)
    try:
        with os.fdopen(number, "wb") as file:
            file.write(content)
        os.chmod(draft, stat.S_IMODE(os.stat(target).st_mode) if target.exists() else 0o666 & ~umask())
        os.replace(draft, target)
    except BaseException:
        os.unlink(draft)
        raise


def umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def main(images):
    refuse_strangers()
    names, left = listed(), []
    for name in names:
        path, target = HERE / "xmp" / name, images / name
        if HERE / "xmp" not in path.resolve().parents or not holds_only_switches(path):
            sys.exit(f"error: {path}: not the side file that viewrank wrote; export again")
        if images.resolve() not in target.resolve().parents:
            sys.exit(f"error: {target}: a link leads out of {images}; move it away")
    for name in names:
        target = images / name
        if target.is_symlink() or target.exists() and not holds_only_switches(target):
            left.append(target)
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        write(target, (HERE / "xmp" / name).read_bytes())
    for target in left:
        print(f"{target}: holds more than the two switches, left as it is: add xcr:InMeshing and xcr:InTexturing by hand", file=sys.stderr)
    return 1 if left else 0


if __name__ == "__main__":
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        sys.exit(__doc__)
    sys.exit(main(Path(sys.argv[1])))
