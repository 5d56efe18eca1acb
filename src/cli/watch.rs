//! `viewrank watch`: the daemon's arguments and signals.

use std::{num::NonZeroUsize, path::PathBuf, process, thread, time::Duration};

use crate::{
    base::{
        error::{Advice, Hint},
        platform::{self, Request},
        shell::{command_path, shown_path},
    },
    config::{self, Bytes, CommandLineSettings},
    daemon::{
        PlanJob, PlanOptions, Signal, WatchOptions, Workers, platform as machine, serve,
        state::OnBusy, watch_roots,
    },
    io::output::Disk,
};
use clap::{Args, builder::PossibleValue};

use super::{
    Failure,
    arguments::number,
    log::{self, LogFormat},
    warn,
};

/// Least interval between scans of all projects.
const SHORTEST_PAUSE: Duration = Duration::from_millis(10);
/// Upper limit of every time on the command line.
const LONGEST: Duration = Duration::from_secs(365 * 24 * 3600);
/// Time from a stop signal to the end of the process.
const LONGEST_STOP: Duration = Duration::from_millis(1500);

/// Plan every project under some folders when its sparse model is complete, and follow the backend.
///
/// Runs until stopped (Ctrl-C or SIGTERM); SIGHUP scans all projects again. `viewrank status` shows
/// the state of each.
#[derive(Args)]
pub struct Arguments {
    /// Folders to watch, projects at any depth.
    #[arg(required = true, value_name = "ROOT")]
    roots: Vec<PathBuf>,
    /// A model is complete when its files have not changed for this time, such as 500ms, 2s or
    /// 1d6h.
    #[arg(long, default_value = "2s", value_parser = duration, value_name = "TIME")]
    settle: Duration,
    /// Scan all folders at this interval instead of waiting for file events [default: 10s on
    /// network file systems].
    #[arg(long, value_parser = pause, value_name = "TIME")]
    poll: Option<Duration>,
    /// Scan all folders at this interval as well, in case file events were lost.
    #[arg(long, default_value = "10min", value_parser = pause, value_name = "TIME")]
    rescan: Duration,
    /// Reaction to a model that changes while it is being planned.
    #[arg(long, default_value = "restart", value_name = "WHAT")]
    on_busy: OnBusy,
    /// Projects to plan at once.
    #[arg(long, default_value = "1", value_name = "N")]
    jobs: NonZeroUsize,
    /// Backends to plan and write for, over those of the projects' settings.
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    backend: Option<Vec<String>>,
    /// Matching partners per key view, over the projects' settings.
    #[arg(short, value_name = "N")]
    k: Option<String>,
    /// Share of what all view clusters reach to plan for, over the projects' settings.
    #[arg(long, value_name = "P%")]
    target: Option<String>,
    /// Memory for plans, such as 4G or 800M: a plan waits until there is room for all by the sizes
    /// of their models, and is refused if its own forecast is larger. With max_memory in its
    /// settings, it may do with less [default: half of this machine's memory].
    #[arg(long, value_name = "SIZE")]
    max_memory: Option<Bytes>,
    /// Follow symbolic links that lead out of the roots.
    #[arg(long)]
    follow_links: bool,
    /// Exit when every project is planned (for cron and CI), with code 1 if any failed.
    #[arg(long)]
    once: bool,
    /// Write metrics to this file, in the Prometheus text format.
    #[arg(long, value_name = "FILE")]
    metrics: Option<PathBuf>,
    /// Re-rank the remaining clusters as depth maps finish, by their measured quality; finished
    /// clusters stay first.
    #[arg(long)]
    replan: bool,
    /// Run this shell command once per project when its depth maps reach the target;
    /// VIEWRANK_PROJECT holds the project's folder [default: on_target of your own viewrank.toml; a
    /// project's own viewrank.toml may not set it].
    #[arg(long, value_name = "COMMAND", value_parser = clap::builder::NonEmptyStringValueParser::new())]
    on_target: Option<String>,
    /// Memory for keeping plans while their depth maps arrive; a larger cache recomputes fewer
    /// plans.
    #[arg(long, default_value = "256M", value_name = "SIZE")]
    cache: Bytes,
    /// Format of the log on standard error.
    #[arg(
        long,
        visible_alias = "format",
        default_value = "text",
        value_name = "FORMAT"
    )]
    log_format: LogFormat,
    /// Plan for the daemon that started this process with its own arguments.
    #[arg(long, hide = true)]
    worker: bool,
}

/// Name of the hidden option.
const WORKER: &str = "--worker";

pub fn run(arguments: Arguments) -> Result<(), Failure> {
    log::start(arguments.log_format);
    // Before any thread or worker starts, since these take it over.
    machine::lower_priority();
    let once = arguments.once;
    let on_target = arguments.on_target.clone();
    let planner = PlanJob::new(PlanOptions {
        on_target,
        replan: arguments.replan,
        // Each worker has its part.
        cache: arguments.cache.0 / arguments.jobs.get() as u64,
        roots: arguments.roots.clone(),
        typed: arguments.typed()?,
        follow_links: arguments.follow_links,
        is_run: false,
    });
    if arguments.worker {
        // The daemon asks to stop, and gets the signals, too.
        platform::on_signal(|_| {});
        serve(&planner, arguments.follow_links, || process::exit(0));
        return Ok(());
    }
    let options = arguments.options();
    let command = machine::this_program(WORKER).map_err(NoProgram)?;
    let planner = Workers::new(planner, command);
    let summary = watch_roots(&options, &planner, &Disk::REAL, forward_signals)?;
    if once && summary.projects == 0 {
        warn(&format!(
            "no project was found in {}",
            in_words(&options.roots)
        ));
    }
    match summary.failed {
        failed if failed > 0 && once => Err(WatchFailure {
            failed,
            projects: summary.projects,
            roots: options.roots,
        }
        .into()),
        _ => Ok(()),
    }
}

impl Arguments {
    /// Command-line options as settings, checked before anything is watched.
    fn typed(&self) -> Result<CommandLineSettings, Failure> {
        let mut typed = CommandLineSettings::default();
        let k = self.k.as_deref().map(number);
        typed.set("--backend", "backends", self.backend.clone());
        typed.set("-k", "partners.k", k);
        typed.set("--target", "cut.target", self.target.clone());
        super::config::load(None, typed.clone())?;
        Ok(typed)
    }

    fn options(self) -> WatchOptions {
        WatchOptions {
            roots: self.roots,
            settle: self.settle,
            poll: self.poll,
            rescan: self.rescan,
            on_busy: self.on_busy,
            jobs: self.jobs.get(),
            max_memory: self
                .max_memory
                .map_or_else(|| machine::machine_memory() / 2, |bytes| bytes.0),
            follow_links: self.follow_links,
            once: self.once,
            metrics: self.metrics,
        }
    }
}

#[derive(Debug, thiserror::Error)]
#[error("cannot find this program to start workers: {0}")]
struct NoProgram(std::io::Error);

impl Hint for NoProgram {
    fn hint(&self) -> Option<Advice> {
        Some("start it by its full path".into())
    }
}

#[derive(Debug, thiserror::Error)]
#[error("{failed} of {projects} projects could not be planned or exported")]
struct WatchFailure {
    failed: usize,
    projects: usize,
    /// The watched folders.
    roots: Vec<PathBuf>,
}

impl Hint for WatchFailure {
    fn hint(&self) -> Option<Advice> {
        let commands: Vec<String> = self
            .roots
            .iter()
            .map(|root| format!("viewrank status {}", command_path(root)))
            .collect();
        Some(format!("to see why: {}", commands.join(", ")).into())
    }
}

fn in_words(folders: &[PathBuf]) -> String {
    let shown: Vec<String> = folders.iter().map(|folder| shown_path(folder)).collect();
    shown.join(", ")
}

fn forward_signals(to_daemon: Box<dyn Fn(Signal) + Send>) {
    platform::on_signal(move |request| match request {
        Request::Rescan => to_daemon(Signal::Rescan),
        Request::Stop => {
            to_daemon(Signal::Stop);
            thread::spawn(end_in_time);
        }
    });
}

/// Exits even if a job has not noticed its cancellation yet (while reading a large file, say). Safe
/// because output files are complete at any instant.
fn end_in_time() {
    thread::sleep(LONGEST_STOP);
    process::exit(0);
}

/// Parses a time between two scans: a [`duration`] of at least 10 ms.
fn pause(text: &str) -> Result<Duration, String> {
    let pause = duration(text)?;
    if pause < SHORTEST_PAUSE {
        Err("at least 10ms".into())
    } else {
        Ok(pause)
    }
}

/// Parses a time as in the settings (`500ms`, `10min`, `1d6h`), at most a year.
fn duration(text: &str) -> Result<Duration, String> {
    let amount = text
        .parse::<config::TimeSpan>()
        .map_err(|error| error.to_string())?;
    // Compared before the conversion, which panics on what a clock cannot count.
    if amount.0 > LONGEST.as_secs_f64() {
        Err("at most 365d".into())
    } else {
        Ok(Duration::from_secs_f64(amount.0))
    }
}

impl clap::ValueEnum for OnBusy {
    fn value_variants<'a>() -> &'a [Self] {
        &[Self::Restart, Self::Queue]
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(match self {
            Self::Restart => PossibleValue::new("restart")
                .help("Cancel the plan and start again when the input has settled"),
            Self::Queue => PossibleValue::new("queue").help("Finish the plan, then plan once more"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_as_in_the_settings_up_to_a_year() {
        assert_eq!(duration("1.5min"), Ok(Duration::from_secs(90)));
        assert_eq!(duration("8760h"), Ok(LONGEST));
        assert_eq!(duration("1d6h"), Ok(Duration::from_secs(30 * 3600)));
        assert_eq!(duration("0s"), Ok(Duration::ZERO));
        for text in ["8761h", "4000000000000000h", "1e400h", "-1s", "s", "5"] {
            assert!(duration(text).is_err(), "{text}");
        }
        assert_eq!(pause("100ms"), Ok(Duration::from_millis(100)));
        assert!(pause("0s").is_err() && pause("9ms").is_err());
    }
}
