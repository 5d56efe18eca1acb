"""views.geojson and surface.ply read by other programs: positions checked with PROJ, scalar fields with plyfile."""
import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pyproj = pytest.importorskip("pyproj")
plyfile = pytest.importorskip("plyfile")


def planned(viewrank, model, folder, settings=""):
    folder.mkdir()
    (folder / "sparse").symlink_to(model)
    (folder / "viewrank.toml").write_text(settings)
    viewrank("plan", folder, "--quiet")
    found = [folder / "viewrank" / name for name in ("views.geojson", "views_local.json")]
    [file] = [file for file in found if file.exists()]
    collection = json.loads(file.read_text())
    assert (file.name == "views_local.json") == ("crs" in collection) == ("not WGS 84" in collection.get("note", "")), "GIS programs take .geojson for WGS 84"
    return collection


def camera_points(collection):
    return {f["properties"]["name"]: f["geometry"]["coordinates"] for f in collection["features"] if f["properties"]["what"] == "camera"}


def check_is_geojson(collection):
    """RFC 7946: a polygon's first ring closes and runs counter-clockwise."""
    assert collection["type"] == "FeatureCollection"
    for feature in collection["features"]:
        assert set(feature) == {"type", "geometry", "properties"} and feature["type"] == "Feature"
        for ring in rings(feature):
            assert len(ring) >= 4 and ring[0] == ring[-1]
            assert signed_area(ring) > 0
        if feature["properties"]["what"] == "camera":
            assert feature["geometry"]["type"] == "Point" and len(feature["geometry"]["coordinates"]) == 3


def rings(feature):
    """Returns the rings of a footprint, in one part or in two."""
    geometry = feature["geometry"]
    polygons = {"Point": [], "Polygon": [geometry["coordinates"]], "MultiPolygon": geometry["coordinates"]}[geometry["type"]]
    assert all(len(polygon) == 1 for polygon in polygons)
    return [polygon[0] for polygon in polygons]


def signed_area(ring):
    """Positive where it runs counter-clockwise."""
    x, y = np.array(ring)[:, :2].T
    x, y = x - x[0], y - y[0]
    return 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])


def footprint_areas(collection):
    found = {}
    for feature in collection["features"]:
        for ring in rings(feature):
            name = feature["properties"]["name"]
            found[name] = found.get(name, 0) + signed_area(ring)
    return found


def centres(model):
    pycolmap = pytest.importorskip("pycolmap")
    images = pycolmap.Reconstruction(str(model)).images.values()
    return {image.name: np.array(image.projection_center()) for image in images}


def test_a_model_of_unknown_place_says_so(viewrank, fixtures, tmp_path):
    model = fixtures / "valley" / "sparse"
    collection = planned(viewrank, model, tmp_path / "local")
    check_is_geojson(collection)
    assert collection["crs"] is None and "local" in collection["frame"]
    manifest = json.loads((tmp_path / "local" / "viewrank" / "manifest.json").read_text())
    ranks = {cluster["key"]: (cluster["rank"], cluster["gain"]) for cluster in manifest["clusters"]}
    for feature in collection["features"]:
        properties = feature["properties"]
        assert (properties["rank"], properties["gain"]) == ranks.get(properties["name"], (None, None))
    assert [(f["properties"]["name"], f["properties"]["status"]) for f in collection["features"] if f["properties"]["what"] == "camera"] == [
        (view["name"], view["status"]) for view in manifest["views"]]
    for name, centre in centres(model / "0").items():
        assert camera_points(collection)[name] == pytest.approx(centre, abs=1e-5)


def test_a_turned_model_is_shown_from_above(viewrank, fixtures, tmp_path):
    """Structure from motion leaves models in any orientation: footprints are as large as in one whose third axis is up."""
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(fixtures / "valley" / "sparse" / "0"))
    half = np.sin(np.radians(55))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(np.array([half * 0.8, half * 0.6, 0, np.cos(np.radians(55))])), [3, -2, 8]))
    turned = tmp_path / "model" / "0"
    turned.mkdir(parents=True)
    model.write(str(turned))
    upright = planned(viewrank, fixtures / "valley" / "sparse", tmp_path / "upright")
    collection = planned(viewrank, turned.parent, tmp_path / "turned")
    check_is_geojson(collection)
    axes = np.array(collection["axes"])
    assert np.array(upright["axes"]) == pytest.approx(np.eye(3)) and axes @ axes.T == pytest.approx(np.eye(3))
    for name, centre in centres(turned).items():
        assert camera_points(collection)[name] == pytest.approx(axes @ centre, abs=1e-5)
    before, after = footprint_areas(upright), footprint_areas(collection)
    assert before.keys() == after.keys()
    ratios = [after[name] / before[name] for name in before]
    assert np.median(ratios) == pytest.approx(1, abs=0.1)


def test_a_survey_over_the_180th_meridian(viewrank, fixtures, tmp_path):
    model = fixtures / "valley" / "sparse"
    centre = np.mean(list(centres(model / "0").values()), axis=0)
    # The meridian through the middle of the cameras.
    longitude = 180 - np.degrees(centre[0] / (6_378_137 * np.cos(np.radians(17))))
    collection = planned(viewrank, model, tmp_path / "fiji", f"frame.origin = [-17.0, {longitude}, 0.0]\n")
    plain = planned(viewrank, model, tmp_path / "plain", f"frame.origin = [-17.0, {longitude - 10}, 0.0]\n")
    check_is_geojson(collection)
    cut = 0
    for feature in collection["features"]:
        for ring in rings(feature):
            x = np.array(ring)[:, 0]
            assert -180 <= x.min() and x.max() <= 180 and x.max() - x.min() < 1
        cut += feature["geometry"]["type"] == "MultiPolygon"
    assert cut > 0 and {np.sign(point[0]) for point in camera_points(collection).values()} == {-1, 1}
    areas, expected = footprint_areas(collection), footprint_areas(plain)
    assert {name: areas[name] / expected[name] for name in expected} == pytest.approx(dict.fromkeys(expected, 1), abs=1e-2)


def test_east_north_up_at_an_origin(viewrank, fixtures, tmp_path):
    latitude, longitude, height = 41.4, -81.89, 250.0
    collection = planned(viewrank, fixtures / "valley" / "sparse", tmp_path / "enu", f"frame.origin = [{latitude}, {longitude}, {height}]\n")
    check_is_geojson(collection)
    assert "crs" not in collection
    chain = f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={longitude} +lat_0={latitude} +h_0={height} +step +inv +proj=cart +ellps=WGS84"
    proj = pyproj.Transformer.from_pipeline(chain)
    for name, centre in centres(fixtures / "valley" / "sparse" / "0").items():
        lon, lat, up = proj.transform(*centre)
        if abs(lon) < 4:  # some versions of PROJ answer in radians here
            lon, lat = np.degrees([lon, lat])
        assert camera_points(collection)[name][:2] == pytest.approx([lon, lat], abs=1e-8)
        assert camera_points(collection)[name][2] == pytest.approx(up, abs=1e-3)


@pytest.mark.parametrize(("zone", "epsg", "offset"), [("33N", 32633, (412_345.0, 5_400_000.0)), ("18S", 32718, (700_000.0, 8_600_000.0))])
def test_utm(viewrank, fixtures, tmp_path, zone, epsg, offset):
    collection = planned(viewrank, fixtures / "valley" / "sparse", tmp_path / "utm", f'frame.utm = "{zone}"\nframe.offset = [{offset[0]}, {offset[1]}]\n')
    check_is_geojson(collection)
    proj = pyproj.Transformer.from_crs(epsg, 4326, always_xy=True)
    for name, centre in centres(fixtures / "valley" / "sparse" / "0").items():
        lon, lat = proj.transform(centre[0] + offset[0], centre[1] + offset[1])
        assert camera_points(collection)[name][:2] == pytest.approx([lon, lat], abs=1e-8)


def test_earth_centred_models_and_the_photographs_places(viewrank, data, tmp_path):
    """lewis, moved to earth-centred coordinates by its GPS origin: its views are where the photographs were taken."""
    pycolmap = pytest.importorskip("pycolmap")
    rows = [line.split(",") for line in (data("lewis") / "gps.csv").read_text().splitlines()[1:]]
    gps = {row[0]: [float(value) for value in row[1:7]] for row in rows}
    first = next(iter(gps.values()))
    # The origin of the local frame follows from any row: its place, less its east, north and up.
    to_ecef = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    lat, lon = np.radians(first[:2])
    axes = np.array([[-np.sin(lon), np.cos(lon), 0], [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
                     [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]])
    place = np.array(to_ecef.transform(first[1], first[0], first[2]))
    origin = place - axes.T @ np.array(first[3:6])
    reconstruction = pycolmap.Reconstruction(str(data("lewis") / "sparse" / "0"))
    reconstruction.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(axes.T), origin))
    model = tmp_path / "model" / "0"
    model.mkdir(parents=True)
    reconstruction.write(str(model))
    collection = planned(viewrank, model.parent, tmp_path / "ecef")
    check_is_geojson(collection)
    assert "earth-centred" in collection["frame"]
    shown = camera_points(collection)
    metres = [np.hypot(*((np.array(shown[name][:2]) - [gps[name][1], gps[name][0]]) * [111_320 * np.cos(lat), 111_130])) for name in shown]
    assert np.median(metres) < 10, "the README of the data says 29 of 52 within 6 m"


def test_opensfm_says_where_it_is(viewrank, data, tmp_path):
    shutil.copytree(data("formats/others/opensfm_berlin"), tmp_path / "opensfm", copy_function=shutil.copyfile)
    (tmp_path / "opensfm" / "reference_lla.json").write_text('{"latitude": 10.0, "longitude": 20.0, "altitude": 30.0}')
    # Three views that most programs cannot match.
    done = viewrank("plan", tmp_path / "opensfm", "--quiet", "--backend", "images", "--confidence", "none")
    assert done.returncode == 0
    collection = json.loads((tmp_path / "opensfm" / "viewrank" / "views.geojson").read_text())
    check_is_geojson(collection)
    shots = json.loads((tmp_path / "opensfm" / "reconstruction.json").read_text())[0]["shots"]
    chain = "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0=20 +lat_0=10 +h_0=30 +step +inv +proj=cart +ellps=WGS84"
    proj = pyproj.Transformer.from_pipeline(chain)
    shown = camera_points(collection)
    assert shown
    for name, (lon, lat, up) in shown.items():
        shot = shots[name]
        rotation = Rotation.from_rotvec(shot["rotation"]).as_matrix()
        expected = proj.transform(*(-rotation.T @ shot["translation"]))
        # Some versions of PROJ answer in radians here.
        expected = [*(np.degrees(expected[:2]) if abs(expected[0]) < 4 else expected[:2]), expected[2]]
        assert [lon, lat] == pytest.approx(expected[:2], abs=1e-8) and up == pytest.approx(expected[2], abs=1e-3)


def test_the_fields_of_the_surface_are_seen_by_another_reader(viewrank, fixtures, tmp_path):
    planned(viewrank, fixtures / "valley" / "sparse", tmp_path / "ply")
    ply = plyfile.PlyData.read(str(tmp_path / "ply" / "viewrank" / "surface.ply"))
    faces, vertices = ply["face"].data, ply["vertex"].data
    assert {"quality", "chosen_views", "reason", "red", "green", "blue"} <= set(faces.dtype.names)
    corners, count = np.stack(faces["vertex_indices"]), len(vertices)
    at_vertices = lambda values: np.bincount(corners.ravel(), np.repeat(values, 3), count) / np.bincount(corners.ravel(), minlength=count)  # noqa: E731
    for name in ("quality", "chosen_views"):
        assert vertices[f"scalar_{name}"] == pytest.approx(at_vertices(faces[name]), abs=1e-5)
    largest = np.zeros(count)
    np.maximum.at(largest, corners.ravel(), np.repeat(faces["reason"], 3))
    assert (vertices["scalar_reason"] == largest).all()
    assert 0 <= faces["quality"].min() and faces["quality"].max() <= 1 and faces["quality"].max() > 0.5
    manifest = json.loads((tmp_path / "ply" / "viewrank" / "manifest.json").read_text())
    assert (faces["reason"] > 0).sum() == manifest["surface"]["unfulfilled"]
