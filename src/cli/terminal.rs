//! Text on stdout and stderr. What does not pass here has no name of a project unescaped: usage
//! errors ([`arguments`](super::arguments)), the log ([`log`](super::log)), progress bars, which
//! are fixed words.
//!
//! Names, messages and settings of a project may come from a stranger, and may hold what a terminal
//! obeys. So text is a list of lines, and of each line only [printable](crate::base::printable)
//! characters are printed; others are shown escaped, line breaks too. Data ([`print_json`],
//! [`print_data`]) has the escapes of its own format.

use std::io::{ErrorKind, IsTerminal, Write};

use clap::builder::styling::{AnsiColor, Style};
use serde::Serialize;

use super::{Exit, Failure};
use crate::base::printable::{escaped, json_escaped, printable, to_json};

/// Width of tables and of text on stderr, characters.
pub const COLUMNS: usize = 80;
/// Width of sentences on stdout where there is no terminal, characters.
const COLUMNS_OF_FILES: usize = 100;
/// Narrowest terminal at which sentences are wrapped.
const NARROWEST: usize = 20;

/// Styles of words on stderr, as clap's.
pub const ERROR: Style = AnsiColor::Red.on_default().bold();
pub const WARNING: Style = AnsiColor::Yellow.on_default().bold();
pub const HINT: Style = AnsiColor::Green.on_default();

/// Prints text to stdout.
pub fn print(lines: impl IntoIterator<Item = impl AsRef<str>>) -> Result<(), Failure> {
    write(
        &lines
            .into_iter()
            .map(|line| printable(line.as_ref()) + "\n")
            .collect::<String>(),
    )
}

/// Prints sentences to stdout, wrapped at the width of the terminal; rows of tables, which begin
/// with a blank, stay whole.
pub fn print_sentences(lines: impl IntoIterator<Item = impl AsRef<str>>) -> Result<(), Failure> {
    let columns = terminal_columns().unwrap_or(COLUMNS_OF_FILES);
    let wrapped = |line: &str| {
        if line.starts_with(' ') {
            vec![line.to_owned()]
        } else {
            wrapped_at(columns, "", line)
        }
    };
    print(lines.into_iter().flat_map(|line| wrapped(line.as_ref())))
}

/// Prints a value as indented JSON to stdout.
pub fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    print_data(&to_json(value))
}

/// Prints a value as JSON on one line to stdout.
pub fn print_json_line(value: &impl Serialize) -> Result<(), Failure> {
    print_data(&json_escaped(
        &serde_json::to_string(value).expect("what is printed is JSON"),
    ))
}

/// Prints a file in some format to stdout; its names are escaped as that format does it.
pub fn print_data(text: &str) -> Result<(), Failure> {
    let end = if text.ends_with('\n') { "" } else { "\n" };
    write(
        &(escaped(text, |c| match c {
            '\n' | '\t' => c.into(),
            c => c.escape_default().to_string(),
        }) + end),
    )
}

/// Writes to stdout. A reader that closes the pipe early (`| head`) is not an error.
#[expect(clippy::disallowed_methods, reason = "all that is printed passes here")]
fn write(text: &str) -> Result<(), Failure> {
    let mut stdout = std::io::stdout().lock();
    match stdout
        .write_all(text.as_bytes())
        // Flushed here: at exit, nobody would hear of an error.
        .and_then(|()| stdout.flush())
    {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(Failure::new(
            Exit::Failed,
            format!("cannot write to stdout: {error}"),
            None,
        )),
        _ => Ok(()),
    }
}

/// Prints a line to stderr; a closed stderr is not an error.
pub fn complain(line: &str) {
    complain_of("", Style::new(), line);
}

/// Prints a line to stderr that begins with a heading, whose style is shown on a terminal only.
#[expect(clippy::disallowed_methods, reason = "all that is printed passes here")]
fn complain_of(heading: &'static str, style: Style, words: &str) {
    _ = writeln!(
        anstream::stderr(),
        "{style}{heading}{style:#}{}",
        printable(words)
    );
}

/// Prints a warning to stderr.
pub fn warn(warning: &str) {
    advise("warning:", WARNING, warning);
}

/// Prints an explanation of the following output to stderr.
pub fn note(fact: &str) {
    advise("note:", HINT, fact);
}

/// Prints a heading, which may be empty, and words to stderr: wrapped on a terminal, else on a
/// single line.
pub fn advise(heading: &'static str, style: Style, words: &str) {
    let space = if heading.is_empty() { "" } else { " " };
    let lines = if is_stderr_terminal() {
        wrapped(&format!("{heading}{space}"), words)
    } else {
        vec![format!("{heading}{space}{words}")]
    };
    for line in lines {
        match line.strip_prefix(heading) {
            Some(words) => complain_of(heading, style, words),
            None => complain(&line),
        }
    }
}

/// Width of the terminal that stdout goes to, columns; `None` without one.
#[expect(clippy::disallowed_methods, reason = "nothing is written")]
fn terminal_columns() -> Option<usize> {
    let (width, _) = terminal_size::terminal_size_of(std::io::stdout())?;
    Some(usize::from(width.0).max(NARROWEST))
}

#[expect(clippy::disallowed_methods, reason = "nothing is written")]
pub fn is_stdout_terminal() -> bool {
    std::io::stdout().is_terminal()
}

#[expect(clippy::disallowed_methods, reason = "nothing is written")]
pub fn is_stderr_terminal() -> bool {
    std::io::stderr().is_terminal()
}

/// Wraps `words` after `heading` at [`COLUMNS`]; a longer word stays whole, so that it can be
/// copied.
pub fn wrapped(heading: &str, words: &str) -> Vec<String> {
    wrapped_at(COLUMNS, heading, words)
}

fn wrapped_at(columns: usize, heading: &str, words: &str) -> Vec<String> {
    let indent = " ".repeat(heading.len());
    let (mut lines, mut line) = (Vec::new(), heading.to_owned());
    let mut empty = true;
    // Split at single blanks, so that two blanks in a path stay two.
    for word in words.split(' ') {
        if !empty && line.chars().count() + 1 + word.chars().count() > columns {
            lines.push(std::mem::replace(&mut line, indent.clone()));
            empty = true;
        }
        if !empty {
            line.push(' ');
        }
        line += word;
        empty = false;
    }
    lines.push(line);
    lines
}

/// Escapes in a string of TOML what is not printable.
pub fn toml_escaped(text: &str) -> String {
    escaped(text, |c| format!("\\U{:08x}", u32::from(c)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::printable::is_printable;

    #[test]
    fn escaped_data_says_the_same() {
        let text = "é \"\\ \x1b\u{7f}\u{9b}\u{202e}\u{e0041}\u{1f600}\n";
        let as_json = to_json(&[text]);
        assert!(
            as_json.chars().all(|c| c == '\n' || is_printable(c)),
            "{as_json}"
        );
        assert_eq!(
            serde_json::from_str::<[String; 1]>(&as_json).unwrap(),
            [text]
        );
        let as_toml = toml_escaped(&format!("a = {}", serde_json::Value::from(text)));
        assert!(as_toml.chars().all(is_printable), "{as_toml}");
        assert_eq!(
            toml::from_str::<toml::Table>(&as_toml).unwrap()["a"].as_str(),
            Some(text)
        );
    }

    #[test]
    fn lines_wrap_at_the_output_width() {
        let at = |columns| wrapped_at(columns, "", "one two three");
        assert_eq!(at(7), ["one two", "three"]);
        assert_eq!(at(13), ["one two three"]);

        let lines = wrapped("warning ", &"word ".repeat(60));
        assert!(lines.iter().all(|line| line.chars().count() <= COLUMNS) && lines.len() > 3);
        assert_eq!(wrapped("- ", "one"), ["- one"]);
        let long = "x".repeat(100);
        assert_eq!(
            wrapped("- ", &long),
            [format!("- {long}")],
            "long words stay whole"
        );
    }
}
