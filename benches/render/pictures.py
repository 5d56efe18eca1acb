"""Renders the views of a scene: lossless pictures, exact depth, mesh and true poses; then JPEG files."""

import io
import multiprocessing
import time

import numpy as np

from . import colmap_model, depth_file, ply
from .camera import Camera
from .frame import Frame
from .rays import bake_sky
from .scenes import scene as scene_of

# The task of this process, under "now".
TASK = {}


def render(settings):
    """Writes OUT/png and OUT/truth. Views that are there already are kept. Returns figures."""
    kind, out = scene_of(settings.scene), settings.out
    camera = Camera.centred(*settings.size, kind.FOCAL_TO_WIDTH)
    for folder in ("png", "truth/depth"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    scene = kind.build(settings.seed)
    views = kind.plan_views(scene, settings.views, settings.seed)
    rays, reach = (200, scene.layout.reach) if scene.indoors else (40, 6.0)
    bake_sky(scene.surface, scene.leaves.triangles, rays, reach)
    ply.write(out / "truth/scene.ply", scene.surface, "synthetic scene %s, seed %d, metres" % (settings.scene, settings.seed))
    write_poses(out, camera, [(view.name + ".jpg", view.rotation, view.centre) for view in views])
    jobs = [(i, view) for i, view in enumerate(views) if not depth_path(out, view.name).exists()]
    seconds = render_views((scene, camera, out, settings.seed, len(views)), jobs, settings.jobs)
    figures = dict(scene=settings.scene, seed=settings.seed, leaves=len(scene.leaves.triangles))
    if seconds:
        figures["seconds_per_image"] = round(float(np.mean(seconds)), 2)
    return figures


def depth_path(out, name):
    return out / "truth/depth" / (name + ".npz")


def write_poses(out, camera, poses):
    images = [colmap_model.posed(i + 1, *pose) for i, pose in enumerate(poses)]
    colmap_model.write(out / "truth/sparse/0", camera, images, [])


def render_views(task, jobs, processes):
    """Every other view first, so that a broken-off run is of use. Returns seconds per view."""
    seconds = []
    with multiprocessing.get_context("spawn").Pool(processes, take_task, (task,)) as pool:
        for taken in pool.imap_unordered(render_view, jobs[::2] + jobs[1::2]):
            seconds.append(taken)
            if len(seconds) % 10 == 0:
                print("%d of %d views, %.1f s each" % (len(seconds), len(jobs), np.mean(seconds)), flush=True)
    return seconds


def take_task(task):
    TASK["now"] = task


def render_view(job):
    from PIL import Image

    (scene, camera, out, seed, total), (i, view), start = TASK["now"], job, time.time()
    frame = Frame(scene, seed, i, total)
    Image.fromarray(frame.picture(camera, view)).save(out / "png" / (view.name + ".png"), compress_level=1)
    depth_file.write(depth_path(out, view.name), *frame.depth(camera, view), fine=scene.indoors)
    return time.time() - start


def encode(out, quality, most_megabytes):
    """JPEG files, at the highest quality up to `quality` with which all together take at most that. Returns the quality."""
    from PIL import Image

    sources = sorted((out / "png").glob("*.png"))
    (out / "images").mkdir(exist_ok=True)

    def size(path, to):
        Image.open(path).save(to, "JPEG", quality=quality, optimize=True, progressive=True, subsampling=2)
        return len(to.getvalue()) if isinstance(to, io.BytesIO) else to.stat().st_size

    # A sample first: encoding all again and again takes long.
    while most_megabytes and np.mean([size(p, io.BytesIO()) for p in sources[::6]]) * len(sources) > most_megabytes * 0.995e6:
        quality -= 1
    while sum(size(p, out / "images" / (p.stem + ".jpg")) for p in sources) > (most_megabytes or 1e9) * 1e6:
        quality -= 1
    return quality


def keep_rendered(out):
    """Leaves only the views that have been rendered in the true model."""
    camera, poses = colmap_model.read_poses(out / "truth/sparse/0")
    there = sorted(name for name in poses if depth_path(out, name[:-4]).exists())
    write_poses(out, camera, [(name, *poses[name]) for name in there])
