"""Sparse models of rendered pictures by pycolmap: known intrinsics held fixed, pairs chosen by true overlap.

Either structure from motion, moved to the true poses, or points triangulated with the true poses, which takes far less with many views.
"""

import math
import shutil
import time

import numpy as np

from . import colmap_model, depth_file
from .pictures import depth_path

# Pixels of the depth from one point that overlap is judged by to the next.
STRIDE = 25
PARTNERS = 32
LEAST_OVERLAP = 0.12


def true_points(out, camera, poses):
    """Points that each view sees, in the world."""
    points = {}
    for name, (rotation, centre) in poses.items():
        z, _ = depth_file.read(depth_path(out, name[:-4]))
        z = z[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        rows, columns = np.nonzero(z)
        z = z[rows, columns]
        u, v = 2 * (columns * STRIDE + STRIDE / 2), 2 * (rows * STRIDE + STRIDE / 2)
        local = np.stack([(u - camera.cx) / camera.focal * z, (v - camera.cy) / camera.focal * z, z], 1)
        points[name] = local @ rotation + centre
    return points


def overlaps(points, camera, own_centre, rotations, centres):
    """How well points that one view sees can be matched in each of others: in it, at a small angle, at a like scale."""
    here, there = points - own_centre, points - centres[:, None]
    q = there @ rotations.transpose(0, 2, 1)
    z = np.maximum(q[..., 2], 0.1)
    u, v = camera.focal * q[..., 0] / z + camera.cx, camera.focal * q[..., 1] / z + camera.cy
    near, far = np.linalg.norm(here, axis=1), np.linalg.norm(there, axis=2)
    angle = np.degrees(np.arccos(np.clip((here * there).sum(2) / near / far, -1, 1)))
    inside = (q[..., 2] > 0.1) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
    like = np.exp(-((angle / 30) ** 2)) * np.minimum(near / far, far / near) ** 0.7
    return (inside * like).sum(1) / max(1, len(near))


def overlapping_pairs(out, camera, poses, partners=PARTNERS):
    """Pairs of names worth matching."""
    names, points = sorted(poses), true_points(out, camera, poses)
    rotations, centres = (np.array([poses[name][i] for name in names]) for i in (0, 1))
    score = np.array([overlaps(points[name], camera, centre, rotations, centres) for name, centre in zip(names, centres)])
    both = score + score.T
    np.fill_diagonal(both, 0)
    best = np.argsort(-both, axis=1)[:, :partners]
    pairs = {(min(a, b), max(a, b)) for a, row in enumerate(best) for b in row if both[a, b] > LEAST_OVERLAP}
    return sorted((names[a], names[b]) for a, b in pairs)


def similarity(a, b):
    """Scale s, rotation R and translation t with b = s R a + t in the least squares sense."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    U, S, Vt = np.linalg.svd((b - mean_b).T @ (a - mean_a))
    d = np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))])
    R = U @ d @ Vt
    s = (S * np.diag(d)).sum() / ((a - mean_a) ** 2).sum()
    return s, R, mean_b - s * R @ mean_a


def extract(database, out, camera, settings):
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    reader.camera_params = "%r,%r,%r,%r" % (camera.focal, camera.focal, camera.cx, camera.cy)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, settings.jobs
    options.sift.max_num_features, options.sift.first_octave, options.sift.peak_threshold = settings.features, -1, 0.004
    single = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(database, out / "images", camera_mode=single, reader_options=reader, extraction_options=options)


def match(database, pairs, jobs):
    import pycolmap

    listed = database.with_name("pairs.txt")
    listed.write_text("".join("%s %s\n" % pair for pair in pairs))
    options, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    options.use_gpu, options.num_threads, pairing.match_list_path = False, jobs, listed
    pycolmap.match_image_pairs(database, options, pairing)


def map_incrementally(database, out, jobs):
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.multiple_models, options.max_num_models = jobs, 1, True, 3
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.ba_refine_principal_point = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
    return pycolmap.incremental_mapping(database, out / "images", database.parent, options)


def triangulate(database, out, camera, poses):
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
    posed = [colmap_model.posed(numbers[name], name, *pose) for name, pose in poses.items()]
    colmap_model.write(database.with_name("posed"), camera, posed, [])
    known = pycolmap.Reconstruction(str(database.with_name("posed")))
    return pycolmap.triangulate_points(known, database, out / "images", database.parent)


def align(model, poses):
    """Moves the model to the true camera centres. Returns what remains: metres, degrees."""
    import pycolmap

    images = [image for image in model.images.values() if image.has_pose]
    found = np.array([image.projection_center() for image in images])
    true = np.array([poses[image.name][1] for image in images])
    s, R, t = similarity(found, true)
    model.transform(pycolmap.Sim3d(s, pycolmap.Rotation3d(R), t))
    angles = []
    for image in images:
        turn = image.cam_from_world().rotation.matrix() @ poses[image.name][0].T
        angles.append(math.degrees(math.acos(min(1, max(-1, (np.trace(turn) - 1) / 2)))))
    return np.linalg.norm(true - (s * found @ R.T + t), axis=1), angles


def observed_part(model):
    """Images and points as records, without the pixels that have no point."""
    images, index = [], {}
    for image in sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.image_id):
        pixels, points = [], []
        for k, pixel in enumerate(image.points2D):
            if pixel.has_point3D():
                index[image.image_id, k] = len(pixels)
                pixels.append(pixel.xy)
                points.append(pixel.point3D_id)
        pose = image.cam_from_world()
        pixels, points = np.array(pixels).reshape(-1, 2), np.array(points, np.int64)
        images.append(colmap_model.Image(image.image_id, image.name, pose.rotation.matrix(), pose.translation, pixels, points))
    points = []
    for number, p in sorted(model.points3D.items()):
        track = [(e.image_id, index[e.image_id, e.point2D_idx]) for e in p.track.elements]
        points.append(colmap_model.Point(number, p.xyz, p.color, p.error, track))
    return images, points


def sparse_model(out, settings):
    """Writes OUT/sparse/0; returns figures."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    start, work = time.time(), out / "mapping"
    camera, poses = colmap_model.read_poses(out / "truth/sparse/0")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    extract(work / "database.db", out, camera, settings)
    pairs = overlapping_pairs(out, camera, poses)
    match(work / "database.db", pairs, settings.jobs)
    print("%d pairs matched, %.0f s" % (len(pairs), time.time() - start), flush=True)
    if settings.known_poses:
        model = triangulate(work / "database.db", out, camera, poses)
    else:
        models = map_incrementally(work / "database.db", out, settings.jobs)
        model = max(models.values(), key=lambda m: m.num_reg_images())
    residuals, angles = align(model, poses)
    images, points = observed_part(model)
    colmap_model.write(out / "sparse/0", camera, images, points)
    shutil.rmtree(work)
    error = pycolmap.Reconstruction(str(out / "sparse/0")).compute_mean_reprojection_error()
    return figures(poses, pairs, images, points) | accuracy(error, residuals, angles) | dict(seconds=round(time.time() - start))


def figures(poses, pairs, images, points):
    observations = sum(len(p.track) for p in points)
    return dict(
        registered=len(images), of=len(poses), pairs_matched=len(pairs), points=len(points), observations=observations,
        mean_track=round(observations / len(points), 3), observations_per_image=round(observations / len(images)),
        not_registered=sorted(set(poses) - {image.name for image in images}),
    )  # fmt: skip


def accuracy(error, residuals, angles):
    return dict(
        mean_reprojection_error_px=round(error, 4), centre_rms_m=round(float(np.sqrt((residuals**2).mean())), 5),
        centre_median_m=round(float(np.median(residuals)), 5), centre_max_m=round(float(residuals.max()), 5),
        rotation_median_deg=round(float(np.median(angles)), 4), rotation_max_deg=round(max(angles), 4),
    )  # fmt: skip
