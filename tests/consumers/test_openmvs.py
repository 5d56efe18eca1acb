"""OpenMVS's DensifyPointCloud and InterfaceCOLMAP (OPENMVS_BIN): `run.py` as printed, against DensifyPointCloud on the whole scene with all of its defaults."""
from conftest import call, clusters_of
from measure import assert_as_good, measure, read_dmap, read_ply


def test_maps_partners_and_cloud_are_as_good_as_its_own_choice(planned, program, views, source, tmp_path):
    densify, interface = program("OPENMVS_BIN", "DensifyPointCloud"), program("OPENMVS_BIN", "InterfaceCOLMAP")
    _, export = planned("openmvs")
    clusters, record = clusters_of(export)
    call(["python3", "run.py", "--densify", str(densify)], export)
    ids = {image.image_id: name for name, image in views.images.items()}
    ours = {}
    for key, partners in clusters:
        depth, _, used = read_dmap(export / f"depth{views.images[key].image_id:04}.dmap")
        assert ids[used[0]] == key and {ids[i] for i in used[1:]} == set(partners), f"{key}: made with {[ids[i] for i in used]}"
        ours[key] = depth

    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    (scene / "sparse").mkdir()
    for name in ("cameras", "images", "points3D"):
        (scene / f"sparse/{name}.bin").symlink_to(source / f"sparse/0/{name}.bin")
    for name in views.names():
        (scene / "images" / name).symlink_to(source / "images" / name)
    call([interface, "-w", str(scene), "-i", str(scene), "-o", "scene.mvs", "--image-folder", str(scene / "images")], scene)
    size = max(next(iter(ours.values())).shape)
    call([densify, "-w", str(scene), "-i", "scene.mvs", "--resolution-level", "0", "--min-resolution", "16", "--max-resolution", str(size)], scene)
    default = {}
    for path in scene.glob("depth*.dmap"):
        depth, image, _ = read_dmap(path)
        name = image.replace("\\", "/").rsplit("/", 1)[1]
        if name in ours:
            default[name] = depth
    assert_as_good(measure(views, ours), measure(views, default))
    cloud = read_ply(export / "fused.ply")
    print(f"{len(cloud)} points in the cloud; {len(read_ply(scene / 'scene_dense.ply'))} in that of all {len(views.names())} maps")
    assert len(cloud) > 1000
