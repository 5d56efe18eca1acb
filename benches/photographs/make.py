"""Makes a set of photographs, from a clone to undistorted images with their model."""

import json
import shutil

from . import alignment, mapping, model, pictures


def make(out, clone, commit, recipe):
    """Writes out/images, out/sparse/0, out/distorted/sparse/0, out/gps.csv where there is GPS, and out/stats.json."""
    import pycolmap

    work = out / "work"
    photographs = pictures.take(clone, commit, work / "images")
    print("%d photographs" % len(photographs), flush=True)
    mapped = mapping.structure_from_motion(work, photographs, recipe)
    aligned, positions = align(mapped, photographs, clone, commit, recipe)
    kept = {p.name for p in photographs} - set(recipe.dropped)
    distorted, undistorted = model.observed_part(mapped, kept), work / "undistorted"
    write(distorted, out / "distorted/sparse/0")
    shutil.rmtree(undistorted, ignore_errors=True)
    settings = dict(jpeg_quality=recipe.quality, num_threads=mapping.THREADS)
    pycolmap.undistort_images(undistorted, out / "distorted/sparse/0", work / "images", **settings)
    shutil.copytree(undistorted / "images", out / "images", dirs_exist_ok=True)
    final = model.observed_part(pycolmap.Reconstruction(str(undistorted / "sparse")), kept)
    write(final, out / "sparse/0")
    if positions:
        positions.write(out / "gps.csv", kept)
    stats = dict(photographs=len(photographs), alignment=aligned, undistorted=model.figures(final), distorted=model.figures(distorted))
    (out / "stats.json").write_text(json.dumps(stats, indent=1) + "\n")
    if not recipe.distorted:
        shutil.rmtree(out / "distorted")
    shutil.rmtree(work)


def align(mapped, photographs, clone, commit, recipe):
    if recipe.control:
        listed = pictures.git(clone, "show", "%s:%s" % (commit, recipe.control)).decode()
        return alignment.by_control(mapped, photographs, listed, recipe.control_width)
    if recipe.lag is not None:
        return alignment.by_plane(mapped, photographs, recipe.lag)
    return alignment.by_gps(mapped, photographs)


def write(reconstruction, folder):
    folder.mkdir(parents=True, exist_ok=True)
    reconstruction.write_binary(str(folder))
