//! Checks the journal of an earlier process before it is carried out.

use std::{
    collections::{BTreeMap, BTreeSet},
    io,
};

use super::{
    OutputError, check_name, open, record,
    transaction::{Direction, FOLDER, JOURNAL, Journal, Root, STAGING, Step, is_there},
};

/// Reads the journal that an earlier process left; `None` if there isn't one.
///
/// # Errors
/// [`OutputError::Journal`] if it must not be carried out. The journal and its staged files are then set aside, so the next run isn't affected.
pub(super) fn journal(root: &Root) -> Result<Option<Journal>, OutputError> {
    let bytes = match open::read_own(&root.path, JOURNAL) {
        Err(OutputError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => return Ok(None),
        read => read?,
    };
    check(root, &bytes).map(Some).map_err(|why| set_aside(root, why))
}

/// Parses and checks a journal; the error says why it is refused.
fn check(root: &Root, bytes: &[u8]) -> Result<Journal, String> {
    let journal: Journal = serde_json::from_slice(bytes).map_err(|error| format!("invalid journal: {error}"))?;
    let change = &journal.change;
    let mut names = change.steps.iter().map(|s| &s.path).chain(&change.new_folders).chain(&change.old_folders);
    names.try_for_each(|name| check_name(name)).map_err(|error| error.to_string())?;
    if journal.identity != root.identity {
        let first = change.steps.first().map_or(String::new(), |step| format!(" (the first is {})", step.path));
        let files = change.steps.len();
        return Err(format!("it was written in another folder, so its {files} files{first} are not touched"));
    }
    if root.staging().symlink_metadata().is_ok_and(|found| !found.is_dir()) {
        return Err(format!("{STAGING} is not a folder"));
    }
    check_steps(root, &journal)?;
    Ok(journal)
}

/// Checks that each file is in its state before or after the change; several steps may change the same file.
fn check_steps(root: &Root, journal: &Journal) -> Result<(), String> {
    let mut known: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for step in &journal.change.steps {
        known.entry(&step.path).or_default().extend(step.new.iter().chain(&step.old).map(String::as_str));
    }
    let hash = |path: &std::path::Path| record::hash(path).map_err(|error| format!("{}: {error}", path.display()));
    for (i, step) in journal.change.steps.iter().enumerate() {
        let Step { path, new, old } = step;
        let target = root.locate(path).map_err(|error| error.to_string())?;
        let (there, staged) = (hash(&target)?, root.staged(i, "new"));
        let is_known = there.as_ref().is_none_or(|there| known[path.as_str()].contains(there.as_str()));
        if !is_known || target.symlink_metadata().is_ok_and(|found| found.is_dir()) {
            return Err(format!("{path} has changed since, so it is not touched"));
        }
        for (name, expected) in [(&staged, new), (&root.staged(i, "old"), old)] {
            if is_there(name) && hash(name)? != *expected {
                return Err(format!("the staged file of {path} has changed since"));
            }
        }
        if journal.direction == Direction::Finish && new.is_some() && there.is_none() && !is_there(&staged) {
            return Err(format!("the staged file of {path} is missing"));
        }
    }
    Ok(())
}

/// Renames the staged files, then the journal. Nothing is removed: a staged file may be the only copy.
fn set_aside(root: &Root, why: String) -> OutputError {
    let folder = root.path.join(FOLDER);
    let names = (1..).map(|n| (format!(".journal.refused-{n}.json"), format!(".staging.refused-{n}")));
    let free = names.map(|(a, b)| (folder.join(a), folder.join(b))).find(|(a, b)| !is_there(a) && !is_there(b));
    let Some((journal, staging)) = free else { return OutputError::Journal { path: root.path.join(JOURNAL), why } };
    let staged = root.disk.rename(&root.staging(), &staging);
    match staged.and_then(|_| root.disk.rename(&root.path.join(JOURNAL), &journal)) {
        Ok(_) => OutputError::Journal { path: journal, why },
        Err(error) => error,
    }
}
