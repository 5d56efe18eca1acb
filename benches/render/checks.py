"""Checks of a set: depth against the mesh, pictures against each other through the depth, and sparse points against the mesh."""

import numpy as np

from . import colmap_model, depth_file, ply
from .mapping import overlapping_pairs
from .pictures import depth_path
from .rays import Rays

# Views agree where their depths differ by less, metres.
AGREE = 0.05
SHIFTS = (-2, -1, 0, 1, 2)
EDGES_CM = (0, 0.5, 1, 2, 3, 5, 10, 20, 50, np.inf)
STATIC, LEAVES = 1, 2


class RenderedSet:
    def __init__(self, out):
        self.out = out
        self.camera, self.poses = colmap_model.read_poses(out / "truth/sparse/0")
        self.names = sorted(self.poses)
        self.directions = self.camera.half_size_directions()
        self.vertices, self.faces, self.materials = ply.read(out / "truth/scene.ply")
        self.contrasts = {}

    def depth(self, name):
        return depth_file.read(depth_path(self.out, name[:-4]))

    def contrast(self, name):
        """Grey values less their blur."""
        from PIL import Image
        from scipy.ndimage import gaussian_filter

        if name not in self.contrasts:
            grey = np.asarray(Image.open(self.out / "images" / name).convert("L"), float)
            self.contrasts[name] = grey - gaussian_filter(grey, 6)
        return self.contrasts[name]


def check(out):
    rendered = RenderedSet(out)
    depth, photographs, points = depth_against_mesh(rendered), photo_consistency(rendered), points_against_mesh(rendered)
    return dict(depth_against_mesh_mm=depth, photo=photographs, **points)


def depth_against_mesh(rendered):
    """Of every eighth view."""
    rays, off = Rays(rendered.vertices, rendered.faces), []
    for name in rendered.names[::8]:
        z, _ = rendered.depth(name)
        rotation, centre = rendered.poses[name]
        found = rays.from_point(centre, (rendered.directions @ rotation).astype(np.float32))["tfar"].reshape(z.shape)
        off.append(np.abs(found - z)[z > 0])
    off = np.concatenate(off) * 1000
    return dict(median=round(float(np.median(off)), 3), max=round(float(off.max()), 3), pixels=len(off))


def photo_consistency(rendered):
    """Correlation of contrasts through the true depth, also where the second image is shifted, in about 25 pairs."""
    pairs = overlapping_pairs(rendered.out, rendered.camera, rendered.poses, 3)
    pairs = pairs[:: max(1, len(pairs) // 24)]
    agree, correlations = zip(*(correlate(rendered, a, b) for a, b in pairs))
    correlations = [c for c in correlations if c is not None]
    by_shift = np.round(np.median(correlations, 0), 3).tolist() if correlations else []
    return dict(pairs=len(pairs), depth_agrees=round(float(np.median(agree)), 4), correlation_by_shift_px=dict(zip(SHIFTS, by_shift)))


def correlate(rendered, a, b):
    """Share of common pixels whose depths agree, and correlations by shift, or None with too little static surface in common."""
    from scipy.ndimage import map_coordinates

    (z, mask), (other_z, _), camera = rendered.depth(a), rendered.depth(b), rendered.camera
    (rotation, centre), (other_rotation, other_centre) = rendered.poses[a], rendered.poses[b]
    world = (rendered.directions * z.reshape(-1, 1)) @ rotation + centre
    q = (world - other_centre) @ other_rotation.T
    ahead = np.maximum(q[:, 2], 0.1)
    u, v = camera.focal * q[:, 0] / ahead + camera.cx, camera.focal * q[:, 1] / ahead + camera.cy
    common = (z.ravel() > 0) & (q[:, 2] > 0.1) & (u > 2) & (u < camera.width - 2) & (v > 2) & (v < camera.height - 2)
    rows, columns = (np.clip((x / 2).astype(int), 0, n - 1) for x, n in zip((v, u), other_z.shape))
    seen = other_z[rows, columns]
    close = np.abs(seen - q[:, 2]) < AGREE
    agree = np.mean(close[common & (seen > 0)])
    used = common & close & (mask.ravel() == STATIC)
    if used.sum() < 400:
        return agree, None
    y, x = (2 * (place.ravel()[used] + 0.5) - 0.5 for place in np.indices(z.shape))
    here, there = map_coordinates(rendered.contrast(a), [y, x], order=1), rendered.contrast(b)
    shifted = [map_coordinates(there, [v[used] - 0.5, u[used] - 0.5 + shift], order=1) for shift in SHIFTS]
    return agree, [np.corrcoef(here, values)[0, 1] for values in shifted]


def points_against_mesh(rendered):
    """Distances of sparse points by what their first observation shows."""
    import pycolmap

    model = pycolmap.Reconstruction(str(rendered.out / "sparse/0"))
    masks, places, classes = {name: rendered.depth(name)[1] for name in rendered.names}, [], []
    for point in model.points3D.values():
        first = point.track.elements[0]
        image = model.images[first.image_id]
        x, y = (image.points2D[first.point2D_idx].xy / 2).astype(int)
        mask = masks[image.name]
        places.append(point.xyz)
        classes.append(mask[min(mask.shape[0] - 1, y), min(mask.shape[1] - 1, x)])
    distances, classes = 100 * mesh_distance(np.array(places), rendered.vertices, rendered.faces), np.array(classes)
    static = distances[classes == STATIC]
    shares = (np.histogram(static, EDGES_CM)[0] / max(1, len(static))).round(4).tolist()
    return dict(
        points_by_class=np.bincount(classes, minlength=4).tolist(),
        point_distance_static_cm=percentiles(static), point_distance_leaves_cm=percentiles(distances[classes == LEAVES]),
        point_distances_static=dict(zip(("%g-%g cm" % edge for edge in zip(EDGES_CM, EDGES_CM[1:])), shares)),
    )  # fmt: skip


def percentiles(values):
    return dict(zip(("p50", "p90", "p99"), np.percentile(values, (50, 90, 99)).round(2).tolist())) if len(values) else {}


def mesh_distance(points, vertices, faces, edge=0.4, nearest=20):
    """Triangles are cut to edges of at most `edge` metres, then those with the nearest centroids are measured."""
    from scipy.spatial import cKDTree

    low, high = points.min(0) - 1, points.max(0) + 1
    triangles = vertices[faces].astype(float)
    triangles = triangles[((triangles.max(1) > low) & (triangles.min(1) < high)).all(1)]
    small = []
    while len(triangles):
        lengths = np.stack([np.linalg.norm(triangles[:, (i + 1) % 3] - triangles[:, i], axis=1) for i in range(3)], 1)
        large = lengths.max(1) > edge
        small.append(triangles[~large])
        triangles = halved(triangles[large], lengths[large].argmax(1))
    triangles = np.concatenate(small)
    _, index = cKDTree(triangles.mean(1)).query(points, nearest)
    return np.min([triangle_distance(points, *np.moveaxis(triangles[index[:, k]], 1, 0)) for k in range(nearest)], axis=0)


def halved(triangles, longest):
    """Each cut at the middle of its longest edge."""
    order = (longest[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(triangles, order[:, :, None], 1), 1, 0)
    middle = (a + b) / 2
    return np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])


def triangle_distance(p, a, b, c):
    """Distances between points and triangles, row by row."""
    dot = lambda x, y: (x * y).sum(1)  # noqa: E731
    ab, ac, ap, bp, cp = b - a, c - a, p - a, p - b, p - c
    d1, d2, d3, d4, d5, d6 = dot(ab, ap), dot(ac, ap), dot(ab, bp), dot(ac, bp), dot(ab, cp), dot(ac, cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    total = va + vb + vc
    total = np.where(np.abs(total) < 1e-20, 1e-20, total)
    v, w = vb / total, vc / total
    inside = (v >= 0) & (w >= 0) & (v + w <= 1)
    from_plane = np.linalg.norm(ap - v[:, None] * ab - w[:, None] * ac, axis=1)
    return np.where(inside, from_plane, np.min([segment_distance(p, s, e) for s, e in ((a, b), (b, c), (c, a))], axis=0))


def segment_distance(p, start, end):
    d = end - start
    t = np.clip(((p - start) * d).sum(1) / np.maximum((d * d).sum(1), 1e-20), 0, 1)
    return np.linalg.norm(p - start - t[:, None] * d, axis=1)
