"""Scale, orientation and place of a model: by GPS, by ground control, or by the ground's plane where GPS heights are poor.

Each returns figures for the set's stats.json; x east, y north, z up, metres.
"""

import os

import numpy as np

# How near the image of a ground control point features have to be that tell its depth, pixels.
NEAR_PX = 60
RANSAC_ERROR_M = 6.0


def similarity(a, b):
    """Scale, rotation, translation of least squares from a to b, in two or three dimensions."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    A, B = a - mean_a, b - mean_b
    U, S, Vt = np.linalg.svd(B.T @ A / len(a))
    D = np.eye(len(S))
    D[-1, -1] = np.sign(np.linalg.det(U @ Vt))
    R = U @ D @ Vt
    s = np.trace(np.diag(S) @ D) / ((A**2).sum() / len(a))
    return s, R, mean_b - s * R @ mean_a


def move(model, s, R, t):
    import pycolmap

    model.transform(pycolmap.Sim3d(s, pycolmap.Rotation3d(R), t))


def rms(values):
    return float(np.sqrt((values**2).mean()))


class Positions:
    """GPS positions of the registered photographs, in a local frame."""

    def __init__(self, model, photographs, of_altitudes):
        import pycolmap

        registered = {image.name for image in model.images.values() if image.has_pose}
        self.photographs = [p for p in photographs if p.name in registered and p.gps]
        self.names = [p.name for p in self.photographs]
        self.gps = np.array([p.gps for p in self.photographs])
        latitude, longitude = (float(np.round(self.gps[:, axis].mean(), 6)) for axis in (0, 1))
        self.origin = [latitude, longitude, float(np.round(of_altitudes(self.gps[:, 2]), 0))]
        self.local = np.asarray(pycolmap.GPSTransform().ellipsoid_to_enu(self.gps, *self.origin))

    def centres(self, model):
        return np.array([model.find_image_with_name(name).projection_center() for name in self.names])

    def residuals(self, model):
        off = self.centres(model) - self.local
        return dict(
            n=len(self.names), origin=self.origin, rms_horizontal=rms(np.hypot(off[:, 0], off[:, 1])), rms_vertical=rms(off[:, 2]),
            median=float(np.median(np.linalg.norm(off, axis=1))), inliers=int((np.linalg.norm(off, axis=1) < RANSAC_ERROR_M).sum()),
        )  # fmt: skip

    def write(self, path, kept):
        rows = ["name,latitude,longitude,altitude,east,north,up"]
        for name, gps, local in zip(self.names, self.gps, self.local):
            if name in kept:
                rows.append("%s,%.8f,%.8f,%.3f,%.3f,%.3f,%.3f" % (name, *gps, *local))
        path.write_text("\n".join(rows) + "\n")


def by_gps(model, photographs):
    """A similarity by RANSAC."""
    import pycolmap

    positions, options = Positions(model, photographs, np.mean), pycolmap.RANSACOptions()
    options.max_error, options.random_seed = RANSAC_ERROR_M, 1
    model.transform(pycolmap.align_reconstruction_to_locations(model, positions.names, positions.local, 3, options))
    return positions.residuals(model), positions


def ground_plane(model):
    """A point and three axes, the last one up, of the plane through nine tenths of the points."""
    points = np.array([p.xyz for p in model.points3D.values()])
    distance = np.linalg.norm(points - np.median(points, 0), axis=1)
    points = points[distance < np.percentile(distance, 90)]
    middle = points.mean(0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    centres = np.mean([image.projection_center() for image in model.images.values() if image.has_pose], 0)
    up = axes[2] * np.sign((centres - middle) @ axes[2])
    return middle, np.stack([axes[0], np.cross(up, axes[0]), up])


def by_plane(model, photographs, lag):
    """Upright by the ground's plane, a similarity in the plane to GPS positions that lag by seconds, the median of the heights."""
    positions = Positions(model, photographs, np.median)
    middle, axes = ground_plane(model)
    local = (positions.centres(model) - middle) @ axes.T
    time = np.array([p.time for p in positions.photographs], float)
    lagging = np.stack([np.interp(time - lag, time, local[:, axis]) for axis in (0, 1)], 1)
    s, turn, t = similarity(lagging, positions.local[:, :2])
    R = np.eye(3)
    R[:2, :2] = turn
    R = R @ axes
    shift = np.array([*t, np.median(positions.local[:, 2] - s * local[:, 2])])
    move(model, s, R, shift - s * R @ middle)
    return dict(positions.residuals(model), lag_s=lag, scale=float(s)), positions


def by_control(model, photographs, listed, width):
    """Ground control points in OpenDroneMap's format; `width` is that of the images that its pixels refer to (None: the originals)."""
    measured = control_measurements(model, {p.name.lower(): p for p in photographs}, listed, width)
    pairs = [(located(model, images), place) for place, images in measured.items()]
    found, true = (list(side) for side in zip(*((f, p) for f, p in pairs if f is not None)))
    count = len(found)
    if count == 2:
        found, true = upright_third(model, found, true)
    if len(found) < 3:
        raise SystemExit("fewer than three ground control points can be used")
    found, true = np.array(found), np.array(true)
    origin = np.round(true[:count].mean(0))
    true = true - origin
    s, R, t = similarity(found, true)
    off = s * found @ R.T + t - true
    move(model, s, R, t)
    return dict(n=count, origin=origin.tolist(), rms_horizontal=rms(np.hypot(off[:, 0], off[:, 1])), rms_vertical=rms(off[:, 2])), None


def control_measurements(model, photographs, listed, width):
    """{place: [(image, pixel)]}."""
    images = {image.name.lower(): image for image in model.images.values() if image.has_pose}
    measured = {}
    for line in listed.strip().splitlines()[1:]:
        if len(line.split()) < 6:
            continue
        *numbers, name = line.split()[:6]
        x, y, z, u, v = map(float, numbers)
        key = os.path.splitext(name)[0].lower() + ".jpg"
        if key in images:
            scale = photographs[key].size[0] / (width or photographs[key].original_width)
            measured.setdefault((x, y, z), []).append((images[key], np.array([u * scale, v * scale])))
    return measured


def located(model, measured):
    """By intersection of rays; of one ray by the depth of the features near it, or None."""
    rays = [(image, ray(model, image, pixel)) for image, pixel in measured]
    if len(rays) == 1:
        return on_ray(model, measured[0][0], measured[0][1], rays[0][1])
    rows = []
    for image, (x, y) in rays:
        P = image.cam_from_world().matrix()
        rows += [x * P[2] - P[0], y * P[2] - P[1]]
    h = np.linalg.svd(np.array(rows))[2][-1]
    return h[:3] / h[3]


def ray(model, image, pixel):
    return np.asarray(model.cameras[image.camera_id].cam_from_img(pixel)).ravel()[:2]


def on_ray(model, image, pixel, direction):
    features = [p for p in image.points2D if p.has_point3D()]
    distances = np.array([np.hypot(*(p.xy - pixel)) for p in features])
    near = np.argsort(distances)[:5]
    if distances[near].max() > NEAR_PX:
        return None
    pose = image.cam_from_world()
    depth = np.median([(pose * model.points3D[features[i].point3D_id].xyz)[2] for i in near])
    return pose.inverse() * np.array([*(direction * depth), depth])


def upright_third(model, found, true):
    """Two points at one height, and a third one above their middle by the ground's plane."""
    up = ground_plane(model)[1][2]
    a, b = found
    b = b - up * ((b - a) @ up)
    height = (true[0][2] + true[1][2]) / 2
    true = [np.array([*place[:2], height]) for place in true]
    lengths = np.linalg.norm(b - a), np.linalg.norm(true[1] - true[0])
    return [a, b, (a + b) / 2 + lengths[0] * up], [*true, (true[0] + true[1]) / 2 + [0, 0, lengths[1]]]
