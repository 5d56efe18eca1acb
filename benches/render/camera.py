"""A pinhole camera, its orientation, and the effects of lens and sensor."""

from typing import NamedTuple

import numpy as np

# Sigma of the blur, pixels.
BLUR = 0.6


class Camera(NamedTuple):
    width: int
    height: int
    focal: float
    cx: float
    cy: float

    @classmethod
    def centred(cls, width, height, focal_to_width):
        return cls(width, height, focal_to_width * width, width / 2, height / 2)

    def directions(self, x, y):
        """Of pixels, in the camera's frame; z is 1."""
        return np.stack([(x - self.cx) / self.focal, (y - self.cy) / self.focal, np.ones(x.shape)], -1).reshape(-1, 3)

    def half_size_directions(self):
        """Through the centres of the pixels of the image at half its size."""
        x, y = np.meshgrid(np.arange(self.width // 2) + 0.5, np.arange(self.height // 2) + 0.5)
        return self.directions(2 * x, 2 * y)


class View(NamedTuple):
    """Name without suffix, rotation camera from world, centre."""

    name: str
    rotation: np.ndarray
    centre: np.ndarray


def look(centre, target, up=(0, 0, 1)):
    """Rotation camera from world."""
    forward = np.asarray(target, float) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def sensed(light, camera, exposure, white, rng):
    """8-bit pixels: vignetting, a soft shoulder, noise, sRGB, dither."""
    from scipy.ndimage import gaussian_filter

    Y, X = np.mgrid[: camera.height, : camera.width]
    r2 = ((X + 0.5 - camera.cx) ** 2 + (Y + 0.5 - camera.cy) ** 2) / camera.focal**2
    light = gaussian_filter(light, (BLUR, BLUR, 0))
    x = light * exposure * white * (1 - 0.28 * r2)[..., None]
    x = np.where(x > 0.7, 0.7 + 0.3 * (1 - np.exp(-np.maximum(x - 0.7, 0) / 0.3)), x)
    x = np.maximum(x + rng.normal(0, 1, x.shape) * np.sqrt(2.0e-5 * np.maximum(x, 0) + 1.0e-6), 0)
    x = np.where(x < 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return np.clip(x * 255 + rng.random(x.shape), 0, 255).astype(np.uint8)
