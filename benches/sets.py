#!/usr/bin/env python3
"""Makes the data sets that tests and measurements read, in VIEWRANK_DATA, else in target/data.

    python3 benches/sets.py --list
    python3 benches/sets.py SET... [--source CLONE] [--jobs 2] [--seed N]

Rendered sets need benches/render/requirements.txt, photographs benches/photographs/requirements.txt and git, `survey` numpy, `formats` git.
Photographs are cloned from their public repository; --source takes a clone that is there already. A set that is there already is kept; an
unfinished one is made anew, except that views that have been rendered are kept.

With the versions of the requirements the rendered images, depth and true poses have the same bytes every time. Sparse models come out alike, but
not to the last digit, where structure from motion runs on several threads.
"""

import argparse
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

from photographs.recipe import Recipe

ROOT = Path(__file__).resolve().parents[1]


class Rendered(NamedTuple):
    scene: str
    seed: int
    views: int
    size: tuple
    minutes: int
    quality: int = 92
    image_mb: float = 0
    features: int = 4000
    known_poses: bool = False

    kind = "rendered"
    # The file that is written last.
    last = "stats.json"
    source = "benches/render"
    licence = "none attached"

    def make(self, folder, options):
        from render.__main__ import make

        make(SimpleNamespace(**self._asdict(), out=folder, jobs=options.jobs, no_sfm=False))


class Photographs(NamedTuple):
    repository: str
    commit: str
    licence: str
    views: int
    minutes: int
    recipe: Recipe

    kind = "photographs"
    last = "stats.json"

    @property
    def source(self):
        return "https://github.com/%s at %s" % (self.repository, self.commit[:7])

    def make(self, folder, options):
        from photographs.make import make

        # A part of a set cannot be gone on with.
        shutil.rmtree(folder, ignore_errors=True)
        with tempfile.TemporaryDirectory() as scratch:
            make(folder, options.source or cloned(self.repository, Path(scratch)), self.commit, self.recipe)
        about = "From %s (%s), reduced and undistorted by benches/sets.py." % (self.source, self.licence)
        (folder / "README.md").write_text("# %s\n\n%s\n" % (folder.name, about))


class Synthetic(NamedTuple):
    """A large sparse model without images."""

    views: int
    points: int
    minutes: int

    kind = "sparse model"
    last = "points3D.bin"
    source = "benches/aerial"
    licence = "none attached"

    def make(self, folder, options):
        from aerial import model

        model.make(folder, self.views, self.points)


class Programs(NamedTuple):
    """Files that come with other programs, for the tests of their readers: (repository, commit, path, path here)."""

    files: tuple
    minutes: int = 5

    kind = "sparse models"
    last = "others/alicevision/scene_v1.2.8_cut.sfm"
    views = "-"
    source = "repositories of OpenSfM, Bundler, AliceVision, OpenMVS"
    licence = "BSD-2, GPL, MPL-2.0, AGPL-3.0"

    def make(self, folder, options):
        with tempfile.TemporaryDirectory() as scratch:
            for repository, commit, path, here in self.files:
                target = folder / "others" / here
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(git_show(cloned(repository, Path(scratch)), commit, path))
        others = folder / "others"
        (others / "bundler_kermit/list.txt").write_text("".join("./kermit%03d.jpg\n" % i for i in range(11)))
        cut_structure(others / "alicevision/scene.json", others / "alicevision/scene_v1.2.8_cut.sfm")


def cut_structure(scene, cut, landmarks=300):
    """Leaves landmarks without observations, fewer."""
    model = json.loads(scene.read_text())
    model["structure"] = [{k: v for k, v in mark.items() if k != "observations"} for mark in model["structure"][:landmarks]]
    cut.write_text(json.dumps(model))
    scene.unlink()


def cloned(repository, scratch):
    """A clone without work tree; files come when they are read."""
    clone = scratch / repository.replace("/", "+")
    if not clone.exists():
        url = "https://github.com/%s" % repository
        subprocess.run(["git", "clone", "--quiet", "--bare", "--filter=blob:none", url, str(clone)], check=True)
    return clone


def git_show(clone, commit, path):
    return subprocess.run(["git", "-C", str(clone), "show", "%s:%s" % (commit, path)], capture_output=True, check=True).stdout


CC_BY = 'CC BY 3.0, "Photos: Andrew Zaborowski", with attribution to OpenStreetMap-PL'
OPENSFM = ("mapillary/OpenSfM", "238744cdf3b5d50149c50d136a87f7fea25ad5cd")
BUNDLER = ("snavely/bundler_sfm", "a35a8f589b7b8419f43f9e41553a84522faa6f9e")
OPENMVS = ("cdcseacave/openMVS", "ce03889e2055a3d6cbcae9dd5a93b5eeea94b909")
ALICEVISION = ("alicevision/AliceVision", "ca8300f38998f1763d5fda7d47cbe0513ab3fa39")
NEAR_DUPLICATES = """3007 3011 3013 3026 3032 3034 3036 3037 3038 3043 3058 3059 3087 3095 3097 3103 3107 3123 3124 3138 3139 3147 3151 3154
3156 3166 3184 3186"""
SETS = dict(
    valley=Rendered("valley", 1, 112, (1000, 750), 20, image_mb=14.8, features=2700),
    statue=Rendered("statue", 1, 72, (640, 480), 5, quality=87, features=1800),
    room=Rendered("room", 1, 72, (800, 600), 7, features=3000),
    grove=Rendered("grove", 1, 90, (1000, 750), 25),
    yard=Rendered("yard", 7, 320, (800, 600), 60),
    valley1236=Rendered("valley", 1, 1236, (400, 300), 60, features=1000, known_poses=True),
    quarry485=Rendered("quarry", 1, 485, (400, 300), 20, features=1000, known_poses=True),
    boruszyn=Photographs(
        "merkato/odm_boruszyn_kap", "f8e9eaba1a195ebcaab902f100df1edc8534b421", CC_BY, 28, 10,
        Recipe(815, "all", control="gcp_list.txt", control_width=2400),
    ),
    lewis=Photographs(
        "OpenDroneMap/odm_data_lewis", "e3ffe160708611575dcb171a1537ef2b6e8ca68b", "CC0 1.0", 52, 15, Recipe(700, "near"),
    ),
    caliterra=Photographs(
        "OpenDroneMap/odm_data_caliterra", "bec3dc7296e90aacb3930eb9df8061849fbfe0d0", "CC0 1.0", 75, 20, Recipe(730, "near", lag=2),
    ),
    ochota=Photographs(
        "merkato/odm_ochota_kap", "a7543fdd6dc1b586ccffd07c3756db6ba22be6ab", CC_BY, 92, 40,
        Recipe(
            815, 22, features=3200, control="gcp_list.txt", quality=88, distorted=False,
            dropped=tuple("img_%s.jpg" % number for number in NEAR_DUPLICATES.split()),
        ),
    ),
    survey=Synthetic(300, 250_000, 1),
    formats=Programs((
        (*OPENSFM, "data/berlin/reconstruction_example.json", "opensfm_berlin/reconstruction.json"),
        (*OPENSFM, "data/berlin/tracks_example.csv", "opensfm_berlin/tracks.csv"),
        (*OPENSFM, "data/berlin/rig_cameras_example.json", "opensfm_berlin/rig_cameras.json"),
        (*OPENSFM, "data/berlin/rig_assignments_example.json", "opensfm_berlin/rig_assignments.json"),
        (*BUNDLER, "examples/kermit/results.example/bundle.out", "bundler_kermit/bundle.out"),
        (*ALICEVISION, "pyTests/data/small.sfm", "alicevision/small.sfm"),
        (*ALICEVISION, "src/aliceVision/sfmDataIO/compatibilityData/scene_v1.2.8.json", "alicevision/scene.json"),
        (*OPENMVS, "apps/Tests/data/scene.mvs", "openmvs/scene.mvs"),
    )),
)  # fmt: skip


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", metavar="SET", help=", ".join(SETS))
    parser.add_argument("--list", action="store_true", help="kind, images, source, licence and time of each set")
    parser.add_argument("--source", type=Path, help="a clone of the photographs' repository")
    parser.add_argument("--jobs", type=int, default=2, help="processes of the renderer")
    parser.add_argument("--seed", type=int, help="another scene of the same kind, in SET-seed-N, for rendered sets")
    options = parser.parse_args()
    unknown = set(options.sets) - set(SETS)
    if unknown or not (options.sets or options.list):
        parser.error("no set %s; there are %s" % (", ".join(sorted(unknown)) or "given", ", ".join(SETS)))
    if options.seed is not None and any(SETS[name].kind != "rendered" for name in options.sets):
        parser.error("--seed: only rendered sets have one")
    return options


def show():
    print("%-10s %-13s %6s %7s  %-62s %s" % ("set", "kind", "images", "minutes", "source", "licence"))
    for name, made in SETS.items():
        print("%-10s %-13s %6s %7d  %-62s %s" % (name, made.kind, made.views, made.minutes, made.source, made.licence))


def main():
    options = arguments()
    if options.list:
        show()
    data = Path(os.environ.get("VIEWRANK_DATA", ROOT / "target/data"))
    for name in options.sets:
        made, folder = SETS[name], data / name
        if options.seed is not None:
            made, folder = made._replace(seed=options.seed), data / f"{name}-seed-{options.seed}"
        if (folder / made.last).exists():
            print("%s is there already: %s" % (name, folder))
            continue
        print("%s: about %d minutes on two cores" % (folder, made.minutes), flush=True)
        made.make(folder, options)


if __name__ == "__main__":
    main()
