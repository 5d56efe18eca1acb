//! Parses arguments, prints errors, sets the exit code; nothing else.

mod cli;

use std::process::ExitCode;

fn main() -> ExitCode {
    match cli::run() {
        Ok(()) => cli::Exit::Success.into(),
        Err(failure) => {
            failure.print();
            failure.exit.into()
        }
    }
}
