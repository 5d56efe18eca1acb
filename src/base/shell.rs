//! Quotes words of shell commands.

use std::path::Path;

/// Quotes a word for POSIX sh, if it needs quotes.
pub fn quoted(word: &str) -> String {
    let plain = !word.is_empty() && word.chars().all(|c| c.is_alphanumeric() || "/._-+=:,%@".contains(c));
    if plain { word.into() } else { format!("'{}'", word.replace('\'', r"'\''")) }
}

/// Quotes a path for a command that a user is shown.
pub fn quoted_path(path: &Path) -> String {
    quoted(&path.display().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quoted_path_is_one_word() {
        assert_eq!(quoted_path(Path::new("/a b/it's")), r"'/a b/it'\''s'");
        assert_eq!(quoted_path(Path::new("/a-b/c_1.x")), "/a-b/c_1.x");
    }
}
