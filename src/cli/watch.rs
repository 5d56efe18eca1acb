//! `viewrank watch`: the daemon's arguments, signals and log.

use std::{io::IsTerminal, num::NonZeroUsize, path::PathBuf, process, thread, time::Duration};

use crate::{
    base::error::Hint,
    config::Bytes,
    daemon::{Options, PlanJob, PlanOptions, Signal, platform, state::OnBusy, watch_roots},
    io::output::Disk,
};
use clap::{Args, ValueEnum, builder::PossibleValue};
use signal_hook::{
    consts::{SIGHUP, SIGINT, SIGTERM},
    iterator::Signals,
};

use super::Failure;

/// Between two looks at everything.
const SHORTEST_PAUSE: Duration = Duration::from_millis(10);
/// Longer than anybody waits.
const LONGEST: Duration = Duration::from_secs(365 * 24 * 3600);
/// After a signal to stop the process ends within this.
const LONGEST_STOP: Duration = Duration::from_millis(1500);

/// Plan every project under some folders when its sparse model is complete, and follow the backend.
///
/// Runs until stopped (Ctrl-C or SIGTERM); SIGHUP looks at everything again. `viewrank status` shows how things stand.
#[derive(Args)]
pub struct Arguments {
    /// Folders to watch, projects at any depth.
    #[arg(required = true, value_name = "ROOT")]
    roots: Vec<PathBuf>,
    /// A model is complete when its files have been still for so long.
    #[arg(long, default_value = "2s", value_parser = duration, value_name = "TIME")]
    settle: Duration,
    /// Look at all folders so often instead of waiting for file events [default: 10s on network file systems].
    #[arg(long, value_parser = pause, value_name = "TIME")]
    poll: Option<Duration>,
    /// Look at everything so often, for events that were lost.
    #[arg(long, default_value = "10min", value_parser = pause, value_name = "TIME")]
    rescan: Duration,
    /// What to do when a model changes while it is planned.
    #[arg(long, default_value = "restart", value_name = "WHAT")]
    on_busy: OnBusy,
    /// Projects to plan at once.
    #[arg(long, default_value = "1", value_name = "N")]
    jobs: NonZeroUsize,
    /// Memory that all plans together may take, as 4G or 800M [default: half of this machine's].
    #[arg(long, value_name = "SIZE")]
    max_memory: Option<Bytes>,
    /// Follow symbolic links that lead out of the roots.
    #[arg(long)]
    follow_links: bool,
    /// End when every project is planned (for cron and CI); exit code 1 if one could not be.
    #[arg(long)]
    once: bool,
    /// Write a Prometheus text file.
    #[arg(long, value_name = "FILE")]
    metrics: Option<PathBuf>,
    /// Rank again what is left whenever depth maps have come, by what they really reach; what is finished stays first.
    #[arg(long)]
    replan: bool,
    /// Run this by the shell once when a project's target is reached by its depth maps; its folder is in VIEWRANK_PROJECT [default:
    /// on_target of your own viewrank.toml; that of a project is refused].
    #[arg(long, value_name = "COMMAND", value_parser = clap::builder::NonEmptyStringValueParser::new())]
    on_target: Option<String>,
    /// Memory for plans whose depth maps are coming, so that they needn't be made again for each.
    #[arg(long, default_value = "256M", value_name = "SIZE")]
    cache: Bytes,
    #[arg(long, default_value = "text", value_name = "FORMAT")]
    log_format: LogFormat,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum LogFormat {
    Text,
    Json,
}

pub fn run(arguments: Arguments) -> Result<(), Failure> {
    start_log(arguments.log_format);
    platform::lower_priority();
    let once = arguments.once;
    let on_target = arguments.on_target.clone();
    let planner = PlanJob::new(PlanOptions {
        on_target,
        replan: arguments.replan,
        cache: arguments.cache.0,
        follow_links: arguments.follow_links,
    });
    let options = arguments.options();
    let summary = watch_roots(&options, &planner, &Disk::REAL, forward_signals)?;
    match summary.failed {
        failed if failed > 0 && once => Err(Failed { failed, projects: summary.projects }.into()),
        _ => Ok(()),
    }
}

impl Arguments {
    fn options(self) -> Options {
        Options {
            roots: self.roots,
            settle: self.settle,
            poll: self.poll,
            rescan: self.rescan,
            on_busy: self.on_busy,
            jobs: self.jobs.get(),
            max_memory: self.max_memory.map_or_else(|| platform::machine_memory() / 2, |bytes| bytes.0),
            follow_links: self.follow_links,
            once: self.once,
            metrics: self.metrics,
        }
    }
}

#[derive(Debug, thiserror::Error)]
#[error("{failed} of {projects} projects could not be planned")]
struct Failed {
    failed: usize,
    projects: usize,
}

impl Hint for Failed {
    fn hint(&self) -> Option<String> {
        Some("`viewrank status` says why".into())
    }
}

/// The level is set by RUST_LOG; times are left to the journal where there is one.
fn start_log(format: LogFormat) {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| "viewrank=info".into());
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_target(false).with_writer(std::io::stderr);
    match format {
        LogFormat::Json => log.json().init(),
        LogFormat::Text if std::env::var_os("JOURNAL_STREAM").is_some() => log.without_time().with_ansi(false).init(),
        LogFormat::Text => log.with_ansi(std::io::stderr().is_terminal()).init(),
    }
}

fn forward_signals(to_daemon: Box<dyn Fn(Signal) + Send>) {
    let Ok(mut signals) = Signals::new([SIGTERM, SIGINT, SIGHUP]) else { return };
    thread::spawn(move || {
        for signal in signals.forever() {
            if signal == SIGHUP {
                to_daemon(Signal::Rescan);
            } else {
                to_daemon(Signal::Stop);
                thread::spawn(end_in_time);
            }
        }
    });
}

/// Ends the process though a job has not noticed yet that it is cancelled (it reads a large file, say): what is written is whole at
/// any instant.
fn end_in_time() {
    thread::sleep(LONGEST_STOP);
    process::exit(0);
}

/// A duration between two looks.
fn pause(text: &str) -> Result<Duration, String> {
    let pause = duration(text)?;
    if pause < SHORTEST_PAUSE { Err("at least 10ms".into()) } else { Ok(pause) }
}

/// `2s`, `500ms`, `10min`, `1h`; at most a year.
fn duration(text: &str) -> Result<Duration, String> {
    let split = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let seconds = match unit {
        "ms" => 0.001,
        "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err("a number and ms, s, min or h, as in 2s".into()),
    };
    let number: f64 = number.parse().map_err(|_| "a number and ms, s, min or h, as in 2s".to_string())?;
    let duration = Duration::try_from_secs_f64(number * seconds).map_err(|error| error.to_string())?;
    if duration > LONGEST { Err("at most 8760h, a year".into()) } else { Ok(duration) }
}

impl clap::ValueEnum for OnBusy {
    fn value_variants<'a>() -> &'a [Self] {
        &[Self::Restart, Self::Queue]
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(match self {
            Self::Restart => PossibleValue::new("restart").help("Cancel it and start again when the input is still"),
            Self::Queue => PossibleValue::new("queue").help("Finish it, then plan once more"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_that_no_clock_can_wait_for_are_refused() {
        assert_eq!(duration("1.5min"), Ok(Duration::from_secs(90)));
        assert_eq!(duration("8760h"), Ok(LONGEST));
        assert_eq!(duration("0s"), Ok(Duration::ZERO));
        for text in ["8761h", "4000000000000000h", "1e400h", "-1s", "s", "5", "5 s"] {
            assert!(duration(text).is_err(), "{text}");
        }
        assert_eq!(pause("100ms"), Ok(Duration::from_millis(100)));
        assert!(pause("0s").is_err() && pause("9ms").is_err());
    }
}
