//! The command line: one file per subcommand; arguments and printing, no method.
//!
//! Data goes to stdout, messages to stderr. A subcommand returns `Result<(), Failure>`; each error of the
//! library becomes a `Failure` by `?`, which [`main`] prints as `error: ...` and `hint: ...`.

mod arguments;
mod backends;
mod completions;
mod config;
mod dispatch;
mod doctor;
mod evaluate;
mod export;
mod inspect;
mod next;
mod plan;
mod predict;
mod progress;
mod ready;
mod report;
mod run;
mod status;
mod summary;
mod train;
mod undistort;
mod watch;

use std::{
    ffi::OsString,
    io::{ErrorKind, IsTerminal, Write},
    process::ExitCode,
};

use crate::base::error::Hint;
use clap::{
    Parser, Subcommand,
    builder::styling::{AnsiColor, Style},
};
use rayon::ThreadPoolBuilder;

/// Width of text output, characters.
const COLUMNS: usize = 80;

/// Exit code of the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    Success = 0,
    /// Input, disk or the run itself failed.
    Failed = 1,
    /// Arguments or settings are wrong; nothing was started.
    Usage = 2,
    /// `doctor` found warnings, but no errors.
    Warnings = 3,
    /// `doctor` found errors.
    Errors = 4,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

/// Error that ends the program, as printed: message, hint, exit code.
#[derive(Debug)]
pub struct Failure {
    pub exit: Exit,
    message: String,
    hint: Option<String>,
    /// The message has been printed to stderr.
    is_printed: bool,
    /// The result has been printed to stdout: no error may follow it there.
    has_result: bool,
}

impl Failure {
    fn new(exit: Exit, message: impl Into<String>, hint: impl Into<Option<String>>) -> Self {
        Self { exit, message: message.into(), hint: hint.into(), is_printed: false, has_result: false }
    }

    /// Returns a failure that the printed result describes.
    fn already_printed(exit: Exit) -> Self {
        Self { is_printed: true, ..Self::new(exit, "", None) }
    }

    /// Returns a failure to be printed after a result.
    fn behind_result(self) -> Self {
        Self { has_result: true, ..self }
    }

    /// Prints the error to stderr, and to stdout as JSON where results are JSON.
    pub fn print(&self) {
        if !self.is_printed {
            complain(&format!("{ERROR}error:{ERROR:#} {}", self.message));
            if let Some(hint) = &self.hint {
                complain(&format!("{HINT}hint:{HINT:#} {hint}"));
            }
        }
        if arguments::asks_for_json() && !self.message.is_empty() && !self.has_result {
            let error = serde_json::json!({ "error": self.message, "hint": self.hint, "exit": self.exit as u8 });
            _ = print(&json(&error));
        }
    }
}

/// Styles of words on stderr, as clap's.
const ERROR: Style = AnsiColor::Red.on_default().bold();
const WARNING: Style = AnsiColor::Yellow.on_default().bold();
const HINT: Style = AnsiColor::Green.on_default();

impl<E: Hint> From<E> for Failure {
    fn from(error: E) -> Self {
        let exit = if error.is_usage() { Exit::Usage } else { Exit::Failed };
        Self::new(exit, error.to_string(), error.hint())
    }
}

/// Writes data to stdout. A reader that closes the pipe early (`| head`) is not an error.
fn print(text: &str) -> Result<(), Failure> {
    let mut stdout = std::io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::new(Exit::Failed, format!("cannot write to stdout: {error}"), None))
        }
        _ => Ok(()),
    }
}

/// Writes a line to stderr, with its colours on a terminal only; a closed stderr is not an error.
fn complain(line: &str) {
    _ = writeln!(anstream::stderr(), "{line}");
}

/// Prints a warning to stderr.
fn warn(warning: &str) {
    advise("warning:", WARNING, warning);
}

/// Prints an explanation of the following output to stderr.
fn note(fact: &str) {
    advise("note:", HINT, fact);
}

/// Prints a heading and words: wrapped on a terminal, else on a single line.
fn advise(heading: &str, style: Style, words: &str) {
    let text = match std::io::stderr().is_terminal() {
        true => wrapped(&format!("{heading} "), words).trim_end().to_owned(),
        false => format!("{heading} {words}"),
    };
    let words = text.strip_prefix(heading).unwrap_or_default();
    complain(&format!("{style}{heading}{style:#}{words}"));
}

/// Wraps `words` after `heading` at [`COLUMNS`]; a longer word stays whole, so that it can be copied.
fn wrapped(heading: &str, words: &str) -> String {
    let indent = " ".repeat(heading.len());
    let (mut text, mut line) = (String::new(), heading.to_owned());
    let mut empty = true;
    for word in words.split(' ') {
        if !empty && line.chars().count() + 1 + word.chars().count() > COLUMNS {
            text += &line;
            text.push('\n');
            line.clone_from(&indent);
            empty = true;
        }
        if !empty {
            line.push(' ');
        }
        line += word;
        empty = false;
    }
    text + &line + "\n"
}

/// Sets the size of the global thread pool; `None`: a thread per core.
fn use_threads(threads: Option<u16>) {
    if let Some(threads) = threads {
        let pool = ThreadPoolBuilder::new().num_threads(threads.into()).build_global();
        pool.expect("no other pool was made before");
    }
}

/// Format of results on stdout.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
enum Format {
    /// For people.
    #[default]
    Text,
    /// For programs.
    Json,
}

/// Formats a value as indented JSON with a final newline.
fn json(value: &impl serde::Serialize) -> String {
    serde_json::to_string_pretty(value).expect("what is printed is JSON") + "\n"
}

/// Ranks multi-view stereo view clusters before matching: which key views, with which partners, in which order.
#[derive(Parser)]
#[command(name = "viewrank", version, arg_required_else_help = true, max_term_width = 80)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
// One value per run of the program.
#[allow(clippy::large_enum_variant)]
enum Command {
    Plan(plan::Arguments),
    Run(run::Arguments),
    Evaluate(evaluate::Arguments),
    Train(train::Arguments),
    Predict(predict::Arguments),
    Export(export::Arguments),
    Report(report::Arguments),
    Doctor(doctor::Arguments),
    Backends(backends::Arguments),
    Undistort(undistort::Arguments),
    Config(config::Arguments),
    Dispatch(dispatch::Arguments),
    Inspect(inspect::Arguments),
    Watch(watch::Arguments),
    Status(status::Arguments),
    Completions(completions::Arguments),
    Man(completions::ManArguments),
}

/// Runs the program: parses arguments, prints errors, returns the exit code.
pub fn main() -> ExitCode {
    run_with(std::env::args_os()).into()
}

/// Runs the program with these arguments, the first of which is its name, as [`main`] does.
pub fn run_with(arguments: impl IntoIterator<Item = OsString>) -> Exit {
    match run(arguments) {
        Ok(()) => Exit::Success,
        Err(failure) => {
            failure.print();
            failure.exit
        }
    }
}

/// Runs the subcommand.
fn run(arguments: impl IntoIterator<Item = OsString>) -> Result<(), Failure> {
    match arguments::parse(arguments.into_iter().collect())?.command {
        Command::Plan(arguments) => plan::run(&arguments),
        Command::Run(arguments) => run::run(&arguments),
        Command::Evaluate(arguments) => evaluate::run(&arguments),
        Command::Train(arguments) => train::run(&arguments),
        Command::Predict(arguments) => predict::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
        Command::Report(arguments) => report::run(&arguments),
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Backends(arguments) => backends::run(&arguments),
        Command::Undistort(arguments) => undistort::run(&arguments),
        Command::Config(arguments) => config::run(&arguments),
        Command::Dispatch(arguments) => dispatch::run(&arguments),
        Command::Inspect(arguments) => inspect::run(&arguments),
        Command::Watch(arguments) => watch::run(arguments),
        Command::Status(arguments) => status::run(&arguments),
        Command::Completions(arguments) => completions::run(&arguments),
        Command::Man(arguments) => completions::man(&arguments),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_wrap_at_the_output_width() {
        let text = wrapped("warning ", &"word ".repeat(60));
        assert!(text.lines().all(|line| line.chars().count() <= COLUMNS) && text.lines().count() > 3);
        assert_eq!(wrapped("- ", "one"), "- one\n");
        let long = "x".repeat(100);
        assert_eq!(wrapped("- ", &long), format!("- {long}\n"), "long words stay whole");
    }
}
