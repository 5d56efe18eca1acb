#!/usr/bin/env python3
"""Stands in for COLMAP where there is no card, so that run.sh of an export can be run as it is:

    COLMAP=benches/colmap_cpu.py PROJECT/viewrank/colmap/stereo/viewrank/run.sh

`patch_match_stereo` matches the lists, photometric only, by the PatchMatch of PyPI's pyarchinit-photogrammetry-core (0.5.0, CPU, GPL) with the defaults of that package: depth ranges, sizes and
files are as COLMAP's, the depths are not. `stereo_fusion` is COLMAP's own, of pycolmap (4.2). Needs both, numpy and opencv-python-headless.
"""

import argparse
import sys
from pathlib import Path

import pycolmap


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb in ("patch_match_stereo", "stereo_fusion"):
        verbs.add_parser(verb).add_argument("--workspace_path", type=Path, required=True)
    matching, fusion = (verbs.choices[verb] for verb in ("patch_match_stereo", "stereo_fusion"))
    matching.add_argument("--config_path", type=Path, default=Path("stereo/patch-match.cfg"))
    matching.add_argument("--PatchMatchStereo.geom_consistency", dest="geom_consistency", choices="0", required=True)
    matching.add_argument("--PatchMatchStereo.filter", dest="filter", choices="1")
    matching.add_argument("--PatchMatchStereo.max_image_size", dest="max_image_size", type=int)
    fusion.add_argument("--input_type", choices=("photometric",))
    fusion.add_argument("--StereoFusion.min_num_pixels", dest="min_num_pixels", type=int)
    fusion.add_argument("--StereoFusion.check_num_images", dest="check_num_images", type=int)
    fusion.add_argument("--output_path", type=Path, required=True)
    args = parser.parse_args()
    {"patch_match_stereo": match, "stereo_fusion": fuse}[args.verb](args)


def fuse(args):
    options = pycolmap.StereoFusionOptions()
    options.num_threads = 1  # the same cloud in each run
    for name in ("min_num_pixels", "check_num_images"):
        if getattr(args, name):
            setattr(options, name, getattr(args, name))
    pycolmap.stereo_fusion(args.output_path, args.workspace_path, input_type=args.input_type, options=options, output_type="ply")


def match(args):
    views = Views(args.workspace_path, args.max_image_size)
    lines = [line.strip() for line in (args.workspace_path / args.config_path).read_text(encoding="utf-8").splitlines() if line.strip() and not line.startswith("#")]
    for key, partners in zip(lines[::2], lines[1::2]):
        depth_path, normal_path = (args.workspace_path / f"stereo/{kind}/{key}.photometric.bin" for kind in ("depth_maps", "normal_maps"))
        if depth_path.is_file() and normal_path.is_file():
            continue
        depth, normals = views.match(key, partners.split(", "))
        # COLMAP knows no map by its depths alone.
        write(normal_path, normals)
        write(depth_path, depth)
        print(f"{key}: {100 * (depth > 0).mean():.0f} % of the pixels", flush=True)


def write(path, values):
    """A map in COLMAP's format: width, height and channels, then floats, channel by channel."""
    rows, columns, channels = values.shape
    path.write_bytes(f"{columns}&{rows}&{channels}&".encode() + values.transpose(2, 0, 1).astype("<f4").tobytes())


class Views:
    def __init__(self, workspace, most):
        self.images, self.most = workspace / "images", most
        self.model = pycolmap.Reconstruction(workspace / "sparse")
        self.by_name = {image.name: image for image in self.model.images.values()}

    def read(self, name):
        """Grey image, and (fx, fy, cx, cy) where the centre of the first pixel is 0."""
        import cv2
        import numpy as np

        grey = cv2.imread(str(self.images / name), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            sys.exit(f"error: cannot read image {self.images / name}")
        long_side = max(grey.shape)
        scale = min(1, (self.most or long_side) / long_side)
        size = [max(1, round(side * scale)) for side in grey.shape[::-1]]
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        camera = self.model.cameras[self.by_name[name].camera_id]
        matrix = np.diag([size[0] / camera.width, size[1] / camera.height, 1]) @ camera.calibration_matrix()
        return grey.astype(np.float32) / 255, (matrix[0, 0], matrix[1, 1], matrix[0, 2] - 0.5, matrix[1, 2] - 0.5)

    def match(self, key, partners):
        """Depths and normals, rows x columns x channels."""
        import numpy as np
        import ppg_core

        pose = self.by_name[key].cam_from_world()
        sources = []
        for partner in partners:
            to_partner = self.by_name[partner].cam_from_world() * pose.inverse()
            sources.append((*self.read(partner), np.ascontiguousarray(to_partner.rotation.matrix()), to_partner.translation))
        depth, normals, _ = ppg_core.patchmatch_depth(*self.read(key), sources, self.depth_range(key))
        return depth[:, :, None], normals * (depth > 0)[:, :, None]

    def depth_range(self, key):
        """As COLMAP takes it from the points that the view observes."""
        import numpy as np

        image = self.by_name[key]
        points = [self.model.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
        depths = (image.cam_from_world() * np.array(points))[:, 2]
        low, high = np.quantile(depths[depths > 0], (0.01, 0.99))
        return 0.75 * float(low), 1.25 * float(high)


if __name__ == "__main__":
    main()
