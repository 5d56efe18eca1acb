//! `viewrank config`: prints the settings in force as a valid `viewrank.toml`.

use std::{
    cell::Cell,
    path::{Path, PathBuf},
};

use crate::backends;
use crate::{
    base::{paths::is_outside, printable::printable},
    config::{
        CommandLineSettings, ConfigError, Configuration, Files, Key, Settings, Source,
        TypedSetting, keys, user_file,
    },
    io::project::{Project, ProjectError},
    model::scene::Units,
    plan::{metres_per_unit, unused_positions},
};
use clap::Args;
use serde_json::{Value, json};

use super::{
    COLUMNS, Exit, Failure, Format, print_json,
    terminal::{print_data, toml_escaped},
    warn,
};

/// Print all settings in force: value, unit, default, and where each value comes from.
///
/// The output is a complete settings file: viewrank config > PROJECT/viewrank.toml
#[derive(Args)]
pub struct Arguments {
    /// Project whose viewrank.toml is read [default: only the user's own settings].
    #[arg(value_parser = super::arguments::project())]
    project: Option<PathBuf>,
    /// Format of the results on stdout
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    if let Some(missing) = arguments
        .project
        .as_ref()
        .filter(|project| !project.exists())
    {
        return Err(ProjectError::NotFound(missing.clone()).into());
    }
    // The settings of a model's file are in its folder.
    let folder = arguments.project.as_deref().map(|p| {
        if p.is_file() {
            p.parent().unwrap_or(p)
        } else {
            p
        }
    });
    let project = folder.and_then(|folder| Project::open_or_planned(folder, None).ok());
    let configuration = load_in(folder, project.as_ref(), CommandLineSettings::default())?;
    let values = serde_json::to_value(&configuration.settings).expect("settings are JSON");
    match arguments.format {
        Format::Text => print_data(&as_toml(&configuration, &values)),
        Format::Json => print_json(&as_json(&configuration, &values)),
    }
}

/// Defaults, the user's file, the project's file, the command line. Wrong settings are a usage
/// error.
pub fn load(
    project: Option<&Project>,
    typed: CommandLineSettings,
) -> Result<Configuration, Failure> {
    load_in(project.map(|project| &*project.root), project, typed)
}

/// `folder`: that of the project's file, which may be there without a model.
fn load_in(
    folder: Option<&Path>,
    project: Option<&Project>,
    typed: CommandLineSettings,
) -> Result<Configuration, Failure> {
    let files = Files {
        user: user_file(),
        // Only `viewrank watch` has folders whose settings count for the projects in them.
        root: None,
        project: folder.map(|folder| folder.join("viewrank.toml")),
    };
    // The closure can only return a number, so the error is kept for after the loading.
    let unread = Cell::new(None);
    let metres = |settings: &Settings| {
        let read = metres_per_unit(project?, settings);
        read.unwrap_or_else(|error| {
            unread.set(Some(error));
            None
        })
    };
    let loaded = Configuration::load_for(&files, typed, backends::canonical_name, &metres);
    // Without the model its unit is unknown, and that is the fault to name.
    if let (Err(ConfigError::NotMetric { .. }), Some(error)) = (&loaded, unread.take()) {
        return Err(error.into());
    }
    if let (Err(ConfigError::NotMetric { .. }), Some(project)) = (&loaded, project) {
        let unused = unused_positions(project, &Settings::default());
        unused.iter().for_each(|said| warn(said));
    }
    // A stranger's project may say that it is a plan of another folder.
    let is_hidden = |path: &PathBuf| {
        let is_projects = files.project.as_ref() == Some(path);
        is_projects && project.is_some_and(|project| is_outside(path, &project.named))
    };
    Ok(loaded.map_err(|error| error.without_words_of(is_hidden))?)
}

/// Refuses options of the last plan, which may be a stranger's, that name files outside of the
/// project: another plan would be made without them.
pub fn refuse_outside(followed: &[&TypedSetting], project: &Path) -> Result<(), Failure> {
    match followed.iter().find(|option| option.leads_out(project)) {
        Some(option) => Err(Failure::new(
            Exit::Usage,
            format!("{option} of the last plan leads out of the project, so it is not followed"),
            match &*option.key {
                key @ ("region" | "images") => {
                    format!("type --{key} again, or copy it into the project and plan with that")
                }
                key => format!(
                    "copy it into the project and plan with that, or set {key} in your own settings (viewrank config)"
                ),
            },
        )),
        None => Ok(()),
    }
}

fn value_of<'a>(values: &'a Value, key: &Key) -> &'a Value {
    key.name.split('.').fold(values, |value, part| &value[part])
}

/// Planning numbers of the settings' backend, by key, with its name: defaults of unset settings.
fn of_backend(settings: &Settings) -> Option<(&'static str, Value)> {
    let backend = backends::by_name(settings.backends.first()?).ok()?;
    let numbers = &backend.planning;
    let gate = serde_json::to_value(numbers.gate.settings()).expect("settings are JSON");
    Some((
        backend.name,
        json!({ "partners": { "gate": gate }, "ranking": { "support": numbers.support } }),
    ))
}

/// Returns the backend's number for an unset key, and the backend's name.
fn number_of<'a>(
    of_backend: &'a Option<(&'static str, Value)>,
    key: &Key,
) -> Option<(&'a Value, &'static str)> {
    let (name, numbers) = of_backend.as_ref()?;
    Some((value_of(numbers, key), *name)).filter(|(value, _)| !value.is_null())
}

fn as_json(configuration: &Configuration, values: &Value) -> Value {
    let units = configuration.settings.units;
    let of_backend = of_backend(&configuration.settings);
    let entry = |key: &Key| {
        let (mut value, mut source) = (
            value_of(values, key),
            configuration.source(&key.name).to_string(),
        );
        if let Some((number, backend)) = number_of(&of_backend, key).filter(|_| value.is_null()) {
            (value, source) = (number, format!("backend {backend}"));
        }
        json!({
            "key": key.name,
            "value": value,
            "default": key.default,
            "unit": key.unit(units),
            "range": key.range(),
            "source": source,
            "doc": key.doc,
        })
    };
    keys().iter().map(entry).collect()
}

fn as_toml(configuration: &Configuration, values: &Value) -> String {
    let of_backend = of_backend(&configuration.settings);
    let mut text = String::new();
    let mut section = "";
    for key in keys() {
        let (its_section, name) = key.name.rsplit_once('.').unwrap_or(("", &key.name));
        if its_section != section {
            section = its_section;
            text += &format!("[{section}]\n");
        }
        comment(&mut text, &key.doc);
        comment(&mut text, &facts(key, configuration.settings.units));
        let value = value_of(values, key);
        // Commands are written as comments: a project's file must not set them.
        let mark = if value.is_null() || key.user_only {
            "# "
        } else {
            ""
        };
        text += &match (value.is_null(), configuration.source(&key.name)) {
            (true, _) => match number_of(&of_backend, key) {
                Some((number, backend)) => {
                    format!("{mark}{name} = {number}  # backend {backend}\n\n")
                }
                None => format!("{mark}{name} =\n\n"),
            },
            (false, Source::Default) => format!("{mark}{name} = {value}\n\n"),
            (false, Source::Written(place)) => {
                format!(
                    "{mark}{name} = {}  # {}\n\n",
                    toml_escaped(&value.to_string()),
                    printable(&place.to_string())
                )
            }
        };
    }
    text.truncate(text.trim_end().len());
    text + "\n"
}

/// Formats unit, range and default on one line.
fn facts(key: &Key, units: Option<Units>) -> String {
    let unit = key.unit(units).map(|unit| format!("Unit: {unit}."));
    let range = key.range().map(|range| format!("Range: {range}."));
    let default = if key.default.is_null() {
        "Default: unset.".into()
    } else {
        format!("Default: {}.", key.default)
    };
    [unit, range, Some(default)]
        .into_iter()
        .flatten()
        .collect::<Vec<_>>()
        .join(" ")
}

/// Appends words as comment lines of at most [`COLUMNS`].
fn comment(text: &mut String, words: &str) {
    let mut line = String::from("#");
    for word in words.split_whitespace() {
        if line.len() + 1 + word.len() > COLUMNS {
            *text += &format!("{line}\n");
            line = "#".into();
        }
        line += &format!(" {word}");
    }
    *text += &format!("{line}\n");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_user_s_commands_are_printed_as_comments() {
        let folder = tempfile::tempdir().unwrap();
        let user = folder.path().join("user.toml");
        std::fs::write(
            &user,
            "on_target = \"stop\"\nseed = 5\n[dispatch]\nsetup = \"module load colmap\"\n",
        )
        .unwrap();
        let configuration = Configuration::load(
            &Files {
                user: Some(user),
                ..Files::default()
            },
            CommandLineSettings::default(),
            backends::canonical_name,
        )
        .unwrap();
        let values = serde_json::to_value(&configuration.settings).unwrap();
        let text = as_toml(&configuration, &values);
        assert!(
            text.contains("\n# on_target = \"stop\"  # ")
                && text.contains("\n# setup = \"module load colmap\"  # ")
        );
        let project = folder.path().join("viewrank.toml");
        std::fs::write(&project, &text).unwrap();
        let again = Configuration::load(
            &Files {
                project: Some(project),
                ..Files::default()
            },
            CommandLineSettings::default(),
            backends::canonical_name,
        )
        .unwrap();
        assert_eq!(again.settings.seed, 5);
        assert_eq!(
            (again.settings.on_target, again.settings.dispatch.setup),
            (None, String::new())
        );
    }

    #[test]
    fn what_is_printed_is_a_settings_file_that_says_the_same() {
        let configuration = Configuration::default();
        let values = serde_json::to_value(&configuration.settings).unwrap();
        let text = as_toml(&configuration, &values);
        assert_eq!(
            toml::from_str::<Settings>(&text).unwrap(),
            configuration.settings
        );
        assert!(text.lines().all(|line| line.len() <= COLUMNS));
        let folder = tempfile::tempdir().unwrap();
        let project = folder.path().join("viewrank.toml");
        std::fs::write(&project, &text).unwrap();
        let of_project = Configuration::load(
            &Files {
                project: Some(project),
                ..Files::default()
            },
            CommandLineSettings::default(),
            backends::canonical_name,
        );
        assert_eq!(
            of_project.unwrap().settings,
            configuration.settings,
            "and one that a project may have"
        );
        assert!(text.contains("# Unit: px. Range: above 0. Default: 0.5.\nsigma_px = 0.5\n"));
    }
}
