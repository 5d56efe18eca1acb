"""The manifest and the settings against their JSON Schemas, by an independent validator."""
import json
import tomllib

import jsonschema
import numpy as np
import pytest


@pytest.fixture(scope="module")
def schemas(fixtures):
    folder = fixtures.parent / "schema"
    return {path.name: json.loads(path.read_text()) for path in folder.glob("*.schema.json")}


@pytest.fixture(scope="module")
def project(viewrank, fixtures, tmp_path_factory):
    """A planned project with the fixture's model and images, one image more than the model knows, and a target in metres."""
    project = tmp_path_factory.mktemp("project")
    (project / "sparse").symlink_to(fixtures / "valley" / "sparse")
    images = project / "images"
    images.mkdir()
    for image in (fixtures / "valley" / "images").iterdir():
        (images / image.name).symlink_to(image)
    (images / "new.jpg").symlink_to(fixtures / "valley" / "images" / "grid_031.jpg")
    (project / "viewrank.toml").write_text('units = "metric"\ntarget.gsd = 0.04\ncut.target = "80%"\n')
    viewrank("plan", project, "--backend", "sgm", "--dump-tables", project / "tables")
    return project


def test_the_manifest_is_as_its_schema_says(schemas, project):
    manifest = json.loads((project / "viewrank" / "manifest.json").read_text())
    schema = schemas["manifest.schema.json"]
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(manifest, schema)
    assert set(manifest) == set(schema["properties"]), "every documented field is there, and no other"
    assert manifest["unregistered"] == ["new.jpg"]


def test_a_manifest_with_a_wrong_field_is_refused(schemas, project):
    manifest = json.loads((project / "viewrank" / "manifest.json").read_text())
    manifest["views"][0]["status"] = "perhaps"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(manifest, schemas["manifest.schema.json"])


def test_settings_files_are_as_their_schema_says(schemas, project, viewrank):
    jsonschema.validate(tomllib.loads((project / "viewrank.toml").read_text()), schemas["viewrank.schema.json"])
    printed = viewrank("config", project).stdout
    settings = tomllib.loads(printed)
    jsonschema.validate(settings, schemas["viewrank.schema.json"])
    assert settings["target"]["gsd"] == 0.04 and settings["units"] == "metric"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({"target": {"gds": 1}}, schemas["viewrank.schema.json"])


def test_the_tables_have_the_shapes_and_types_that_are_promised(project):
    table = {path.stem: np.load(path) for path in (project / "tables").glob("*.npy")}
    views = len(json.loads((project / "tables" / "views.json").read_text()))
    expected = {
        "vertices": ("<f8", 2), "triangles": ("<u4", 2), "weight": ("<f8", 1), "visible": ("<u4", 2), "unary": ("<f4", 1), "candidates": ("<u4", 1),
        "candidate_offsets": ("<u8", 1), "partners": ("<u4", 1), "partner_offsets": ("<u8", 1), "cluster_key": ("<u4", 1),
        "fulfilment": ("<u4", 2), "fulfilment_value": ("<f4", 1), "order": ("<u4", 1), "gain": ("<f8", 1),
    }
    for name, (dtype, dimensions) in expected.items():
        assert (table[name].dtype.str, table[name].ndim) == (dtype, dimensions), name
    assert len(table["candidate_offsets"]) == views + 1
    assert len(table["partner_offsets"]) == len(table["cluster_key"]) + 1
    assert len(table["unary"]) == len(table["visible"]) and len(table["fulfilment_value"]) == len(table["fulfilment"])
    rows = table["visible"].astype(np.int64)
    assert (np.diff(rows[:, 0] * len(table["triangles"]) + rows[:, 1]) > 0).all(), "sorted by view, then triangle, no row twice"
