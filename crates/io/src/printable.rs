//! Names, messages and settings of a project may come from a stranger, and may hold what a terminal
//! obeys, at once or when somebody looks at a file with `cat`.

use std::fmt::Write;

use serde::Serialize;

/// Escapes what a terminal would not show but obey, as Rust does: `\n`, `\u{1b}`.
pub fn printable(text: &str) -> String {
    escaped(text, |c| c.escape_default().to_string())
}

/// Escapes a text for XML and HTML, on one line.
pub fn in_markup(text: &str) -> String {
    printable(text)
        .replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
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
    // Line breaks are those of the layout: JSON has escaped the ones in texts.
    escaped(text, |c| if c == '\n' { c.into() } else { escape(c) })
}

/// Formats a value as indented JSON with a final newline, without what a terminal would obey.
///
/// # Panics
/// On values that JSON does not have: maps with keys other than strings, and the like.
pub fn to_json(value: &impl Serialize) -> String {
    json_escaped(&serde_json::to_string_pretty(value).expect("what is written is JSON")) + "\n"
}

/// Escapes all but printable characters.
pub fn escaped(text: &str, escape: impl Fn(char) -> String) -> String {
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

/// Returns whether a letter or mark shows nothing: with it, one name looks like another.
fn is_blank(c: char) -> bool {
    matches!(
        c,
        '\u{34f}'
            | '\u{115f}'
            | '\u{1160}'
            | '\u{17b4}'
            | '\u{17b5}'
            | '\u{2800}'
            | '\u{3164}'
            | '\u{ffa0}'
    ) || matches!(c, '\u{180b}'..='\u{180f}' | '\u{fe00}'..='\u{fe0f}' | '\u{e0100}'..='\u{e01ef}')
}

/// Returns whether a character is a graphic one or the blank: no control, no format character (as
/// those that change the direction of text), no separator of lines, nothing unassigned.
pub fn is_printable(c: char) -> bool {
    // Of a string, the standard library escapes just the others, and quotes and backslashes; at its
    // start combining accents, too.
    let shown = |c: char| String::from_iter(['a', c]).escape_debug().count() == 2;
    matches!(c, ' '..='~') || shown(c) && !is_blank(c)
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
            ("\u{3164}\u{a0}\u{3000}", r"\u{3164}\u{a0}\u{3000}"),
            ("a\u{34f}\u{fe0f}", r"a\u{34f}\u{fe0f}"),
        ];
        for (text, expected) in shown {
            assert_eq!(printable(text), expected);
        }
    }
}
