//! Parses the command line, and suggests corrections of misspelt subcommands, options and projects.

use std::{
    ffi::OsString,
    path::{Path, PathBuf},
    sync::OnceLock,
};

use clap::{
    Arg, Command, CommandFactory, FromArgMatches,
    builder::{PathBufValueParser, TypedValueParser},
    error::{ContextKind, ContextValue, Error, ErrorKind},
};

use super::{Arguments, Exit, Failure};
use crate::{
    base::{printable::printable, shell::command_word},
    config::RegionChoice,
    io::{paths, project},
};

/// Other words for subcommands, separated by blanks.
const SUBCOMMANDS: [(&str, &str); 13] = [
    (
        "plan",
        "rank order prioritize prioritise select choose schedule analyze analyse cluster optimize optimise sort",
    ),
    (
        "run",
        "match densify dense compute start reconstruct mvs stereo patch_match_stereo go",
    ),
    ("inspect", "info show stat stats print model list"),
    ("doctor", "check validate verify diagnose lint"),
    ("config", "settings setting configuration init set"),
    ("report", "html page view open plot"),
    ("evaluate", "measure eval score benchmark quality"),
    ("export", "write convert save output"),
    ("backends", "programs formats engines"),
    ("undistort", "rectify image_undistorter undistorted"),
    ("dispatch", "slurm submit queue sbatch parallel"),
    ("train", "learn fit"),
    ("watch", "daemon monitor follow serve"),
];

/// Other words for options, separated by blanks.
const OPTIONS: [(&str, &str); 12] = [
    (
        "--images",
        "--image-path --image_path --image-dir --image-folder --imgs --photos --pictures",
    ),
    (
        "--out",
        "--output --output-path --output_path --output-dir --dest --destination -o",
    ),
    (
        "--target",
        "--quality --share --percent --goal --stop-at -t",
    ),
    (
        "--budget",
        "--max-views --views --num-views --max-maps --limit --number --clusters --num-clusters -n",
    ),
    (
        "--gsd",
        "--resolution --ground-sampling-distance --pixel-size --res",
    ),
    (
        "-k",
        "--k --neighbors --neighbours --num-neighbors --partner --sources --num-sources",
    ),
    (
        "--backend",
        "--engine --mvs --matcher --format-for --program-name -b",
    ),
    ("--region", "--roi --aoi --bbox --box --area --polygon"),
    ("--max-memory", "--memory --mem --ram -m"),
    ("--threads", "--jobs --num-threads --num_threads --cpus -j"),
    ("--format json", "--json --as-json"),
    ("--dry-run", "--dryrun --no-write --simulate --pretend"),
];

/// Words that people type where something else than another option is meant.
const ADVICE: [(&str, &str); 4] = [
    (
        "settings are in PROJECT/viewrank.toml; viewrank config PROJECT lists them",
        "--config --settings --set --option --config-file -c",
    ),
    (
        "write units = \"metric\" into PROJECT/viewrank.toml",
        "--units --unit --metric --metres --meters",
    ),
    (
        "name the project without an option, as in viewrank plan PROJECT",
        "--project --input --workspace --workspace_path --workspace-path --path --sparse -i -p",
    ),
    (
        "viewrank plan --verbose says most; --quiet says less",
        "--debug -v",
    ),
];

/// Returns the value of a setting that is a number if it can be: the settings say what is wrong
/// with another one.
pub fn number(typed: &str) -> toml::Value {
    typed
        .parse()
        .map_or_else(|_| toml::Value::from(typed), toml::Value::Integer)
}

/// Returns the region as a setting, which is relative to the project.
pub fn region(typed: &str) -> String {
    if RegionChoice::is_file(typed) {
        absolute(Path::new(typed))
    } else {
        typed.to_owned()
    }
}

/// Returns a path as a setting, which is relative to the project.
pub fn absolute(path: &Path) -> String {
    paths::absolute(path).to_string_lossy().into_owned()
}

/// Returns the command line, to be shown: bytes that are not UTF-8 are replaced.
pub fn typed_words() -> Vec<String> {
    let words = std::env::args_os();
    words
        .map(|word| word.to_string_lossy().into_owned())
        .collect()
}

/// Returns whether the command line asks for JSON, even if the rest of it is invalid.
pub fn asks_for_json() -> bool {
    static JSON: OnceLock<bool> = OnceLock::new();
    *JSON.get_or_init(|| is_json(&typed_words()))
}

fn is_json(typed: &[String]) -> bool {
    let typed: Vec<&str> = typed
        .iter()
        .map(String::as_str)
        // After `--` all words are paths.
        .take_while(|word| *word != "--")
        .collect();
    typed.contains(&"--format=json") || typed.windows(2).any(|two| two == ["--format", "json"])
}

/// Parses the command line; `--help` and `--version` end the program inside clap.
pub fn parse(typed: Vec<OsString>) -> Result<Arguments, Failure> {
    parse_from(typed).map_err(|error| {
        if !error.use_stderr() {
            error.exit();
        }
        // Printed as clap does it; the words are kept for the error in JSON.
        _ = error.print();
        let rendered = error.render().to_string();
        let message = rendered
            .lines()
            .next()
            .unwrap_or_default()
            .trim_start_matches("error: ");
        let tip = rendered
            .lines()
            .find_map(|line| line.trim().strip_prefix("tip: "));
        Failure {
            is_printed: true,
            ..Failure::new(Exit::Usage, message, tip.map(String::from))
        }
    })
}

fn parse_from(typed: Vec<OsString>) -> Result<Arguments, Error> {
    let mut definition = definition();
    let mut matches = definition
        .try_get_matches_from_mut(typed)
        .map_err(in_words)?;
    Arguments::from_arg_matches_mut(&mut matches)
        .map_err(|error| in_words(error.format(&mut definition)))
}

/// Returns the error as it is printed: with the probable meaning, and typed words printable, which
/// a pattern of the shell may have made of any file's name.
fn in_words(error: Error) -> Error {
    let typed =
        text(&error, ContextKind::InvalidArg) + &text(&error, ContextKind::InvalidSubcommand);
    let mut error = suggest(error);
    if printable(&typed) != typed {
        // A tip of clap's repeats the word.
        error.remove(ContextKind::Suggested);
    }
    let why = std::error::Error::source(&error)
        .map(ToString::to_string)
        .unwrap_or_default();
    if printable(&why) != why {
        let what = [
            "invalid value '",
            &text(&error, ContextKind::InvalidValue),
            "' for '",
            &text(&error, ContextKind::InvalidArg),
            "': ",
            &why,
        ];
        return Error::raw(error.kind(), printable(&what.concat())).with_cmd(&definition());
    }
    let shown = |value: &ContextValue| match value {
        ContextValue::String(text) => Some(ContextValue::String(printable(text))),
        ContextValue::Strings(texts) => Some(ContextValue::Strings(
            texts.iter().map(|text| printable(text)).collect(),
        )),
        _ => None,
    };
    let typed: Vec<_> = error
        .context()
        .filter_map(|(kind, value)| Some((kind, shown(value)?)))
        .collect();
    typed
        .into_iter()
        .for_each(|(kind, value)| _ = error.insert(kind, value));
    error
}

fn text(error: &Error, kind: ContextKind) -> String {
    match error.get(kind) {
        Some(ContextValue::String(text)) => text.clone(),
        _ => String::new(),
    }
}

/// Returns the definition of the command line. A negative number after an option is its value, so
/// that the error names the option.
fn definition() -> Command {
    let with_negative = |argument: Arg| {
        if argument.get_action().takes_values() && !argument.is_positional() {
            argument.allow_negative_numbers(true)
        } else {
            argument
        }
    };
    Arguments::command().mut_subcommands(|subcommand| subcommand.mut_args(with_negative))
}

/// Adds the probable meaning to an error.
fn suggest(mut error: Error) -> Error {
    let one = |word: &str| ContextValue::Strings(vec![word.into()]);
    match error.kind() {
        ErrorKind::InvalidSubcommand => {
            let typed = text(&error, ContextKind::InvalidSubcommand);
            if Path::new(&typed).exists() {
                let tip = format!("to plan a project: viewrank plan {}", command_word(&typed));
                error.insert(
                    ContextKind::Suggested,
                    ContextValue::StyledStrs(vec![tip.into()]),
                );
                error.remove(ContextKind::SuggestedSubcommand);
            } else if let Some(meant) = meant_by(&typed.to_lowercase(), &SUBCOMMANDS) {
                error.insert(ContextKind::SuggestedSubcommand, one(meant));
            } else if typed == "version" {
                error.insert(
                    ContextKind::Suggested,
                    ContextValue::StyledStrs(vec!["viewrank --version".into()]),
                );
            }
        }
        ErrorKind::UnknownArgument => {
            let typed = text(&error, ContextKind::InvalidArg);
            let typed = typed
                .split_once('=')
                .map_or(typed.as_str(), |(name, _)| name)
                .to_lowercase();
            // Not every subcommand has the option that is meant.
            let option = meant_by(&typed, &OPTIONS).filter(|meant| is_known(meant));
            let tip = option.map(|meant| format!("the option is {meant}"));
            let tip = tip
                .or_else(|| meant_by(&typed, &ADVICE).map(str::to_owned))
                .or_else(|| meant_by_word(&typed));
            // The list of options is advice only where clap has nothing better.
            let has_none = error.get(ContextKind::SuggestedArg).is_none();
            if let Some(tip) = tip.or_else(|| has_none.then(options_of_subcommand).flatten()) {
                error.insert(
                    ContextKind::Suggested,
                    ContextValue::StyledStrs(vec![tip.into()]),
                );
                error.remove(ContextKind::SuggestedArg);
            }
        }
        _ => {}
    }
    error
}

fn meant_by(typed: &str, table: &[(&'static str, &str)]) -> Option<&'static str> {
    let means = |(_, words): &&(_, &str)| words.split(' ').any(|word| word == typed);
    table.iter().find(means).map(|(meant, _)| *meant)
}

/// Returns the probable meaning of a word that is no option and that the subcommand has no place
/// for.
fn meant_by_word(typed: &str) -> Option<String> {
    if typed.starts_with('-') {
        return None;
    }
    let words = typed_words();
    let last = words.iter().position(|word| word.to_lowercase() == typed)?;
    let whole = |first: usize| words[first..=last].join(" ");
    // From 2, after the program and its subcommand.
    if let Some(path) = (2..last).map(whole).find(|path| Path::new(path).exists()) {
        return Some(format!("quote a path with blanks: {}", command_word(&path)));
    }
    is_known("--depth-maps").then(|| "the folder of depth maps is named by --depth-maps".into())
}

/// Returns where the options of the typed subcommand are listed.
fn options_of_subcommand() -> Option<String> {
    typed_subcommand(&definition()).map(|subcommand| {
        format!(
            "viewrank {} --help lists the options",
            subcommand.get_name()
        )
    })
}

fn typed_subcommand(definition: &Command) -> Option<&Command> {
    definition.find_subcommand(typed_words().get(1)?)
}

/// Returns whether the typed subcommand has this option.
fn is_known(option: &str) -> bool {
    let name = option.split(' ').next().unwrap_or_default();
    let definition = definition();
    let Some(subcommand) = typed_subcommand(&definition) else {
        return false;
    };
    subcommand.get_arguments().any(|argument| {
        let long = argument.get_long().map(|long| format!("--{long}"));
        let short = argument.get_short().map(|short| format!("-{short}"));
        [long, short]
            .into_iter()
            .flatten()
            .any(|known| known == name)
    })
}

/// Parses a folder that has to be there.
pub fn folder() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|typed| match (typed.is_dir(), typed.exists()) {
        (true, _) => Ok(typed),
        (false, true) => Err("this is a file; name a folder"),
        (false, false) => Err("there is no such folder"),
    })
}

/// Parses a project. A part may name it: a file of its sparse model, its database, `sparse`,
/// `sparse/0`, its images or its results.
pub fn project() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().map(|typed| match project::containing(&typed) {
        Some(project) => {
            let project = paths::from_here(&project);
            super::note(&format!(
                "{} belongs to the project {}",
                typed.display(),
                project.display()
            ));
            project
        }
        None => paths::from_here(&typed),
    })
}

/// Reads one of the sizes that a key view may be matched at.
pub(super) fn scale(text: &str) -> Result<f64, String> {
    text.trim()
        .parse()
        .map_err(|_| "a size is 1 or 0.5, as in --scales 1,0.5".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_suggested_subcommand_exists_and_no_typed_word_is_one() {
        let known = Arguments::command();
        for (meant, words) in SUBCOMMANDS {
            assert!(known.find_subcommand(meant).is_some(), "{meant}");
            words
                .split(' ')
                .for_each(|word| assert!(known.find_subcommand(word).is_none(), "{word}"));
        }
    }

    #[test]
    fn each_suggested_option_exists_in_plan() {
        let known = Arguments::command();
        let plan = known.find_subcommand("plan").unwrap();
        for (meant, _) in OPTIONS {
            let name = meant.split(' ').next().unwrap().trim_start_matches('-');
            let is_meant = |argument: &clap::Arg| {
                argument.get_long() == Some(name)
                    || argument
                        .get_short()
                        .is_some_and(|short| short.to_string() == name)
            };
            assert!(plan.get_arguments().any(is_meant), "{meant}");
        }
    }

    #[test]
    fn json_is_asked_for_by_an_option() {
        let is = |typed: &[&str]| {
            is_json(
                &typed
                    .iter()
                    .map(|word| (*word).to_owned())
                    .collect::<Vec<_>>(),
            )
        };
        assert!(
            is(&["viewrank", "plan", "--format", "json"]) && is(&["viewrank", "--format=json"])
        );
        assert!(
            !is(&["viewrank", "plan", "--", "--format=json"]) && !is(&["viewrank", "plan", "json"])
        );
    }
}
