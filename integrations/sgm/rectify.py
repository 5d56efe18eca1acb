"""Brings a pair of views onto one canvas on which rows match rows and the dominant plane of the sparse points does not move.

Plane plus parallax: the partner, carried to the key view through the plane, agrees with it wherever the scene is that plane. What
is off the plane moves along the line through the key view's epipole. So the canvas is polar around the epipole: a row is an epipolar line, a
column a distance from the epipole, in pixels of the key view. That holds wherever the epipole lies, inside the key view too, and slanted
ground is as easy as level ground: only the relief is left to search.

With p a key pixel, w its inverse z-depth and w0(p) = plane . p that of the plane, the partner shows it at H q with
    q = (p + a e) / (1 + a e_z),   a = bend (w - w0),   e the homogeneous epipole,   so   |p - E| / |q - E| = 1 + a e_z,   E = e_xy / e_z.
"""

from dataclasses import dataclass

import cv2
import numpy as np

MIN_SHARED = 8  # sparse points without which neither the plane nor the search range is known
MIN_OVERLAP = 0.03  # share of the key view that the partner must show
MAX_DISPARITIES = 0.4  # searched, as a share of the image's longer side
MIN_HELD = 0.7  # share of the sparse points that the searched disparities must hold
RANGE_MARGIN = 0.1  # added to both ends of the search range, share of it
RANGE_PIXELS = 5  # and in pixels
FAR = 1e6  # an epipole farther away is put here; the error is below 0.001 px per pixel of disparity
SEAM = 24  # rows by which a full turn around the epipole overlaps itself


class Refused(Exception):
    """This pair is not matched; the text is the reason."""


@dataclass
class Parallax:
    """Parameters that convert disparities of a pair to inverse depths. Pixels are matched pixels of the key view."""

    plane: np.ndarray  # inverse depth of the dominant plane at pixel (u, v): plane . (u, v, 1)
    epipole: np.ndarray  # E
    gain: float  # e_z bend: inverse depth off the plane = d / (gain (r - d)), r the distance to the epipole
    coarse: float  # key pixels per pixel of the coarser image, at least 1

    def inverse_depth(self, u, v, d):
        r = np.hypot(u - self.epipole[0], v - self.epipole[1])
        return self.plane[0] * u + self.plane[1] * v + self.plane[2] + d / (self.gain * (r - d))

    def disparity(self, u, v, inverse):
        r = np.hypot(u - self.epipole[0], v - self.epipole[1])
        a = self.gain * (inverse - (self.plane[0] * u + self.plane[1] * v + self.plane[2]))
        return r * a / (1 + a)

    def deviation(self, inverse):
        """Standard deviation of an inverse depth map (h x w) per pixel of matching error."""
        h, w = inverse.shape
        u, v = np.arange(w)[None, :], np.arange(h)[:, None]
        r = np.hypot(u - self.epipole[0], v - self.epipole[1])
        zoom = 1 + self.gain * (inverse - (self.plane[0] * u + self.plane[1] * v + self.plane[2]))
        return (self.coarse * zoom**2 / (np.maximum(r, 0.5) * abs(self.gain))).astype(np.float32)


@dataclass
class Canvas:
    """Rows are angles around the epipole, columns distances from it; both canvases of a pair have this grid."""

    first_angle: float
    angle_step: float
    first_radius: float
    size: tuple  # columns, rows
    low: int  # searched disparities: low <= radius in the key - radius in the partner < low + count
    count: int


@dataclass
class Pair:
    parallax: Parallax
    canvas: Canvas
    homography: np.ndarray  # H, key pixel to partner pixel through the plane
    scale: float  # partner pixels per key pixel


def geometry(a, b, xyz):
    """Median triangulation angle (degrees) of the points `xyz`, and log2 of how much finer view `a` shows them than `b`."""
    to_a, to_b = xyz - a.centre, xyz - b.centre
    lengths = np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1)
    cosine = (to_a * to_b).sum(1) / np.maximum(lengths, 1e-300)
    za, zb = (np.maximum(v.project(xyz)[1], 1e-9) for v in (a, b))
    octaves = np.median(np.log2(zb / za)) + np.log2(a.K[0, 0] / b.K[0, 0])
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))))), float(octaves)


def rectify(a, b, shared, around):
    """Canvas and parallax of key view `a` and partner `b`.

    shared: points (n x 3) that both observe, at least MIN_SHARED; around: those that either observes, for the search range.
    """
    pixels, depth = a.project(shared)
    front = (depth > 0) & (b.project(shared)[1] > 0)
    if front.sum() < MIN_SHARED:
        raise Refused(f"only {front.sum()} shared points lie in front of both views")
    R, t = b.R @ a.R.T, b.t - b.R @ a.R.T @ a.t
    centre = -R.T @ t  # of the partner, in the key view's frame
    if not centre.any():
        raise Refused("both views are at the same place")
    inverse_K = np.linalg.inv(a.K)
    for plane in (dominant_plane(pixels[front], 1 / depth[front]), np.array([0, 0, np.median(1 / depth[front])])):
        bend = 1 - plane @ a.K @ centre
        if bend > 0.1:
            break
    else:
        raise Refused("the partner lies on or behind the plane of the shared points")
    H = b.K @ (R + np.outer(t, plane @ a.K)) @ inverse_K
    e = -a.K @ centre
    e_z = np.copysign(max(abs(e[2]), np.hypot(e[0], e[1]) / FAR), e[2])
    scale = local_scale(H, np.median(pixels[front], axis=0))
    parallax = Parallax(plane, e[:2] / e_z, e_z / bend, max(1.0, 1 / scale))
    low, high = search_range(a, b, parallax, around)
    return Pair(parallax, canvas(a, b, parallax.epipole, H, low, high), H, scale)


def dominant_plane(pixels, inverse):
    """Robust fit of inverse depth = plane . (u, v, 1): least squares, reweighted (Cauchy), slightly damped towards a level plane."""
    centre, spread = pixels.mean(0), pixels.std(0) + 1e-9
    A = np.c_[(pixels - centre) / spread, np.ones(len(pixels))]
    damping = np.diag([0.0025, 0.0025, 0]) * len(pixels)
    weight = np.ones(len(pixels))
    for _ in range(20):
        fit = np.linalg.solve(A.T @ (A * weight[:, None]) + damping, A.T @ (weight * inverse))
        residual = np.abs(A @ fit - inverse)
        weight = 1 / (1 + (residual / (1.5 * np.median(residual) + 1e-12)) ** 2)
    slopes = fit[:2] / spread
    return np.r_[slopes, fit[2] - slopes @ centre]


def local_scale(H, pixel):
    """Target pixels per source pixel (linear) of a homography."""
    w = H[2] @ np.r_[pixel, 1]
    return float(np.sqrt(abs(np.linalg.det(H)) / max(abs(w), 1e-12) ** 3))


def search_range(a, b, parallax, xyz):
    """Disparities that the sparse points seen in both images have, with a margin."""
    pixels, depth = a.project(xyz)
    there, depth_b = b.project(xyz)
    both = (depth > 0) & (depth_b > 0) & inside(pixels, a.size) & inside(there, b.size)
    if both.sum() < MIN_SHARED:
        raise Refused(f"only {both.sum()} sparse points project into both images")
    d = np.sort(parallax.disparity(*pixels[both].T, 1 / depth[both]))
    low, high = np.percentile(d, [0.5, 99.5])
    margin = RANGE_MARGIN * (high - low) + RANGE_PIXELS
    low, high = int(np.floor(low - margin)), int(np.ceil(high + margin))
    room = 16 * round(MAX_DISPARITIES * max(a.size) / 16)
    if high - low > room:  # the window that holds most points, if that is most of them
        held = np.searchsorted(d, d + room - 2 * RANGE_PIXELS, "right") - np.arange(len(d))
        if held.max() < MIN_HELD * len(d):
            raise Refused(f"{high - low} disparities to search, and {room} hold only {100 * held.max() / len(d):.0f} % of the points: too deep a scene for this baseline")
        low = int(np.floor(d[held.argmax()])) - RANGE_PIXELS
        high = low + room
    return low, high


def inside(pixels, size):
    return ((pixels > -0.5) & (pixels < np.array(size) - 0.5)).all(-1)


def canvas(a, b, epipole, H, low, high):
    """The part of the key view that the partner shows, as a polar grid of about one pixel."""
    count = -(-(high - low) // 16) * 16
    step = max(a.size) / 64
    x, y = np.meshgrid(np.arange(-0.5, a.size[0], step), np.arange(-0.5, a.size[1], step))
    pixels = np.c_[x.ravel(), y.ravel()]
    offset = pixels - epipole
    radius = np.hypot(*offset.T)
    seen = np.zeros(len(pixels), bool)
    for d in np.linspace(low, high, 5):
        q = np.c_[epipole + offset * ((radius - d) / np.maximum(radius, 1e-9))[:, None], np.ones(len(pixels))] @ H.T
        seen |= (q[:, 2] > 0) & (radius > d) & inside(q[:, :2] / np.where(q[:, 2:] > 0, q[:, 2:], 1), b.size)
    if seen.mean() < MIN_OVERLAP:
        raise Refused(f"only {100 * seen.mean():.0f} % of the key view is in the partner's image")
    near, far = max(radius[seen].min() - step, 0), radius[seen].max() + step
    angle_step = 1 / max(0.75 * far, near)
    angle, turn = angles(offset[seen], step if near else None, angle_step)
    columns = int(np.ceil(far - near)) + max(0, low + count) + max(0, -low)
    return Canvas(angle, angle_step, near - max(0, low + count), (columns, int(np.ceil(turn / angle_step))), low, count)


def angles(offset, step, angle_step):
    """First angle and range of angles (radians) that hold the directions `offset`, `step` pixels more on both sides."""
    if step is None:  # the epipole is in the picture
        return -np.pi, 2 * np.pi + SEAM * angle_step
    direction = np.arctan2(offset[:, 1], offset[:, 0])
    middle = np.arctan2(*(offset / np.hypot(*offset.T)[:, None]).mean(0)[::-1])
    relative = (direction - middle + np.pi) % (2 * np.pi) - np.pi
    margin = step / np.hypot(*offset.T).min()
    low, high = relative.min() - margin, relative.max() + margin
    return middle + low, min(high - low, 2 * np.pi)


def canvas_pixels(pair):
    """Key pixels (x, y) and partner pixels (x, y, homogeneous w) of the canvas grid."""
    c, E, H = pair.canvas, pair.parallax.epipole, pair.homography
    angle = c.first_angle + c.angle_step * np.arange(c.size[1])[:, None]
    radius = c.first_radius + np.arange(c.size[0])[None, :]
    x, y = E[0] + radius * np.cos(angle), E[1] + radius * np.sin(angle)
    w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    safe = np.where(w > 0, w, 1)
    return (x, y), ((H[0, 0] * x + H[0, 1] * y + H[0, 2]) / safe, (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / safe), w > 0


def key_on_canvas(pair, size):
    """Canvas column and row (float32) of every key pixel."""
    c, E = pair.canvas, pair.parallax.epipole
    u, v = np.arange(size[0])[None, :] - E[0], np.arange(size[1])[:, None] - E[1]
    turn = (np.arctan2(v, u) - c.first_angle) % (2 * np.pi)
    return (np.hypot(u, v) - c.first_radius).astype(np.float32), (turn / c.angle_step).astype(np.float32)
