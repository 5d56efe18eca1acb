//! Quotes words of commands: for scripts, and for commands that the user is shown.

use std::path::Path;

use crate::printable::is_printable;

/// Quotes a word for a script of POSIX sh, if it needs quotes.
pub fn quoted(word: &str) -> String {
    if is_plain(word) {
        word.into()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

/// Quotes a path for a script of POSIX sh.
pub fn quoted_path(path: &Path) -> String {
    quoted(&path.display().to_string())
}

/// Quotes a word for a command that the user types: in a shell, on Windows in cmd or PowerShell.
pub fn command_word(word: &str) -> String {
    if cfg!(windows) {
        for_windows(word)
    } else {
        sh_word(word)
    }
}

/// Quotes a word for a command that the user types in a POSIX shell, on any system.
pub fn sh_word(word: &str) -> String {
    if word.chars().all(is_printable) {
        quoted(word)
    } else {
        with_escapes(word)
    }
}

/// Quotes a word with characters that are escaped where they are shown, so that what is typed is
/// the same word. `$'...'` is not in all shells, and means something else in those without it.
fn with_escapes(word: &str) -> String {
    let escaped = word.bytes().map(|byte| match byte {
        byte if byte.is_ascii_alphanumeric() || b"/._ ".contains(&byte) => char::from(byte).into(),
        byte => format!("\\{byte:03o}"),
    });
    // `$(...)` drops line breaks at the end. With a slash behind them, a folder's name is the same,
    // and that of a file names nothing.
    let end = if word.ends_with('\n') { "/" } else { "" };
    format!("\"$(printf '{}{end}')\"", escaped.collect::<String>())
}

/// Quotes a path for a command that the user types.
pub fn command_path(path: &Path) -> String {
    command_word(&shown_path(path))
}

/// Two commands for the user to type; PowerShell has no `&&`.
pub fn one_after_other(first: &str, second: &str) -> String {
    format!(
        "{first}{} {second}",
        if cfg!(windows) { ", then" } else { " &&" }
    )
}

/// Returns a path as the system writes it, without a `./` before it: on Windows, joined paths have
/// both kinds of separators.
pub fn shown_path(path: &Path) -> String {
    let inner = path.strip_prefix(".").unwrap_or(path).display().to_string();
    let path = match inner {
        // Such a name would be an option.
        inner if inner.starts_with('-') => format!("./{inner}"),
        inner if inner.is_empty() => path.display().to_string(),
        inner => inner,
    };
    if cfg!(windows) {
        path.replace('/', r"\")
    } else {
        path
    }
}

/// Quotes for both cmd and PowerShell; what PowerShell expands between double quotes gets the
/// quotes of PowerShell.
fn for_windows(word: &str) -> String {
    // cmd expands `%`, and `,` and `@` are operators of PowerShell.
    if is_plain(&word.replace('\\', "/")) && !word.contains([',', '%', '@']) {
        return word.into();
    }
    if word.contains(['$', '`']) {
        return format!("'{}'", word.replace('\'', "''"));
    }
    // A backslash before the closing quote would escape it. Names of files have no double quotes.
    let end = word.len() - word.trim_end_matches('\\').len();
    format!("\"{word}{}\"", r"\".repeat(end))
}

/// Returns whether no shell takes a word for something else; zsh has a command's path for `=ls`.
fn is_plain(word: &str) -> bool {
    !word.is_empty()
        && !word.starts_with('=')
        && word
            .chars()
            .all(|c| c.is_alphanumeric() || "/._-+=:,%@".contains(c))
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    #[test]
    fn a_path_has_no_dot_before_it() {
        let shown = ["./a/b", ".", "./-a", "-a/b", "../a"].map(|path| shown_path(Path::new(path)));
        assert_eq!(shown, ["a/b", ".", "./-a", "./-a/b", "../a"]);
    }

    #[test]
    fn a_quoted_path_is_one_word() {
        assert_eq!(quoted_path(Path::new("/a b/it's")), r"'/a b/it'\''s'");
        assert_eq!(quoted_path(Path::new("/a-b/c_1.x")), "/a-b/c_1.x");
        assert_eq!(quoted("=ls"), "'=ls'");
        assert_eq!(quoted("a=ls"), "a=ls");
    }

    #[test]
    #[cfg(unix)]
    fn a_command_names_what_is_escaped_where_it_is_shown() {
        let path = Path::new("a\u{3164}'\\/b%\t");
        assert_eq!(
            command_path(path),
            r#""$(printf 'a\343\205\244\047\134/b\045\011')""#
        );
    }

    #[test]
    #[cfg(unix)]
    fn all_shells_read_the_same_word() {
        let words = [
            "a\u{3164}';touch x #",
            "-n\u{202e}$(touch x)`touch x`\"!!",
            "%s\\n\u{1b}[2J",
            "a\nb",
            "=ls",
            "é'\u{200b}",
        ];
        for shell in [
            &["sh"][..],
            &["bash"],
            &["dash"],
            &["zsh"],
            &["busybox", "sh"],
        ] {
            for word in words {
                let script = format!("printf '%s' {}", command_word(word));
                let mut command = Command::new(shell[0]);
                // Not all are installed.
                let Ok(done) = command.args(&shell[1..]).args(["-c", &script]).output() else {
                    continue;
                };
                let said = String::from_utf8_lossy(&done.stdout);
                assert_eq!(said, word, "{shell:?}: {script}");
            }
        }
        assert_eq!(command_word("a\n"), r#""$(printf 'a\012/')""#);
    }

    #[test]
    fn windows_has_other_quotes() {
        assert_eq!(for_windows(r"C:\it's a\b"), "\"C:\\it's a\\b\"");
        assert_eq!(for_windows(r"C:\a-b\c_1.x"), r"C:\a-b\c_1.x");
        assert_eq!(for_windows(r"C:\my dir\"), r#""C:\my dir\\""#);
        assert_eq!(for_windows(r"C:\$(it's)"), r"'C:\$(it''s)'");
        assert_eq!(for_windows("a,b"), "\"a,b\"");
    }
}
