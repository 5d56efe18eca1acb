//! Words of commands that somebody types or a script runs.

use std::path::Path;

/// A word for sh, quoted where it must be.
pub fn quoted(word: &str) -> String {
    let plain = !word.is_empty() && word.chars().all(|c| c.is_alphanumeric() || "/._-+=:,%@".contains(c));
    if plain { word.into() } else { format!("'{}'", word.replace('\'', r"'\''")) }
}

/// A path in a command that somebody is to type.
pub fn quoted_path(path: &Path) -> String {
    quoted(&path.display().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_in_commands_are_one_word() {
        assert_eq!(quoted_path(Path::new("/a b/it's")), r"'/a b/it'\''s'");
        assert_eq!(quoted_path(Path::new("/a-b/c_1.x")), "/a-b/c_1.x");
    }
}
