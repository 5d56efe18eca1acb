#!/usr/bin/env python3
"""Judges orders of depth maps by the cloud that the program fuses: which share of its cells do the first maps of an order cover?

    benches/cells.py PROJECT WORK_FOLDER --openmvs FOLDER [--image-scale 0.5] [--check] [--viewrank viewrank]
    benches/cells.py PROJECT WORK_FOLDER --matcher sgm
    benches/cells.py PROJECT WORK_FOLDER --matcher colmap --colmap PROGRAM [--maps WORKSPACE]
    PATCHMATCHNET=FOLDER PYTHON=PROGRAM benches/cells.py PROJECT WORK_FOLDER --matcher patchmatchnet

Matches all key views once, fuses all maps, and lets `viewrank evaluate` judge the orders (docs/method.md, section 8). Writes WORK_FOLDER/.../cells.tsv, which says which maps take part in which
cells, and cells.json with the shares, from which benches/tables.py makes the tables of the documents. From then on `viewrank evaluate PROJECT --cells cells.tsv` judges any plan within seconds.

With COLMAP, run.sh of the export matches and fuses, and its clouds are compared with those of COLMAP's default min_num_pixels, also with exact depth (as in benches/partners.py) where there is any.
PROGRAM needs a card, or is benches/colmap_cpu.py, whose depths are those of another PatchMatch. With --maps, the photometric maps of all views are those of a workspace that COLMAP has matched, with whatever partners.

PatchmatchNet is matched by `viewrank run`. Its cloud does not name the maps of its points, so the cells of the table are those in which its maps agree.

--check also fuses the first maps of two orders at 10 and 30 %, and compares their clouds with what the table says. Needs numpy, scipy and pycolmap; runs resume as those of
benches/sizes.py, whose folder of maps this shares.
"""

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import colmap_cuda
from fused import positions
from partners import Exact
from scipy.spatial import cKDTree
from sizes import Bench, OpenMvs, Reference, Sgm

CHECKED = (0.1, 0.3)
FINISHED = (0.1, 0.2, 0.3, 0.5)
# Maps that the fusion wants.
LEAST = {"openmvs": 2, "sgm": 1, "colmap": 2, "patchmatchnet": 2}
# Their clouds name the maps of each point; of others, the maps alone make the table.
NAMED = ("openmvs", "colmap")
# PatchmatchNet's fusion takes so many of the other maps.
FUSED_WITH = 24
# min_num_pixels of stereo_fusion: run.sh's, and COLMAP's default.
PIXELS = (2, 5)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path, help="COLMAP project with images/ and sparse/")
    parser.add_argument("work", type=Path, metavar="work_folder", help="folder for maps, clouds and the table")
    parser.add_argument("--matcher", choices=LEAST, default="openmvs")
    parser.add_argument("--image-scale", type=float, default=0.5)
    parser.add_argument("--openmvs", type=Path, default=Path(os.environ.get("OPENMVS_BIN", ".")), help="folder of its programs")
    parser.add_argument("--colmap", default=os.environ.get("COLMAP", "colmap"), help="its program")
    parser.add_argument("--maps", type=Path, help="COLMAP workspace with all depth and normal maps")
    parser.add_argument("--check", action="store_true", help="compare the table with real fusions of the first maps")
    parser.add_argument("--viewrank", default="viewrank")
    args = parser.parse_args()
    args.gsd = None
    bench = {"openmvs": OpenMvs, "sgm": Sgm, "colmap": Colmap, "patchmatchnet": PatchmatchNet}[args.matcher](args)
    shutil.rmtree(bench.project / "viewrank/cache", ignore_errors=True)
    before = processor_seconds()
    default = bench.plan()
    planning = processor_seconds() - before
    every = bench.plan("--budget", "100%", "--target", "100%")
    matching = bench.match(every, 1.0)
    whole = None if args.matcher == "sgm" else bench.fuse(every, 1.0)
    judged = judge(bench, args.matcher in NAMED)
    shutil.copy(bench.project / "viewrank/evaluation/cells.tsv", bench.work)
    clusters = default["clusters"][: default["cut"]["clusters"]]
    # Some may have no map: OpenMVS found too little of them.
    names, _ = read_table(bench.work / "cells.tsv")
    chosen = sum(cluster["key"] in names for cluster in clusters)
    covered = {kind: judged[kind]["orders"][0]["curve"][chosen] for kind in ("all", "agreeing")}
    spread = {kind: order(judged[kind], "every n-th")["curve"][chosen] for kind in ("all", "agreeing")}
    plan = {"maps": len(clusters), "forecast": default["cut"]["share"], "covered": covered, "every n-th": spread}
    plan["seconds"] = {"planning": planning, "matching": len(clusters) * matching, "all": judged["maps"] * matching}
    result = {"set": args.project.resolve().name, "matcher": args.matcher, "image_scale": args.image_scale, "maps": len(every["clusters"]), "cells": judged, "default": plan}
    result["so far"] = so_far(bench, every, judged)
    if whole is not None:
        nth = every_nth(sorted(every["clusters"], key=lambda cluster: cluster["key"]), len(clusters))
        choices = [{**every, "clusters": of} for of in (nth, clusters)]
        reference = Reference(whole, bench)
        clouds = [bench.fuse(of, 1.0) for of in choices]
        plan["points"] = {"all": reference.number, "plan": len(clouds[1])}
        for of, cloud in zip((spread, plan), clouds):
            of["fused"] = reference.covered(cKDTree(cloud), 2)[0] / 100
        if args.matcher == "colmap":
            truth = args.project / "truth"
            exact = Exact(truth, bench).of if (truth / "depth").is_dir() else lambda _: None
            result["fused_of"] = {pixels: fused_of(bench, every, choices, pixels, exact) for pixels in PIXELS}
        if args.check:
            result["check"] = check(bench, reference, every, judged)
    (bench.work / "cells.json").write_text(json.dumps(result, indent=1) + "\n")
    show(result)


def so_far(bench, every, judged):
    """The share of the area that `viewrank evaluate` says of the first maps of the plan, when no others are there yet, and what the table of all maps says of them."""
    names, _ = read_table(bench.work / "cells.tsv")
    ranked = [cluster["key"] for cluster in every["clusters"] if cluster["key"] in names]
    curve, folder, found = judged["all"]["orders"][0]["curve"], bench.work / "first", []
    for share in FINISHED:
        number = max(2, round(share * len(ranked)))
        shutil.rmtree(folder, ignore_errors=True)
        for path in (*map(bench.map_of, ranked[:number]), *bench.names()):
            link = folder / path
            link.parent.mkdir(parents=True, exist_ok=True)
            link.hardlink_to(bench.maps(1.0) / path)
        command = [bench.args.viewrank, "evaluate", bench.project, "--depth-maps", folder, "--out", bench.work / "of-first", "--format", "json", "--quiet"]
        said = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)["reached"]["share"]
        found.append({"maps": number, "real": curve[number], "said": said})
    return found


def every_nth(items, number):
    return [items[i * len(items) // number] for i in range(number)]


def processor_seconds():
    """User time of all programs that have ended."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime


def fused_of(bench, every, choices, pixels, exact):
    """What main() finds, with this min_num_pixels in all fusions."""
    whole = bench.fuse(every, 1.0, pixels)
    reference = Reference(whole, bench)
    nth, plan = (bench.fuse(of, 1.0, pixels) for of in choices)
    covered = {name: reference.covered(cKDTree(cloud), 2)[0] / 100 for name, cloud in (("every n-th", nth), ("plan", plan))}
    return {"points": {"all": len(whole), "plan": len(plan)}, "fused": covered, "exact": exact(whole)}


def judge(bench, fused):
    """What `viewrank evaluate` says of the cloud of all maps, which is the last that was fused."""
    cloud = ["--cloud", bench.cloud()] if fused else []
    command = [bench.args.viewrank, "evaluate", bench.project, "--depth-maps", bench.maps(1.0), *cloud, "--format", "json", "--quiet"]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
    return json.loads(done.stdout)["cells"]


def order(kind, name):
    return next(order for order in kind["orders"] if order["name"] == name)


def show(result):
    cells = result["cells"]
    print(f"{cells['maps']} maps, {cells['all']['cells']:.0f} cells, {cells['agreeing']['cells']:.0f} where three maps agree; at 10, 20, 30 and 50 % of the maps")
    print(f"{'':14} {'all cells':28}  three agree")
    for row, agreeing in zip(cells["all"]["orders"], cells["agreeing"]["orders"]):
        print(f"{row['name']:14} " + "   ".join(" ".join(f"{100 * share:6.1f}" for share in of["covered"]) for of in (row, agreeing)))
    print(f"{'way of ours':14} " + "   ".join(" ".join(f"{way or 0:6.2f}" for way in cells[kind]["orders"][0]["way"]) for kind in ("all", "agreeing")))
    plan = result["default"]
    print("first maps, real and said by evaluate: " + ", ".join(f"{of['maps']}: {100 * of['real']:.1f}, {100 * of['said']:.1f}" for of in result["so far"]))
    print(f"default plan: {plan['maps']} maps, forecast {100 * plan['forecast']:.1f} %, covered {100 * plan['covered']['all']:.1f} % of the cells")


def check(bench, reference, every, judged):
    """Real fusions of the first maps against the table: per cent of all cells, real and said."""
    names, rows = read_table(bench.work / "cells.tsv")
    by_key = {cluster["key"]: cluster for cluster in every["clusters"] if cluster["key"] in names}
    ranked, spread, found = list(by_key), sorted(by_key), []
    for tenth in CHECKED:
        number = max(2, round(tenth * judged["maps"]))
        choices = {"ours": ranked[:number], "every n-th": every_nth(spread, number)}
        for name, chosen in choices.items():
            cloud = bench.fuse({**every, "clusters": [by_key[key] for key in chosen]}, 1.0)
            real = reference.covered(cKDTree(cloud), 2)[0]
            mask = sum(1 << names.index(key) for key in chosen)
            said = 100 * sum(cells for cells, maps in rows if (maps & mask).bit_count() >= LEAST[bench.args.matcher]) / sum(cells for cells, _ in rows)
            found.append({"order": name, "maps": number, "real": real, "said": said})
            print(f"{number:4} {name:12} real {real:5.1f}, said {said:5.1f}", flush=True)
    return found


def read_table(path):
    head, *lines = path.read_text(encoding="utf-8").rstrip("\n").split("\n")
    rows = [line.split("\t") for line in lines]
    return head.split("\t"), [(int(cells), int(maps, 16)) for cells, _, maps in rows]


class Colmap(Bench):
    """A workspace in which run.sh matches all key views; each fusion takes some of its maps."""

    def match_all(self, plan, scale):
        workspace = self.maps(scale)
        if not workspace.exists():
            shutil.copytree(self.project / "viewrank/colmap", workspace, symlinks=True)
        for kind in ("depth_maps", "normal_maps") if self.args.maps else ():
            shutil.copytree(self.args.maps / "stereo" / kind, workspace / "stereo" / kind, dirs_exist_ok=True)
        self.start(workspace, self.fusion() if self.args.maps else ["sh", "stereo/viewrank/run.sh"])

    def program(self):
        found = shutil.which(self.args.colmap) or sys.exit(f"error: no program {self.args.colmap}: give --colmap")
        return str(Path(found).resolve())

    def start(self, workspace, command):
        done = subprocess.run(command, cwd=workspace, env={**os.environ, "COLMAP": self.program()}, capture_output=True, text=True)
        if done.returncode:
            sys.exit(done.stdout + done.stderr)

    def fusion(self, pixels=PIXELS[0]):
        """The last command of the export, with another number of pixels."""
        record = json.loads((self.project / "viewrank/colmap/stereo/viewrank/export.json").read_text())
        command = re.sub(r"(--StereoFusion.min_num_pixels) \d+", rf"\1 {pixels}", record["commands"][-1])
        return [self.program(), *command.split()[1:]]

    def cloud(self):
        return self.maps(1.0) / "stereo/viewrank/fused.ply"

    def map_of(self, key):
        return f"stereo/depth_maps/{key}.photometric.bin"

    def fuse(self, plan, scale, pixels=PIXELS[0]):
        """Points of the cloud of the plan's maps, n x 3, of those that were matched above."""
        workspace, keys = self.maps(scale), {cluster["key"] for cluster in plan["clusters"]}
        exported = self.project / "viewrank/colmap/stereo/fusion.cfg"
        listed = [key for key in exported.read_text().splitlines() if key in keys]
        (workspace / "stereo/fusion.cfg").write_text("".join(f"{key}\n" for key in listed))
        self.start(workspace, self.fusion(pixels))
        return colmap_cuda.read_cloud(self.cloud())


class PatchmatchNet(Bench):
    """Matched in the project, from which the maps are moved: plans change where maps are there."""

    def match_all(self, plan, scale):
        command = [self.args.viewrank, "run", self.project, "--backend", "patchmatchnet", "--budget", "100%", "--target", "100%", "--quiet"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        shutil.move(self.project / "viewrank/patchmatchnet", self.maps(scale))
        self.plan("--budget", "100%", "--target", "100%")

    def names(self):
        return ["view_names.txt"]

    def number_of(self):
        """Number of each view in the export."""
        lines = (self.maps(1.0) / "view_names.txt").read_text(encoding="utf-8").splitlines()
        return {name: int(number) for number, name in (line.split(maxsplit=1) for line in lines)}

    def map_of(self, key):
        return f"depths/depth_est/{self.number_of()[key]:08}.pfm"

    def fuse(self, plan, scale):
        """Points of the cloud of the plan's maps, n x 3, by the program's own fusion with the options of run.sh."""
        whole, joined, number_of = self.maps(scale), (self.work / "joined").resolve(), self.number_of()
        keys = {number_of[cluster["key"]] for cluster in plan["clusters"]}
        _, *lines = (whole / "fuse/pair.txt").read_text().splitlines()
        entries = []
        for key, others in zip(lines[::2], lines[1::2]):
            words = others.split()[1:]
            there = [pair for pair in zip(words[::2], words[1::2]) if int(pair[0]) in keys][:FUSED_WITH]
            if int(key) in keys and there:
                entries.append(f"{key}\n{len(there)} " + " ".join(f"{other} {score}" for other, score in there) + "\n")
        shutil.rmtree(joined, ignore_errors=True)
        (joined / "depths").mkdir(parents=True)
        (joined / "pair.txt").write_text(f"{len(entries)}\n" + "".join(entries))
        for folder in ("cams", "images", "depths/depth_est", "depths/confidence"):
            (joined / folder).symlink_to((whole / folder).resolve())
        checkpoint = os.environ.get("CHECKPOINT", "checkpoints/params_000007.ckpt")
        options = re.search(r"--output_type fusion .*(?=\))", (whole / "run.sh").read_text())[0].split()
        folders = ["--input_folder", joined, "--output_folder", joined / "depths"]
        command = [os.environ.get("PYTHON", "python3"), "eval.py", *folders, "--checkpoint_path", checkpoint, *options]
        subprocess.run(command, cwd=os.environ["PATCHMATCHNET"], check=True, stdout=subprocess.DEVNULL)
        return positions((joined / "depths/fused.ply").read_bytes())


if __name__ == "__main__":
    sys.exit(main())
