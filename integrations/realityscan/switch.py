#!/usr/bin/env python3
"""Puts the side files beside the images: python3 switch.py IMAGES

A side file that is there already is replaced if it holds the two switches and nothing else, as one of an earlier plan does. Any other holds
poses or settings of somebody's: it stays as it is and is named.
"""

import os
import sys

# The folder may be a stranger's: a json.py that he put there is not imported.
sys.path[:] = [path for path in sys.path if os.path.realpath(path) != os.path.dirname(os.path.realpath(__file__))]

import re
import stat
import tempfile
from pathlib import Path

SWITCHES = re.compile(rb'xcr:In(Meshing|Texturing)="[01]"')


def without_switches(side_file):
    return b"".join(SWITCHES.sub(b"", side_file).split())


def shown(path):
    """A path, which may be a stranger's, without what a terminal would obey."""
    return "".join(sign if sign.isprintable() else "?" for sign in str(path))


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
    ours = Path(__file__).resolve().parent / "xmp"
    left = []
    for path in sorted(ours.rglob("*.xmp")):
        target = images / path.relative_to(ours)
        if images.resolve() not in target.resolve().parents:
            sys.exit(f"error: {shown(target)}: a link leads out of {shown(images)}; move it away")
        new = path.read_bytes()
        if target.is_symlink() or target.exists() and not target.is_file() or target.exists() and without_switches(target.read_bytes()) != without_switches(new):
            left.append(target)
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        write(target, new)
    for target in left:
        print(f"{shown(target)}: holds more than the two switches, left as it is: add xcr:InMeshing and xcr:InTexturing by hand", file=sys.stderr)
    return 1 if left else 0


if __name__ == "__main__":
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        sys.exit(__doc__)
    sys.exit(main(Path(sys.argv[1])))
