//! Checks the journal of an earlier process before it is carried out.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    OutputError, check_name,
    journal::{Direction, FOLDER, JOURNAL, Journal, Root, STAGING, Step, staged},
    record,
};
use crate::{
    input::{self, FileKind},
    json,
};

/// Reads the journal that an earlier process left; `None` if there isn't one.
///
/// # Errors
/// [`OutputError::Journal`] if it must not be carried out. The journal and its staged files are
/// then set aside, so the next run isn't affected.
pub(super) fn journal(root: &Root) -> Result<Option<Journal>, OutputError> {
    let file = match root.folder.file(JOURNAL) {
        Err(error) if error.is_missing() => return Ok(None),
        file => file?,
    };
    let read = input::read_all(file, FileKind::List);
    let bytes = read.map_err(|error| root.folder.failed(JOURNAL.as_ref(), error))?;
    check(root, &bytes)
        .map(Some)
        .map_err(|why| set_aside(root, why))
}

/// Parses and checks a journal; the error says why it is refused.
fn check(root: &Root, bytes: &[u8]) -> Result<Journal, String> {
    let journal: Journal = serde_json::from_slice(bytes)
        .map_err(|error| format!("invalid journal: {}", json::place_and_fault(&error, bytes)))?;
    let change = &journal.change;
    let mut names = change
        .steps
        .iter()
        .map(|s| &s.path)
        .chain(&change.new_folders)
        .chain(&change.old_folders);
    names
        .try_for_each(|name| check_name(name))
        .map_err(|error| error.to_string())?;
    if journal.identity != root.identity {
        let first = change.steps.first().map_or(String::new(), |step| {
            format!(" (the first is {})", step.path)
        });
        let files = change.steps.len();
        return Err(format!(
            "it was written in another folder, so its {files} files{first} are not touched"
        ));
    }
    // Through a link, files from elsewhere would be moved into the project.
    if matches!(root.folder.find(STAGING), Ok(Some(found)) if !found.is_dir()) {
        return Err(format!("{STAGING} is not a folder"));
    }
    check_steps(root, &journal)?;
    Ok(journal)
}

/// Checks that each file is in its state before or after the change; several steps may change the
/// same file.
fn check_steps(root: &Root, journal: &Journal) -> Result<(), String> {
    let known = known_hashes(&journal.change.steps);
    for (i, step) in journal.change.steps.iter().enumerate() {
        let is_there = check_file(root, &step.path, &known[step.path.as_str()])?;
        check_staged(root, i, step)?;
        if journal.direction == Direction::Finish
            && step.new.is_some()
            && !is_there
            && !root.folder.has(staged(i, "new"))
        {
            return Err(format!("the staged file of {} is missing", step.path));
        }
    }
    Ok(())
}

/// Hashes that each file has before or after a step.
fn known_hashes(steps: &[Step]) -> BTreeMap<&str, BTreeSet<&str>> {
    let mut known: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for step in steps {
        let hashes = step.new.iter().chain(&step.old).map(String::as_str);
        known.entry(&step.path).or_default().extend(hashes);
    }
    known
}

/// Checks that a file has one of the known hashes or is absent; returns whether it is there.
fn check_file(root: &Root, path: &str, known: &BTreeSet<&str>) -> Result<bool, String> {
    let found = root.folder.find(path).map_err(|error| error.to_string())?;
    let there = hash(root, path)?;
    // A file edited since the crash is the user's.
    let is_known = there.as_ref().is_none_or(|there| known.contains(&**there));
    if !is_known || found.is_some_and(|found| found.is_dir()) {
        return Err(format!("{path} has changed since, so it is not touched"));
    }
    Ok(there.is_some())
}

/// Checks the staged files of the i-th step, as far as they are there.
fn check_staged(root: &Root, i: usize, step: &Step) -> Result<(), String> {
    for (name, expected) in [(staged(i, "new"), &step.new), (staged(i, "old"), &step.old)] {
        if root.folder.has(&name) && hash(root, &name)? != *expected {
            let path = &step.path;
            return Err(format!("the staged file of {path} has changed since"));
        }
    }
    Ok(())
}

fn hash(root: &Root, path: &str) -> Result<Option<String>, String> {
    record::hash(&root.folder, path).map_err(|error| error.to_string())
}

/// Renames the staged files, then the journal. Nothing is removed: a staged file may be the only
/// copy.
fn set_aside(root: &Root, why: String) -> OutputError {
    let mut names = (1..).map(|n| {
        (
            format!("{FOLDER}/.journal.refused-{n}.json"),
            format!("{FOLDER}/.staging.refused-{n}"),
        )
    });
    let is_free = |(journal, staging): &(String, String)| {
        !root.folder.has(journal) && !root.folder.has(staging)
    };
    let Some((journal, staging)) = names.find(is_free) else {
        return OutputError::Journal {
            path: root.folder.path(JOURNAL),
            why,
        };
    };
    let rename = |from: &str, to: &str| root.disk.rename(&root.folder, from, to);
    // The staged files first: the next run removes those that have no journal.
    match rename(STAGING, &staging).and_then(|_| rename(JOURNAL, &journal)) {
        Ok(_) => OutputError::Journal {
            path: root.folder.path(journal),
            why,
        },
        Err(error) => error,
    }
}
