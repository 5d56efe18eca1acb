//! The log of the daemon on stderr, in which values are printable like all text on a terminal.

use std::io::{self, Write};

use tracing_subscriber::{EnvFilter, field::MakeExt, fmt::format};

use super::terminal::is_stderr_terminal;
use crate::base::printable::{json_escaped, printable};

/// Format of the log.
#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum LogFormat {
    Text,
    Json,
}

/// Starts the log. RUST_LOG sets the level; under systemd the journal adds the times.
#[expect(clippy::disallowed_methods, reason = "values are escaped")]
pub fn start(format: LogFormat) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| "viewrank=info".into());
    let log = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(false);
    // The library's own format leaves values as they are.
    let values = format::debug_fn(|text: &mut format::Writer<'_>, field, value| {
        let value = printable(&format!("{value:?}"));
        match field.name() {
            "message" => write!(text, "{value}"),
            name => write!(text, "{name}={value}"),
        }
    });
    match format {
        LogFormat::Json => log.json().with_writer(|| JsonLines(io::stderr())).init(),
        LogFormat::Text => {
            let log = log
                .fmt_fields(values.delimited(" "))
                .with_writer(io::stderr);
            match std::env::var_os("JOURNAL_STREAM") {
                Some(_) => log.without_time().with_ansi(false).init(),
                None => log.with_ansi(is_stderr_terminal()).init(),
            }
        }
    }
}

/// Escapes in lines of JSON what is not printable.
struct JsonLines<W>(W);

impl<W: Write> Write for JsonLines<W> {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.0
            .write_all(json_escaped(&String::from_utf8_lossy(line)).as_bytes())?;
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}
