//! The log of the daemon on stderr, in which values are printable like all text on a terminal.

use std::{
    env,
    io::{self, Write},
};

use tracing::level_filters::LevelFilter;
use tracing_subscriber::{
    field::MakeExt, filter::Targets, fmt::format, layer::SubscriberExt, util::SubscriberInitExt,
};

use super::terminal::is_stderr_terminal;
use crate::base::printable::{json_escaped, printable};

/// Format of the log.
#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum LogFormat {
    Text,
    Json,
}

/// Starts the log. RUST_LOG sets the level, as `debug` or `viewrank=debug`; under systemd the
/// journal adds the times.
#[expect(clippy::disallowed_methods, reason = "values are escaped")]
pub fn start(format: LogFormat) {
    let wanted: Option<Targets> = env::var("RUST_LOG").ok().and_then(|text| text.parse().ok());
    let filter =
        wanted.unwrap_or_else(|| Targets::new().with_target("viewrank", LevelFilter::INFO));
    let log = tracing_subscriber::fmt()
        // The filter decides; by default the library drops all below INFO, whatever RUST_LOG says.
        .with_max_level(LevelFilter::TRACE)
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
        LogFormat::Json => {
            let log = log.json().with_writer(|| JsonLines(io::stderr()));
            log.finish().with(filter).init();
        }
        LogFormat::Text => {
            let log = log
                .fmt_fields(values.delimited(" "))
                .with_writer(io::stderr);
            match env::var_os("JOURNAL_STREAM") {
                Some(_) => {
                    let log = log.without_time().with_ansi(false);
                    log.finish().with(filter).init();
                }
                None => {
                    let log = log.with_ansi(is_stderr_terminal());
                    log.finish().with(filter).init();
                }
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
        // The length of what was given, as `Write` wants it, not of what it became.
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}
