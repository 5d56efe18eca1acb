"""Depth maps of a plan's own surface, as a perfect program would measure them."""
import numpy as np
import plyfile


class Surface:
    """`viewrank/surface.ply` of a project."""

    def __init__(self, project):
        ply = plyfile.PlyData.read(str(project / "viewrank" / "surface.ply"))
        vertex = ply["vertex"]
        self.vertices = np.stack([np.asarray(vertex[axis], float) for axis in "xyz"], axis=1)
        self.triangles = np.stack(ply["face"]["vertex_indices"])

    def depths(self, model, view, width, height):
        """Depth of the surface in the middle of every pixel of a reduced image; 0 where there is none. For pinhole views."""
        camera = model.cameras[model.views[view]["camera"]]
        pixels = model.project(view, self.vertices) * [width / camera["width"], height / camera["height"]]
        nearness = 1 / model.in_camera(view, self.vertices)[:, 2]
        found = np.zeros((height, width))
        for corners in self.triangles[(nearness[self.triangles] > 0).all(axis=1)]:
            low, high = pixels[corners].min(axis=0), pixels[corners].max(axis=0)
            x0, y0 = np.maximum(np.ceil(low - 0.5), 0).astype(int)
            x1, y1 = np.minimum(np.floor(high - 0.5), [width - 1, height - 1]).astype(int)
            if x0 > x1 or y0 > y1:
                continue
            a, b, c = pixels[corners]
            area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            if area == 0:
                continue
            x, y = np.meshgrid(np.arange(x0, x1 + 1) + 0.5, np.arange(y0, y1 + 1) + 0.5)
            of_b = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
            of_c = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
            # 1 / depth is linear in the image.
            inverse = nearness[corners] @ np.stack([1 - of_b - of_c, of_b, of_c]).reshape(3, -1)
            inside = (of_b >= 0) & (of_c >= 0) & (of_b + of_c <= 1)
            part = found[y0:y1 + 1, x0:x1 + 1]
            part[...] = np.maximum(part, np.where(inside, inverse.reshape(x.shape), 0))
        return np.divide(1, found, out=np.zeros_like(found), where=found > 0).astype(np.float32)
