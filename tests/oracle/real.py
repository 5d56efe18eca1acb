#!/usr/bin/env python3
"""Real fulfilment (method 8) once more, from the dumped tables and the depth maps alone, and held against viewrank's own table.

    viewrank evaluate PROJECT --depth-maps MAPS --reference REFERENCE --dump-tables TABLES
    python tests/oracle/real.py PROJECT/sparse/0 TABLES MAPS REFERENCE

MAPS and REFERENCE: folders of integrations/sgm. Nothing of viewrank is used but its tables; the model is read by pycolmap. Needs numpy and pycolmap.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import pycolmap


class View:
    def __init__(self, image, camera):
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        self.R, self.t = pose.rotation.matrix(), np.asarray(pose.translation)
        K = camera.calibration_matrix()
        self.focal, self.centre, self.size = np.array([K[0, 0], K[1, 1]]), np.array([K[0, 2], K[1, 2]]), np.array([camera.width, camera.height], float)

    def camera_points(self, xyz):
        return xyz @ self.R.T + self.t

    def pixels(self, xyz):
        c = self.camera_points(xyz)
        return self.focal * c[..., :2] / c[..., 2:] + self.centre

    def jacobian(self, xyz):
        """2 x 3 per point, pixels per scene unit."""
        x, y, z = self.camera_points(xyz).T
        zero = np.zeros_like(z)
        du = np.stack([1 / z, zero, -x / z**2], -1) * self.focal[0]
        dv = np.stack([zero, 1 / z, -y / z**2], -1) * self.focal[1]
        return np.stack([du, dv], 1) @ self.R


class Tables:
    def __init__(self, folder, model):
        load = lambda name: np.load(folder / (name + ".npy"))
        self.settings = json.loads((folder / "settings.json").read_text())
        names = [v["name"] for v in json.loads((folder / "views.json").read_text())]
        reconstruction = pycolmap.Reconstruction(str(model))
        by_name = {image.name: image for image in reconstruction.images.values()}
        self.names, self.views = names, [View(by_name[n], reconstruction.cameras[by_name[n].camera_id]) for n in names]
        self.vertices, self.triangles, self.gsd = load("vertices"), load("triangles"), load("triangle_gsd").astype(float)
        visible = load("visible")
        self.visible = [visible[visible[:, 0] == v, 1] for v in range(len(names))]
        self.keys, offsets, partners = load("real_key"), load("real_partner_offsets"), load("real_partners")
        self.partners = [partners[a:b] for a, b in zip(offsets, offsets[1:], strict=False)]
        rows, values = load("real"), load("real_value")
        self.real = {(int(c), int(t)): float(f) for (c, t), f in zip(rows, values, strict=True)}
        self.accuracy = self.settings["in_force"]["accuracy_over_gsd"]


def front(view, tables, shape):
    """Triangle in front per pixel centre, -1 where none: a loop over triangles, exact inverse depth by interpolation."""
    height, width = shape
    scale = np.array([width, height]) / view.size
    camera = view.camera_points(tables.vertices)
    pixels = (view.focal * camera[:, :2] / camera[:, 2:] + view.centre) * scale
    best, picture = np.zeros(shape), np.full(shape, -1)
    for number, corners in enumerate(tables.triangles):
        z = camera[corners, 2]
        if (z <= 0).any():
            continue
        p = pixels[corners]
        low = np.maximum(np.floor(p.min(0)).astype(int), 0)
        high = np.minimum(np.ceil(p.max(0)).astype(int), [width, height])
        if (high <= low).any():
            continue
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        a, b = p[1] - p[0], p[2] - p[0]
        area = a[0] * b[1] - a[1] * b[0]
        if area == 0:
            continue
        u = ((x - p[0, 0]) * b[1] - (y - p[0, 1]) * b[0]) / area
        v = (a[0] * (y - p[0, 1]) - a[1] * (x - p[0, 0])) / area
        inverse = (1 - u - v) / z[0] + u / z[1] + v / z[2]
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        nearer = (u >= 0) & (v >= 0) & (u + v <= 1) & (inverse > best[part])
        best[part] = np.where(nearer, inverse, best[part])
        picture[part] = np.where(nearer, number, picture[part])
    return picture


def resampled(reference, shape):
    """Reference depth at the centres of a map of another shape; the same where shapes agree."""
    if reference.shape == shape:
        return reference
    rows = (np.arange(shape[0]) + 0.5) * reference.shape[0] / shape[0]
    columns = (np.arange(shape[1]) + 0.5) * reference.shape[1] / shape[1]
    nearest = reference[np.ix_(rows.astype(int), columns.astype(int))]
    inverse = np.divide(1, reference, out=np.full(reference.shape, np.nan), where=reference > 0)
    r, c = rows - 0.5, columns - 0.5
    r0, c0 = np.floor(r).astype(int), np.floor(c).astype(int)
    inside = lambda i, n: (i >= 0) & (i < n)
    total = np.zeros(shape)
    for dr in (0, 1):
        for dc in (0, 1):
            weight = np.outer(np.abs(1 - dr - (r - r0)), np.abs(1 - dc - (c - c0)))
            ok = np.outer(inside(r0 + dr, reference.shape[0]), inside(c0 + dc, reference.shape[1]))
            value = inverse[np.ix_((r0 + dr).clip(0, reference.shape[0] - 1), (c0 + dc).clip(0, reference.shape[1] - 1))]
            total += np.where(weight > 1e-9, weight * np.where(ok, value, np.nan), 0)
    smooth = 1 / total
    return np.where(np.abs(smooth - nearest) <= 0.02 * nearest, smooth, nearest)


def right_pixels(view, depth, reference, picture, tables, elsewhere):
    height, width = depth.shape
    x = ((np.arange(width) + 0.5) * view.size[0] / width - view.centre[0]) / view.focal[0]
    y = ((np.arange(height) + 0.5) * view.size[1] / height - view.centre[1]) / view.focal[1]
    ray = np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
    limit = 3 * np.where(picture >= 0, tables.accuracy * tables.gsd[picture], elsewhere)
    if reference is None:
        return (depth > 0) & (picture >= 0)
    return (depth > 0) & (reference > 0) & (np.abs(depth - resampled(reference, depth.shape)) * ray <= limit)


def factors(cluster, tables):
    """Triangles that the key view sees, and (alpha f_res + (1 - alpha) f_unc) f_cov of the matched partners."""
    key, partners = tables.keys[cluster], tables.partners[cluster]
    seen = tables.visible[key]
    corners = tables.vertices[tables.triangles[seen]]
    centroid = corners.mean(1)
    settings = tables.settings
    scale, alpha = settings["image_scale"], settings["fulfilment"]["alpha"]
    p = tables.views[key].pixels(corners) * scale
    (ax, ay), (bx, by) = (p[:, 1] - p[:, 0]).T, (p[:, 2] - p[:, 0]).T
    projected = 0.5 * np.abs(ax * by - ay * bx)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    resolution = np.minimum(projected / area * tables.gsd[seen] ** 2, 1)
    sees = np.array([np.isin(seen, tables.visible[v]) for v in partners]).reshape(len(partners), len(seen))
    information = np.zeros((len(seen), 3, 3))
    for v, mask in [(key, np.ones(len(seen), bool)), *zip(partners, sees, strict=True)]:
        J = tables.views[v].jacobian(centroid[mask]) * scale / settings["fulfilment"]["sigma_px"]
        information[mask] += np.einsum("nij,nik->njk", J, J)
    smallest = np.linalg.eigvalsh(information)[:, 0]
    with np.errstate(invalid="ignore"):
        uncertainty = np.where(smallest > 0, np.minimum(tables.accuracy * tables.gsd[seen] * np.sqrt(np.maximum(smallest, 0)), 1), 0)
    covered = 1 + sees.sum(0) >= settings["coverage"]["min_cameras"]
    return seen, np.where(covered, alpha * resolution + (1 - alpha) * uncertainty, 0)


def share_of_right(view, seen, picture, right, tables):
    """Share of the right pixels of each triangle's visible part; the pixel of the centroid where it has none."""
    count = len(tables.triangles)
    pixels = np.bincount(picture[picture >= 0], minlength=count)[seen]
    good = np.bincount(picture[(picture >= 0) & right], minlength=count)[seen]
    centroid = view.pixels(tables.vertices[tables.triangles[seen]].mean(1)) * np.array(picture.shape[::-1]) / view.size
    column, row = centroid.astype(int).T
    inside = (centroid >= 0).all(1) & (column < picture.shape[1]) & (row < picture.shape[0])
    at_centroid = np.where(inside, right[np.where(inside, row, 0), np.where(inside, column, 0)], False)
    return np.where(pixels > 0, good / np.maximum(pixels, 1), at_centroid)


def load_map(folder, name):
    path = folder / "depth_maps" / (name + ".npy") if (folder / "depth_maps").is_dir() else folder / (name + ".npy")
    return np.load(path).astype(float)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("model", "tables", "maps"):
        parser.add_argument(name, type=Path)
    parser.add_argument("reference", type=Path, nargs="?")
    args = parser.parse_args()
    tables = Tables(args.tables, args.model)
    elsewhere = tables.settings["target"]["accuracy"]
    ours, theirs, worst = 0.0, 0.0, []
    for cluster, key in enumerate(tables.keys):
        view, name = tables.views[key], tables.names[key]
        depth = load_map(args.maps, name)
        reference = load_map(args.reference, name) if args.reference else None
        picture = front(view, tables, depth.shape)
        right = right_pixels(view, depth, reference, picture, tables, elsewhere)
        seen, f = factors(cluster, tables)
        f = f * share_of_right(view, seen, picture, right, tables)
        found = np.array([tables.real.get((cluster, int(t)), 0.0) for t in seen])
        ours, theirs = ours + f.sum(), theirs + found.sum()
        worst.append((abs(f.sum() - found.sum()) / max(f.sum(), 1), np.abs(f - found).mean(), name))
    difference = abs(ours - theirs) / max(ours, 1e-9)
    print(f"{len(tables.keys)} clusters: sum of f {ours:.3f} here, {theirs:.3f} in the tables, {100 * difference:.3f} % apart")
    largest = max(worst)
    print(f"largest difference of one cluster: {100 * largest[0]:.3f} % ({largest[2]}); mean difference of one f there: {largest[1]:.5f}")
    sys.exit(0 if difference < 0.01 and largest[0] < 0.01 else "more than 1 % apart")


if __name__ == "__main__":
    main()
