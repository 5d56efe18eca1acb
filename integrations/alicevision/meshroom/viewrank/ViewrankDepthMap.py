"""Depth maps of the views that are worth one, in place of DepthMap, DepthMapFilter and Meshing."""

__version__ = "1.0"

from meshroom.core import desc


class ViewrankDepthMap(desc.CommandLineNode):
    commandLine = (
        'sh "{nodeSourceCodeFolder}/plan_and_match.sh" "{inputValue}" "{imagesFolderValue}" "{nodeCacheFolder}" '
        "{partnersValue} {targetValue} {matchValue}"
    )
    gpu = desc.Level.INTENSIVE
    category = "Dense Reconstruction"
    documentation = """
viewrank plans which views get a depth map, with which partners and in which order, and AliceVision computes these depth maps, best first. The maps
are then filtered and meshed. `viewrank` has to be on the PATH.

`input` is a .sfm file as text: put ConvertSfMFormat before the node where structure from motion wrote .abc.
"""

    inputs = [
        desc.File(
            name="input",
            label="SfMData",
            description="Model of PrepareDenseScene's images, a .sfm file as text.",
            value="",
        ),
        desc.File(
            name="imagesFolder",
            label="Images Folder",
            description="Undistorted images of PrepareDenseScene.",
            value="",
        ),
        desc.IntParam(
            name="partners",
            label="Partners",
            description="Matching partners per key view. More give more image pairs to match.",
            value=5,
            range=(1, 20, 1),
        ),
        desc.FloatParam(
            name="target",
            label="Target",
            description="Stop at this share of the area that all depth maps together would cover, per cent.",
            value=90.0,
            range=(1.0, 100.0, 1.0),
        ),
        desc.BoolParam(
            name="match",
            label="Match",
            description="Compute the depth maps. Off: plan only, and see the report.",
            value=True,
        ),
    ]

    outputs = [
        desc.File(
            name="report",
            label="Report",
            description="Which views, with which partners, and why.",
            value="{nodeCacheFolder}/project/viewrank/report.html",
        ),
        desc.File(
            name="depthMapsFolder",
            label="Depth Maps Folder",
            description="Depth maps of the key views, not filtered.",
            value="{nodeCacheFolder}/project/viewrank/alicevision/depthMaps",
        ),
        desc.File(
            name="output",
            label="SfMData",
            description="The key views that have a depth map, with the dense point cloud.",
            value="{nodeCacheFolder}/project/viewrank/alicevision/dense.abc",
        ),
        desc.File(
            name="mesh",
            label="Mesh",
            description="The mesh, for MeshFiltering and Texturing.",
            value="{nodeCacheFolder}/project/viewrank/alicevision/mesh.obj",
        ),
    ]
