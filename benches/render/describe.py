"""Counts of a rendered set from its files, and its README."""

import collections

import numpy as np

from . import colmap_model, depth_file, materials, ply
from .pictures import depth_path
from .scenes import INDOORS

VIEWS = dict(
    statue="`ring_a_*`, `ring_b_*`, `ring_c_*` three rings around the bust at about 1 m, `close_*` from 0.5 to 0.75 m",
    room="`inward_*` from the walls across the room, `ahead_*` along a walk around it, `outward_*` from the middle to the walls, "
    "`close_*` 1 to 1.5 m before a wall",
    grove="`grid_*` nadir flight with gaps at 24 to 29 m and, a quarter of it, at 40 to 44 m, `ring_*` irregular arcs at about 11, 17 and "
    "26 m around two outcrops and (from 90 views on) the hut, `walk_*` from 1.7 m upwards among the trees",
)
VIEWS_OUTDOORS = "`grid_*` nadir flight at 25 m, `dome_a_*` and `dome_b_*` two rings each around two objects, `walk_*` low oblique views"
HARD_OUTDOORS = """Leaves move by centimetres from image to image, and so do their shadows; grass has blades within 1.5 cm above and below the
mesh that sway; the mesh is the truth for the lawn. Water mirrors sky and trees with other ripples in each image: its depth is the surface.
Windows mirror too; plaster has nearly no texture. Exposure varies by 6 %, white balance by 1 %, the sun moves 2 degrees."""
HARD = dict(
    statue="""The bust (material 12, `marble`, in `truth/scene.ply`) is what is worth a depth map; the hall fills most of the pixels: blank
walls, repeated tiles, windows that are too bright, furniture seen with a small baseline.""",
    room="""Walls, ceiling, door and table tops have next to no texture; table tops, the screen and lacquer mirror; the window is too bright;
depths in one picture range from 0.5 to 6 m; many neighbours lie along the line of sight; floor, rug and sofas repeat.""",
)

FOUND_POSES = "incremental mapping, moved to the true camera centres by one similarity; its poses carry the error above"
TRUE_POSES = "triangulation with the true poses"

README = """# {name}: a synthetic scene with exact depth

Rendered by `python3 -m benches.render {name} --scene {scene} --seed {seed} --views {planned} --size {w}x{h}{options}`: ray casting,
procedural textures. No part of it is photographed or taken from elsewhere. Metres, z up.

| | |
|---|---|
| images | {views} of {w} x {h}, undistorted, JPEG quality {quality}: {groups} |
| camera | PINHOLE, f = {focal:g}, principal point in the middle |
| ground sampling distance (median of an image) | {gsd} cm (least, median, largest) |
| static mesh | {vertices} vertices, {faces} triangles |
| pixels: none, static, leaves, water | {classes} |
| sparse model | {registered} of {of} registered, {points} points, {observations} observations |
| mean reprojection error | {mean_reprojection_error_px} px |
| camera centres after alignment | median {centre_median_m} m, largest {centre_max_m} m |
| rotations after alignment | median {rotation_median_deg} degrees, largest {rotation_max_deg} degrees |
| depth against the mesh | median {depth[median]} mm, largest {depth[max]} mm |
| contrast of image pairs through the true depth, by shift in px | {photo} |
| sparse points on static surfaces to the mesh | {distances} cm |

- `images/`: {flights}.
- `sparse/0/`: COLMAP model from SIFT and {poses}.
- `truth/sparse/0/`: the true poses, without points; match the images by name.
- `truth/scene.ply`: the mesh that was rendered; each face has a `material`: {materials}.
- `truth/depth/NAME.npz`: z-depth for the true pose at half resolution. Pixel (i, j) is the corner point (2 i + 1, 2 j + 1) of the image.
- `stats.json`: all figures and checks.

## Depth

Arrays `lo`, `hi`, `mask` and indoors `fine` of uint8. `mask`: 0 none or sky, 1 static, 2 leaves that move (no depth), 3 water.

    zz = hi * 256 + lo                          # uint16
    r  = (zz >> 1) ^ (0 - (zz & 1))             # modulo 65536
    q  = cumsum(cumsum(r, axis=0), axis=1)      # modulo 65536, rows downwards first, then along the row
    depth = q * {step} where mask is 1 or 3
    depth += (fine - {half}) * {fine_step:g}    # where there is `fine`

## Difficulties

{hard}
There is no lens distortion, rolling shutter or motion blur; light is one source, light from all sides with baked occlusion, and one mirror bounce.
"""


def describe(out):
    camera, poses = colmap_model.read_poses(out / "truth/sparse/0")
    pixels, gsd = np.zeros(4), []
    for name in sorted(poses):
        z, mask = depth_file.read(depth_path(out, name[:-4]))
        pixels += np.bincount(mask.ravel(), minlength=4)[:4]
        if (mask == depth_file.STATIC).any():
            gsd.append(float(np.median(z[mask == depth_file.STATIC])) / camera.focal * 100)
    vertices, faces, _ = ply.read(out / "truth/scene.ply")
    return dict(
        views=len(poses), groups=dict(collections.Counter(name.rsplit("_", 1)[0] for name in poses)),
        size=[camera.width, camera.height], focal=camera.focal, static_vertices=len(vertices), static_faces=len(faces),
        class_share=(pixels / pixels.sum()).round(4).tolist(), gsd_cm=np.percentile(gsd, (0, 50, 100)).round(2).tolist(),
    )  # fmt: skip


def write_readme(settings, stats):
    scene, (width, height) = settings.scene, stats["size"]
    names = materials.NAMES if scene in INDOORS else materials.OUTDOOR_NAMES
    options = " --quality %d" % settings.quality + (" --image-mb %g" % settings.image_mb if settings.image_mb else "")
    options += " --known-poses" if settings.known_poses else ""
    check = stats["check"]
    text = README.format(
        **stats["mapping"], name=settings.out.resolve().name, scene=scene, seed=settings.seed, planned=settings.views, w=width, h=height,
        options=options + " --features %d" % settings.features, views=stats["views"], quality=stats["jpeg_quality"],
        groups=", ".join("%d %s" % (n, group) for group, n in stats["groups"].items()), focal=stats["focal"],
        gsd=listed(stats["gsd_cm"]), vertices=stats["static_vertices"], faces=stats["static_faces"],
        classes=listed("%.1f %%" % (100 * share) for share in stats["class_share"]), depth=check["depth_against_mesh_mm"],
        photo=listed("%s: %s" % pair for pair in check["photo"]["correlation_by_shift_px"].items()),
        distances=listed("%s %s" % pair for pair in check["point_distance_static_cm"].items()), flights=VIEWS.get(scene, VIEWS_OUTDOORS),
        materials=listed("%d %s" % pair for pair in enumerate(names)), step=depth_file.STEP, half=depth_file.FINE // 2,
        poses=TRUE_POSES if settings.known_poses else FOUND_POSES, fine_step=depth_file.STEP / depth_file.FINE, hard=HARD.get(scene, HARD_OUTDOORS),
    )  # fmt: skip
    (settings.out / "README.md").write_text(text)


def listed(values):
    return ", ".join(map(str, values))
