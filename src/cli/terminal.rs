//! Text on stdout and stderr. What does not pass here has no name of a project unescaped: usage
//! errors ([`arguments`](super::arguments)), the log ([`log`](super::log)), progress bars, which
//! are fixed words.
//!
//! Names, messages and settings of a project may come from a stranger, and may hold what a terminal
//! obeys. So text is a list of lines, and of each line only [printable](is_printable) characters
//! are printed; others are shown escaped, line breaks too. Data ([`print_json`], [`print_data`])
//! has the escapes of its own format.

use std::{
    fmt::Write as _,
    io::{ErrorKind, IsTerminal, Write},
};

use clap::builder::styling::{AnsiColor, Style};
use serde::Serialize;

use super::{Exit, Failure};

/// Width of text output, characters.
pub const COLUMNS: usize = 80;

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

/// Prints a value as indented JSON to stdout.
pub fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    print_data(&json(value))
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
pub fn complain_of(heading: &'static str, style: Style, words: &str) {
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

/// Prints a heading and words: wrapped on a terminal, else on a single line.
fn advise(heading: &'static str, style: Style, words: &str) {
    let lines = if is_stderr_terminal() {
        wrapped(&format!("{heading} "), words)
    } else {
        vec![format!("{heading} {words}")]
    };
    for line in lines {
        match line.strip_prefix(heading) {
            Some(words) => complain_of(heading, style, words),
            None => complain(&line),
        }
    }
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
    let indent = " ".repeat(heading.len());
    let (mut lines, mut line) = (Vec::new(), heading.to_owned());
    let mut empty = true;
    for word in words.split(' ') {
        if !empty && line.chars().count() + 1 + word.chars().count() > COLUMNS {
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

/// Escapes what a terminal would not show but obey, as Rust does: `\n`, `\u{1b}`.
pub fn printable(text: &str) -> String {
    escaped(text, |c| c.escape_default().to_string())
}

/// Formats a value as indented JSON with a final newline.
pub fn json(value: &impl Serialize) -> String {
    json_escaped(&serde_json::to_string_pretty(value).expect("what is printed is JSON")) + "\n"
}

/// Escapes in JSON what is not printable; JSON itself escapes C0 controls only.
pub fn json_escaped(text: &str) -> String {
    let escape = |c: char| {
        let units = &mut [0; 2];
        c.encode_utf16(units)
            .iter()
            .fold(String::new(), |mut text, unit| {
                _ = write!(text, "\\u{unit:04x}");
                text
            })
    };
    escaped(text, |c| if c == '\n' { c.into() } else { escape(c) })
}

/// Escapes in a string of TOML what is not printable.
pub fn toml_escaped(text: &str) -> String {
    escaped(text, |c| format!("\\U{:08x}", u32::from(c)))
}

fn escaped(text: &str, escape: impl Fn(char) -> String) -> String {
    text.chars()
        .fold(String::with_capacity(text.len()), |mut shown, c| {
            if is_printable(c) {
                shown.push(c)
            } else {
                shown += &escape(c)
            }
            shown
        })
}

/// Returns whether a character is a graphic one or a blank: no control, no format character (as
/// those that change the direction of text), no separator of lines, nothing unassigned.
fn is_printable(c: char) -> bool {
    // Of a string, the standard library escapes just the others, and quotes and backslashes; at its
    // start combining accents, too.
    let shown = |c: char| String::from_iter(['a', c]).escape_debug().count() == 2;
    matches!(c, ' '..='~') || shown(c)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_obeys_is_escaped() {
        let shown = [
            ("a b/é\u{301} 名 😀 \"'\\", "a b/é\u{301} 名 😀 \"'\\"),
            ("c\nd\x1b[2J\u{7f}\r\t", r"c\nd\u{1b}[2J\u{7f}\r\t"),
            (
                "\u{9b}31m\u{202e}\u{2066}\u{200b}\u{2028}\u{feff}",
                r"\u{9b}31m\u{202e}\u{2066}\u{200b}\u{2028}\u{feff}",
            ),
            ("\u{e0041}\u{fff9}\u{ad}", r"\u{e0041}\u{fff9}\u{ad}"),
        ];
        for (text, expected) in shown {
            assert_eq!(printable(text), expected);
        }
    }

    #[test]
    fn escaped_data_says_the_same() {
        let text = "é \"\\ \x1b\u{7f}\u{9b}\u{202e}\u{e0041}\u{1f600}\n";
        let as_json = json(&[text]);
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
