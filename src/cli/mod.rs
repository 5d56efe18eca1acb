//! The command line: one file per subcommand; arguments and printing, no method.
//!
//! Data goes to stdout, messages to stderr, both through [`terminal`]. A subcommand returns
//! `Result<(), Failure>`; each error of the library becomes a `Failure` by `?`, which [`main`]
//! prints as `error: ...` and `hint: ...`.

mod arguments;
mod backends;
mod completions;
mod config;
mod dispatch;
mod doctor;
mod evaluate;
mod export;
mod inspect;
mod log;
mod next;
mod pilot;
mod plan;
mod predict;
mod progress;
mod ready;
mod report;
mod run;
mod status;
mod summary;
mod terminal;
mod train;
mod undistort;
mod watch;

use std::{ffi::OsString, process::ExitCode};

use crate::base::advice::on_command_line;
use crate::base::error::{Hint, shortened};
use clap::{Parser, Subcommand};
use rayon::ThreadPoolBuilder;
use terminal::{COLUMNS, note, print, print_json, print_sentences, warn, wrapped};

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
    /// Lines that a program printed before it failed.
    output: Vec<String>,
    hint: Option<String>,
    /// The message has been printed to stderr.
    is_printed: bool,
    /// The result has been printed to stdout: no error may follow it there.
    has_result: bool,
    /// By the user: no error.
    is_stop: bool,
}

impl Failure {
    fn new(exit: Exit, message: impl Into<String>, hint: impl Into<Option<String>>) -> Self {
        let hint: Option<String> = hint.into();
        Self {
            exit,
            message: shortened(&message.into()).into_owned(),
            output: Vec::new(),
            hint: hint.map(|hint| shortened(&hint).into_owned()),
            is_printed: false,
            has_result: false,
            is_stop: false,
        }
    }

    /// Returns the end that the user asked for with Ctrl-C. `at`: how far it got.
    fn stopped(at: &str, go_on: String) -> Self {
        Self {
            is_stop: true,
            ..Self::new(Exit::Failed, format!("stopped {at}"), go_on)
        }
    }

    /// Adds what a program printed before it failed, but for the line that the message ends with.
    fn with_output(self, output: &str) -> Self {
        let is_said = |line: &&str| {
            let line = line.trim();
            let words = line.strip_prefix("error: ").unwrap_or(line);
            !words.is_empty() && self.message.ends_with(words)
        };
        let lines = output.lines().filter(|line| !is_said(line));
        Self {
            output: lines.map(String::from).collect(),
            ..self
        }
    }

    /// Returns a failure that the printed result describes.
    fn already_printed(exit: Exit) -> Self {
        Self {
            is_printed: true,
            ..Self::new(exit, "", None)
        }
    }

    /// Returns a failure to be printed after a result.
    fn behind_result(self) -> Self {
        Self {
            has_result: true,
            ..self
        }
    }

    /// Prints the error to stderr, and to stdout as JSON where results are JSON.
    pub fn print(&self) {
        if !self.is_printed {
            let (error, hint) = if self.is_stop {
                ("", "")
            } else {
                ("error:", "hint:")
            };
            terminal::advise(error, terminal::ERROR, &self.message);
            self.output
                .iter()
                .for_each(|line| terminal::complain(&format!("  {line}")));
            if let Some(words) = &self.hint {
                terminal::advise(hint, terminal::HINT, words);
            }
        }
        if arguments::asks_for_json() && !self.message.is_empty() && !self.has_result {
            let lines: Vec<&str> = std::iter::once(&self.message)
                .chain(&self.output)
                .map(String::as_str)
                .collect();
            let error = serde_json::json!({ "error": lines.join("\n"), "hint": self.hint, "exit": self.exit as u8 });
            _ = print_json(&error);
        }
    }
}

impl<E: Hint> From<E> for Failure {
    fn from(error: E) -> Self {
        let exit = if error.is_usage() {
            Exit::Usage
        } else {
            Exit::Failed
        };
        let hint = error.hint().map(|advice| on_command_line(&advice));
        Self::new(exit, error.to_string(), hint)
    }
}

/// Sets the size of the global thread pool; `None`: a thread per core.
fn use_threads(threads: Option<u16>) {
    if let Some(threads) = threads {
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads.into())
            .build_global();
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

/// Ranks multi-view stereo view clusters before matching: which key views, with which partners, in
/// which order.
#[derive(Parser)]
#[command(
    name = "viewrank",
    version,
    arg_required_else_help = true,
    max_term_width = 80
)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
// One value per run of the program.
#[allow(clippy::large_enum_variant)]
enum Command {
    Plan(plan::Arguments),
    Pilot(pilot::Arguments),
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
        Command::Pilot(arguments) => pilot::run(&arguments),
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
