//! A journal that is found: may it be carried out?

use std::{
    collections::{BTreeMap, BTreeSet},
    io,
};

use super::{
    OutputError, check_name, open, record,
    transaction::{Direction, FOLDER, JOURNAL, Journal, Root, STAGING, Step, is_there},
};

/// The journal that an earlier process left, `None` where there is none.
///
/// # Errors
/// [`OutputError::Journal`] where it is not to be carried out. It is set aside then, with what was staged, and the next run goes on without.
pub(super) fn journal(root: &Root) -> Result<Option<Journal>, OutputError> {
    let bytes = match open::read_own(&root.path, JOURNAL) {
        Err(OutputError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => return Ok(None),
        read => read?,
    };
    check(root, &bytes).map(Some).map_err(|why| set_aside(root, why))
}

/// The journal, or why it is refused.
fn check(root: &Root, bytes: &[u8]) -> Result<Journal, String> {
    let journal: Journal = serde_json::from_slice(bytes).map_err(|error| format!("no journal: {error}"))?;
    let change = &journal.change;
    let mut names = change.steps.iter().map(|s| &s.path).chain(&change.new_folders).chain(&change.old_folders);
    names.try_for_each(|name| check_name(name)).map_err(|error| error.to_string())?;
    if journal.identity != root.identity {
        let first = change.steps.first().map_or(String::new(), |step| format!(", {} first", step.path));
        let files = change.steps.len();
        return Err(format!("not written in this folder, so the {files} files that it names stay as they are{first}"));
    }
    if root.staging().symlink_metadata().is_ok_and(|found| !found.is_dir()) {
        return Err(format!("{STAGING} is no folder"));
    }
    check_steps(root, &journal)?;
    Ok(journal)
}

/// Is each file either as it was before or as it is to be? Several sets may change the same.
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
            return Err(format!("{path} has changed since, so it stays as it is"));
        }
        for (name, expected) in [(&staged, new), (&root.staged(i, "old"), old)] {
            if is_there(name) && hash(name)? != *expected {
                return Err(format!("what was staged for {path} has changed since"));
            }
        }
        if journal.direction == Direction::Finish && new.is_some() && there.is_none() && !is_there(&staged) {
            return Err(format!("what was staged for {path} is gone"));
        }
    }
    Ok(())
}

/// Gives the journal, and first what was staged, names of their own: among it may be the only copy of something.
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
