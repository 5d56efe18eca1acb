#!/usr/bin/env python3
"""Writes finished.sfm: keys.sfm with only those views that have a depth map in depthMaps/. Filtering and meshing open the maps of all views."""
import os
import sys

# The folder may be a stranger's: a json.py that he put there is not imported.
sys.path[:] = [path for path in sys.path if os.path.realpath(path) != os.path.dirname(os.path.realpath(__file__))]

import json
from pathlib import Path

folder = Path(__file__).resolve().parent
scene = json.loads((folder / "keys.sfm").read_text(encoding="utf-8"))
scene["views"] = [view for view in scene["views"] if (folder / f"depthMaps/{view['viewId']}_depthMap.exr").is_file()]
ids = {view["viewId"] for view in scene["views"]}
if not ids:
    sys.exit("error: depthMaps holds no map of a key view")
scene["poses"] = [pose for pose in scene["poses"] if pose["poseId"] in ids]
for landmark in scene["structure"]:
    landmark["observations"] = [seen for seen in landmark["observations"] if seen["observationId"] in ids]
scene["structure"] = [landmark for landmark in scene["structure"] if len(landmark["observations"]) > 1]
# A new file: what somebody has put in the place of the draft is not written.
draft = folder / "finished.sfm.part"
draft.unlink(missing_ok=True)
with open(draft, "x", encoding="utf-8") as file:
    json.dump(scene, file, indent=1)
os.replace(draft, folder / "finished.sfm")
