"""Renders a synthetic scene with exact depth, and makes a sparse model of the pictures.

    python3 -m benches.render OUT [--scene valley|yard|quarry|grove|statue|room] [--seed 1] [--views 120] [--size 1000x750]

Needs Python 3.9 or later and benches/render/requirements.txt. The sets of the repository's measurements: benches/sets.py.
Writes images/, sparse/0/, truth/{sparse/0,depth,scene.ply}, stats.json and README.md. Views that are there already are kept.
"""

import argparse
import json
import shutil
from pathlib import Path

from . import pictures
from .scenes import NAMES


def arguments():
    parser = argparse.ArgumentParser("python3 -m benches.render", description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--scene", default="valley", choices=NAMES)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--views", type=int, default=120)
    parser.add_argument("--size", type=lambda text: tuple(map(int, text.split("x"))), default=(1000, 750))
    parser.add_argument("--quality", type=int, default=92, help="JPEG quality")
    parser.add_argument("--image-mb", type=float, default=0, help="lower the quality until the images together take at most this")
    parser.add_argument("--features", type=int, default=4000, help="SIFT features per image")
    parser.add_argument("--jobs", type=int, default=2, help="processes, and threads of pycolmap")
    parser.add_argument("--known-poses", action="store_true", help="triangulate with the true poses, without structure from motion")
    parser.add_argument("--no-sfm", action="store_true", help="render only")
    return parser.parse_args()


def make(settings):
    """A whole set in settings.out."""
    stats = pictures.render(settings)
    stats["jpeg_quality"] = pictures.encode(settings.out, settings.quality, settings.image_mb)
    if not settings.no_sfm:
        from . import checks, describe, mapping

        pictures.keep_rendered(settings.out)
        stats["mapping"] = mapping.sparse_model(settings.out, settings)
        stats["check"] = checks.check(settings.out)
        stats.update(describe.describe(settings.out))
        describe.write_readme(settings, stats)
    shutil.rmtree(settings.out / "png")
    (settings.out / "stats.json").write_text(json.dumps(stats, indent=1) + "\n")
    return stats


if __name__ == "__main__":
    make(arguments())
