#!/usr/bin/env python3
"""Checks what this repository says about MVS programs against their sources, and lists what has become untrue.

    git clone https://github.com/colmap/colmap SOURCES/colmap       # and openMVS, ODM, ODX, PatchmatchNet, as far as they are to be checked
    python3 benches/versions.py SOURCES
    python3 benches/versions.py SOURCES openMVS=v2.4.0 colmap=4.2.1

SOURCES holds a folder for each program, named as its repository: a work tree, a clone, or a bare repository. NAME=REVISION reads a clone at that revision (default: HEAD). Each
statement names the file here that makes it: one that is no longer made is listed too, so that this list follows the text. Exit code 1: something is untrue or no longer said. A program
without sources is skipped, and named. Needs git for clones, and nothing besides.
"""

import argparse
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parents[1]


class Statement(NamedTuple):
    """Says `words`, in our `file` by `text`: in `source` of the program there is (or is not) a match of `pattern`."""

    words: str
    file: str
    text: str
    source: str
    pattern: str
    there: bool = True


def option(name):
    """DensifyPointCloud takes this option, which is passed."""
    return Statement(f"--{name} is an option of DensifyPointCloud", "src/backends/openmvs/run.rs", name, "apps/DensifyPointCloud/DensifyPointCloud.cpp", rf'\("{name}[",]')


PROGRAMS = {
    "openMVS": [
        *map(option, ["resolution-level", "min-resolution", "max-resolution", "number-views", "number-views-fuse", "geometric-iters", "postprocess-dmaps"]),
        *map(option, ["fusion-mode", "fusion-filter", "view-neighbors-file", "dense-config-file", "max-threads", "estimate-roi", "crop-to-roi", "tower-mode"]),
        Statement("filter 2 is the default fusion", "docs/backends.md", "Filter 2 (dense-fuse), the default", "apps/DensifyPointCloud/DensifyPointCloud.cpp", r'"fusion-filter".*default_value\(2\)'),
        Statement("filter 2 joins at least five pixels", "docs/backends.md", "least five pixels (`Min Pixels Fuse`)", "libs/MVS/DepthMap.cpp", r'"Min Pixels Fuse",.*"5"\)'),
        Statement("depth maps are of the kinds DR and D2", "crates/io/src/depthmaps/openmvs.rs", "`DR` (v2.0 to v2.4.0)", "libs/MVS/Interface.h", r'HeaderDepthDataRawName\(\) \{[^}]*"D[R2]"'),
        Statement("partners of a score below 2 are dropped", "docs/backends.md", "below max(2, 3 % of the best)", "libs/MVS/DepthMap.cpp", r'"View Min Score",.*"2\.0"\)'),
        Statement("partners of a score below 3 % are dropped", "docs/backends.md", "below max(2, 3 % of the best)", "libs/MVS/DepthMap.cpp", r'"View Min Score Ratio",.*"0\.03"\)'),
        Statement("12 partners at most by default", "docs/backends.md", "`Max Views` (else 12)", "libs/MVS/DepthMap.cpp", r'"Max Views",.*"12"\)'),
        Statement("scenes are of version 7", "docs/backends.md", "version 7 has view scores", "libs/MVS/Interface.h", r"define MVSI_PROJECT_VER \(\(uint32_t\)7\)"),
    ],
    "colmap": [
        Statement("`colmap help` says with CUDA", "docs/backends.md", '"with CUDA"', "src/colmap/util/version.cc.in", '"with CUDA"'),
        Statement("`colmap help` says without GPU support since 4.2.0", "docs/backends.md", '"without GPU support" from 4.2.0', "src/colmap/util/version.cc.in", '"without GPU support"'),
        Statement(
            "narrower partners are copied row by row since 4.2.0", "docs/backends.md", "repaired in 4.2.0 by colmap#4634", "src/colmap/mvs/patch_match_cuda.cu", r"memcpy\(dest, bitmap\.RowMajorData\(\)", False
        ),
        Statement("fusion wants 5 pixels by default", "docs/backends.md", "`min_num_pixels` (default 5)", "src/colmap/mvs/fusion.h", "int min_num_pixels = 5;"),
        Statement("fusion compares with 50 views", "docs/backends.md", "`check_num_images` (50)", "src/colmap/mvs/fusion.h", "int check_num_images = 50;"),
        Statement("pairs below 3 degrees are filtered", "docs/backends.md", "`filter_min_triangulation_angle`", "src/colmap/mvs/patch_match_options.h", r"filter_min_triangulation_angle = 3\.0"),
        Statement("the depth range is of 1 to 99 % of the points", "docs/backends.md", "1 and 99 % quantiles", "src/colmap/mvs/model.cc", r"kMinPercentile = 0\.01f;[\s\S]*kMaxPercentile = 0\.99f;"),
        Statement("the depth range is stretched by a quarter", "docs/backends.md", "× 0.75 and 1.25", "src/colmap/mvs/model.cc", r"kStretchRatio = 0\.25f;"),
        Statement("`__auto__` is a keyword", "docs/backends.md", "`__auto__, N`", "src/colmap/mvs/patch_match.cc", '"__auto__"'),
        Statement("`__all__` is a keyword", "docs/backends.md", "`__all__`", "src/colmap/mvs/patch_match.cc", '"__all__"'),
        Statement("the cloud has a .vis beside it", "docs/backends.md", "fused.ply.vis", "src/colmap/exe/mvs.cc", r"WritePointsVisibility"),
        *(
            Statement(f"--{name} is an option", "src/backends/colmap/mod.rs", name, "src/colmap/controllers/option_manager.cc", rf'"{re.escape(name)}"')
            for name in ("PatchMatchStereo.geom_consistency", "PatchMatchStereo.max_image_size", "PatchMatchStereo.filter", "StereoFusion.min_num_pixels", "StereoFusion.check_num_images")
        ),
    ],
    "ODM": [
        Statement("an existing scene is kept", "docs/backends.md", "ODM keeps an existing `scene.mvs`", "stages/openmvs.py", r'"scene\.mvs"\)\s+if not io\.file_exists'),
        Statement("two maps must agree", "docs/backends.md", "sets `--number-views-fuse 2`", "stages/openmvs.py", "number_views_fuse = 2"),
        Statement("partners are cut at OpenMVS's default", "docs/backends.md", "no `--number-views`", "stages/openmvs.py", r"--number-views (?!fuse)", False),
        Statement("OpenMVS works in depthmaps", "docs/backends.md", "relative to `openmvs/depthmaps`", "stages/openmvs.py", r"-w \"%s\"' % depthmaps_dir"),
        Statement("the quality is medium by default", "docs/backends.md", "`--pc-quality medium`", "opendm/config.py", r"'--pc-quality',[\s\S]{0,120}default='medium'"),
        Statement("--end-with takes opensfm", "integrations/odm/README.md", "--end-with opensfm", "opendm/config.py", r"processopts = \[[^\]]*'opensfm'"),
    ],
    "ODX": [
        Statement("the image is webodm/odx", "src/backends/odm.rs", "webodm/odx", "README.md", r"webodm/odx --project-path /datasets project"),
        Statement("the quality is medium by default", "docs/backends.md", "`--pc-quality medium`", "opendm/config.py", r"'--pc-quality',[\s\S]{0,120}default='medium'"),
        Statement("--end-with takes opensfm", "integrations/odm/README.md", "--end-with opensfm", "opendm/config.py", r"processopts = \[[^\]]*'opensfm'"),
        Statement("an existing scene is kept", "docs/backends.md", "its dense stage was not read", "stages/openmvs.py", r'"scene\.mvs"\)\s+if not io\.file_exists'),
    ],
    "PatchmatchNet": [
        Statement(f"{name} is an option of eval.py", "src/backends/pairs/dialects.rs", name, "eval.py", rf'"{name}"')
        for name in ("--input_folder", "--output_folder", "--checkpoint_path", "--num_views", "--output_type", "--geo_mask_thres")
    ],
}


class Sources:
    """The files of a program: of a folder, or of a revision of a clone."""

    def __init__(self, folder, revision):
        self.folder, self.revision = folder, revision

    def git(self, *words):
        return subprocess.run(["git", "-C", self.folder, *words], capture_output=True, text=True, errors="replace", check=False)

    def is_clone(self):
        return self.revision is not None or not (self.folder / "README.md").is_file()

    def name(self):
        if not self.is_clone():
            return "the files there"
        done = self.git("log", "-1", "--format=%h of %as", self.revision or "HEAD")
        return f"{self.revision or 'HEAD'} ({done.stdout.strip()})" if done.returncode == 0 else None

    def read(self, path):
        """Text of a file; None without it."""
        if self.is_clone():
            done = self.git("show", f"{self.revision or 'HEAD'}:{path}")
            return done.stdout if done.returncode == 0 else None
        try:
            return (self.folder / path).read_text(errors="replace")
        except OSError:
            return None


def check(statement, sources):
    """Says what is wrong with a statement; None where it is true."""
    text = sources.read(statement.source)
    if text is None:
        return f"cannot tell whether {statement.words}: no {statement.source}"
    if bool(re.search(statement.pattern, text)) != statement.there:
        return f"untrue: {statement.words} ({statement.file}: {statement.text!r}); see {statement.source}"
    return None


def unsaid(statement):
    """Says that our file no longer makes a statement; None where it does."""
    said = HERE / statement.file
    if said.is_file() and statement.text in " ".join(said.read_text(encoding="utf-8").split()):
        return None
    return f"no longer said: {statement.words} ({statement.file}: {statement.text!r}); correct this list"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", type=Path, help="folder with the sources of the programs")
    parser.add_argument("revisions", nargs="*", metavar="NAME=REVISION")
    arguments = parser.parse_args()
    revisions = dict(word.partition("=")[::2] for word in arguments.revisions)
    unknown = sorted(set(revisions) - set(PROGRAMS))
    if unknown:
        parser.error(f"no program {unknown[0]}: take one of {', '.join(PROGRAMS)}")
    wrong = 0
    for program, statements in PROGRAMS.items():
        found = [fault for fault in map(unsaid, statements) if fault]
        sources = Sources(arguments.sources / program, revisions.get(program))
        name = sources.name() if sources.folder.is_dir() else None
        if name is None:
            print(f"{program}: no sources, {len(statements)} statements not checked")
        else:
            found += [fault for fault in (check(statement, sources) for statement in statements) if fault]
            print(f"{program} {name}: {len(statements)} statements, {len(found)} untrue or not to be checked")
        for fault in found:
            print(f"  {fault}")
        wrong += len(found)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
