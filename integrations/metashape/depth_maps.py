"""Makes the depth maps of viewrank's key views in Metashape, and a point cloud of them.

    metashape.sh -r depth_maps.py PROJECT.psx [CHUNK]

Reads clusters.json beside this file. Works on a copy of the chunk, named as it with " (viewrank)" behind: the chunk itself, with depth maps and
clouds that are there already, stays as it is. Only key views and their partners are enabled in the copy. The project is saved when the depth
maps are made, and again with the point cloud. Names that no camera has, and labels that several cameras have, end the script before anything
is done.
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

import json

try:
    import Metashape
except ModuleNotFoundError:
    sys.exit(f"error: {__file__}: there is no Metashape here; run the script in it (metashape -r), or install its Python module")

COPY = " (viewrank)"


def main():
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    path = os.path.join(os.path.dirname(os.path.abspath(__file__)), "clusters.json")
    if os.path.islink(path) or not os.path.isfile(path):
        sys.exit(f"error: {path}: not the list that viewrank wrote; export again")
    with open(path, encoding="utf-8") as file:
        clusters = json.load(file)
    document = Metashape.Document()
    document.open(sys.argv[1])
    chunk = chosen_chunk(document, sys.argv[2] if len(sys.argv) > 2 else None)
    find(chunk, clusters["enabled"])
    copy = chunk.copy()
    copy.label = chunk.label + COPY
    enabled = {camera.key for camera in find(copy, clusters["enabled"])}
    keys = [camera.key for camera in find(copy, clusters["keys"])]
    for camera in copy.cameras:
        camera.enabled = camera.key in enabled
    copy.buildDepthMaps(downscale=int(clusters["downscale"]), filter_mode=Metashape.MildFiltering, cameras=keys, reuse_depth=False, max_neighbors=clusters["max_neighbors"])
    document.save()
    print(f"{len(keys)} depth maps in the chunk {copy.label}")
    build = getattr(copy, "buildPointCloud", None) or copy.buildDenseCloud
    build()
    document.save()


def chosen_chunk(document, label):
    """The chunk of that label, or the only one that is no copy of ours."""
    chunks = [chunk for chunk in document.chunks if (not chunk.label.endswith(COPY) if label is None else chunk.label == label)]
    if len(chunks) != 1:
        sys.exit(f"error: {len(chunks)} chunks fit; name one of {[chunk.label for chunk in document.chunks]}")
    return chunks[0]


def cameras_by_label(chunk):
    """Cameras by label as it is and without extension: which of the two Metashape keeps depends on the import."""
    labels = {}
    for camera in chunk.cameras:
        for label in {camera.label, os.path.splitext(camera.label)[0]}:
            labels.setdefault(label, []).append(camera)
    return labels


def find(chunk, names):
    labels, found, wrong = cameras_by_label(chunk), [], []
    for name in names:
        file = name.split("/")[-1]
        cameras = labels.get(name) or labels.get(file) or labels.get(os.path.splitext(file)[0]) or []
        if len(cameras) == 1:
            found.append(cameras[0])
        else:
            wrong.append(f"{name}: {len(cameras)} cameras")
    if wrong:
        sys.exit("error: labels that are not found or not unique:\n  " + "\n  ".join(wrong))
    return found


if __name__ == "__main__":
    main()
