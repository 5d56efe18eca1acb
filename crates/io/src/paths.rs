//! Paths without links, absolute ones, and those in a folder.

use std::path::{Component, Path, PathBuf};

/// Returns whether both are the same file or folder, which need not exist.
pub fn is_same(one: &Path, other: &Path) -> bool {
    real(one) == real(other)
}

/// The path from the root of the file system on, with its links; the path itself where the working
/// folder is gone.
pub fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}

/// The folders in a folder, also by links, sorted; none where it cannot be read.
pub fn sub_folders(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    let paths = entries.filter_map(Result::ok).map(|entry| entry.path());
    let mut folders: Vec<_> = paths.filter(|path| path.is_dir()).collect();
    folders.sort();
    folders
}

/// A name with `/`, without its extension.
pub fn stem(name: &str) -> &str {
    match name.rsplit_once('.') {
        // In `day.1/a` the dot is the folder's, and in `.a` it begins the name.
        Some((stem, extension))
            if !extension.contains('/') && !stem.is_empty() && !stem.ends_with('/') =>
        {
            stem
        }
        _ => name,
    }
}

/// The path without links and `..`, also of a file that doesn't exist yet.
pub fn real(path: &Path) -> PathBuf {
    let absolute = absolute(path);
    let there = absolute
        .ancestors()
        .find_map(|above| Some((above, dunce::canonicalize(above).ok()?)));
    let Some((above, mut real)) = there else {
        return absolute;
    };
    for part in absolute
        .strip_prefix(above)
        .unwrap_or(Path::new(""))
        .components()
    {
        match part {
            // What does not exist is no link, so that `..` undoes the part before it.
            Component::ParentDir => _ = real.pop(),
            part => real.push(part),
        }
    }
    real
}

/// The path of a file without links and `..` among its folders; the file itself may be a link.
pub fn place_of_file(file: &Path) -> PathBuf {
    match (file.parent(), file.file_name()) {
        (Some(folder), Some(name)) => real(folder).join(name),
        _ => real(file),
    }
}

/// Returns whether links, or the path itself, lead to a file outside of the folder. Errors must not
/// quote such a file of a project, which may be a stranger's.
pub fn is_outside(file: &Path, folder: &Path) -> bool {
    !real(file).starts_with(real(folder))
}

/// The path as it is typed most briefly in the working folder: one that is absolute, or leads up
/// and down, becomes relative where that is shorter, unless it would look like an option.
pub fn from_here(path: &Path) -> PathBuf {
    let is_plain = |part| matches!(part, Component::Normal(_));
    let Ok(here) = std::env::current_dir() else {
        return path.into();
    };
    if path.components().all(is_plain) {
        return path.into();
    }
    let (here, there) = (real(&here), real(path));
    let mut ups = PathBuf::new();
    for above in here.ancestors() {
        if let Ok(inner) = there.strip_prefix(above) {
            let relative = match ups.join(inner) {
                empty if empty.as_os_str().is_empty() => ".".into(),
                relative => relative,
            };
            let is_shorter = relative.as_os_str().len() < path.as_os_str().len();
            let is_option = relative.as_os_str().as_encoded_bytes().starts_with(b"-");
            let is_better = is_shorter && !is_option;
            return if is_better { relative } else { path.into() };
        }
        ups.push("..");
    }
    path.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_extension_is_what_follows_the_last_dot_of_a_files_name() {
        for (name, short) in [
            ("day.1/a.b.jpg", "day.1/a.b"),
            ("day.1/a", "day.1/a"),
            ("day.1/.a", "day.1/.a"),
            (".a", ".a"),
            ("a", "a"),
        ] {
            assert_eq!(stem(name), short);
        }
    }

    #[test]
    fn a_path_is_typed_as_briefly_as_it_can_be() {
        let here = std::env::current_dir().unwrap();
        for (typed, brief) in [
            (here.clone(), "."),
            (here.join("new/a"), "new/a"),
            (here.join("../b"), "../b"),
            ("src/../src".into(), "src"),
            ("a/b".into(), "a/b"),
            ("..".into(), ".."),
            ("./-x".into(), "./-x"),
        ] {
            assert_eq!(from_here(&typed), Path::new(brief), "{typed:?}");
        }
        assert_eq!(from_here(Path::new("/")), Path::new("/"));
    }

    #[test]
    fn a_path_is_resolved_before_it_exists() {
        let folder = tempfile::tempdir().unwrap();
        let home = dunce::canonicalize(folder.path()).unwrap();
        std::fs::create_dir(home.join("a")).unwrap();
        assert_eq!(real(&home.join("a/new/../b c/d")), home.join("a/b c/d"));
        assert_eq!(real(&home.join("a/../a")), home.join("a"));
        assert!(
            is_same(&home.join("a/../b"), &home.join("b"))
                && !is_same(&home.join("a"), &home.join("b"))
        );
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(home.join("a"), home.join("link")).unwrap();
            assert_eq!(real(&home.join("link/new")), home.join("a/new"));
        }
    }
}
