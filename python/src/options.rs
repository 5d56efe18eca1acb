//! Keywords of `viewrank.plan` as settings.

use std::path::{Path, PathBuf};

use pyo3::{
    exceptions::PyTypeError,
    prelude::*,
    types::{PyBool, PyDict, PyFloat, PyInt, PySequence, PyString},
};
use toml::Value;
use viewrank::{
    Advice, Project, Settings, backends,
    config::{CommandLineSettings, Configuration, Files, RegionChoice, user_file},
    metres_per_unit,
};

use crate::failure::Failure;

/// Keywords and the settings that they set; the program has an option `--KEYWORD` for each.
const KEYWORDS: [(&str, &str); 20] = [
    ("mesh_as_is", "surface.mesh_as_is"),
    ("test_every", "test_every"),
    ("max_memory", "max_memory"),
    ("confidence", "confidence.source"),
    ("accuracy", "target.accuracy"),
    ("partners", "partners.method"),
    ("backend", "backends"),
    ("surface", "surface.kind"),
    ("budget", "cut.budget"),
    ("target", "cut.target"),
    ("points", "cut.points"),
    ("region", "region"),
    ("mesh", "surface.mesh"),
    ("pilot", "pilot.maps"),
    ("seed", "seed"),
    ("time", "cut.time"),
    ("gsd", "target.gsd"),
    ("up", "surface.up"),
    ("k", "partners.k"),
    // No setting: advice names it, and `plan()` takes it by itself.
    ("model", ""),
];

/// Writes advice for those who call `plan()`: settings as its keywords, `gsd=`.
pub fn as_keywords(advice: &Advice) -> String {
    advice.describe(|key, value| {
        let is_meant = |(keyword, known): &&(&str, &str)| *known == key || *keyword == key;
        let Some((keyword, _)) = KEYWORDS.iter().find(is_meant) else {
            return format!("--{key}");
        };
        match value {
            None => format!("{keyword}="),
            Some(value) if value.parse::<f64>().is_ok() => format!("{keyword}={value}"),
            Some(value) => format!("{keyword}=\"{value}\""),
        }
    })
}

/// The settings of the user's file, the project's file and the keywords, later ones first.
pub fn load(root: &Path, typed: CommandLineSettings) -> Result<Settings, Failure> {
    let files = Files {
        user: user_file(),
        root: None,
        project: Some(root.join("viewrank.toml")),
    };
    let metres = |settings: &Settings| {
        metres_per_unit(&Project::open_or_planned(root, None).ok()?, settings).ok()?
    };
    let lookup = backends::canonical_name;
    Ok(Configuration::load_for(&files, typed, lookup, &metres)?.settings)
}

/// Takes the keywords of `plan()`, and a dictionary `settings` of other settings by key.
pub fn typed(keywords: &Bound<'_, PyDict>) -> PyResult<CommandLineSettings> {
    let mut typed = CommandLineSettings::default();
    for (name, value) in keywords {
        let name: String = name.extract()?;
        if value.is_none() {
            continue;
        }
        if name == "settings" {
            for (key, value) in value.cast::<PyDict>()? {
                let key: String = key.extract()?;
                typed.set("settings", &key, Some(amount(&key, &value)?));
            }
            continue;
        }
        let known = KEYWORDS
            .iter()
            .find(|(keyword, key)| *keyword == name && !key.is_empty());
        let (keyword, key) =
            known.ok_or_else(|| PyTypeError::new_err(format!("unknown keyword {name}")))?;
        typed.set(keyword, key, Some(amount(key, &value)?));
    }
    Ok(typed)
}

/// The value of a setting; shares, seconds and boxes in the form in which the program takes them.
fn amount(key: &str, value: &Bound<'_, PyAny>) -> PyResult<Value> {
    let number = value
        .extract::<f64>()
        .ok()
        // To Python, True is a number.
        .filter(|_| !value.is_instance_of::<PyBool>());
    let is_whole = value.is_instance_of::<PyInt>();
    let text = match (key, number) {
        // 0.9 is 90 %, 1 is all; 90 is what `--target 90` is.
        ("cut.target", Some(share)) if share <= 1.0 => Some(format!("{}%", 100.0 * share)),
        ("cut.target", Some(percent)) => Some(percent.to_string()),
        ("cut.budget", Some(share)) if !is_whole => Some(format!("{}%", 100.0 * share)),
        ("cut.time", Some(seconds)) => Some(format!("{seconds}s")),
        ("cut.points" | "max_memory", Some(count)) => Some(format!("{count}")),
        ("region", None) if !value.is_instance_of::<PyString>() => {
            match value.extract::<[f64; 6]>() {
                Ok(corners) => Some(corners.map(|x| x.to_string()).join(",")),
                Err(_) => Some(absolute(&value.extract::<PathBuf>()?)),
            }
        }
        ("surface.mesh" | "pilot.maps", _) => Some(absolute(&value.extract::<PathBuf>()?)),
        ("backends", _) if value.is_instance_of::<PyString>() => {
            return Ok(Value::Array(vec![value.extract::<String>()?.into()]));
        }
        _ => None,
    };
    let value = text.map_or_else(|| setting(value), |text| Ok(text.into()))?;
    Ok(match (key, value.as_str()) {
        ("region", Some(text)) if RegionChoice::is_file(text) => absolute(Path::new(text)).into(),
        _ => value,
    })
}

fn absolute(path: &Path) -> String {
    std::path::absolute(path)
        .unwrap_or(path.into())
        .to_string_lossy()
        .into_owned()
}

fn setting(value: &Bound<'_, PyAny>) -> PyResult<Value> {
    if value.is_instance_of::<PyBool>() {
        return Ok(value.extract::<bool>()?.into());
    }
    // Before the real numbers, to which Python converts it too.
    if let Ok(whole) = value.extract::<i64>() {
        return Ok(whole.into());
    }
    if value.is_instance_of::<PyFloat>() || value.extract::<f64>().is_ok() {
        return Ok(value.extract::<f64>()?.into());
    }
    if let Ok(text) = value.extract::<String>() {
        return Ok(text.into());
    }
    if let Ok(members) = value.cast::<PySequence>() {
        return members
            .try_iter()?
            .map(|member| setting(&member?))
            .collect::<PyResult<Vec<Value>>>()
            .map(Value::Array);
    }
    value
        .extract::<PathBuf>()
        .map(|path| absolute(&path).into())
}
