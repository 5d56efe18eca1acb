//! Options that were typed for the last plan, which the next one goes on with.

use std::{
    fmt,
    path::{Component, Path},
};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use toml::Value;

use super::{CommandLineSettings, Entry, PathValue, SettingLocation, path_outside};
use crate::base::shell::command_word;

/// The options of `viewrank plan` that a run goes on with. Others of a plan, which may be a
/// stranger's, do not count.
const OPTIONS: [(&str, &str); 21] = [
    ("partners.k", "-k"),
    ("cut.budget", "--budget"),
    ("cut.target", "--target"),
    ("cut.time", "--time"),
    ("cut.points", "--points"),
    ("test_every", "--test-every"),
    ("region", "--region"),
    ("target.gsd", "--gsd"),
    ("target.accuracy", "--accuracy"),
    ("ranking.scales", "--scales"),
    ("partners.method", "--partners"),
    ("confidence.source", "--confidence"),
    ("surface.kind", "--surface"),
    ("surface.up", "--up"),
    ("surface.mesh", "--mesh"),
    ("surface.mesh_as_is", "--mesh-as-is"),
    ("images", "--images"),
    ("pilot.maps", "--pilot"),
    ("frame.gps", "--no-gps"),
    ("seed", "--seed"),
    ("max_memory", "--max-memory"),
];

/// Longest text of an option, bytes: a path, mostly.
const LONGEST: usize = 4096;

fn option_of(key: &str) -> Option<&'static str> {
    let of_key = OPTIONS.iter().find(|(known, _)| *known == key);
    of_key.map(|(_, option)| *option)
}

/// A setting that was given on the command line of a plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TypedSetting {
    /// The setting, as `target.gsd`.
    pub key: String,
    /// The value as it was typed; paths are absolute, but those inside the project begin with `./`,
    /// so that it can be moved.
    #[schemars(with = "serde_json::Value")]
    pub value: Value,
    /// Value in the settings files, which it replaced.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<serde_json::Value>")]
    pub instead_of: Option<Value>,
}

impl TypedSetting {
    /// Returns whether it can be an option that was typed: the file may be a stranger's.
    pub fn is_of_plan(&self) -> bool {
        let is_short = |text: &str| text.len() <= LONGEST;
        option_of(&self.key).is_some() && self.value.as_str().is_none_or(is_short)
    }

    /// As it is written for a project, which can be moved with the files in it.
    pub fn written_in(&self, root: &Path) -> Self {
        // With `..` in it, the rest of a path that begins with the folder may lead out again.
        let is_inside = |path: &Path| path.components().all(|c| matches!(c, Component::Normal(_)));
        let inside = PathValue::new(&self.key, &self.value).and_then(|named| {
            let inside = named.path.strip_prefix(root).ok()?;
            inside
                .to_str()
                .filter(|_| is_inside(inside))
                .map(String::from)
        });
        self.with(inside.map(|inside| format!("./{inside}")))
    }

    /// As it was typed, of one that was written for a project.
    pub fn read_in(&self, root: &Path) -> Self {
        let inside = PathValue::new(&self.key, &self.value)
            .and_then(|named| Some(named.path.strip_prefix(".").ok()?.to_owned()));
        self.with(inside.map(|inside| root.join(inside).to_string_lossy().into_owned()))
    }

    fn with(&self, path: Option<String>) -> Self {
        Self {
            value: path.map_or_else(|| self.value.clone(), Value::from),
            ..self.clone()
        }
    }

    /// Returns whether it names a file outside of a project that the project's own files, which may
    /// be a stranger's, may not name.
    pub fn leads_out(&self, root: &Path) -> bool {
        path_outside(&self.key, &self.value, root).is_some()
    }
}

impl fmt::Display for TypedSetting {
    /// Writes the option as in a command.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let word = |value: &Value| match value {
            Value::String(text) => text.clone(),
            value => value.to_string(),
        };
        let option = option_of(&self.key).unwrap_or(&self.key);
        let value = match &self.value {
            // The option alone says the value: `--no-gps` is frame.gps = false.
            Value::Boolean(_) => return f.write_str(option),
            Value::Array(members) => members.iter().map(word).collect::<Vec<_>>().join(","),
            value => word(value),
        };
        write!(f, "{option} {}", command_word(&value))
    }
}

/// Options typed for the same purpose replace each other: each limit is one.
fn purpose(key: &str) -> &str {
    if key.starts_with("cut.") { "cut" } else { key }
}

impl CommandLineSettings {
    /// Goes on with the options of the last plan, which may be a stranger's, where none of the same
    /// purpose was typed now, and the files still say what they said then.
    pub fn following(mut self, mut planned: Vec<TypedSetting>) -> Self {
        let is_typed = |then: &TypedSetting| {
            let mut typed = self.typed.iter();
            typed.any(|now| purpose(&now.key) == purpose(&then.key))
        };
        planned.retain(|then| !is_typed(then));
        self.planned = planned;
        self
    }

    /// Returns the entries over those of the files: of the last plan, then those typed now.
    pub(super) fn over(self, files: &[Entry]) -> Vec<Entry> {
        let still = |then: &TypedSetting| value_of(files, &then.key) == then.instead_of.as_ref();
        let planned = self.planned.into_iter().filter(still);
        let planned = planned.filter_map(|then| {
            let place = SettingLocation::LastPlan(option_of(&then.key)?);
            Some(Entry {
                key: then.key,
                value: then.value,
                place,
            })
        });
        planned.chain(self.typed).collect()
    }
}

fn value_of<'a>(entries: &'a [Entry], key: &str) -> Option<&'a Value> {
    let of_key = entries.iter().rev().find(|entry| entry.key == key);
    of_key.map(|entry| &entry.value)
}

/// Returns what the next plan can go on with. Backends are left out: the files of the plan say
/// them.
pub(super) fn typed_settings(files: &[Entry], over: &[Entry]) -> Vec<TypedSetting> {
    let kept = over.iter().filter(|entry| option_of(&entry.key).is_some());
    let setting = |entry: &Entry| TypedSetting {
        key: entry.key.clone(),
        value: entry.value.clone(),
        instead_of: value_of(files, &entry.key).cloned(),
    };
    kept.map(setting).collect()
}
