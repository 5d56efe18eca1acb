//! The schemas in the repository are those of the program.
//!
//! After a change of a format or of a setting: `VIEWRANK_WRITE_SCHEMA=1 cargo test --test it
//! schema::`.

use std::{env, fs, path::Path};

use schemars::{Schema, schema_for};
use viewrank::{
    Settings,
    daemon::{follow::Progress, phase::Status},
    doctor::Diagnosis,
    manifest::Manifest,
};

fn compare(name: &str, schema: &Schema) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("schema")
        .join(name);
    let text = serde_json::to_string_pretty(schema).unwrap() + "\n";
    if env::var_os("VIEWRANK_WRITE_SCHEMA").is_some() {
        fs::write(&path, &text).unwrap();
    }
    assert!(
        fs::read_to_string(&path).unwrap() == text,
        "{name} is out of date: see the head of this test"
    );
}

#[test]
fn schema_of_the_manifest() {
    compare("manifest.schema.json", &Manifest::schema());
}

#[test]
fn schema_of_the_progress() {
    compare("progress.schema.json", &schema_for!(Progress));
}

#[test]
fn schema_of_the_status() {
    compare("status.schema.json", &schema_for!(Status));
}

#[test]
fn schema_of_the_diagnosis() {
    compare("doctor.schema.json", &schema_for!(Diagnosis));
}

#[test]
fn schema_of_the_settings() {
    compare("viewrank.schema.json", &schema_for!(Settings));
}

#[test]
fn every_field_of_the_manifest_is_documented() {
    let schema = Manifest::schema();
    let parts = schema
        .get("$defs")
        .and_then(|defs| defs.as_object())
        .unwrap();
    let all = parts
        .iter()
        .map(|(name, part)| (name.as_str(), part))
        .chain([("", schema.as_value())]);
    let mut undocumented = Vec::new();
    for (part, schema) in all {
        for (name, field) in schema
            .get("properties")
            .and_then(|p| p.as_object())
            .into_iter()
            .flatten()
        {
            // A reference alone shows the description of what it refers to.
            let referred = field
                .get("$ref")
                .and_then(|r| r.as_str())
                .and_then(|r| parts.get(r.rsplit('/').next()?));
            if field
                .get("description")
                .or(referred.and_then(|r| r.get("description")))
                .is_none()
            {
                undocumented.push(format!("{part}.{name}"));
            }
        }
    }
    assert!(undocumented.is_empty(), "{undocumented:?}");
}
