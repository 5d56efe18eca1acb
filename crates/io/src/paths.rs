//! Paths without links.

use std::path::{Component, Path, PathBuf};

/// Returns whether both are the same file or folder, which need not exist.
pub fn is_same(one: &Path, other: &Path) -> bool {
    real(one) == real(other)
}

/// The path without links and `..`, also of a file that doesn't exist yet.
pub fn real(path: &Path) -> PathBuf {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
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
            Component::ParentDir => _ = real.pop(),
            part => real.push(part),
        }
    }
    real
}

#[cfg(test)]
mod tests {
    use super::*;

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
