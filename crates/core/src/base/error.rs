//! The trait of all errors of this crate and those above it, what their hints are made of, and how
//! long their texts may be.

use std::{borrow::Cow, fmt};

/// Errors are interface: `Display` says what went wrong and where (file with byte or line, view,
/// setting), its cause included; `hint` says what to do about it. Only the program prints them, in
/// one place.
pub trait Hint: std::error::Error {
    /// Returns advice, an imperative; `None` if there is none.
    fn hint(&self) -> Option<Advice>;

    /// Returns the file or folder that the error concerns, if any.
    fn path(&self) -> Option<&std::path::Path> {
        None
    }

    /// Returns whether an argument or a setting is wrong (exit code 2).
    fn is_usage(&self) -> bool {
        false
    }
}

/// Most characters of an error or a warning, which may quote a file: a single word of it may have
/// as many megabytes.
const MOST_CHARACTERS: usize = 1000;
/// Those of them at the end, which says what is wrong with what is quoted.
const AT_END: usize = 300;

/// An error or a warning without its middle, if it is longer than anybody reads.
pub fn shortened(text: &str) -> Cow<'_, str> {
    if text.chars().nth(MOST_CHARACTERS).is_none() {
        return text.into();
    }
    // 5 characters are the dots between, with their blanks.
    let start = text.char_indices().nth(MOST_CHARACTERS - AT_END - 5);
    let end = text.char_indices().nth_back(AT_END - 1);
    let [start, end] = [start, end].map(|found| found.map_or(0, |(at, _)| at));
    format!("{} ... {}", &text[..start], &text[end..]).into()
}

/// What to do about an error. Settings and commands in it are values, not words: the command line
/// writes them as options, Python as keywords.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Advice(Vec<Part>);

/// A part of an [`Advice`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Part {
    Text(String),
    /// A setting by its key (or an argument by its name), with a value to give it.
    Set(&'static str, Option<String>),
    /// A command of the program.
    Run(String),
}

impl Advice {
    pub fn text(text: impl Into<String>) -> Self {
        Self::default().and(text)
    }

    /// Continues with text.
    pub fn and(mut self, text: impl Into<String>) -> Self {
        self.0.push(Part::Text(text.into()));
        self
    }

    /// Continues with a setting.
    pub fn set(mut self, key: &'static str) -> Self {
        self.0.push(Part::Set(key, None));
        self
    }

    /// Continues with a setting and its value.
    pub fn set_to(mut self, key: &'static str, value: impl Into<String>) -> Self {
        self.0.push(Part::Set(key, Some(value.into())));
        self
    }

    /// Continues with a command, without the program's name.
    pub fn run(mut self, command: impl Into<String>) -> Self {
        self.0.push(Part::Run(command.into()));
        self
    }

    /// Continues with other advice.
    pub fn join(mut self, other: Self) -> Self {
        self.0.extend(other.0);
        self
    }

    /// Writes the advice; `set` writes a setting with its value.
    pub fn describe(&self, set: impl Fn(&str, Option<&str>) -> String) -> String {
        let part = |part: &Part| match part {
            Part::Text(text) => text.clone(),
            Part::Set(key, value) => set(key, value.as_deref()),
            Part::Run(command) => format!("viewrank {command}"),
        };
        self.0.iter().map(part).collect()
    }
}

impl From<&str> for Advice {
    fn from(text: &str) -> Self {
        Self::text(text)
    }
}

impl From<String> for Advice {
    fn from(text: String) -> Self {
        Self::text(text)
    }
}

impl fmt::Display for Advice {
    /// Names settings by their keys.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.describe(|key, value| match value {
            None => key.into(),
            Some(value) => format!("{key} = {value}"),
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_of_a_long_text_is_left_out() {
        let long = format!("{} is no number", "\u{e9}".repeat(1 << 20));
        let shown = shortened(&long);
        assert_eq!(shown.chars().count(), MOST_CHARACTERS);
        assert!(shown.starts_with('\u{e9}') && shown.ends_with(" is no number"));
        let just_so = "\u{e9}".repeat(MOST_CHARACTERS);
        assert_eq!(shortened(&just_so), just_so);
    }

    #[test]
    fn each_audience_reads_settings_in_its_own_terms() {
        let advice = Advice::text("set ")
            .set("target.gsd")
            .and(", or plan without pictures: ")
            .set_to("confidence.source", "geometric")
            .and(" (")
            .run("doctor")
            .and(")");
        let options = advice.describe(|key, value| format!("--{key} {}", value.unwrap_or("X")));
        assert_eq!(
            options,
            "set --target.gsd X, or plan without pictures: --confidence.source geometric (viewrank doctor)"
        );
        assert_eq!(
            advice.to_string(),
            "set target.gsd, or plan without pictures: confidence.source = geometric (viewrank doctor)"
        );
    }
}
