"""The method once more, by another hand: numpy, straight from its formulas, one (cluster, triangle) table at a time.

Reads the dumped tables of a plan and the COLMAP binary model that it was made from, and recomputes fulfilment (method 3), the
candidates (4 and 7.1) and the greedy order (5). Nothing here is fast or shared with the program.
"""
import json
import struct
from pathlib import Path

import numpy as np

STILL_DEG = 0.5
PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8}


# --- the model -----------------------------------------------------------------------------------------------------------------

class Model:
    """A COLMAP binary model; views in the order of their names."""

    def __init__(self, folder):
        folder = Path(folder)
        self.cameras = read_cameras((folder / "cameras.bin").read_bytes())
        images = read_images((folder / "images.bin").read_bytes())
        order = sorted(images, key=lambda image: images[image]["name"].encode())
        self.views = [images[image] for image in order]
        view_of = {image: i for i, image in enumerate(order)}
        self.points, self.tracks = read_points((folder / "points3D.bin").read_bytes(), view_of)

    def in_camera(self, view, x):
        """Points (n x 3, world) in camera coordinates."""
        return x @ self.views[view]["rotation"].T + self.views[view]["translation"]

    def centre(self, view):
        return -self.views[view]["rotation"].T @ self.views[view]["translation"]

    def project(self, view, x):
        """Pixels (n x 2) of points (n x 3, world)."""
        return distort(self.cameras[self.views[view]["camera"]], self.in_camera(view, x))

    def jacobian(self, view, x):
        """d pixel / d world (n x 2 x 3), by complex steps: exact to rounding."""
        rows = []
        for axis in range(3):
            step = np.zeros(3, dtype=complex)
            step[axis] = 1e-30j
            rows.append(self.project(view, x + step).imag / 1e-30)
        return np.stack(rows, axis=-1)


def read_cameras(data):
    cameras, at = {}, 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        camera, model, width, height = struct.unpack_from("<IiQQ", data, at)
        count = PARAMETERS[model]
        params = struct.unpack_from(f"<{count}d", data, at + 24)
        cameras[camera] = {"model": model, "width": width, "height": height, "params": params}
        at += 24 + 8 * count
    return cameras


def read_images(data):
    images, at = {}, 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        image, *pose = struct.unpack_from("<I7d", data, at)
        camera, = struct.unpack_from("<I", data, at + 60)
        end = data.index(b"\0", at + 64)
        count, = struct.unpack_from("<Q", data, end + 1)
        images[image] = {
            "name": data[at + 64:end].decode(),
            "camera": camera,
            "rotation": rotation(pose[:4]),
            "translation": np.array(pose[4:]),
        }
        at = end + 9 + 24 * count
    return images


def read_points(data, view_of):
    points, tracks, at = [], [], 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        points.append(struct.unpack_from("<3d", data, at + 8))
        length, = struct.unpack_from("<Q", data, at + 43)
        track = struct.unpack_from(f"<{2 * length}I", data, at + 51)
        tracks.append(sorted({view_of[image] for image in track[::2] if image in view_of}))
        at += 51 + 8 * length
    return np.array(points).reshape(-1, 3), tracks


def rotation(quaternion):
    w, x, y, z = np.array(quaternion) / np.linalg.norm(quaternion)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


def distort(camera, x_cam):
    u, v = x_cam[:, 0] / x_cam[:, 2], x_cam[:, 1] / x_cam[:, 2]
    p, r2 = camera["params"], u * u + v * v
    if camera["model"] == 0:
        fx, fy, cx, cy, du, dv = p[0], p[0], p[1], p[2], 0, 0
    elif camera["model"] == 1:
        fx, fy, cx, cy, du, dv = *p, 0, 0
    elif camera["model"] in (2, 3):
        fx, fy, cx, cy = p[0], p[0], p[1], p[2]
        radial = p[3] * r2 + (p[4] * r2 * r2 if camera["model"] == 3 else 0)
        du, dv = u * radial, v * radial
    else:
        fx, fy, cx, cy, k1, k2, p1, p2 = p
        radial = k1 * r2 + k2 * r2 * r2
        du = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
        dv = v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
    return np.stack([fx * (u + du) + cx, fy * (v + dv) + cy], axis=-1)


# --- the tables ----------------------------------------------------------------------------------------------------------------

class Tables:
    """What `viewrank plan --dump-tables DIR` wrote."""

    def __init__(self, folder):
        folder = Path(folder)
        for path in folder.glob("*.npy"):
            setattr(self, path.stem, np.load(path))
        self.settings = json.loads((folder / "settings.json").read_text())
        self.views = json.loads((folder / "views.json").read_text())
        self.corners = self.vertices[self.triangles]
        self.centroids = self.corners.mean(axis=1)
        normals = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        self.areas = 0.5 * np.linalg.norm(normals, axis=1)
        self.normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        split = np.searchsorted(self.visible[:, 0], np.arange(len(self.views) + 1))
        self.seen = [self.visible[a:b, 1] for a, b in zip(split, split[1:])]
        self.seen_unary = [self.unary[a:b] for a, b in zip(split, split[1:])]
        self.seen_allowed = [self.allowed[a:b] for a, b in zip(split, split[1:])]

    def partners_of(self, cluster):
        return self.partners[self.partner_offsets[cluster]:self.partner_offsets[cluster + 1]]

    def agreement_of(self, key, partner):
        """Agreement of the pictures of a pair on each triangle that the key view sees; None where they were not compared."""
        rows = [len(seen) for seen in self.seen]
        pairs = np.diff(self.agreement_offsets.astype(np.int64))
        start = int(sum(pairs[v] * rows[v] for v in range(key)))
        partners = self.agreement_partners[self.agreement_offsets[key]:self.agreement_offsets[key + 1]].tolist()
        if partner not in partners:
            return None
        start += partners.index(partner) * rows[key]
        return self.agreement[start:start + rows[key]]

    def candidates_of(self, view):
        return self.candidates[self.candidate_offsets[view]:self.candidate_offsets[view + 1]]

    def fulfilment_of(self, cluster):
        rows = self.fulfilment[:, 0] == cluster
        return dict(zip(self.fulfilment[rows, 1].tolist(), self.fulfilment_value[rows].tolist()))


# --- method 3 ------------------------------------------------------------------------------------------------------------------

def fulfilment(model, tables, key, partners):
    """f of every triangle that the key view sees, in the order of `tables.seen[key]`."""
    settings = tables.settings
    seen = tables.seen[key]
    gsd = tables.triangle_gsd[seen].astype(float)
    sees = np.array([np.isin(seen, tables.seen[p]) for p in partners]).reshape(len(partners), len(seen))
    coverage = 1 + sees.sum(axis=0) >= settings["coverage"]["min_cameras"]
    resolution = np.minimum(pixels_per_area(model, tables, key, seen) * gsd ** 2, 1)
    accuracy = gsd * settings["in_force"]["accuracy_over_gsd"]
    uncertainty = f_unc(model, tables, key, partners, seen, sees, accuracy)
    confidence = f_conf(model, tables, key, partners, seen, sees)
    alpha = settings["fulfilment"]["alpha"]
    return (alpha * resolution + (1 - alpha) * uncertainty) * coverage * confidence


def pixels_per_area(model, tables, view, triangles):
    corners = tables.corners[triangles]
    a, b, c = (model.project(view, corners[:, i]) for i in range(3))
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    return 0.5 * np.abs(ux * vy - uy * vx) * tables.settings["image_scale"] ** 2 / tables.areas[triangles]


def f_unc(model, tables, key, partners, seen, sees, accuracy):
    scale = tables.settings["image_scale"] / tables.settings["fulfilment"]["sigma_px"]
    information = np.zeros((len(seen), 3, 3))
    for view, here in [(key, np.ones(len(seen), bool)), *zip(partners, sees)]:
        jacobian = scale * model.jacobian(view, tables.centroids[seen[here]])
        information[here] += np.einsum("nij,nik->njk", jacobian, jacobian)
    smallest = np.linalg.eigvalsh(information)[:, 0]
    largest = np.linalg.eigvalsh(information)[:, 2]
    singular = smallest <= 1e-12 * largest
    root = np.sqrt(np.where(singular, 1, smallest))
    return np.where(singular, 0, np.minimum(accuracy * root, 1))


def f_conf(model, tables, key, partners, seen, sees):
    """P(at least `min_matches` of the independent matches succeed), by the distribution of their number."""
    settings = tables.settings["confidence"]
    if settings["source"] == "none":
        return np.ones(len(seen))
    chances = np.zeros((len(partners), len(seen)))
    for i, partner in enumerate(partners):
        here = sees[i]
        row = np.searchsorted(tables.seen[partner], seen[here])
        if settings["source"] == "photometric" and (agreement := tables.agreement_of(key, partner)) is not None:
            agreed = agreement[here].astype(float)
            agree, differ = settings["agree"], settings["differ"]
            chances[i, here] = np.where(agreed > 0, differ + (agree - differ) * np.minimum((agreed - 1) / 254 / settings["full_agreement"], 1), 0)
            continue
        mean = 0.5 * (tables.seen_unary[key][here].astype(float) + tables.seen_unary[partner][row])
        allowed = tables.seen_allowed[key][here].astype(float) * tables.seen_allowed[partner][row]
        chances[i, here] = mean * allowed * geometric(model, tables, settings, key, partner, seen[here])
    at_most = np.zeros((len(partners) + 1, len(seen)))
    at_most[0] = 1
    for chance in chances:
        at_most[1:] = at_most[1:] * (1 - chance) + at_most[:-1] * chance
        at_most[0] *= 1 - chance
    return at_most[settings["min_matches"]:].sum(axis=0)


def geometric(model, tables, settings, key, partner, triangles):
    """Method 7.2."""
    cos_key, cos_partner, octaves, angle = constellation(model, tables, key, partner, triangles)
    p = settings["p0"] * np.clip(np.minimum(cos_key, cos_partner), 0, None) ** settings["cosine_power"]
    if settings["scale_octaves"] > 0:
        p *= np.exp(-0.5 * (octaves / settings["scale_octaves"]) ** 2)
    if settings["full_angle"] > 0:
        p *= np.minimum(angle / settings["full_angle"], 1)
    return p


def constellation(model, tables, key, partner, triangles):
    """Cosines of incidence of both views, octaves between their distances, angle between their rays in degrees."""
    to_key = model.centre(key) - tables.centroids[triangles]
    to_partner = model.centre(partner) - tables.centroids[triangles]
    l_key, l_partner = np.linalg.norm(to_key, axis=1), np.linalg.norm(to_partner, axis=1)
    normals = tables.normals[triangles]
    cos_key = np.einsum("ij,ij->i", normals, to_key) / l_key
    cos_partner = np.einsum("ij,ij->i", normals, to_partner) / l_partner
    cosine = np.einsum("ij,ij->i", to_key, to_partner) / (l_key * l_partner)
    return cos_key, cos_partner, np.log2(l_partner / l_key), np.degrees(np.arccos(np.clip(cosine, -1, 1)))


# --- method 4 and 7.1 ----------------------------------------------------------------------------------------------------------

def candidates(model, key, count, gate):
    """The `count` views with the most shared points that `gate` lets pass; ties by name."""
    shared = [[] for _ in model.views]
    for point, track in enumerate(model.tracks):
        if key in track:
            for view in track:
                shared[view].append(point)
    order = sorted((v for v in range(len(model.views)) if v != key and shared[v]), key=lambda v: (-len(shared[v]), v))
    return [v for v in order if gate(model, key, v, model.points[shared[v]])][:count]


def has_baseline(model, key, partner, points):
    """Not where most shared points are seen under a triangulation angle below half a degree."""
    return np.mean(angles(model, key, partner, points) < STILL_DEG) <= 0.5


def angles(model, key, partner, points):
    """Triangulation angles at the points, degrees."""
    a, b = model.centre(key) - points, model.centre(partner) - points
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ij,ij->i", a, b)))


# --- method 5 ------------------------------------------------------------------------------------------------------------------

SINGLE_MAP_CREDIT = 0.5


def weights(model, tables):
    """What each triangle counts: by default the mean of its pixels over the views that see it."""
    triangles, kind = len(tables.triangles), tables.settings["ranking"]["weight"]
    raw = np.ones(triangles) if kind == "count" else tables.areas.copy()
    if kind == "pixels":
        pixels, views = np.zeros(triangles), np.zeros(triangles)
        for view, seen in enumerate(tables.seen):
            pixels[seen] += pixels_per_area(model, tables, view, seen) * tables.areas[seen]
            views[seen] += 1
        raw = pixels / np.maximum(views, 1)
    return raw / raw.sum()


def worth(largest):
    """What the m largest f of a triangle are worth; `largest` ascending."""
    if largest.shape[1] == 1:
        return largest[:, 0]
    return (largest[:, 0] + SINGLE_MAP_CREDIT * largest[:, 1:].mean(axis=1)) / (1 + SINGLE_MAP_CREDIT)


def with_one_more(largest, f):
    return np.sort(np.column_stack([largest, f]), axis=1)[:, 1:]


def greedy(tables, limit):
    """Plain greedy: every gain of every cluster anew in each round. Returns the first `limit` (cluster, gain)."""
    triangles, clusters = len(tables.triangles), len(tables.cluster_key)
    split = np.searchsorted(tables.fulfilment[:, 0], np.arange(clusters + 1))
    of = [(tables.fulfilment[a:b, 1], tables.fulfilment_value[a:b].astype(float)) for a, b in zip(split, split[1:])]
    best = np.zeros((triangles, tables.settings["ranking"]["support"]))
    taken, order = set(), []
    while len(order) < limit:
        gains = [
            -1.0 if c in taken else float((tables.weight[t] * (worth(with_one_more(best[t], f)) - worth(best[t]))).sum())
            for c, (t, f) in enumerate(of)
        ]
        most = int(np.argmax(gains))
        if gains[most] <= 0:
            break
        order.append((most, gains[most]))
        taken.add(most)
        t, f = of[most]
        best[t] = with_one_more(best[t], f)
    return order


def drawn(model, tables, keys, chosen):
    """Part of the photographs of `keys` that the chosen views draw (method 5.10), without sharpness."""
    whole = missed = 0.0
    for view in keys:
        seen = tables.seen[view]
        pixels = pixels_per_area(model, tables, view, seen) * tables.areas[seen]
        left = np.ones(len(seen))
        for other in chosen:
            both = np.isin(seen, tables.seen[other])
            rays = [tables.centroids[seen[both]] - model.centre(of) for of in (view, other)]
            own, its = (of / np.linalg.norm(of, axis=1, keepdims=True) for of in rays)
            angle = np.degrees(np.arccos(np.clip((own * its).sum(axis=1), -1, 1)))
            left[both] *= 1 - 0.7 * np.exp(-angle / 60)
        whole += 1
        missed += (pixels * left).sum() / pixels.sum()
    return 1 - missed / whole
