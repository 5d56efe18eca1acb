//! Settings in force: defaults, over them the user's file, the project's `viewrank.toml`, and the
//! command line.

mod planned;

use std::{
    collections::BTreeMap,
    fmt, io,
    path::{Path, PathBuf},
};

use etcetera::BaseStrategy;
use serde::Deserialize;
use toml::{Table, Value, de::DeTable};

pub use self::planned::TypedSetting;
use self::planned::typed_settings;
use super::{Key, RegionChoice, Settings, keys};
use crate::{
    base::{
        error::{Advice, Hint},
        input::{self, FileKind},
        paths::{absolute, is_outside},
    },
    model::{cluster::MapScale, georeference::Zone},
};

/// Resolves a typed backend name to its canonical name.
pub type BackendLookup = fn(&str) -> Result<&'static str, UnknownBackend>;

/// Unknown backend name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no backend \"{name}\"")]
pub struct UnknownBackend {
    /// As it was typed.
    pub name: String,
    /// Nearest known name.
    pub meant: Option<&'static str>,
    /// The known names, in words.
    pub known: String,
}

impl Hint for UnknownBackend {
    fn hint(&self) -> Option<Advice> {
        let meant = self
            .meant
            .map_or(String::new(), |name| format!("did you mean {name}? "));
        Some(format!("{meant}take one of {}", self.known).into())
    }

    fn is_usage(&self) -> bool {
        true
    }
}

/// Settings files; missing ones are skipped.
#[derive(Clone, Debug, Default)]
pub struct Files {
    pub user: Option<PathBuf>,
    /// `viewrank.toml` of a watched folder, for all projects in it.
    pub root: Option<PathBuf>,
    pub project: Option<PathBuf>,
}

/// Path of `viewrank/viewrank.toml` in the user's configuration folder (`$XDG_CONFIG_HOME`,
/// `~/.config`).
pub fn user_file() -> Option<PathBuf> {
    etcetera::choose_base_strategy()
        .ok()
        .map(|folders| folders.config_dir().join("viewrank/viewrank.toml"))
}

/// Settings from the command line: option, key, value.
#[derive(Clone, Debug, Default)]
pub struct CommandLineSettings {
    typed: Vec<Entry>,
    /// Those of the last plan, in the order of their options.
    planned: Vec<TypedSetting>,
}

impl CommandLineSettings {
    /// Records the value of an option, if given.
    pub fn set(&mut self, option: &'static str, key: &str, value: Option<impl Into<Value>>) {
        if let Some(value) = value {
            self.typed.push(Entry {
                key: key.into(),
                value: value.into(),
                place: SettingLocation::Option(option),
            });
        }
    }

    /// Returns whether all typed options are among these.
    pub fn are_among(&self, options: &[&str]) -> bool {
        self.typed.iter().all(|entry| matches!(entry.place, SettingLocation::Option(option) if options.contains(&option)))
    }
}

/// Location of a value: file and line, or option.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SettingLocation {
    File {
        path: PathBuf,
        line: usize,
    },
    Option(&'static str),
    /// An option of the last plan, which may be a stranger's.
    LastPlan(&'static str),
}

/// Origin of a value in force.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    Default,
    Written(SettingLocation),
}

impl fmt::Display for SettingLocation {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::File { path, line } => write!(f, "{}:{line}", path.display()),
            Self::Option(option) => write!(f, "{option}"),
            Self::LastPlan(option) => write!(f, "{option} of the last plan"),
        }
    }
}

impl Source {
    fn is_option(&self) -> bool {
        matches!(self, Self::Written(SettingLocation::Option(_)))
    }
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Default => write!(f, "default"),
            Self::Written(place) => place.fmt(f),
        }
    }
}

/// A value with its key and location.
#[derive(Clone, Debug)]
struct Entry {
    key: String,
    value: Value,
    place: SettingLocation,
}

/// All settings in force, with the origin of each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Configuration {
    pub settings: Settings,
    pub(super) places: BTreeMap<String, SettingLocation>,
}

impl Configuration {
    /// Loads the settings of the files and the command line; `backend` resolves the name of each
    /// backend.
    pub fn load(
        files: &Files,
        typed: CommandLineSettings,
        backend: BackendLookup,
    ) -> Result<Self, ConfigError> {
        Self::load_for(files, typed, backend, &|_| None)
    }

    /// As [`Self::load`]; `metres` returns how many are in a unit of the model, if that is known.
    /// It is called with the settings that are no lengths, if there is a length with a unit and no
    /// setting `units`.
    pub fn load_for(
        files: &Files,
        typed: CommandLineSettings,
        backend: BackendLookup,
        metres: &dyn Fn(&Settings) -> Option<f64>,
    ) -> Result<Self, ConfigError> {
        let of_project = || [&files.root, &files.project].into_iter().flatten();
        // Errors quote the file, and a stranger's link may lead to any. The user's own may well be
        // a link.
        let linked: Vec<&PathBuf> = of_project().filter(|file| leads_away(file)).collect();
        Self::merged(files, typed, backend, metres)
            .map_err(|error| error.without_words_of(|path| linked.contains(&path)))
    }

    fn merged(
        files: &Files,
        typed: CommandLineSettings,
        backend: BackendLookup,
        metres: &dyn Fn(&Settings) -> Option<f64>,
    ) -> Result<Self, ConfigError> {
        let mut entries = files.user.as_deref().map_or(Ok(Vec::new()), read)?;
        for file in [&files.root, &files.project].into_iter().flatten() {
            let project = read(file)?;
            for entry in &project {
                refuse_commands(entry)?;
                refuse_outside(entry, file)?;
            }
            entries.extend(project);
        }
        let over = typed.over(&entries);
        // Before they join the entries, which still say what the files do.
        let typed = typed_settings(&entries, &over);
        entries.extend(over);
        let is_measured = |entry: &Entry| is_length(entry) && entry.value.is_str();
        let has_units = entries.iter().any(|entry| entry.key == "units");
        let of_model = if entries.iter().any(is_measured) && !has_units {
            let others = entries.iter().filter(|entry| !is_measured(entry)).cloned();
            metres(&Self::over_defaults(others.collect(), backend)?.settings)
        } else {
            None
        };
        convert_lengths(&mut entries, of_model)?;
        let mut configuration = Self::over_defaults(entries, backend)?;
        let is_named = |place: &SettingLocation| match place {
            SettingLocation::File { path, .. } => Some(path) != files.project.as_ref(),
            SettingLocation::Option(_) => true,
            SettingLocation::LastPlan(_) => false,
        };
        configuration.settings.named = ["region", "surface.mesh"]
            .into_iter()
            .filter(|key| configuration.places.get(*key).is_some_and(is_named))
            .filter_map(|key| configuration.settings.file(key))
            .collect();
        configuration.settings.typed = typed;
        Ok(configuration)
    }

    /// Merges entries over the defaults; later ones win.
    fn over_defaults(entries: Vec<Entry>, backend: BackendLookup) -> Result<Self, ConfigError> {
        let mut table = Table::new();
        let mut places = BTreeMap::new();
        for entry in entries {
            // Each by itself: in the merged table, an error has no file and line.
            check(&entry, backend)?;
            insert(&mut table, &entry.key, entry.value);
            places.insert(entry.key, entry.place);
        }
        let mut settings = Settings::deserialize(table).expect("each entry was checked by itself");
        settings.backends =
            proper_names(&settings.backends, backend).expect("each entry was checked by itself");
        let configuration = Self { settings, places };
        configuration.check_together()?;
        Ok(configuration)
    }

    /// Returns the options in force that were typed for the last plan.
    pub fn followed(&self) -> impl Iterator<Item = &TypedSetting> {
        let is_planned = |setting: &&TypedSetting| {
            matches!(
                self.source(&setting.key),
                Source::Written(SettingLocation::LastPlan(_))
            )
        };
        self.settings.typed.iter().filter(is_planned)
    }

    pub fn source(&self, key: &str) -> Source {
        self.places
            .get(key)
            .cloned()
            .map_or(Source::Default, Source::Written)
    }

    /// Checks that depend on several values or on more than type and range.
    pub(super) fn check_together(&self) -> Result<(), ConfigError> {
        let surface = &self.settings.surface;
        if surface.max_edge_factor < surface.edge_factor {
            let why = format!(
                "must not be below surface.edge_factor, which is {}",
                surface.edge_factor
            );
            return Err(self.refuse("surface.max_edge_factor", surface.max_edge_factor, why));
        }
        let gate = &self.settings.partners.gate;
        if let (Some(least), Some(most)) = (gate.min_angle, gate.max_angle)
            && least > most
        {
            let why = format!("must not be above partners.gate.max_angle, which is {most}");
            return Err(self.refuse("partners.gate.min_angle", least, why));
        }
        let confidence = &self.settings.confidence;
        if let (Some(differ), Some(agree)) = (confidence.differ, confidence.agree)
            && differ > agree
        {
            let why = format!("must not be above confidence.agree, which is {agree}");
            return Err(self.refuse("confidence.differ", differ, why));
        }
        if surface.up == Some([0.0; 3]) {
            return Err(self.refuse("surface.up", "0,0,0", "must be a direction".into()));
        }
        if !self.settings.ranking.scales.contains(&MapScale::Full) {
            let why =
                "must have 1 among them; to match all images at half the size, halve image_scale"
                    .into();
            return Err(self.refuse("ranking.scales", "0.5", why));
        }
        let frame = &self.settings.frame;
        if let Some([latitude, longitude, _]) = frame
            .origin
            // Longitudes are counted from 0 to 360 as well; eastings and northings are larger.
            .filter(|o| o[0].abs() > 90.0 || o[1].abs() > 360.0)
        {
            let why = "must be latitude, longitude and height".into();
            return Err(self.refuse("frame.origin", format!("{latitude}, {longitude}"), why));
        }
        if let Some(zone) = frame
            .utm
            .as_deref()
            .filter(|zone| Zone::parse(zone).is_none())
        {
            return Err(self.refuse(
                "frame.utm",
                zone,
                "must be a zone and N or S, as 33N".into(),
            ));
        }
        Ok(())
    }

    fn refuse(&self, key: &str, value: impl fmt::Display, why: String) -> ConfigError {
        ConfigError::Value {
            from: self.source(key),
            key: key.into(),
            value: value.to_string(),
            why,
        }
    }
}

/// Metres in the units of length that people write behind a number.
const METRES: [(&str, f64); 5] = [
    ("mm", 0.001),
    ("cm", 0.01),
    ("dm", 0.1),
    ("km", 1000.0),
    // Last, because the others end with it.
    ("m", 1.0),
];

fn is_length(entry: &Entry) -> bool {
    keys()
        .iter()
        .any(|key| key.name == entry.key && key.is_length())
}

/// Replaces lengths with a unit ("2cm") by numbers, in units of the model, where these are known:
/// metres, if the last of `units` says so, else `of_model` metres each.
fn convert_lengths(entries: &mut [Entry], of_model: Option<f64>) -> Result<(), ConfigError> {
    let units = entries.iter().rev().find(|entry| entry.key == "units");
    let is_metric = units.is_some_and(|entry| entry.value.as_str() == Some("metric"));
    let metres_per_unit = if is_metric { Some(1.0) } else { of_model };
    for entry in entries {
        let is_length = is_length(entry);
        let Some(text) = entry.value.as_str().filter(|_| is_length) else {
            continue;
        };
        let refuse = |why: &str| ConfigError::Value {
            from: Source::Written(entry.place.clone()),
            key: entry.key.clone(),
            value: entry.value.to_string(),
            why: why.into(),
        };
        let text = text.trim();
        let unit = METRES
            .iter()
            .find_map(|(unit, metres)| Some((text.strip_suffix(unit)?, *metres)));
        let (number, metres) = unit.unwrap_or((text, 1.0));
        if number.contains(',') {
            return Err(refuse("must be a number with a decimal point, as 0.02"));
        }
        let number: f64 = number
            .trim()
            .parse()
            .map_err(|_| refuse("must be a number, in metres also with mm, cm or m"))?;
        let not_metric = || ConfigError::NotMetric {
            place: entry.place.clone(),
            key: entry.key.clone(),
            value: text.into(),
        };
        let per_unit = match unit {
            Some(_) => metres_per_unit.ok_or_else(not_metric)?,
            None => 1.0,
        };
        // 2 cm are 0.02, not 0.02 plus the rounding of the product.
        let length = if metres < 1.0 {
            number / (1.0 / metres).round()
        } else {
            number * metres
        };
        entry.value = (length / per_unit).into();
    }
    Ok(())
}

/// Returns whether the file is a link that leads out of its folder.
fn leads_away(file: &Path) -> bool {
    file.is_symlink() && file.parent().is_some_and(|folder| is_outside(file, folder))
}

/// Reads the entries of a file; empty if it does not exist.
fn read(path: &Path) -> Result<Vec<Entry>, ConfigError> {
    let text = match input::read_text(path, FileKind::Settings) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(source) => {
            return Err(ConfigError::Read {
                path: path.into(),
                source,
            });
        }
        Ok(text) => text,
    };
    let ends: Vec<usize> = text
        .bytes()
        .enumerate()
        .filter(|(_, byte)| *byte == b'\n')
        .map(|(at, _)| at)
        .collect();
    let line_of = |byte: usize| 1 + ends.partition_point(|&end| end < byte);
    let syntax = |error: toml::de::Error| {
        let line = line_of(error.span().map_or(0, |span| span.start));
        let place = SettingLocation::File {
            path: path.into(),
            line,
        };
        ConfigError::Syntax {
            place,
            why: error.message().replace('\n', ", "),
        }
    };
    // Parsed twice: `Value` has no positions, and `DeTable`, which has them, no plain values.
    let values: Value = toml::from_str(&text).map_err(syntax)?;
    let mut entries = Vec::new();
    collect(
        DeTable::parse(&text).map_err(syntax)?.get_ref(),
        "",
        &mut |key, at| {
            let place = SettingLocation::File {
                path: path.into(),
                line: line_of(at),
            };
            let value = key
                .split('.')
                .try_fold(&values, |value, part| value.get(part));
            let entry = value.map(|value| Entry {
                key: key.into(),
                value: from_file(key, value, path),
                place: place.clone(),
            });
            entries.push(entry.ok_or_else(|| ConfigError::UnknownKey {
                place,
                key: key.into(),
            }));
        },
    );
    entries.into_iter().collect()
}

/// The settings that name a file or a folder, and whether a project's file, which may come from
/// anybody, may name one outside of its folder.
const PATHS: [(&str, bool); 4] = [
    // Photographs are often kept apart. A link `images` leads there without a setting; what is
    // looked through is limited, and only pictures of the model's names are read.
    ("images", true),
    // All that is below is listed.
    ("pilot.maps", false),
    ("region", false),
    ("surface.mesh", false),
];

/// A value that is a path.
struct PathValue {
    key: &'static str,
    path: PathBuf,
    may_leave: bool,
}

impl PathValue {
    fn new(key: &str, value: &Value) -> Option<Self> {
        let &(key, may_leave) = PATHS.iter().find(|(known, _)| *known == key)?;
        let text = value.as_str()?;
        let is_path = key != "region" || RegionChoice::is_file(text);
        is_path.then(|| Self {
            key,
            path: text.into(),
            may_leave,
        })
    }
}

/// Converts a value of `file`; relative paths are resolved against its folder.
fn from_file(key: &str, value: &Value, file: &Path) -> Value {
    match (PathValue::new(key, value), absolute(file).parent()) {
        (Some(PathValue { path, .. }), Some(folder)) => {
            folder.join(path).to_string_lossy().into_owned().into()
        }
        _ => value.clone(),
    }
}

/// Refuses a path in a project's `file` that leads out of its folder.
fn refuse_outside(entry: &Entry, file: &Path) -> Result<(), ConfigError> {
    let file = absolute(file);
    let outside = |folder| path_outside(&entry.key, &entry.value, folder);
    match file.parent().and_then(outside) {
        Some(PathValue { key, path, .. }) => {
            let place = entry.place.clone();
            Err(ConfigError::Outside { place, key, path })
        }
        None => Ok(()),
    }
}

/// Returns a path outside of a project, where its files may not name such a one.
fn path_outside(key: &str, value: &Value, project: &Path) -> Option<PathValue> {
    let named = PathValue::new(key, value)?;
    (!named.may_leave && is_outside(&named.path, project)).then_some(named)
}

/// Calls `found` with each key that is not a section, and its byte offset. A name with a dot keeps
/// its quotes: `"partners.k"` is not the setting `partners.k`.
fn collect(table: &DeTable, path: &str, found: &mut impl FnMut(&str, usize)) {
    for (name, value) in table {
        let text = name.get_ref();
        let text = if text.contains('.') {
            format!("\"{text}\"")
        } else {
            text.to_string()
        };
        let key = if path.is_empty() {
            text
        } else {
            format!("{path}.{text}")
        };
        match value.get_ref().as_table() {
            Some(section) if is_section(&key) => collect(section, &key, found),
            _ => found(&key, name.span().start),
        }
    }
}

fn is_section(key: &str) -> bool {
    keys().iter().any(|known| {
        known
            .name
            .strip_prefix(key)
            .is_some_and(|rest| rest.starts_with('.'))
    })
}

/// Refuses settings that run commands in a project's file, which may come from anybody.
fn refuse_commands(entry: &Entry) -> Result<(), ConfigError> {
    let user_only = keys()
        .iter()
        .any(|key| key.name == entry.key && key.user_only);
    let refusal = || ConfigError::UserOnly {
        place: entry.place.clone(),
        key: entry.key.clone(),
    };
    if user_only { Err(refusal()) } else { Ok(()) }
}

/// Resolves backend names, keeping the order and dropping duplicates.
fn proper_names(names: &[String], backend: BackendLookup) -> Result<Vec<String>, UnknownBackend> {
    let mut proper: Vec<String> = Vec::new();
    for name in names {
        let name = backend(name)?;
        if proper.iter().all(|known| known != name) {
            proper.push(name.into());
        }
    }
    Ok(proper)
}

/// Checks that the key is known and the value has its type and range.
fn check(entry: &Entry, backend: BackendLookup) -> Result<(), ConfigError> {
    let refuse = |why: String| ConfigError::Value {
        from: Source::Written(entry.place.clone()),
        key: entry.key.clone(),
        value: entry.value.to_string(),
        why,
    };
    let Some(key) = keys().iter().find(|key| key.name == entry.key) else {
        return Err(if is_section(&entry.key) {
            refuse(format!(
                "is a section: write [{}] and its settings below",
                entry.key
            ))
        } else {
            ConfigError::UnknownKey {
                place: entry.place.clone(),
                key: entry.key.clone(),
            }
        });
    };
    let numbers = match &entry.value {
        Value::Array(members) => members.as_slice(),
        one => std::slice::from_ref(one),
    };
    let number = |value: &Value| {
        value
            .as_float()
            .or_else(|| value.as_integer().map(|n| n as f64))
    };
    if numbers.iter().filter_map(number).any(|n| !key.allows(n)) {
        return Err(refuse(format!("must be {}", wanted(key))));
    }
    // In a table of its own, so that the error is about this key.
    let mut alone = Table::new();
    insert(&mut alone, &entry.key, entry.value.clone());
    let settings = Settings::deserialize(alone).map_err(|error| refuse(type_error(key, &error)))?;
    let unknown = |error| ConfigError::Backend {
        place: entry.place.clone(),
        error,
    };
    proper_names(&settings.backends, backend)
        .map(drop)
        .map_err(unknown)
}

/// Describes the accepted values: range and unit.
fn wanted(key: &Key) -> String {
    let range = key.range().unwrap_or_else(|| "a number".into());
    key.unit(None)
        .map_or(range.clone(), |unit| format!("{range} ({unit})"))
}

fn type_error(key: &Key, error: &toml::de::Error) -> String {
    if key.words.is_empty() {
        let message = error.message().lines().next().unwrap_or_default();
        let kinds = [
            // serde names Rust types, such as u32, which mean little to whoever writes the file.
            ("expected u", "must be a whole number"),
            ("expected f", "must be a number"),
            ("expected a bool", "must be true or false"),
        ];
        let kind = kinds
            .iter()
            .find(|(expected, _)| message.contains(expected));
        return kind.map_or(message, |(_, words)| words).to_owned();
    }
    format!("must be {}", key.words.join(", "))
}

fn insert(table: &mut Table, key: &str, value: Value) {
    match key.split_once('.') {
        None => drop(table.insert(key.into(), value)),
        Some((section, rest)) => {
            let inner = table.entry(section).or_insert_with(|| Table::new().into());
            if let Value::Table(inner) = inner {
                insert(inner, rest, value);
            }
        }
    }
}

/// Error in settings: each variant has the location.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("{}: {source}", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("{place}: {why}")]
    Syntax { place: SettingLocation, why: String },
    #[error("{place}: unknown setting {key}")]
    UnknownKey { place: SettingLocation, key: String },
    #[error("{0}: a fault that is not shown, because the file is outside of the project")]
    Hidden(SettingLocation),
    #[error("{place}: {key} runs commands, so a project's file may not set it")]
    UserOnly { place: SettingLocation, key: String },
    #[error("{place}: {key} = {} leads out of the folder of this file, so a project's file may not set it", path.display())]
    Outside {
        place: SettingLocation,
        key: &'static str,
        path: PathBuf,
    },
    #[error("{place}: {error}")]
    Backend {
        place: SettingLocation,
        error: UnknownBackend,
    },
    #[error("{place}: {key} = {value}: the model's unit of length is unknown")]
    NotMetric {
        place: SettingLocation,
        key: String,
        value: String,
    },
    #[error("{}", wrong_value(from, key, value, why))]
    Value {
        from: Source,
        key: String,
        value: String,
        why: String,
    },
}

/// Who types an option need not know the setting's key.
fn wrong_value(from: &Source, key: &str, value: &str, why: &str) -> String {
    if from.is_option() {
        format!("{from} {value}: {why}")
    } else {
        format!("{from}: {key} = {value}: {why}")
    }
}

impl Hint for ConfigError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::Read { .. } => "make the file readable, or move it away".into(),
            Self::Syntax { .. } => "see https://toml.io for the grammar; put text in quotes".into(),
            Self::Hidden(_) => "copy the file into the project to see the fault".into(),
            Self::UnknownKey { key, .. } => match nearest(key) {
                Some(known) => format!("did you mean {known}?").into(),
                None => "run viewrank config to list all settings".into(),
            },
            Self::UserOnly { .. } => match user_file() {
                Some(path) => format!("set it in {}, or on the command line", path.display()).into(),
                None => "set it on the command line".into(),
            },
            Self::Outside { key, .. } => {
                Advice::text("copy it there, or name it yourself: ").set(key)
            }
            Self::NotMetric { .. } => "write units = \"metric\" into viewrank.toml if a unit of the model is a metre (or georeference it), else \
                                       give the number in units of the model"
                .into(),
            Self::Backend { error, .. } => return error.hint(),
            Self::Value { from, key, .. } => match keys().iter().find(|known| known.name == *key) {
                Some(known) if from.is_option() => format!("{from}: {}", known.doc).into(),
                Some(known) => format!("{key}: {}", known.doc).into(),
                None => "run viewrank config to list all settings".into(),
            },
        })
    }

    fn is_usage(&self) -> bool {
        true
    }

    fn path(&self) -> Option<&Path> {
        match (self, self.place()) {
            (Self::Read { path, .. }, _) | (_, Some(SettingLocation::File { path, .. })) => {
                Some(path)
            }
            _ => None,
        }
    }
}

impl ConfigError {
    /// The error without any word of the file, if that is `hidden`.
    pub fn without_words_of(self, hidden: impl Fn(&PathBuf) -> bool) -> Self {
        match self.place() {
            Some(place @ SettingLocation::File { path, .. }) if hidden(path) => {
                Self::Hidden(place.clone())
            }
            _ => self,
        }
    }

    fn place(&self) -> Option<&SettingLocation> {
        match self {
            Self::Syntax { place, .. }
            | Self::UnknownKey { place, .. }
            | Self::Hidden(place)
            | Self::UserOnly { place, .. }
            | Self::Outside { place, .. }
            | Self::Backend { place, .. }
            | Self::NotMetric { place, .. }
            | Self::Value {
                from: Source::Written(place),
                ..
            } => Some(place),
            Self::Read { .. } | Self::Value { .. } => None,
        }
    }
}

/// Longest key that is compared with the known ones, bytes: the time grows with its length.
const LONGEST_KEY: usize = 100;

/// Finds the known key or section nearest to a misspelt one: similar as a whole, or in its last
/// part.
fn nearest(key: &str) -> Option<String> {
    if key.len() > LONGEST_KEY {
        return None;
    }
    let parts = |key: &'_ str| {
        key.rsplit_once('.')
            .map_or((String::new(), key.into()), |(s, l)| {
                (s.into(), String::from(l))
            })
    };
    let (section, last) = parts(key);
    let is_section = keys().iter().any(|known| parts(&known.name).0 == section);
    let likeness = |known: &str| {
        let (of_known, last_of_known) = parts(known);
        // A section says little of a setting, so that it only counts by its letters.
        let whole = if section.is_empty() {
            strsim::jaro_winkler(known, key)
        } else {
            strsim::normalized_damerau_levenshtein(known, key)
        };
        let other = if section.is_empty() || !is_section || of_known == section {
            0.99
        } else {
            0.8
        };
        whole.max(other * strsim::jaro_winkler(&last_of_known, &last))
    };
    let best = keys()
        .iter()
        .max_by(|a, b| likeness(&a.name).total_cmp(&likeness(&b.name)))?;
    let to_section = |known: &&str| {
        if section.is_empty() {
            strsim::jaro_winkler(known, key)
        } else {
            0.0
        }
    };
    let sections = keys()
        .iter()
        .filter_map(|known| Some(known.name.split_once('.')?.0));
    let nearest_section = sections.max_by(|a, b| to_section(a).total_cmp(&to_section(b)))?;
    match (likeness(&best.name), to_section(&nearest_section)) {
        (of_key, of_section) if of_key.max(of_section) <= 0.8 => None,
        (of_key, of_section) if of_section > of_key => Some(format!("[{nearest_section}]")),
        _ => Some(best.name.clone()),
    }
}

#[cfg(test)]
mod tests;
