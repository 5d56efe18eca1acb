"""The part of a model that is kept, and figures of it."""

import numpy as np


def observed_part(model, kept):
    """A copy with the kept images, and without 2D points that have no 3D point there."""
    images = {i: image for i, image in model.images.items() if image.has_pose and image.name in kept}
    tracks = {}
    for number, point in model.points3D.items():
        track = [(e.image_id, e.point2D_idx) for e in point.track.elements if e.image_id in images]
        if len(track) >= 2:
            tracks[number] = track
    return copied(model, images, tracks)


def copied(model, images, tracks):
    import pycolmap

    copy, index = pycolmap.Reconstruction(), {}
    for camera in model.cameras.values():
        copy.add_camera_with_trivial_rig(camera)
    for i in sorted(images):
        image, pixels = images[i], []
        for k, pixel in enumerate(image.points2D):
            if pixel.has_point3D() and pixel.point3D_id in tracks:
                index[i, k] = len(pixels)
                pixels.append(pycolmap.Point2D(pixel.xy))
        new = pycolmap.Image(name=image.name, points2D=pixels, camera_id=image.camera_id, image_id=i)
        copy.add_image_with_trivial_frame(new, image.cam_from_world())
    for number in sorted(tracks):
        point, track = model.points3D[number], pycolmap.Track()
        for i, k in tracks[number]:
            track.add_element(i, index[i, k])
        copied_point = pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error, track=track)
        copy.add_point3D_with_id(number, copied_point)
    copy.update_point_3d_errors()
    return copy


def figures(model):
    model.update_point_3d_errors()
    lengths = np.array([p.track.length() for p in model.points3D.values()])
    cameras = [(c.model.name, c.width, c.height, [round(float(x), 6) for x in c.params]) for c in model.cameras.values()]
    return dict(
        images=model.num_reg_images(), cameras=cameras, points=model.num_points3D(), observations=int(lengths.sum()),
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()), mean_track_length=float(lengths.mean()),
        points_in_two_images=int((lengths == 2).sum()), median_depth_m=float(np.mean([median_depth(model, i) for i in model.images.values()])),
    )  # fmt: skip


def median_depth(model, image):
    pose = image.cam_from_world()
    return np.median([(pose * model.points3D[p.point3D_id].xyz)[2] for p in image.points2D if p.has_point3D()])
