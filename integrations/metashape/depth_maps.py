"""Makes the depth maps of viewrank's key views in Metashape, and a point cloud of them.

    metashape.sh -r depth_maps.py PROJECT.psx [CHUNK]

Reads clusters.json beside this file. Only key views and their partners are enabled while the maps are made; afterwards each camera is as it
was. Names that no camera has, and labels that several cameras have, end the script before anything is done.
"""

import json
import os
import sys

import Metashape


def main():
    here = os.path.dirname(os.path.abspath(__file__))
    with open(os.path.join(here, "clusters.json"), encoding="utf-8") as file:
        clusters = json.load(file)
    document = Metashape.Document()
    document.open(sys.argv[1])
    chunk = chosen_chunk(document, sys.argv[2] if len(sys.argv) > 2 else None)
    labels = cameras_by_label(chunk)
    enabled = {camera.key for camera in find(labels, clusters["enabled"])}
    keys = [camera.key for camera in find(labels, clusters["keys"])]
    before = {camera.key: camera.enabled for camera in chunk.cameras}
    try:
        for camera in chunk.cameras:
            camera.enabled = camera.key in enabled
        chunk.buildDepthMaps(downscale=int(clusters["downscale"]), filter_mode=Metashape.MildFiltering, cameras=keys, reuse_depth=False, max_neighbors=clusters["max_neighbors"])
        build = getattr(chunk, "buildPointCloud", None) or chunk.buildDenseCloud
        build()
    finally:
        for camera in chunk.cameras:
            camera.enabled = before[camera.key]
    document.save()
    print(f"{len(keys)} depth maps")


def chosen_chunk(document, label):
    chunks = [chunk for chunk in document.chunks if label in (None, chunk.label)]
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


def find(labels, names):
    found, wrong = [], []
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
