"""views.geojson and surface.ply as other programs see them: places on the earth by PROJ, scalar fields by plyfile."""
import json
import shutil

import numpy as np
import pytest

pyproj = pytest.importorskip("pyproj")
plyfile = pytest.importorskip("plyfile")


def planned(viewrank, model, folder, settings=""):
    folder.mkdir()
    (folder / "sparse").symlink_to(model)
    (folder / "viewrank.toml").write_text(settings)
    viewrank("plan", folder, "--quiet")
    return json.loads((folder / "viewrank" / "views.geojson").read_text())


def camera_points(collection):
    return {f["properties"]["name"]: f["geometry"]["coordinates"] for f in collection["features"] if f["properties"]["what"] == "camera"}


def check_is_geojson(collection):
    """RFC 7946: a polygon's first ring closes and runs counter-clockwise."""
    assert collection["type"] == "FeatureCollection"
    for feature in collection["features"]:
        assert set(feature) == {"type", "geometry", "properties"} and feature["type"] == "Feature"
        if feature["geometry"]["type"] == "Polygon":
            (ring,) = feature["geometry"]["coordinates"]
            assert len(ring) >= 4 and ring[0] == ring[-1]
            x, y = np.array(ring)[:, :2].T
            x, y = x - x[0], y - y[0]
            assert np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0
        else:
            assert feature["geometry"]["type"] == "Point" and len(feature["geometry"]["coordinates"]) == 3


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
    """lewis, moved to earth-centred coordinates by its GPS origin: its views lie where the photographs were taken."""
    pycolmap = pytest.importorskip("pycolmap")
    rows = [line.split(",") for line in (data / "lewis" / "gps.csv").read_text().splitlines()[1:]]
    gps = {row[0]: [float(value) for value in row[1:7]] for row in rows}
    first = next(iter(gps.values()))
    # The origin of the local frame follows from any row: its place, less its east, north and up.
    to_ecef = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    lat, lon = np.radians(first[:2])
    axes = np.array([[-np.sin(lon), np.cos(lon), 0], [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
                     [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]])
    place = np.array(to_ecef.transform(first[1], first[0], first[2]))
    origin = place - axes.T @ np.array(first[3:6])
    reconstruction = pycolmap.Reconstruction(str(data / "lewis" / "sparse" / "0"))
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
    source = next(iter(sorted((data / "formats" / "others").rglob("reconstruction.json"))), None)
    if source is None:
        pytest.skip("no OpenSfM model in the data")
    shutil.copytree(source.parent, tmp_path / "opensfm")
    (tmp_path / "opensfm" / "reference_lla.json").write_text('{"latitude": 10.0, "longitude": 20.0, "altitude": 30.0}')
    done = viewrank("plan", tmp_path / "opensfm", "--quiet")
    assert done.returncode == 0
    collection = json.loads((tmp_path / "opensfm" / "viewrank" / "views.geojson").read_text())
    check_is_geojson(collection)
    for lon, lat, _ in camera_points(collection).values():
        assert abs(lon - 20) < 0.1 and abs(lat - 10) < 0.1


def test_the_fields_of_the_surface_are_seen_by_another_reader(viewrank, fixtures, tmp_path):
    planned(viewrank, fixtures / "valley" / "sparse", tmp_path / "ply")
    ply = plyfile.PlyData.read(str(tmp_path / "ply" / "viewrank" / "surface.ply"))
    faces = ply["face"].data
    assert {"quality", "chosen_views", "reason", "red", "green", "blue"} <= set(faces.dtype.names)
    assert 0 <= faces["quality"].min() and faces["quality"].max() <= 1 and faces["quality"].max() > 0.5
    manifest = json.loads((tmp_path / "ply" / "viewrank" / "manifest.json").read_text())
    assert (faces["reason"] > 0).sum() == manifest["surface"]["unfulfilled"]
