"""Independent photometric confidence, written from method 7.4 with OpenCV's filters: pictures are warped to each triangle's plane and correlated."""

import cv2
import numpy as np
import oracle
import pytest

CENTRES = np.array([[1 / 3, 1 / 3, 1 / 3], [2 / 3, 1 / 6, 1 / 6], [1 / 6, 2 / 3, 1 / 6], [1 / 6, 1 / 6, 2 / 3]])
SCALE = 0.5
GRID = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)), axis=-1).reshape(-1, 2)


@pytest.fixture(scope="module")
def planned(viewrank, fixtures, tmp_path_factory):
    tables, project = tmp_path_factory.mktemp("tables"), tmp_path_factory.mktemp("project")
    for part in ("sparse", "images"):
        (project / part).symlink_to(fixtures / "valley" / part)
    (project / "viewrank.toml").write_text(f'image_scale = {SCALE}\n[confidence]\nsource = "photometric"\n')
    viewrank("plan", project, "--backend", "colmap", "--dump-tables", tables)
    read = oracle.Tables(tables)
    read.backend = "colmap"
    return oracle.Model(fixtures / "valley" / "sparse" / "0"), read, project


def gsd(model, view, points):
    """Scene units per pixel of the model's image: depth over focal length, the smaller singular value of a pinhole's Jacobian inverted."""
    return 1 / np.linalg.svd(model.jacobian(view, points), compute_uv=False)[:, 1]


def patches(model, tables, project, view, triangles, spacing):
    """For each triangle four patches of 49 normalised samples; nan if the picture does not show one."""
    image = cv2.imread(str(project / "images" / tables.views[view]["name"]), cv2.IMREAD_GRAYSCALE)
    full = np.array(image.shape[::-1])
    small = np.floor(full * SCALE / 2 + 0.5).astype(int)
    picture = cv2.resize(image, tuple(int(side) for side in small), interpolation=cv2.INTER_AREA).astype(np.float32)
    pyramid = [picture]
    while min(pyramid[-1].shape) >= 32:
        half = pyramid[-1][: pyramid[-1].shape[0] // 2 * 2, : pyramid[-1].shape[1] // 2 * 2]
        pyramid.append((half[::2, ::2] + half[1::2, ::2] + half[::2, 1::2] + half[1::2, 1::2]) / 4)
    corners = tables.corners[triangles]
    right = corners[:, 1] - corners[:, 0]
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(tables.normals[triangles], right)
    found = np.full((len(triangles), 4, 49), np.nan)
    for c, shares in enumerate(CENTRES):
        centre = np.einsum("nij,i->nj", corners, shares)
        points = centre[:, None] + spacing[:, None, None] * (GRID[None, :, :1] * right[:, None] + GRID[None, :, 1:] * down[:, None])
        apart = spacing / gsd(model, view, centre) * small[0] / full[0]
        level = np.clip(np.round(np.log2(apart)), 0, len(pyramid) - 1).astype(int)
        pixels = model.project(view, points.reshape(-1, 3)).reshape(-1, 49, 2) * (small / full)
        for i, (at, l) in enumerate(zip(pixels, level)):
            x, y = (at / 2**l - 0.5).T.astype(np.float32)
            shape = pyramid[l].shape
            if x.min() < 0 or y.min() < 0 or x.max() > shape[1] - 1 or y.max() > shape[0] - 1:
                continue
            samples = cv2.remap(pyramid[l], x[None], y[None], cv2.INTER_LINEAR)[0].astype(float)
            samples -= samples.mean()
            found[i, c] = samples / np.sqrt((samples**2).sum() + 4 * 49)
    return found


def test_pictures_agree_where_the_oracle_says_so(planned):
    model, tables, project = planned
    triangles = len(tables.triangles)
    logs, views = np.zeros(triangles), np.zeros(triangles)
    for view, seen in enumerate(tables.seen):
        logs[seen] += np.log2(gsd(model, view, tables.centroids[seen]))
        views[seen] += 1
    spacing = 2 * 2 ** (logs / np.maximum(views, 1)) / SCALE
    stacks = {v: patches(model, tables, project, v, tables.seen[v], spacing[tables.seen[v]]) for v in range(0, 6)}
    shown, differences = [], []
    for key in range(0, 6):
        for partner in set(tables.candidates_of(key).tolist()) & set(stacks):
            common, a, b = np.intersect1d(tables.seen[key], tables.seen[partner], return_indices=True)
            products = (stacks[key][a] * stacks[partner][b]).sum(axis=2)
            patches_of_both = (~np.isnan(products)).sum(axis=1)
            expected = np.where(patches_of_both > 0, np.nansum(products, axis=1) / np.maximum(patches_of_both, 1), np.nan)
            agreement = tables.agreement_of(key, partner)
            assert set(np.nonzero(agreement)[0]) <= set(a), "only where both see the triangle"
            found = (agreement[a].astype(float) - 1) / 254
            both = ~np.isnan(expected) & (agreement[a] > 0)
            shown.append(np.isnan(expected) != (agreement[a] > 0))
            differences.append(np.abs(found[both] - np.clip(expected[both], 0, 1)))
    differences = np.concatenate(differences)
    assert len(differences) > 500
    assert np.concatenate(shown).mean() > 0.98, "the same patches are in the pictures"
    assert np.median(differences) < 0.01 and np.quantile(differences, 0.95) < 0.06
