"""A whole model, and its files in the binary layout of COLMAP 3."""

import struct

import numpy as np

from .flight import FOCAL, HEIGHT, WIDTH, Survey, pixels
from .visible import Cloud, observed

MEAN_TRACK = 6.6
NOISE_PX = 0.5
# Metres around the survey where points are.
BEYOND = 25
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
POINT = np.dtype([("id", "<u8"), ("place", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("length", "<u8")])
AT_ONCE = 200_000
PINHOLE = 1


def make(folder, views, points, seed=1):
    """Writes a model with that number of views, and at most that number of points."""
    rng = np.random.default_rng(seed)
    survey = Survey(views, rng)
    half = survey.side / 2 + BEYOND
    gain, surviving = pilot(survey, half, points, rng)
    model = Model(survey, *sampled(survey, half, points, gain, surviving, rng))
    model.move_points(rng)
    model.write(folder)


def pilot(survey, half, points, rng):
    """The gain that gives the wanted track length, and how many of the points that are sampled survive."""
    count = min(60_000, max(8_000, points // 10))
    cloud = Cloud(survey.site.sample(count, half, rng), half, rng)
    found, likely = (np.concatenate(part) for part in zip(*(observed(survey.site, cloud, view, rng) for view in survey.views)))
    draw, kept = rng.random(len(found)), len(cloud.order)

    def lengths(gain):
        tracks = np.bincount(found[draw < gain * likely * cloud.salience[found]], minlength=kept)
        return tracks[tracks >= 2]

    low, high = 0.01, 30.0
    for _ in range(40):
        gain = np.sqrt(low * high)
        tracks = lengths(gain)
        if (tracks.mean() if len(tracks) else 0) < MEAN_TRACK:
            low = gain
        else:
            high = gain
    return gain, len(lengths(gain)) / kept * (kept / count)


def sampled(survey, half, wanted, gain, surviving, rng):
    """Places, colours, and of each observation its view (ascending) and its point."""
    count = int(wanted / max(0.02, surviving) * 1.02) + 100
    points = survey.site.sample(count, half, rng)
    cloud = Cloud(points, half, rng)
    del points
    views, seen = [], []
    for k, view in enumerate(survey.views):
        found, _ = observed(survey.site, cloud, view, rng, gain)
        views.append(np.full(len(found), k, np.int32))
        seen.append(found.astype(np.int32))
    views, seen = np.concatenate(views), np.concatenate(seen)
    tracks = np.bincount(seen, minlength=len(cloud.order))
    good = np.nonzero(tracks >= 2)[0]
    if len(good) > wanted:
        good = np.sort(rng.choice(good, wanted, replace=False))
    # In random order, as structure from motion leaves them.
    new = np.full(len(cloud.order), -1, np.int32)
    new[good] = rng.permutation(len(good)).astype(np.int32)
    kept, old = new[seen] >= 0, np.empty(len(good), np.int64)
    old[new[good]] = good
    return cloud.points.places[old], cloud.points.colours[old], views[kept], new[seen[kept]]


class Model:
    def __init__(self, survey, places, colours, views, seen):
        self.views, self.places, self.colours = survey.views, places, colours
        self.of_view, self.seen = views, seen
        self.start = np.searchsorted(views, np.arange(len(self.views) + 1))
        self.pixels = np.empty((len(seen), 2))
        self.errors = np.zeros(len(places))
        self.lengths = np.bincount(seen, minlength=len(places))

    def by_view(self):
        for k, view in enumerate(self.views):
            yield view, slice(self.start[k], self.start[k + 1])

    def move_points(self, rng):
        """Noise, then one Gauss-Newton step of each point onto its noisy observations."""
        A, b = np.zeros((len(self.places), 6)), np.zeros((len(self.places), 3))
        for view, part in self.by_view():
            seen, local = self.seen[part], view.local(self.places[self.seen[part]])
            z, noise = local[:, 2:], rng.normal(0, NOISE_PX, (len(local), 2))
            self.pixels[part] = FOCAL * local[:, :2] / z + (WIDTH / 2, HEIGHT / 2) + noise
            J = FOCAL / z[:, :, None] * (view.rotation[None, :2] - (local[:, :2] / z)[:, :, None] * view.rotation[None, 2:3])
            # A point occurs once in a view, so that plain += adds up.
            A[seen] += np.stack([(J[:, :, i] * J[:, :, j]).sum(1) for i, j in UPPER], 1)
            b[seen] += (J * noise[:, :, None]).sum(1)
        self.places = self.places + solved(A, b)
        for view, part in self.by_view():
            off = pixels(view.local(self.places[self.seen[part]])) - self.pixels[part]
            self.errors[self.seen[part]] += np.linalg.norm(off, axis=1)
        self.errors /= self.lengths

    def write(self, folder):
        """points3D.bin comes last, and whole."""
        folder.mkdir(parents=True, exist_ok=True)
        camera = struct.pack("<QiiQQ4d", 1, 1, PINHOLE, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
        (folder / "cameras.bin").write_bytes(camera)
        with open(folder / "images.bin", "wb") as out:
            out.write(struct.pack("<Q", len(self.views)))
            for k, (view, part) in enumerate(self.by_view()):
                out.write(self.image(k + 1, view, part))
        with open(folder / "points3D.part", "wb") as out:
            out.write(struct.pack("<Q", len(self.places)))
            for records in self.points():
                out.write(records)
        (folder / "points3D.part").rename(folder / "points3D.bin")

    def image(self, number, view, part):
        observations = np.empty(part.stop - part.start, OBSERVATION)
        observations["pixel"], observations["point"] = self.pixels[part], self.seen[part] + 1
        translation = -view.rotation @ view.centre
        head = struct.pack("<i7di", number, *quaternion(view.rotation), *translation, 1) + view.name.encode() + b"\0"
        return head + struct.pack("<Q", len(observations)) + observations.tobytes()

    def points(self):
        """Records with their tracks, some at a time."""
        order = np.argsort(self.seen, kind="stable")
        track = np.empty((len(order), 2), "<i4")
        track[:, 0] = self.of_view[order] + 1
        track[:, 1] = (np.arange(len(order)) - self.start[self.of_view])[order]
        first = np.concatenate([[0], np.cumsum(self.lengths)])
        for a in range(0, len(self.places), AT_ONCE):
            b = min(len(self.places), a + AT_ONCE)
            heads, lengths = np.empty(b - a, POINT), self.lengths[a:b]
            heads["id"], heads["place"], heads["colour"] = np.arange(a, b) + 1, self.places[a:b], self.colours[a:b]
            heads["error"], heads["length"] = self.errors[a:b], lengths
            sizes = POINT.itemsize + 8 * lengths
            records = np.empty(int(sizes.sum()), np.uint8)
            at_head = (np.cumsum(sizes) - sizes)[:, None] + np.arange(POINT.itemsize)
            at_track = np.ones(len(records), bool)
            at_track[at_head] = False
            records[at_head] = heads.view(np.uint8).reshape(-1, POINT.itemsize)
            records[at_track] = track[first[a] : first[b]].reshape(-1).view(np.uint8)
            yield records.tobytes()


def solved(A, b):
    """Steps from the upper halves of the normal equations, damped a little."""
    M = np.empty((len(A), 3, 3))
    for (i, j), values in zip(UPPER, A.T):
        M[:, i, j] = M[:, j, i] = values
    M[:, [0, 1, 2], [0, 1, 2]] += 1e-4 * np.trace(M, axis1=1, axis2=2)[:, None]
    return np.linalg.solve(M, b[:, :, None])[:, :, 0]


def quaternion(R):
    """w, x, y, z of a rotation matrix, from its largest component."""
    xx, yy, zz = R[0, 0], R[1, 1], R[2, 2]
    t = np.array([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz])
    k = int(t.argmax())
    s = np.sqrt(t[k]) * 2
    wx, wy, wz = (R[2, 1] - R[1, 2]) / s, (R[0, 2] - R[2, 0]) / s, (R[1, 0] - R[0, 1]) / s
    xy, xz, yz = (R[0, 1] + R[1, 0]) / s, (R[0, 2] + R[2, 0]) / s, (R[1, 2] + R[2, 1]) / s
    return np.array([(s / 4, wx, wy, wz), (wx, s / 4, xy, xz), (wy, xy, s / 4, yz), (wz, xz, yz, s / 4)][k])
